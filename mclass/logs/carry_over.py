"""The data section of one log carried over into another, neither decoded nor compressed again.

Of a log that is not whole, all that holds is carried over:

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
from collections.abc import Callable, Sequence

import numpy as np
from mcap.opcode import Opcode
from mcap.records import ChunkIndex

from mclass.logs.chunks import ChunkEntry, ChunkLostError, Kind, State, read_chunk
from mclass.logs.reader import LogReader
from mclass.logs.section import DataSection
from mclass.logs.source import MAGIC
from mclass.logs.wire import opcodes_at, walk


def carry_over(
    reader: LogReader, section: DataSection, progress: Callable[[int, int], None] | None
) -> None:
    """Copy a log's data section and take over its index.

    Args:
        reader: The log.
        section: Where to; holds nothing but magic and header yet.
        progress: Called with bytes copied and bytes in all.

    Raises:
        LogError: If the disk is full or fails, or the log lost bytes in the meantime.
    """
    index = reader.index
    contents = section.contents
    contents.schemas = {key: index.schemas[key].raw for key in sorted(index.schemas)}
    contents.channels = {key: index.channels[key].raw for key in sorted(index.channels)}
    shifts = _copy_records(reader, section, progress)
    for entry in index.chunks:
        if is_copied(entry):
            contents.add_chunk(_moved(entry, shifts(entry.offset)), entry.counts or {})
    contents.chunks.sort(key=lambda chunk: chunk.chunk_start_offset)
    for attachment in index.attachments:
        offset = attachment.offset + shifts(attachment.offset)
        contents.attachments.append(dataclasses.replace(attachment, offset=offset))
    for metadata in index.metadata:
        offset = metadata.offset + shifts(metadata.offset)
        contents.metadata.append(dataclasses.replace(metadata, offset=offset))


def _copy_records(
    reader: LogReader, section: DataSection, progress: Callable[[int, int], None] | None
) -> Callable[[int], int]:
    """Copy whole records; returns by how many bytes each place of the source moved."""
    index = reader.index

    def report(position: int) -> None:
        if progress is not None:
            progress(position, index.data_end)

    anew = [entry for entry in index.chunks if not is_copied(entry)]
    kept = _without(
        index.kept,
        [(e.offset, e.offset + e.length + e.index_length) for e in anew if e.kind is Kind.CHUNK],
    )
    pieces: list[tuple[int, int, ChunkEntry | None]] = [
        *((start, end, None) for start, end in kept),
        *((entry.offset, entry.offset + entry.length, entry) for entry in anew),
    ]
    starts, shifts = [], []
    whole = kept == [(len(MAGIC), index.data_end)]
    # What the kernel copies is never seen here: continue the source's checksum or have none.
    section.crc = (index.data_crc or None) if whole else None
    for start, end, entry in sorted(pieces, key=lambda piece: piece[0]):
        if entry is not None:
            _wrap(reader, entry, section)
            continue
        starts.append(start)
        shifts.append(section.position - start)
        section.copy(reader.source, start, end, report)
    return lambda offset: shifts[bisect.bisect_right(starts, offset) - 1]


def _wrap(reader: LogReader, entry: ChunkEntry, section: DataSection) -> None:
    """Write messages that stand in no whole chunk as a chunk, records unchanged."""
    try:
        content = read_chunk(reader.source, entry)
    except ChunkLostError:
        # It may have defined what follows. Where definitions contradict each other, one more
        # would give messages behind it to another channel.
        disputed = reader.index.disputed
        for opcode, records in (
            (Opcode.SCHEMA, section.contents.schemas),
            (Opcode.CHANNEL, section.contents.channels),
        ):
            section.emit(
                b"".join(raw for key, raw in records.items() if (opcode, key) not in disputed)
            )
        return
    known = np.isin(content.heads["channel"], list(section.contents.channels))
    if known.all() and not content.unusable:
        section.write_chunk(content.data, content.starts, "")
        return
    kept = [*content.starts[known].tolist(), *content.definitions]
    data = b"".join(content.record(start) for start in sorted(kept))
    starts, _ = walk(data)
    section.write_chunk(data, starts[opcodes_at(data, starts) == Opcode.MESSAGE], "")


def is_copied(entry: ChunkEntry) -> bool:
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
