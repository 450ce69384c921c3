"""One walk along the records of a log's data section, and what it finds."""

from __future__ import annotations

import struct

from mcap.opcode import Opcode
from mcap.records import MetadataIndex

from mclass.logs.attachments import read_attachment_head
from mclass.logs.chunks import ChunkEntry, Kind
from mclass.logs.damage import Damage
from mclass.logs.record_index import LogIndex
from mclass.logs.scan import PEEK, PRIVATE_OPCODES, RecordFinder
from mclass.logs.source import MAGIC, Source
from mclass.logs.summary import Summary
from mclass.logs.wire import (
    MAX_RECORD,
    MESSAGE_HEAD,
    RECORD_HEAD,
    MalformedError,
    parse_chunk_head,
    parse_header,
    parse_metadata,
)

_RUN_BYTES = 1 << 20
_MAX_DEFINITION = 1 << 26
_LATEST = (1 << 64) - 1
_SUMMARY_OPCODES = frozenset(
    {
        Opcode.CHUNK_INDEX,
        Opcode.ATTACHMENT_INDEX,
        Opcode.STATISTICS,
        Opcode.METADATA_INDEX,
        Opcode.SUMMARY_OFFSET,
    }
)


class UntrustedSummaryError(Exception):
    """The summary contradicts the file; the text ends a sentence that says how."""


class Walk:
    """One walk. With a summary it jumps over the chunks that this lists."""

    def __init__(self, source: Source, damage: Damage, summary: Summary | None) -> None:
        self._source = source
        self._damage = damage
        self._summary = summary
        self._end = source.size if summary is None else summary.start
        self._finder = RecordFinder(source, self._end)
        self._run: ChunkEntry | None = None
        self._strays: dict[int, int] = {}
        self._index = LogIndex(summarised=summary is not None)
        if summary is not None:
            self._index.add_definitions(summary)
            self._index.statistics = summary.statistics

    def walk(self) -> LogIndex:
        """Go from the magic to the end of the data section.

        Raises:
            UntrustedSummaryError: If there is a summary and the file is not as it says.
        """
        index = self._index
        jumps = {} if self._summary is None else dict(self._summary.chunks)
        position: int | None = len(MAGIC)
        while position is not None and position < self._end:
            index.data_end = position
            entry = jumps.pop(position, None)
            position = self._record(position) if entry is None else self._jump(entry)
        self._close_run()
        if jumps or (position is not None and position > self._end):
            raise UntrustedSummaryError("a chunk is not where it says")
        if position is not None:
            index.data_end = position
            self._miss_end_mark()
        if not index.has_header:
            self._damage.remark("the log has no header; its profile is unknown")
        return index

    def _jump(self, entry: ChunkEntry) -> int:
        self._close_run()
        end = entry.offset + entry.length + entry.index_length
        self._index.chunks.append(entry)
        self._keep(entry.offset, end)
        return end

    def _record(self, position: int) -> int | None:  # noqa: PLR0911 (one a kind)
        """Take one record; the next one's place, None where the walk ends."""
        span = self._finder.span(position)
        if span is None:
            return self._beyond_damage(position)
        opcode, following = span
        if opcode == Opcode.MESSAGE:
            self._add_to_run(position, following)
            return following
        self._close_run()
        if opcode == Opcode.DATA_END:
            crc = self._source.peek(position + RECORD_HEAD, 4)
            self._index.data_crc = int.from_bytes(crc, "little")
            self._lose_strays()
            return None
        if opcode == Opcode.FOOTER:
            self._damage.remark("the data section has no end mark")
            self._index.data_end = min(self._strays, default=position)
            return None
        if opcode in _SUMMARY_OPCODES:
            self._strays[position] = following
            return following
        if opcode == Opcode.CHUNK:
            end = self._end_by_sizes(position)
            if end is not None and end != following:
                return self._misfit_chunk(position, end)
            return self._chunk(position, following)
        try:
            self._other_record(opcode, position, following - position)
        except MalformedError:
            length = following - position
            self._damage.lose("a record is broken", position, n_bytes=length, messages=0)
        else:
            self._keep(position, following)
        return following

    def _other_record(self, opcode: int, position: int, length: int) -> None:
        index = self._index
        if opcode == Opcode.ATTACHMENT:
            index.attachments.append(read_attachment_head(self._source, position)[0])
        elif length > _MAX_DEFINITION:
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA):
                raise MalformedError("too long")
        elif opcode == Opcode.HEADER and position == len(MAGIC):
            index.profile, index.library = parse_header(self._source.peek(position, length))
            index.has_header = True
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            record = self._source.peek(position, length)
            index.define_record(record)
            index.marks.append(index.mark(position, record))
        elif opcode == Opcode.MESSAGE_INDEX:
            messages = int.from_bytes(self._source.peek(position + RECORD_HEAD + 2, 4), "little")
            reason = "only the message index of a chunk is left"
            self._damage.lose(reason, position, messages=messages // 16)
        elif opcode >= PRIVATE_OPCODES:
            self._damage.remark(f"records of an unknown kind ({opcode:#04x}) were passed over")
        elif opcode == Opcode.METADATA:
            name, _ = parse_metadata(self._source.peek(position, length))
            index.metadata.append(MetadataIndex(position, length, name))

    def _chunk(self, position: int, following: int) -> int:
        """Take a chunk and the message indexes behind it."""
        entry = self._chunk_entry(Kind.CHUNK, position, following)
        counts: dict[int, int] = {}
        offsets: dict[int, int] = {}
        n_indexes = 0
        end = following
        while (span := self._finder.span(end)) and span[0] == Opcode.MESSAGE_INDEX:
            channel, size = struct.unpack("<HI", self._source.peek(end + RECORD_HEAD, 6))
            counts[channel], offsets[channel] = size // 16, end
            n_indexes += 1
            end = span[1]
        if not entry.uncompressed_size:
            entry.counts = {}
        # Indexes that are missing, cut off (maybe between two), broken or double do not tell
        # all: the chunk itself must be asked, and they are left out of a copy.
        elif offsets and span and len(offsets) == n_indexes:
            entry.counts, entry.index_offsets, entry.index_length = counts, offsets, end - following
        self._index.chunks.append(entry)
        self._keep(position, following + entry.index_length)
        return end

    def _end_by_sizes(self, position: int) -> int | None:
        """Where the chunk at ``position`` ends by the sizes in its head, if a record is next."""
        try:
            head = parse_chunk_head(self._source.peek(position, PEEK), any_length=True)
        except MalformedError:
            return None
        end = position + head.data_offset + head.compressed_size
        return end if self._finder.span(end) is not None else None

    def _misfit_chunk(self, position: int, end: int) -> int:
        """Take a chunk whose length is wrong, but whose sizes lead to the next record."""
        if self._summary is not None:
            raise UntrustedSummaryError(f"the chunk at byte {position} has a wrong length")
        entry = self._chunk_entry(Kind.CUT, position, end, any_length=True)
        self._index.chunks.append(entry)
        self._damage.remark("a chunk has a wrong length; its sizes were used", position)
        while (span := self._finder.span(end)) and span[0] == Opcode.MESSAGE_INDEX:
            end = span[1]
        return end

    def _chunk_entry(
        self, kind: Kind, position: int, following: int, *, any_length: bool = False
    ) -> ChunkEntry:
        head = parse_chunk_head(self._source.peek(position, PEEK), any_length=any_length)
        return ChunkEntry(
            kind,
            position,
            following - position,
            head.start_time,
            head.end_time,
            head.compression,
            head.compressed_size,
            head.uncompressed_size,
        )

    def _add_to_run(self, position: int, following: int) -> None:
        length = following - position
        if length > MAX_RECORD:
            self._close_run()
            self._keep(position, following)
            reason = "a message claims more than 1 GiB"
            self._damage.lose(reason, position, n_bytes=length, messages=1)
            return
        if self._run is not None and self._run.length + length > _RUN_BYTES:
            self._close_run()
        if self._run is None:
            self._run = ChunkEntry(Kind.LOOSE, position, 0, _LATEST, 0)
        run = self._run
        head = self._source.peek(position + RECORD_HEAD, MESSAGE_HEAD - RECORD_HEAD)
        channel, _, time = struct.unpack_from("<HIQ", head)
        run.length += length
        run.uncompressed_size = run.compressed_size = run.length
        run.start_time, run.end_time = min(run.start_time, time), max(run.end_time, time)
        run.counts = run.counts or {}
        run.counts[channel] = run.counts.get(channel, 0) + 1

    def _close_run(self) -> None:
        if self._run is not None:
            self._index.chunks.append(self._run)
            self._run = None

    def _keep(self, start: int, end: int) -> None:
        kept = self._index.kept
        if kept and kept[-1][1] == start:
            kept[-1] = (kept[-1][0], end)
        else:
            kept.append((start, end))

    def _beyond_damage(self, position: int) -> int | None:
        """Go on behind bytes that are no whole record, or stop if nothing follows them."""
        self._close_run()
        if self._summary is not None:
            raise UntrustedSummaryError(f"there is no record at byte {position}")
        end = self._end_by_sizes(position)
        if end is not None:
            return self._misfit_chunk(position, end)
        if self._cut_chunk(position):
            return None
        following = self._finder.resync(position)
        lost = (following or self._end) - position
        reason = "these bytes are no MCAP record"
        if following is None and not any(self._source.peek(position, PEEK)):
            reason = "the file ends in zeros, as after a power failure"
        elif following is None:
            reason = "the file ends within a record"
        self._damage.lose(reason, position, n_bytes=lost)
        return following

    def _cut_chunk(self, position: int) -> bool:
        """Take the chunk at ``position`` if its head is whole and the file ends within it."""
        try:
            entry = self._chunk_entry(Kind.CUT, position, self._end)
        except MalformedError:
            return False
        claimed = int.from_bytes(self._source.peek(position + 1, 8), "little")
        if position + RECORD_HEAD + claimed <= self._end:
            return False
        self._index.chunks.append(entry)
        reason = "the file ends within this chunk; its first messages are used"
        self._damage.lose(reason, position, chunks=1)
        return True

    def _miss_end_mark(self) -> None:
        if self._summary is not None:
            self._damage.remark("the data section has no end mark")
            return
        self._lose_strays()
        self._damage.lose("the file ends here without an end mark", self._index.data_end)

    def _lose_strays(self) -> None:
        for start, end in self._strays.items():
            reason = "a record of the summary stands among the data"
            self._damage.lose(reason, start, n_bytes=end - start)
