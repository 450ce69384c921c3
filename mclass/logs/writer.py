"""Writing MCAP logs: another log's data carried over as it is, then new channels.

New chunks, attachments and metadata follow what `mclass.logs.carry_over` copies, then one
summary over old and new.
"""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable, Mapping, Set
from pathlib import Path
from types import TracebackType

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, DataEnd, Header, Metadata, MetadataIndex

from mclass.errors import LogError
from mclass.logs.carry_over import carry_over, is_copied
from mclass.logs.closing import record_bytes
from mclass.logs.in_place import InPlaceFile
from mclass.logs.pending import PendingFile
from mclass.logs.reader import LogReader
from mclass.logs.section import DataSection
from mclass.logs.source import MAGIC
from mclass.logs.uploads import UploadFile, pending_file
from mclass.logs.wire import MESSAGE_HEAD, RECORD_HEAD, pack_record, pack_string
from mclass.places import PlaceLike, place_of

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
        self._section = DataSection(self._file)
        self._known_schemas: dict[tuple[str, str, bytes], int] = {}
        self._sequences: dict[int, int] = {}
        self._schema_ids, self._channel_ids = _Ids(set()), _Ids(set())
        self._chunk = bytearray()
        self._starts: list[int] = []

    def __enter__(self) -> LogWriter:
        try:
            self._file.open()
            self._section.emit(MAGIC)
            if self._source is None or not self._source.index.has_header:
                self._section.emit(record_bytes(Header(self._profile, _LIBRARY)))
            if self._source is not None:
                self._keep_clear_of(self._source)
                carry_over(self._source, self._section, self._progress)
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
        self._section.contents.channels[channel_id] = record
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
        self._section.contents.attachments.append(
            AttachmentIndex(
                offset=self._section.position,
                length=len(record),
                log_time=log_time_ns,
                create_time=log_time_ns,
                data_size=len(data),
                name=name,
                media_type=media_type,
            )
        )
        self._section.emit(record)

    def add_metadata(self, name: str, pairs: Mapping[str, str]) -> None:
        """Add a metadata record.

        Raises:
            LogError: If the disk is full or fails.
        """
        record = record_bytes(Metadata(name, dict(pairs)))
        self._section.contents.metadata.append(
            MetadataIndex(self._section.position, len(record), name)
        )
        self._section.emit(record)

    def _keep_clear_of(self, reader: LogReader) -> None:
        """Use the source's schemas again, and no number that it uses."""
        index = reader.index
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

    def _schema_id(self, name: str, encoding: str, data: bytes) -> int:
        if not name:
            return 0
        known = self._known_schemas.get((name, encoding, data))
        if known is not None:
            return known
        schema_id = self._schema_ids.next()
        content = struct.pack("<H", schema_id) + pack_string(name) + pack_string(encoding)
        record = pack_record(Opcode.SCHEMA, content + struct.pack("<I", len(data)) + data)
        self._section.contents.schemas[schema_id] = record
        self._known_schemas[name, encoding, data] = schema_id
        self._chunk += record
        return schema_id

    def _flush_chunk(self) -> None:
        data = bytes(self._chunk)
        starts = np.array(self._starts, dtype=np.int64)
        self._chunk, self._starts = bytearray(), []
        if len(starts):
            self._section.write_chunk(data, starts, "zstd")
        else:
            # Definitions alone: an empty chunk would say nothing more.
            self._section.emit(data)

    def _finish(self) -> None:
        if self._chunk:
            self._flush_chunk()
        self._section.emit(record_bytes(DataEnd(self._section.crc or 0)))
        self._section.contents.write_end(self._file.write, self._section.position)


def _refuse_broken(reader: LogReader) -> None:
    """Refuse to append to a log that would have to be mended first."""
    index = reader.index
    whole = index.has_header and index.kept == [(len(MAGIC), index.data_end)]
    if reader.damage.losses or not whole or not all(map(is_copied, index.chunks)):
        raise LogError(
            "is damaged, so nothing is appended to it. Write a mended copy, without --in-place.",
            path=str(reader.path),
        )
