"""The end of a log being written: the summary over everything in it, and the footer."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    ChunkIndex,
    McapRecord,
    MetadataIndex,
    Statistics,
    SummaryOffset,
)

from mclass.logs.source import MAGIC
from mclass.logs.wire import pack_chunk_index

_LATEST = (1 << 64) - 1


@dataclass
class Contents:
    """What a log being written holds.

    Attributes:
        schemas: Whole records by id.
        channels: Whole records by id.
        chunks: In file order.
        attachments: In file order.
        metadata: In file order.
        counts: Messages of each channel.
        start_time: Earliest log time [ns].
        end_time: Latest log time [ns].
    """

    schemas: dict[int, bytes] = field(default_factory=dict)
    channels: dict[int, bytes] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    attachments: list[AttachmentIndex] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)
    start_time: int = _LATEST
    end_time: int = 0

    def add_chunk(self, chunk: ChunkIndex, counts: dict[int, int]) -> None:
        """Add a chunk and the messages in it."""
        self.chunks.append(chunk)
        for channel, count in counts.items():
            self.counts[channel] = self.counts.get(channel, 0) + count
        if counts:
            self.start_time = min(self.start_time, chunk.message_start_time)
            self.end_time = max(self.end_time, chunk.message_end_time)

    def write_end(self, write: Callable[[bytes], None], start: int) -> None:
        """Write summary, footer and magic.

        Args:
            write: Appends bytes to the file.
            start: Where they begin in the file.
        """
        groups = [
            (Opcode.SCHEMA, self.schemas.values()),
            (Opcode.CHANNEL, self.channels.values()),
            (Opcode.STATISTICS, [record_bytes(self._statistics())]),
            (Opcode.CHUNK_INDEX, map(pack_chunk_index, self.chunks)),
            (Opcode.ATTACHMENT_INDEX, map(record_bytes, self.attachments)),
            (Opcode.METADATA_INDEX, map(record_bytes, self.metadata)),
        ]
        position, crc, offsets = start, 0, b""
        for opcode, records in groups:
            group = b"".join(records)
            if group:
                offsets += record_bytes(SummaryOffset(opcode, position, len(group)))
                crc = zlib.crc32(group, crc)
                write(group)
                position += len(group)
        footer = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, position)
        crc = zlib.crc32(offsets + footer, crc)
        write(offsets + footer + struct.pack("<I", crc) + MAGIC)

    def _statistics(self) -> Statistics:
        total = sum(self.counts.values())
        return Statistics(
            message_count=total,
            schema_count=len(self.schemas),
            channel_count=len(self.channels),
            attachment_count=len(self.attachments),
            metadata_count=len(self.metadata),
            chunk_count=len(self.chunks),
            message_start_time=self.start_time if total else 0,
            message_end_time=self.end_time,
            channel_message_counts=dict(sorted(self.counts.items())),
        )


def record_bytes(record: McapRecord) -> bytes:
    """A whole record as ``mcap`` writes it."""
    builder = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data
