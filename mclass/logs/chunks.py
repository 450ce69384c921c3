"""One chunk at a time: decompressed, checked, its messages found as arrays.

Messages that stand in the file without a chunk are handled as if a chunk held them
(``Kind.LOOSE``), and so is what is left of a chunk that the end of the file cuts off.
"""

from __future__ import annotations

import enum
import zlib
from collections.abc import Callable, Iterator, Set
from dataclasses import dataclass, field

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from mcap.opcode import Opcode

from mclass.errors import LogError
from mclass.logs.source import Source
from mclass.logs.stores import StoreError
from mclass.logs.wire import (
    CHUNK_HEAD,
    MAX_RECORD,
    MESSAGE_HEAD,
    RECORD_HEAD,
    ChunkHead,
    MalformedError,
    MessageHeads,
    heads_at,
    lengths_at,
    message_index_offsets,
    opcodes_at,
    parse_chunk_head,
    record_head,
    walk,
)
from mclass.records import IntArray

_STEP = 1 << 26
_LONGEST_NAME = 32


class Kind(enum.Enum):
    """How messages lie in the file."""

    CHUNK = "chunk"
    LOOSE = "loose"
    CUT = "cut"


class State(enum.Enum):
    """What is known of a chunk's bytes, and so what becomes of them in a copy."""

    SOUND = "sound"
    RAGGED = "ragged"
    """Holds records that no reader can use among others: written anew without them."""
    BROKEN = "broken"
    """No reader gets anything out of it, and most stop at it: left out."""


@dataclass
class ChunkEntry:
    """Where a chunk is and what it holds, known without decompressing it.

    Attributes:
        kind: Chunk, run of loose records, or chunk cut off by the end of the file.
        offset: Of its first record in the file.
        length: Bytes of the chunk record, or of the run.
        start_time: Earliest log time [ns]; as the file says.
        end_time: Latest log time [ns].
        compression: Its name in MCAP; empty for none.
        compressed_size: Bytes of its data in the file.
        uncompressed_size: Bytes of its records.
        index_length: Bytes of the message indexes that follow it.
        index_offsets: Where in the file each channel's message index is.
        counts: Messages of each channel; None while unknown.
        lost: Whether it turned out that the content cannot be used.
        state: Whether a copy can take the bytes as they are.
    """

    kind: Kind
    offset: int
    length: int
    start_time: int
    end_time: int
    compression: str = ""
    compressed_size: int = 0
    uncompressed_size: int = 0
    index_length: int = 0
    index_offsets: dict[int, int] = field(default_factory=dict)
    counts: dict[int, int] | None = None
    lost: bool = False
    state: State = State.SOUND

    @property
    def messages(self) -> int | None:
        """Messages of all channels; None while unknown."""
        return None if self.counts is None else sum(self.counts.values())


@dataclass(frozen=True)
class ChunkContent:
    """A chunk's records.

    Attributes:
        data: Its bytes, decompressed.
        starts: Where message records begin in ``data``, increasing, (n,).
        heads: Their fields, (n,).
        definitions: Where schema and channel records begin.
        unusable: Bytes after the last whole record, and of messages too short to be any.
        indexed: Whether the chunk's message indexes lead to exactly these messages.
    """

    data: bytes
    starts: IntArray
    heads: MessageHeads
    definitions: tuple[int, ...]
    unusable: int
    indexed: bool

    def record(self, start: int) -> bytes:
        """The whole record at ``start``."""
        return self.data[start : start + RECORD_HEAD + record_head(self.data, start)[1]]

    def counts(self) -> dict[int, int]:
        """Messages of each channel."""
        channels, counts = np.unique(self.heads["channel"], return_counts=True)
        return dict(zip(channels.tolist(), counts.tolist(), strict=True))

    def rows_by_channel(self, wanted: Set[int]) -> Iterator[tuple[int, IntArray]]:
        """Rows of each wanted channel; the channel whose first row comes first, first."""
        channels = self.heads["channel"]
        present, firsts = np.unique(channels, return_index=True)
        for channel_id in present[np.argsort(firsts)].tolist():
            if channel_id in wanted:
                yield channel_id, np.flatnonzero(channels == channel_id)


@dataclass(frozen=True)
class CompressionUse:
    """Chunks of one compression: how many, and their bytes packed and unpacked."""

    chunks: int
    compressed_size: int
    uncompressed_size: int


class ChunkLostError(Exception):
    """A chunk cannot be used; the text ends a sentence that says so.

    ``broken`` tells that others cannot use it either.
    """

    def __init__(self, reason: str, *, broken: bool = True) -> None:
        self.broken = broken
        super().__init__(reason)


class IndexLiesError(Exception):
    """A chunk index disagrees with what is in its place."""


def read_chunk(source: Source, entry: ChunkEntry) -> ChunkContent:
    """Read, decompress and check one chunk.

    Raises:
        ChunkLostError: If its content cannot be trusted or cannot be had.
        StoreError: If a store fails: that is no damage of the log.
        IndexLiesError: If the entry came from a chunk index and another thing is there.
    """
    if entry.length > MAX_RECORD or entry.uncompressed_size > MAX_RECORD:
        raise ChunkLostError("it claims more than 1 GiB, which no chunk needs")
    try:
        return _read_chunk(source, entry)
    except StoreError:
        raise
    except LogError as error:
        raise ChunkLostError(f"the disk fails ({error})") from error
    except MemoryError:
        raise ChunkLostError("it needs more memory than there is", broken=False) from None


def _read_chunk(source: Source, entry: ChunkEntry) -> ChunkContent:
    record = source.read(entry.offset, entry.length + entry.index_length)
    if entry.kind is Kind.LOOSE:
        return _by_walking(record)
    head = _checked_head(record, entry)
    packed = memoryview(record)[head.data_offset : head.data_offset + head.compressed_size]
    data = decompress(head.compression, packed, head.uncompressed_size)
    if entry.kind is Kind.CUT and len(data) < head.uncompressed_size:
        return _by_walking(data)
    if len(data) != head.uncompressed_size:
        raise ChunkLostError("its data decompresses to another size than it says")
    if head.uncompressed_crc and zlib.crc32(data) != head.uncompressed_crc:
        raise ChunkLostError("its checksum does not match")
    indexed = _by_message_index(data, record[entry.length :])
    return _by_walking(data) if indexed is None else indexed


def decompress(compression: str, data: memoryview, size: int) -> bytes:
    """At most ``size + 1`` bytes out of ``data``; fewer if it is cut off.

    Memory follows what comes out, not what ``size`` claims.

    Raises:
        ChunkLostError: If the compression is unknown or the data is broken.
    """
    if compression == "":
        return bytes(data)
    take: Callable[[int], bytes]
    if compression == "zstd":
        take = zstandard.ZstdDecompressor().stream_reader(data).read
    elif compression == "lz4":
        take = _lz4_taker(data)
    else:
        reason = f"its compression {compression!r} is not known; known: lz4, zstd"
        raise ChunkLostError(reason, broken=False)
    pieces = []
    missing = size + 1
    try:
        while missing > 0 and (piece := take(min(missing, _STEP))):
            pieces.append(piece)
            missing -= len(piece)
    except (zstandard.ZstdError, RuntimeError, EOFError):
        raise ChunkLostError("its compressed data is broken") from None
    return pieces[0] if len(pieces) == 1 else b"".join(pieces)


def _lz4_taker(data: memoryview) -> Callable[[int], bytes]:
    decompressor = lz4.frame.LZ4FrameDecompressor()
    pending: list[memoryview | bytes] = [data]

    def take(length: int) -> bytes:
        if decompressor.eof:
            return b""
        fresh = pending.pop() if pending else b""
        piece: bytes = decompressor.decompress(fresh, max_length=length)
        return piece

    return take


def _checked_head(record: bytes, entry: ChunkEntry) -> ChunkHead:
    try:
        _, length = record_head(record)
        head = parse_chunk_head(
            record[: RECORD_HEAD + CHUNK_HEAD + _LONGEST_NAME], any_length=entry.kind is Kind.CUT
        )
    except MalformedError:
        raise IndexLiesError from None
    agrees = (
        length + RECORD_HEAD == entry.length
        and head.compression == entry.compression
        and head.uncompressed_size == entry.uncompressed_size
    )
    if not agrees and entry.kind is Kind.CHUNK:
        raise IndexLiesError
    return head


def _by_message_index(data: bytes, index_records: bytes) -> ChunkContent | None:
    """Messages by the chunk's message indexes, if these are right.

    They are right when every entry leads to a message record and these, together with the
    records of other kinds between them, fill the chunk without gap or overlap.
    """
    starts = message_index_offsets(index_records)
    if starts is None or not len(starts) or starts[-1] + MESSAGE_HEAD > len(data):
        return None
    heads = heads_at(data, starts)
    lengths = heads["length"]
    if (heads["opcode"] != Opcode.MESSAGE).any() or (lengths > len(data)).any():
        return None
    ends = starts + RECORD_HEAD + lengths.astype(np.int64)
    gap_starts = np.append(0, ends)
    gap_ends = np.append(starts, len(data))
    if (gap_starts > gap_ends).any() or (lengths < MESSAGE_HEAD - RECORD_HEAD).any():
        return None
    definitions: list[int] = []
    for gap in np.flatnonzero(gap_starts != gap_ends):
        start, end = int(gap_starts[gap]), int(gap_ends[gap])
        others, stop = walk(data[start:end])
        opcodes = opcodes_at(data, others + start)
        if stop != end - start or (opcodes == Opcode.MESSAGE).any():
            return None
        definitions.extend((others + start)[_is_definition(opcodes)].tolist())
    return ChunkContent(data, starts, heads, tuple(definitions), 0, indexed=True)


def _by_walking(data: bytes) -> ChunkContent:
    """Messages by going from record to record."""
    records, stop = walk(data)
    opcodes = opcodes_at(data, records)
    starts = records[opcodes == Opcode.MESSAGE]
    lengths = lengths_at(data, starts)
    long_enough = lengths >= MESSAGE_HEAD - RECORD_HEAD
    short = int((lengths[~long_enough] + RECORD_HEAD).sum())
    starts = starts[long_enough]
    definitions = tuple(records[_is_definition(opcodes)].tolist())
    unusable = len(data) - stop + short
    return ChunkContent(data, starts, heads_at(data, starts), definitions, unusable, indexed=False)


def _is_definition(
    opcodes: np.ndarray[tuple[int], np.dtype[np.uint8]],
) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    return np.asarray((opcodes == Opcode.SCHEMA) | (opcodes == Opcode.CHANNEL))
