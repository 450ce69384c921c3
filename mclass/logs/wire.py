"""MCAP records as bytes: bounded parsing, and arrays over many messages at once.

Nothing here trusts a length: reading past the end of a record raises ``MalformedError``.
Indexes are returned as the record classes of ``mcap``; schemas and channels keep their bytes,
so that they are written again exactly as they came.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, ChunkIndex, MetadataIndex, Statistics

from mclass.records import IntArray

RECORD_HEAD = 9
"""Bytes before a record's content: opcode and length."""
MESSAGE_HEAD = 31
"""Bytes of a message record before its payload."""
CHUNK_HEAD = 40
"""Bytes of a chunk's content without the compression's name and the data."""
MAX_RECORD = 1 << 30
"""Larger chunks and records are refused: no real one is, and they would not fit in memory."""

MESSAGE_DTYPE = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
_HEAD_DTYPE = np.dtype([("opcode", "u1"), ("length", "<u8")])
_INDEX_ENTRY_DTYPE = np.dtype([("log_time", "<u8"), ("offset", "<u8")])

_unpack_head = struct.Struct("<BQ").unpack_from

MessageHeads = npt.NDArray[np.void]
"""Array of ``MESSAGE_DTYPE``."""


class MalformedError(Exception):
    """Bytes that cannot be the record they claim to be."""


@dataclass(frozen=True)
class SchemaRecord:
    """A schema; ``raw`` is the whole record."""

    id: int
    name: str
    encoding: str
    data: bytes
    raw: bytes


@dataclass(frozen=True)
class ChannelRecord:
    """A channel; ``raw`` is the whole record."""

    id: int
    schema_id: int
    topic: str
    message_encoding: str
    metadata: Mapping[str, str]
    raw: bytes


@dataclass(frozen=True)
class ChunkHead:
    """What stands before a chunk's data. ``data_offset`` counts from the record's start."""

    start_time: int
    end_time: int
    uncompressed_size: int
    uncompressed_crc: int
    compression: str
    data_offset: int
    compressed_size: int


class Cursor:
    """Reads fields one after another from ``data[position:end]``."""

    def __init__(self, data: bytes, position: int = 0, end: int | None = None) -> None:
        self.data = data
        self.position = position
        self.end = len(data) if end is None else min(end, len(data))

    def take(self, length: int) -> bytes:
        """The next ``length`` bytes."""
        start, stop = self.position, self.position + length
        if stop > self.end:
            raise MalformedError(f"{length} bytes wanted, {self.end - start} left")
        self.position = stop
        return self.data[start:stop]

    def u16(self) -> int:
        """The next two bytes as an unsigned integer."""
        return int.from_bytes(self.take(2), "little")

    def u32(self) -> int:
        """The next four bytes as an unsigned integer."""
        return int.from_bytes(self.take(4), "little")

    def u64(self) -> int:
        """The next eight bytes as an unsigned integer."""
        return int.from_bytes(self.take(8), "little")

    def string(self) -> str:
        """A length and that many bytes of UTF-8; broken characters become U+FFFD."""
        return self.take(self.u32()).decode("utf-8", "replace")

    def string_map(self) -> dict[str, str]:
        """Pairs of strings up to a length in bytes."""
        length = self.u32()
        inner = Cursor(self.data, self.position, self.position + length)
        self.take(length)
        pairs = {}
        while inner.position < inner.end:
            key = inner.string()
            pairs[key] = inner.string()
        return pairs

    def integer_map(self) -> dict[int, int]:
        """Pairs of channel id and 64-bit integer up to a length in bytes."""
        content = self.take(self.u32())
        if len(content) % 10:
            raise MalformedError("a map of channels with half a pair")
        return dict(struct.iter_unpack("<HQ", content))


def record_head(data: bytes, offset: int = 0) -> tuple[int, int]:
    """Opcode and content length of the record at ``offset``."""
    if offset + RECORD_HEAD > len(data):
        raise MalformedError("a record cut within its first bytes")
    opcode, length = _unpack_head(data, offset)
    return opcode, length


def content_of(record: bytes, opcode: int) -> Cursor:
    """Cursor over the content of a whole record, which must have that opcode."""
    found, length = record_head(record)
    if found != opcode or RECORD_HEAD + length > len(record):
        raise MalformedError(f"no whole record of kind {opcode:#04x}")
    return Cursor(record, RECORD_HEAD, RECORD_HEAD + length)


def parse_header(record: bytes) -> tuple[str, str]:
    """Profile and library."""
    cursor = content_of(record, Opcode.HEADER)
    return cursor.string(), cursor.string()


def parse_schema(record: bytes) -> SchemaRecord:
    """A whole schema record."""
    cursor = content_of(record, Opcode.SCHEMA)
    schema_id = cursor.u16()
    name, encoding = cursor.string(), cursor.string()
    return SchemaRecord(schema_id, name, encoding, cursor.take(cursor.u32()), record)


def parse_channel(record: bytes) -> ChannelRecord:
    """A whole channel record."""
    cursor = content_of(record, Opcode.CHANNEL)
    channel_id, schema_id = cursor.u16(), cursor.u16()
    topic, encoding = cursor.string(), cursor.string()
    return ChannelRecord(channel_id, schema_id, topic, encoding, cursor.string_map(), record)


def parse_chunk_head(start: bytes, *, any_length: bool = False) -> ChunkHead:
    """The first bytes of a chunk record (up to ``CHUNK_HEAD`` and a short name are enough).

    Args:
        start: The bytes.
        any_length: Whether the record's length may contradict the sizes within.

    Raises:
        MalformedError: If its sizes contradict each other.
    """
    opcode, length = record_head(start)
    cursor = Cursor(start, RECORD_HEAD)
    head = (cursor.u64(), cursor.u64(), cursor.u64(), cursor.u32())
    name_length = cursor.u32()
    if opcode != Opcode.CHUNK or name_length > 32:
        raise MalformedError("not a chunk")
    compression = cursor.take(name_length).decode("utf-8", "replace")
    size = cursor.u64()
    if CHUNK_HEAD + name_length + size > length and not any_length:
        raise MalformedError("a chunk whose data is longer than itself")
    return ChunkHead(*head, compression, cursor.position, size)


def parse_chunk_index(record: bytes) -> ChunkIndex:
    """A whole chunk index record."""
    cursor = content_of(record, Opcode.CHUNK_INDEX)
    start_time, end_time, offset, length = (cursor.u64() for _ in range(4))
    return ChunkIndex(
        message_start_time=start_time,
        message_end_time=end_time,
        chunk_start_offset=offset,
        chunk_length=length,
        message_index_offsets=cursor.integer_map(),
        message_index_length=cursor.u64(),
        compression=cursor.string(),
        compressed_size=cursor.u64(),
        uncompressed_size=cursor.u64(),
    )


def parse_attachment_index(record: bytes) -> AttachmentIndex:
    """A whole attachment index record."""
    cursor = content_of(record, Opcode.ATTACHMENT_INDEX)
    offset, length, log_time, create_time, size = (cursor.u64() for _ in range(5))
    name, media_type = cursor.string(), cursor.string()
    return AttachmentIndex(offset, length, log_time, create_time, size, name, media_type)


def parse_attachment_head(start: bytes, offset: int) -> tuple[AttachmentIndex, int]:
    """Index of the attachment record at ``offset`` and where its data begins within it.

    Args:
        start: The record's first bytes, names included.
        offset: The record's place in the file.
    """
    opcode, length = record_head(start)
    if opcode != Opcode.ATTACHMENT:
        raise MalformedError("not an attachment")
    cursor = Cursor(start, RECORD_HEAD)
    log_time, create_time = cursor.u64(), cursor.u64()
    name, media_type = cursor.string(), cursor.string()
    size = cursor.u64()
    if cursor.position + size + 4 > RECORD_HEAD + length:
        raise MalformedError("an attachment whose data is longer than itself")
    index = AttachmentIndex(
        offset, RECORD_HEAD + length, log_time, create_time, size, name, media_type
    )
    return index, cursor.position


def parse_metadata_index(record: bytes) -> MetadataIndex:
    """A whole metadata index record."""
    cursor = content_of(record, Opcode.METADATA_INDEX)
    return MetadataIndex(cursor.u64(), cursor.u64(), cursor.string())


def parse_metadata(record: bytes) -> tuple[str, dict[str, str]]:
    """Name and pairs of a whole metadata record."""
    cursor = content_of(record, Opcode.METADATA)
    return cursor.string(), cursor.string_map()


def parse_statistics(record: bytes) -> Statistics:
    """A whole statistics record."""
    cursor = content_of(record, Opcode.STATISTICS)
    return Statistics(
        message_count=cursor.u64(),
        schema_count=cursor.u16(),
        channel_count=cursor.u32(),
        attachment_count=cursor.u32(),
        metadata_count=cursor.u32(),
        chunk_count=cursor.u32(),
        message_start_time=cursor.u64(),
        message_end_time=cursor.u64(),
        channel_message_counts=cursor.integer_map(),
    )


def walk(data: bytes) -> tuple[IntArray, int]:
    """Starts of the whole records that follow one another in ``data``, and where they stop."""
    starts = array("q")
    position, last = 0, len(data) - RECORD_HEAD
    while position <= last:
        opcode, length = _unpack_head(data, position)
        following = position + RECORD_HEAD + length
        # No record has the opcode 0; without this test zeros would be records without end.
        if following > len(data) or not opcode:
            break
        starts.append(position)
        position = following
    return np.array(starts, dtype=np.int64), position


def heads_at(data: bytes, starts: IntArray) -> MessageHeads:
    """Heads of the message records at ``starts``, each ``MESSAGE_HEAD`` bytes within ``data``."""
    return _overlapping(data, MESSAGE_DTYPE)[starts]


def opcodes_at(data: bytes, starts: IntArray) -> npt.NDArray[np.uint8]:
    """Opcodes of the records at ``starts``."""
    opcodes: npt.NDArray[np.uint8] = _overlapping(data, _HEAD_DTYPE)["opcode"][starts]
    return opcodes


def lengths_at(data: bytes, starts: IntArray) -> IntArray:
    """Content lengths of the records at ``starts``, which end within ``data``."""
    return _overlapping(data, _HEAD_DTYPE)["length"][starts].astype(np.int64)


def _overlapping(data: bytes, dtype: np.dtype[np.void]) -> npt.NDArray[np.void]:
    """A view of ``data`` whose element ``i`` begins at byte ``i``."""
    count = max(len(data) - dtype.itemsize + 1, 0)
    if not count:
        return np.empty(0, dtype)
    return np.ndarray((count,), dtype, buffer=data, strides=(1,))


def message_index_offsets(data: bytes) -> IntArray | None:
    """Sorted offsets in the message index records of ``data``; None if they are broken."""
    pieces = []
    position = 0
    while position < len(data):
        try:
            opcode, length = record_head(data, position)
        except MalformedError:
            return None
        size = length - 6
        following = position + RECORD_HEAD + length
        if opcode != Opcode.MESSAGE_INDEX or size < 0 or size % 16 or following > len(data):
            return None
        start = position + RECORD_HEAD + 6
        entries = np.frombuffer(data, _INDEX_ENTRY_DTYPE, size // 16, start)
        pieces.append(entries["offset"])
        position = following
    if not pieces:
        return None
    offsets = np.concatenate(pieces)
    if len(offsets) and offsets.max() >= np.uint64(MAX_RECORD):
        return None
    return np.sort(offsets.astype(np.int64))


def pack_record(opcode: int, content: bytes) -> bytes:
    """A whole record."""
    return struct.pack("<BQ", opcode, len(content)) + content


def pack_string(text: str) -> bytes:
    """A length and the text in UTF-8."""
    encoded = text.encode("utf-8", "replace")
    return len(encoded).to_bytes(4, "little") + encoded


def pack_chunk_head(head: ChunkHead) -> bytes:
    """All of a chunk record that precedes its data."""
    content = struct.pack(
        "<QQQI", head.start_time, head.end_time, head.uncompressed_size, head.uncompressed_crc
    )
    content += pack_string(head.compression) + head.compressed_size.to_bytes(8, "little")
    return struct.pack("<BQ", Opcode.CHUNK, len(content) + head.compressed_size) + content


def pack_message_index(channel: int, log_times: npt.NDArray[np.uint64], offsets: IntArray) -> bytes:
    """A message index record of one channel."""
    entries = np.empty(len(offsets), _INDEX_ENTRY_DTYPE)
    entries["log_time"] = log_times
    entries["offset"] = offsets
    content = struct.pack("<HI", channel, entries.nbytes) + entries.tobytes()
    return pack_record(Opcode.MESSAGE_INDEX, content)


def pack_chunk_index(index: ChunkIndex) -> bytes:
    """A chunk index record; as the ``mcap`` record writes it, but in one go."""
    pairs = [number for pair in index.message_index_offsets.items() for number in pair]
    content = struct.pack(
        f"<QQQQI{'HQ' * (len(pairs) // 2)}Q",
        index.message_start_time,
        index.message_end_time,
        index.chunk_start_offset,
        index.chunk_length,
        10 * (len(pairs) // 2),
        *pairs,
        index.message_index_length,
    )
    content += pack_string(index.compression)
    content += struct.pack("<QQ", index.compressed_size, index.uncompressed_size)
    return pack_record(Opcode.CHUNK_INDEX, content)
