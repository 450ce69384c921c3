"""The summary section: what a whole log says of itself at its end."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Statistics

from mclass.logs.chunks import ChunkEntry, Kind
from mclass.logs.source import MAGIC, Source
from mclass.logs.wire import (
    RECORD_HEAD,
    ChannelRecord,
    MalformedError,
    SchemaRecord,
    content_of,
    parse_channel,
    parse_chunk_index,
    parse_schema,
    parse_statistics,
    record_head,
)

FOOTER_LENGTH = RECORD_HEAD + 20
_MAX_SUMMARY_RECORD = 1 << 26
_INDEX_HEAD = RECORD_HEAD + 6


@dataclass
class Summary:
    """The parts of a summary that reading needs.

    Attributes:
        start: Where it begins in the file: the end of the data section.
        schemas: By id.
        channels: By id.
        chunks: By the chunk's offset.
        statistics: None if it has none.
    """

    start: int
    schemas: dict[int, SchemaRecord] = field(default_factory=dict)
    channels: dict[int, ChannelRecord] = field(default_factory=dict)
    chunks: dict[int, ChunkEntry] = field(default_factory=dict)
    statistics: Statistics | None = None


def read_summary(source: Source) -> Summary | None:
    """The summary; None when the log says that it has none.

    Raises:
        MalformedError: If it is cut off or broken, or its checksum does not match.
    """
    footer_start = source.size - len(MAGIC) - FOOTER_LENGTH
    if footer_start < len(MAGIC) or not source.peek(source.size - 8, 8) == MAGIC:
        raise MalformedError("the file does not end as MCAP does")
    footer = content_of(source.peek(footer_start, FOOTER_LENGTH), Opcode.FOOTER)
    start, offsets_start, crc = footer.u64(), footer.u64(), footer.u32()
    if start == 0:
        return None
    if not len(MAGIC) < start <= footer_start:
        raise MalformedError("its place is outside of the file")
    source.expect([(start, source.size)])
    summary = _parse(source, start, offsets_start or footer_start, footer_start)
    if crc and crc != source.checksum(start, source.size - len(MAGIC) - 4):
        raise MalformedError("its checksum does not match")
    return summary


def _parse(source: Source, start: int, stop: int, footer_start: int) -> Summary:
    if not start <= stop <= footer_start:
        raise MalformedError("its offsets are outside of it")
    summary = Summary(start)
    position = start
    while position < stop:
        opcode, length = record_head(source.peek(position, RECORD_HEAD))
        size = RECORD_HEAD + length
        if size > _MAX_SUMMARY_RECORD or position + size > footer_start:
            raise MalformedError("a record in it runs past its end")
        record = source.peek(position, size)
        if opcode == Opcode.SCHEMA:
            schema = parse_schema(record)
            summary.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = parse_channel(record)
            summary.channels[channel.id] = channel
        elif opcode == Opcode.CHUNK_INDEX:
            entry = _entry(parse_chunk_index(record))
            summary.chunks[entry.offset] = entry
        elif opcode == Opcode.STATISTICS:
            summary.statistics = parse_statistics(record)
        elif opcode in (Opcode.HEADER, Opcode.CHUNK, Opcode.MESSAGE, Opcode.DATA_END):
            raise MalformedError("there is data in it")
        position += size
    return summary


def _entry(index: ChunkIndex) -> ChunkEntry:
    return ChunkEntry(
        Kind.CHUNK,
        index.chunk_start_offset,
        index.chunk_length,
        index.message_start_time,
        index.message_end_time,
        index.compression,
        index.compressed_size,
        index.uncompressed_size,
        index.message_index_length,
        index.message_index_offsets,
        _counts(index),
    )


def _counts(index: ChunkIndex) -> dict[int, int] | None:
    """Messages of each channel by the sizes of its message indexes, which lie side by side."""
    if not index.message_index_offsets:
        return None if index.uncompressed_size else {}
    places = sorted((offset, channel) for channel, offset in index.message_index_offsets.items())
    begin = index.chunk_start_offset + index.chunk_length
    if places[0][0] != begin:
        return None
    places.append((begin + index.message_index_length, -1))
    counts = {}
    for (offset, channel), (following, _) in itertools.pairwise(places):
        counts[channel], rest = divmod(following - offset - _INDEX_HEAD, 16)
        if rest or following < offset + _INDEX_HEAD:
            return None
    return counts
