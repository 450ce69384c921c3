"""Writing MCAP logs: another log's data carried over as it is, then new channels.

The data section of the source is copied byte for byte, neither decoded nor compressed again;
new chunks, attachments and metadata follow, then one summary over old and new. Of a log that
is not whole, all that holds is carried over:

- Whole records are copied as they are; chunks are not opened for that.
- A chunk that proved broken when it was read is left out, since most readers stop at it. What
  it defined is written in its place. (A chunk of a compression that we do not know is kept.)
- Bytes that are no records are left out, since a reader could not get past them.
- Messages outside of chunks are put into uncompressed chunks of their own, record for record
  the same, because a log with both would hide them from readers that go by the chunk index.
  Likewise the whole messages of a chunk that the end of the file cuts off, that has a wrong
  length or in which broken records stand among others.
- Attachments and metadata stay even if new ones bear the same name; readers such as
  ``LogReader`` give the last one.

The checksum of the data section is written when it costs nothing: for a new log, and for a
copied one whose own checksum is there to be continued. Else it is 0, "not available": it would
mean to read all that is otherwise copied inside the kernel.
"""

from __future__ import annotations

import bisect
import dataclasses
import itertools
import struct
import zlib
from collections.abc import Callable, Mapping, Sequence, Set
from pathlib import Path
from types import TracebackType

import numpy as np
import zstandard
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    ChunkIndex,
    DataEnd,
    Header,
    Metadata,
    MetadataIndex,
)

from mclass.errors import LogError
from mclass.logs.chunks import ChunkEntry, ChunkLostError, Kind, State, read_chunk
from mclass.logs.closing import Contents, record_bytes
from mclass.logs.in_place import InPlaceFile
from mclass.logs.pending import PendingFile
from mclass.logs.reader import LogReader
from mclass.logs.source import MAGIC
from mclass.logs.uploads import UploadFile, pending_file
from mclass.logs.wire import (
    MESSAGE_HEAD,
    RECORD_HEAD,
    ChunkHead,
    heads_at,
    opcodes_at,
    pack_chunk_head,
    pack_message_index,
    pack_record,
    pack_string,
    walk,
)
from mclass.places import PlaceLike, place_of
from mclass.records import IntArray

_LIBRARY = "mclass"
_CHUNK_BYTES = 1 << 20
_MAX_TIME = (1 << 64) - 1
_MAX_ID = (1 << 16) - 1
_HIDDEN_IDS = (1 << 15) - 1
_pack_message_head = struct.Struct("<BQHIQQ").pack


class _Ids:
    """Numbers for channels or schemas that no other bears.

    Args:
        taken: In use.
        hidden: The first numbers are taken after this one, and those up to it last.
    """

    def __init__(self, taken: Set[int], hidden: int = 0) -> None:
        last = max(hidden, *taken, 0)
        numbers = itertools.chain(range(last + 1, _MAX_ID + 1), range(1, last + 1))
        self._free = (number for number in numbers if number not in taken)

    def next(self) -> int:
        """A free number; raises StopIteration when there is none."""
        return next(self._free)


class LogWriter:
    """A log being written; a context manager.

    Under its name appears either the complete log, when the ``with`` block ends well, or
    nothing. The same calls give the same bytes.

    Args:
        output: Path of the log, or its URL.
        source: Log whose data is carried over first; None for a new log.
        profile: Of a new log; a source keeps its own.
        overwrite: Whether a file of that name may be replaced.
        carry_over: False for a log of the new data alone; the source is then only protected.
        in_place: Append to the source itself; the output is its path.
        progress: Called with bytes copied and bytes in all while the source is carried over.

    Raises:
        LogError: If the output cannot or may not be written, or is the source itself.
    """

    def __init__(
        self,
        output: PlaceLike,
        *,
        source: LogReader | None = None,
        profile: str = "",
        overwrite: bool = False,
        carry_over: bool = True,
        in_place: bool = False,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        self.path = place_of(output)
        self._source = source if carry_over else None
        self._profile = profile
        self._progress = progress
        self._file: PendingFile | UploadFile | InPlaceFile
        if in_place:
            assert source is not None
            _refuse_broken(source)
            self._file = InPlaceFile(Path(str(self.path)), source.index.data_end)
        else:
            reader_source = None if source is None else source.source
            self._file = pending_file(self.path, overwrite=overwrite, source=reader_source)
        self._position = 0
        self._crc: int | None = 0
        self._contents = Contents()
        self._known_schemas: dict[tuple[str, str, bytes], int] = {}
        self._sequences: dict[int, int] = {}
        self._schema_ids, self._channel_ids = _Ids(set()), _Ids(set())
        self._chunk = bytearray()
        self._starts: list[int] = []

    def __enter__(self) -> LogWriter:
        try:
            self._file.open()
            self._emit(MAGIC)
            if self._source is None or not self._source.index.has_header:
                self._emit(record_bytes(Header(self._profile, _LIBRARY)))
            if self._source is not None:
                self._carry_over(self._source)
        except BaseException:
            self._file.discard()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if kind is None:
                self._finish()
                self._file.publish()
        finally:
            self._file.discard()

    def add_channel(
        self,
        topic: str,
        message_encoding: str,
        schema_name: str,
        schema_encoding: str,
        schema_data: bytes,
        metadata: Mapping[str, str] | None = None,
    ) -> int:
        """Add a channel; an equal schema already in the log is used again.

        Args:
            topic: Name; not compared with the topics that the log has.
            message_encoding: Of its messages.
            schema_name: Message type; empty for a channel without schema.
            schema_encoding: Of the schema.
            schema_data: The schema.
            metadata: Of the channel.

        Returns:
            The channel's id, for ``write``.

        Raises:
            LogError: If the log has as many channels as the format allows.
        """
        try:
            schema_id = self._schema_id(schema_name, schema_encoding, schema_data)
            channel_id = self._channel_ids.next()
        except StopIteration:
            raise LogError(
                f"there is no number left for {topic}: MCAP allows 65,535 channels and schemas.",
                path=str(self.path),
            ) from None
        pairs = b"".join(
            pack_string(key) + pack_string(value) for key, value in (metadata or {}).items()
        )
        content = struct.pack("<HH", channel_id, schema_id)
        content += pack_string(topic) + pack_string(message_encoding)
        record = pack_record(Opcode.CHANNEL, content + struct.pack("<I", len(pairs)) + pairs)
        self._contents.channels[channel_id] = record
        self._sequences[channel_id] = 0
        self._chunk += record
        return channel_id

    def write(
        self,
        channel_id: int,
        log_time_ns: int,
        data: bytes | bytearray | memoryview,
        publish_time_ns: int | None = None,
    ) -> None:
        """Add a message to a channel of ``add_channel``.

        Args:
            channel_id: The channel.
            log_time_ns: Log time [ns].
            data: The message.
            publish_time_ns: Publish time [ns]; the log time when left out.

        Raises:
            LogError: If a time is out of range, or the disk is full or fails.
        """
        publish_time = log_time_ns if publish_time_ns is None else publish_time_ns
        if not (0 <= log_time_ns <= _MAX_TIME and 0 <= publish_time <= _MAX_TIME):
            raise LogError(
                f"a message cannot have the time {log_time_ns} ns (log) or {publish_time} ns "
                "(publish): MCAP times start at 1970.",
                path=str(self.path),
            )
        if self._chunk and len(self._chunk) + len(data) > _CHUNK_BYTES:
            self._flush_chunk()
        sequence = self._sequences[channel_id]
        self._sequences[channel_id] = sequence + 1
        self._starts.append(len(self._chunk))
        self._chunk += _pack_message_head(
            Opcode.MESSAGE,
            MESSAGE_HEAD - RECORD_HEAD + len(data),
            channel_id,
            sequence,
            log_time_ns,
            publish_time,
        )
        self._chunk += data

    def attach(self, name: str, media_type: str, data: bytes, log_time_ns: int) -> None:
        """Add an attachment; ``log_time_ns`` [ns] is its creation time, too.

        Raises:
            LogError: If the disk is full or fails.
        """
        record = record_bytes(Attachment(log_time_ns, log_time_ns, name, media_type, data))
        self._contents.attachments.append(
            AttachmentIndex(
                offset=self._position,
                length=len(record),
                log_time=log_time_ns,
                create_time=log_time_ns,
                data_size=len(data),
                name=name,
                media_type=media_type,
            )
        )
        self._emit(record)

    def add_metadata(self, name: str, pairs: Mapping[str, str]) -> None:
        """Add a metadata record.

        Raises:
            LogError: If the disk is full or fails.
        """
        record = record_bytes(Metadata(name, dict(pairs)))
        self._contents.metadata.append(MetadataIndex(self._position, len(record), name))
        self._emit(record)

    def _emit(self, data: bytes | bytearray | memoryview) -> None:
        self._file.write(data)
        self._position += len(data)
        if self._crc is not None:
            self._crc = zlib.crc32(data, self._crc)

    def _carry_over(self, reader: LogReader) -> None:
        """Copy the source's data section and take over its index."""
        index = reader.index
        contents = self._contents
        contents.schemas = {key: index.schemas[key].raw for key in sorted(index.schemas)}
        contents.channels = {key: index.channels[key].raw for key in sorted(index.channels)}
        self._known_schemas = {
            (schema.name, schema.encoding, schema.data): schema.id
            for schema in index.schemas.values()
            if schema.id
        }
        counted = {channel for entry in index.chunks for channel in entry.counts or ()}
        # Ids may be in use that nothing readable defines: keep clear of them, or messages whose
        # channel is lost would turn up in a new one.
        told = index.summarised and all(map(index.defines, counted))
        hidden = 0 if told else _HIDDEN_IDS
        self._channel_ids = _Ids({*index.channels, *counted}, hidden)
        named = {channel.schema_id for channel in index.channels.values()}
        self._schema_ids = _Ids({*index.schemas, *named}, hidden)

        shifts = self._copy_records(reader)
        for entry in index.chunks:
            if _is_copied(entry):
                contents.add_chunk(_moved(entry, shifts(entry.offset)), entry.counts or {})
        contents.chunks.sort(key=lambda chunk: chunk.chunk_start_offset)
        for attachment in index.attachments:
            offset = attachment.offset + shifts(attachment.offset)
            contents.attachments.append(dataclasses.replace(attachment, offset=offset))
        for metadata in index.metadata:
            offset = metadata.offset + shifts(metadata.offset)
            contents.metadata.append(dataclasses.replace(metadata, offset=offset))

    def _copy_records(self, reader: LogReader) -> Callable[[int], int]:
        """Copy whole records; returns by how many bytes each place of the source moved."""
        index = reader.index
        anew = [entry for entry in index.chunks if not _is_copied(entry)]
        kept = _without(
            index.kept,
            [
                (e.offset, e.offset + e.length + e.index_length)
                for e in anew
                if e.kind is Kind.CHUNK
            ],
        )
        pieces: list[tuple[int, int, ChunkEntry | None]] = [
            *((start, end, None) for start, end in kept),
            *((entry.offset, entry.offset + entry.length, entry) for entry in anew),
        ]
        starts, shifts = [], []
        whole = kept == [(len(MAGIC), index.data_end)]
        # What the kernel copies is never seen here: continue the source's checksum or have none.
        self._crc = (index.data_crc or None) if whole else None
        for start, end, entry in sorted(pieces, key=lambda piece: piece[0]):
            if entry is not None:
                self._wrap(reader, entry)
                continue
            starts.append(start)
            shifts.append(self._position - start)
            self._file.copy(reader.source, start, end, self._report)
            self._position += end - start
        return lambda offset: shifts[bisect.bisect_right(starts, offset) - 1]

    def _report(self, position: int) -> None:
        if self._progress is not None and self._source is not None:
            self._progress(position, self._source.index.data_end)

    def _wrap(self, reader: LogReader, entry: ChunkEntry) -> None:
        """Write messages that stand in no whole chunk as a chunk, records unchanged."""
        try:
            content = read_chunk(reader.source, entry)
        except ChunkLostError:
            # It may have defined what follows. Where definitions contradict each other, one more
            # would give messages behind it to another channel.
            disputed = reader.index.disputed
            for opcode, records in (
                (Opcode.SCHEMA, self._contents.schemas),
                (Opcode.CHANNEL, self._contents.channels),
            ):
                self._emit(
                    b"".join(raw for key, raw in records.items() if (opcode, key) not in disputed)
                )
            return
        known = np.isin(content.heads["channel"], list(self._contents.channels))
        if known.all() and not content.unusable:
            self._write_chunk(content.data, content.starts, "")
            return
        kept = [*content.starts[known].tolist(), *content.definitions]
        data = b"".join(content.record(start) for start in sorted(kept))
        starts, _ = walk(data)
        self._write_chunk(data, starts[opcodes_at(data, starts) == Opcode.MESSAGE], "")

    def _schema_id(self, name: str, encoding: str, data: bytes) -> int:
        if not name:
            return 0
        known = self._known_schemas.get((name, encoding, data))
        if known is not None:
            return known
        schema_id = self._schema_ids.next()
        content = struct.pack("<H", schema_id) + pack_string(name) + pack_string(encoding)
        record = pack_record(Opcode.SCHEMA, content + struct.pack("<I", len(data)) + data)
        self._contents.schemas[schema_id] = record
        self._known_schemas[name, encoding, data] = schema_id
        self._chunk += record
        return schema_id

    def _flush_chunk(self) -> None:
        data = bytes(self._chunk)
        starts = np.array(self._starts, dtype=np.int64)
        self._chunk, self._starts = bytearray(), []
        if len(starts):
            self._write_chunk(data, starts, "zstd")
        else:
            # Definitions alone: an empty chunk would say nothing more.
            self._emit(data)

    def _write_chunk(self, data: bytes, starts: IntArray, compression: str) -> None:
        """Write records as a chunk with its message indexes; nothing if there are no messages."""
        if not len(starts):
            self._emit(data)
            return
        heads = heads_at(data, starts)
        times = heads["log_time"]
        packed = zstandard.ZstdCompressor().compress(data) if compression else data
        head = ChunkHead(
            int(times.min()),
            int(times.max()),
            len(data),
            zlib.crc32(data),
            compression,
            0,
            len(packed),
        )
        offset = self._position
        self._emit(pack_chunk_head(head))
        self._emit(packed)
        length = self._position - offset
        places, counts = {}, {}
        for channel in np.unique(heads["channel"]).tolist():
            rows = np.flatnonzero(heads["channel"] == channel)
            places[channel], counts[channel] = self._position, len(rows)
            self._emit(pack_message_index(channel, times[rows], starts[rows]))
        chunk = ChunkIndex(
            chunk_length=length,
            chunk_start_offset=offset,
            compression=compression,
            compressed_size=len(packed),
            message_end_time=head.end_time,
            message_index_length=self._position - offset - length,
            message_index_offsets=places,
            message_start_time=head.start_time,
            uncompressed_size=len(data),
        )
        self._contents.add_chunk(chunk, counts)

    def _finish(self) -> None:
        if self._chunk:
            self._flush_chunk()
        self._emit(record_bytes(DataEnd(self._crc or 0)))
        self._contents.write_end(self._file.write, self._position)


def _is_copied(entry: ChunkEntry) -> bool:
    """Whether a copy takes the chunk's bytes as they are."""
    return entry.kind is Kind.CHUNK and entry.state is State.SOUND


def _without(
    ranges: Sequence[tuple[int, int]], holes: Sequence[tuple[int, int]]
) -> list[tuple[int, int]]:
    """Ranges of bytes without those of the holes, which lie in them; both in file order."""
    left = []
    waiting = list(reversed(holes))
    for start, end in ranges:
        begin = start
        while waiting and waiting[-1][0] < end:
            hole_start, hole_end = waiting.pop()
            if hole_start > begin:
                left.append((begin, hole_start))
            begin = hole_end
        if end > begin:
            left.append((begin, end))
    return left


def _refuse_broken(reader: LogReader) -> None:
    """Refuse to append to a log that would have to be mended first."""
    index = reader.index
    whole = index.has_header and index.kept == [(len(MAGIC), index.data_end)]
    if reader.damage.losses or not whole or not all(map(_is_copied, index.chunks)):
        raise LogError(
            "is damaged, so nothing is appended to it. Write a mended copy, without --in-place.",
            path=str(reader.path),
        )


def _moved(entry: ChunkEntry, shift: int) -> ChunkIndex:
    """Chunk index of a copied chunk."""
    return ChunkIndex(
        chunk_length=entry.length,
        chunk_start_offset=entry.offset + shift,
        compression=entry.compression,
        compressed_size=entry.compressed_size,
        message_end_time=entry.end_time,
        message_index_length=entry.index_length,
        message_index_offsets={
            channel: offset + shift for channel, offset in entry.index_offsets.items()
        },
        message_start_time=entry.start_time,
        uncompressed_size=entry.uncompressed_size,
    )
