"""Where everything in a log is, and what it defines."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, MetadataIndex, Statistics

from mclass.logs.chunks import ChunkContent, ChunkEntry
from mclass.logs.source import MAGIC
from mclass.logs.summary import Summary
from mclass.logs.wire import (
    ChannelRecord,
    MalformedError,
    SchemaRecord,
    parse_channel,
    parse_schema,
)


class Mark(NamedTuple):
    """A schema or channel record: where it is, and whether it says what the known one says."""

    place: int
    opcode: Opcode
    id: int
    in_use: bool


@dataclass
class LogIndex:
    """Where everything in a log is.

    Attributes:
        profile: Of the header; empty without one.
        library: Of the header.
        has_header: Whether a header record was read.
        schemas: By id.
        channels: By id.
        chunks: In file order; runs of messages outside chunks, a chunk that is cut and those
            of a wrong length among them.
        attachments: In file order.
        metadata: In file order.
        kept: Byte ranges of whole records without the runs of loose messages; with the
            ``chunks`` of the kinds loose and cut they are all that the log holds.
        data_crc: Checksum of the data section as the file says; 0 if it says none.
        data_end: Where the data section ends.
        marks: Of the schemas and channels outside of chunks, in file order.
        disputed: Opcodes and ids of which definitions that contradict each other were met.
        statistics: As the file says; None if it says none.
        summarised: Whether the summary was used.
    """

    profile: str = ""
    library: str = ""
    has_header: bool = False
    schemas: dict[int, SchemaRecord] = field(default_factory=dict)
    channels: dict[int, ChannelRecord] = field(default_factory=dict)
    chunks: list[ChunkEntry] = field(default_factory=list)
    attachments: list[AttachmentIndex] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)
    kept: list[tuple[int, int]] = field(default_factory=list)
    data_crc: int = 0
    data_end: int = len(MAGIC)
    marks: list[Mark] = field(default_factory=list)
    disputed: set[tuple[Opcode, int]] = field(default_factory=set)
    statistics: Statistics | None = None
    summarised: bool = False

    def message_counts(self) -> dict[int, int] | None:
        """Messages of each channel over all chunks; None if some chunk's are unknown."""
        totals: dict[int, int] = {}
        for entry in self.chunks:
            if entry.counts is None:
                return None
            for channel, count in entry.counts.items():
                totals[channel] = totals.get(channel, 0) + count
        return {channel: count for channel, count in totals.items() if count}

    def define(self, content: ChunkContent) -> None:
        """Take over the schemas and channels that stand in a chunk."""
        for start in content.definitions:
            # What a broken one leaves undefined is counted as lost in the end.
            with contextlib.suppress(MalformedError):
                self.define_record(content.record(start))

    def define_record(self, record: bytes) -> None:
        """Take over one whole schema or channel record; the first of an id stays.

        Raises:
            MalformedError: If it is broken.
        """
        if record[0] == Opcode.SCHEMA:
            schema = parse_schema(record)
            self.schemas.setdefault(schema.id, schema)
        else:
            channel = parse_channel(record)
            self.channels.setdefault(channel.id, channel)

    def mark(self, place: int, record: bytes) -> Mark:
        """Compare a whole schema or channel record with the known one of its id; note a dispute.

        Args:
            place: Of the record, for the answer.
            record: The record.

        Raises:
            MalformedError: If it is broken.
        """
        found: SchemaRecord | ChannelRecord
        known: SchemaRecord | ChannelRecord | None
        if record[0] == Opcode.SCHEMA:
            found = parse_schema(record)
            known = self.schemas.get(found.id)
        else:
            found = parse_channel(record)
            known = self.channels.get(found.id)
        mark = Mark(
            place,
            Opcode(record[0]),
            found.id,
            known is None or known.raw == record or _content(known) == _content(found),
        )
        if not mark.in_use:
            self.disputed.add((mark.opcode, mark.id))
        return mark

    def add_definitions(self, summary: Summary) -> None:
        """Take over the schemas and channels of a summary where there are none yet."""
        self.schemas = {**summary.schemas, **self.schemas}
        self.channels = {**summary.channels, **self.channels}

    def defines(self, channel_id: int) -> bool:
        """Whether that channel and its schema are known."""
        channel = self.channels.get(channel_id)
        return channel is not None and (channel.schema_id == 0 or channel.schema_id in self.schemas)


def _content(record: SchemaRecord | ChannelRecord) -> tuple[object, ...]:
    """What messages are decoded by."""
    if isinstance(record, SchemaRecord):
        return record.name, record.encoding, record.data
    return record.topic, record.message_encoding, record.schema_id
