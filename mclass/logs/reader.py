"""Reading MCAP logs at the level of records: whole, unindexed, damaged or cut off.

All that can be used is used; ``LogReader.damage`` counts what could not be, in sentences.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from types import TracebackType

import numpy as np

from mclass.errors import LogError
from mclass.logs.attachments import AttachmentInfo, is_intact, read_attachment
from mclass.logs.channels import ChannelInfo, MessageBatch
from mclass.logs.chunks import (
    ChunkContent,
    ChunkEntry,
    ChunkLostError,
    CompressionUse,
    IndexLiesError,
    Kind,
    read_chunk,
)
from mclass.logs.damage import Damage
from mclass.logs.index import keeps_times, load_index, lose_chunk, scan_index, use_content
from mclass.logs.record_index import LogIndex
from mclass.logs.redefined import Redefinitions
from mclass.logs.remote import open_remote
from mclass.logs.source import Source, open_source
from mclass.logs.summary import Summary
from mclass.logs.wire import (
    MESSAGE_HEAD,
    RECORD_HEAD,
    ChannelRecord,
    MalformedError,
    parse_metadata,
)
from mclass.places import PlaceLike, Url, place_of
from mclass.records import BoolArray

_LATEST = (1 << 63) - 1
_TIMES_LIE = "chunks were chosen by the times they state, and this one's are wrong"
_MAY_MISS = "chunks state wrong times, so that reading a part of the time can miss messages"
_MESSAGE_FIELDS = MESSAGE_HEAD - RECORD_HEAD


class LogReader:
    """An open log.

    Attributes:
        path: Of the file, or its URL.
        size: Bytes in the file.
        damage: What could not be used; grows while the log is read.
        index: Where everything is; for ``LogWriter``.
        source: The file's bytes; for ``LogWriter``.
        on_read: Called with bytes done and bytes in all while messages are read.
    """

    def __init__(self, source: Source, path: PlaceLike | None = None) -> None:
        self.on_read: Callable[[int, int], None] | None = None
        self.path = place_of(source.name if path is None else path)
        self.source = source
        self.size = source.size
        self.index: LogIndex
        self.damage: Damage
        self.index, self.damage = load_index(source)

    @classmethod
    def open(cls, path: PlaceLike) -> LogReader:
        """Open a log; a pipe is copied to a temporary file first.

        Of a log at a URL only what is needed is fetched.

        Raises:
            LogError: If it cannot be opened, or is not MCAP.
            UsageError: If what is needed for a URL is not installed.
        """
        source = open_log_source(path)
        try:
            return cls(source, path)
        except BaseException:
            source.close()
            raise

    def close(self) -> None:
        """Close the file; harmless when done twice."""
        self.source.close()

    def __enter__(self) -> LogReader:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    @property
    def profile(self) -> str:
        """The log's profile (``ros2``); often empty."""
        return self.index.profile

    @property
    def library(self) -> str:
        """What wrote the log."""
        return self.index.library

    @property
    def channels(self) -> Sequence[ChannelInfo]:
        """All channels by increasing id."""
        counts = self._message_counts()
        channels = (self.index.channels[key] for key in sorted(self.index.channels))
        return tuple(self._channel_info(channel, counts) for channel in channels)

    @property
    def start_ns(self) -> int | None:
        """Earliest log time [ns]; None if the log holds no messages."""
        starts = [entry.start_time for entry in self.index.chunks if entry.messages != 0]
        return min(*starts, _LATEST) if starts else None

    @property
    def end_ns(self) -> int | None:
        """Latest log time [ns], that message included; None if the log holds no messages."""
        ends = [entry.end_time for entry in self.index.chunks if entry.messages != 0]
        return min(max(ends), _LATEST) if ends else None

    @property
    def message_count(self) -> int | None:
        """Messages of all channels; None when unknown without reading all of the log."""
        counts = self._message_counts()
        return None if counts is None else sum(counts.values())

    @property
    def indexed(self) -> bool:
        """Whether the log's own summary is there, right and in use."""
        return self.index.summarised

    @property
    def compressions(self) -> Mapping[str, CompressionUse]:
        """Chunks by the name of their compression; messages without chunks are not in it."""
        uses: dict[str, CompressionUse] = {}
        for entry in self.index.chunks:
            if entry.kind is Kind.CHUNK:
                use = uses.get(entry.compression, CompressionUse(0, 0, 0))
                uses[entry.compression] = CompressionUse(
                    use.chunks + 1,
                    use.compressed_size + entry.compressed_size,
                    use.uncompressed_size + entry.uncompressed_size,
                )
        return uses

    @property
    def attachments(self) -> Sequence[AttachmentInfo]:
        """All attachments in file order."""
        return tuple(
            AttachmentInfo(found.name, found.media_type, found.data_size, found.log_time)
            for found in self.index.attachments
        )

    @property
    def metadata_names(self) -> Sequence[str]:
        """Names of all metadata records in file order."""
        return tuple(found.name for found in self.index.metadata)

    def attachment(self, name: str, max_size: int = 1 << 26) -> bytes | None:
        """Data of the last attachment of that name, None if there is none.

        Raises:
            LogError: If it is larger than ``max_size`` bytes, or broken.
        """
        found = [entry for entry in self.index.attachments if entry.name == name]
        if not found:
            return None
        if found[-1].data_size > max_size:
            raise LogError(
                f"attachment {name!r} has {found[-1].data_size:,} bytes, more than the "
                f"{max_size:,} that are read.",
                path=str(self.path),
            )
        data, intact = read_attachment(self.source, found[-1])
        if not intact:
            raise LogError(
                f"attachment {name!r} is broken: its checksum does not match.", path=str(self.path)
            )
        return data

    def metadata(self, name: str) -> Mapping[str, str] | None:
        """The last metadata record of that name, None if there is none."""
        found = [entry for entry in self.index.metadata if entry.name == name]
        if not found:
            return None
        record = self.source.read(found[-1].offset, found[-1].length)
        try:
            return parse_metadata(record)[1]
        except MalformedError as error:
            raise LogError(f"metadata {name!r} is broken: {error}.", path=str(self.path)) from error

    def batches(
        self,
        channel_ids: Iterable[int],
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> Iterator[MessageBatch]:
        """Messages of some channels in file order, a batch for each channel and chunk.

        Only chunks that hold such messages are decompressed. Chunks that cannot be used are
        counted in ``damage`` and passed over. ``first_index`` counts the messages of lost
        chunks too where their message indexes tell how many there were.

        Args:
            channel_ids: Channels wanted.
            start_ns: Earliest log time [ns], inclusive.
            end_ns: Latest log time [ns], exclusive.

        Raises:
            LogError: If the disk fails.
        """
        infos = {channel.id: channel for channel in self.channels}
        wanted = infos.keys() & frozenset(channel_ids)
        seen = dict.fromkeys(wanted, 0)
        bounded = start_ns is not None or end_ns is not None
        redefinitions = Redefinitions(self.index, self.damage, wanted)

        def relevant(entry: ChunkEntry) -> bool:
            if entry.counts is None:
                return True
            return any(entry.counts.get(channel_id) for channel_id in wanted) and (
                entry.start_time > entry.end_time
                or (
                    (start_ns is None or entry.end_time >= start_ns)
                    and (end_ns is None or entry.start_time < end_ns)
                )
            )

        for entry, content in self._contents(relevant):
            if self.on_read is not None:
                self.on_read(entry.offset + entry.length, self.size)
            if content is None:
                for channel_id in wanted & (entry.counts or {}).keys():
                    seen[channel_id] += (entry.counts or {})[channel_id]
                continue
            times = np.minimum(content.heads["log_time"], np.uint64(_LATEST)).astype(np.int64)
            within = np.ones(len(times), dtype=np.bool_)
            if start_ns is not None:
                within &= times >= start_ns
            if end_ns is not None:
                within &= times < end_ns
            if bounded and not keeps_times(entry, content):
                self.damage.lose(_TIMES_LIE, entry.offset, messages=None)
            foreign = redefinitions.foreign(entry, content)
            if foreign is not None:
                within &= ~foreign
            for channel_id, rows in content.rows_by_channel(wanted):
                first = seen[channel_id]
                seen[channel_id] += len(rows)
                # Times need not increase; a batch without gap keeps the numbering right.
                for begin, stop in _runs(within[rows]):
                    span = rows[begin:stop]
                    yield MessageBatch(
                        infos[channel_id],
                        content.data,
                        content.starts[span] + MESSAGE_HEAD,
                        content.heads["length"][span].astype(np.int64) - _MESSAGE_FIELDS,
                        times[span],
                        first + begin,
                    )

    def verify(self, progress: Callable[[int, int], None] | None = None) -> tuple[str, ...]:
        """Read and check everything; returns what is wrong, in sentences.

        Checksums of all chunks, attachments and the data section are computed; message
        indexes and times are compared with the messages. (That the records fill the data
        section and fit the statistics was checked when the log was opened.) What cannot be
        used is also counted in ``damage``.

        Args:
            progress: Called with bytes done and bytes in all.

        Raises:
            LogError: If the disk fails.
        """
        problems: list[str] = []
        redefinitions = Redefinitions(self.index, self.damage, self.index.channels.keys())
        for entry, content in self._contents(lambda entry: True):
            if content is not None:
                redefinitions.foreign(entry, content)
                if not keeps_times(entry, content) and _MAY_MISS not in problems:
                    problems.append(_MAY_MISS)
            if progress is not None:
                progress(entry.offset, self.size)
        problems += [
            f"attachment {attachment.name!r}: its checksum does not match"
            for attachment in self.index.attachments
            if not is_intact(self.source, attachment)
        ]
        crc = self.index.data_crc
        if crc and crc != self.source.checksum(0, self.index.data_end):
            problems.append("the checksum of the data section does not match")
        if progress is not None:
            progress(self.size, self.size)
        return (*self.damage.sentences, *problems)

    def _message_counts(self) -> dict[int, int] | None:
        statistics = self.index.statistics
        if self.index.summarised and statistics is not None and statistics.channel_message_counts:
            return statistics.channel_message_counts
        return self.index.message_counts()

    def _channel_info(self, channel: ChannelRecord, counts: dict[int, int] | None) -> ChannelInfo:
        schema = self.index.schemas.get(channel.schema_id)
        return ChannelInfo(
            channel.id,
            channel.topic,
            channel.message_encoding,
            schema.name if schema else "",
            schema.encoding if schema else "",
            schema.data if schema else b"",
            None if counts is None else counts.get(channel.id, 0),
            channel.metadata,
        )

    def _contents(
        self, relevant: Callable[[ChunkEntry], bool]
    ) -> Iterator[tuple[ChunkEntry, ChunkContent | None]]:
        """All chunks in file order; without content those not relevant and those lost."""
        position = 0
        while True:
            self.source.expect(
                (entry.offset, entry.offset + entry.length + entry.index_length)
                for entry in self.index.chunks
                if entry.offset >= position and not entry.lost and relevant(entry)
            )
            try:
                for entry in self.index.chunks:
                    if entry.offset >= position:
                        content = self._content(entry) if relevant(entry) else None
                        position = entry.offset + entry.length
                        yield entry, content
            except IndexLiesError:
                self.damage.remark(
                    "the summary is wrong (a chunk is not what it says); the log was indexed by "
                    "reading it"
                )
                self._rebuild()
            else:
                return

    def _content(self, entry: ChunkEntry) -> ChunkContent | None:
        if entry.lost:
            return None
        try:
            content = read_chunk(self.source, entry)
        except ChunkLostError as error:
            lose_chunk(entry, error, self.damage)
            return None
        except IndexLiesError:
            if self.index.summarised:
                raise
            changed = ChunkLostError("the file changed while it was read")
            lose_chunk(entry, changed, self.damage)
            return None
        use_content(entry, content, self.damage)
        return content

    def _rebuild(self) -> None:
        """Index the log anew by reading through it."""
        old = self.index
        known = Summary(0, old.schemas, old.channels, {}, old.statistics)
        self.index = scan_index(self.source, self.damage, known)


def open_log_source(path: PlaceLike) -> Source:
    """The bytes of a log, wherever it is.

    Raises:
        LogError: If it cannot be opened, or is not MCAP.
        UsageError: If what is needed for a URL is not installed.
    """
    place = place_of(path)
    return open_remote(place) if isinstance(place, Url) else open_source(place)


def _runs(within: BoolArray) -> Iterator[tuple[int, int]]:
    """Begin and end of each run of true elements."""
    if within.all():
        if len(within):
            yield 0, len(within)
        return
    edges = np.flatnonzero(np.diff(np.concatenate(([False], within, [False]))))
    yield from zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
