"""Attachments: their heads, their data, and whether they are whole."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

from mcap.records import AttachmentIndex

from mclass.logs.source import Source
from mclass.logs.wire import RECORD_HEAD, parse_attachment_head


@dataclass(frozen=True)
class AttachmentInfo:
    """An attachment without its data. ``size`` in bytes, ``log_time_ns`` in nanoseconds."""

    name: str
    media_type: str
    size: int
    log_time_ns: int


def read_attachment_head(source: Source, position: int) -> tuple[AttachmentIndex, int]:
    """Index of the attachment at ``position`` and where its data begins within the record.

    Raises:
        MalformedError: If there is none, or its names are longer than any path.
    """
    return parse_attachment_head(source.peek(position, 1 << 16), position)


def read_attachment(source: Source, found: AttachmentIndex) -> tuple[bytes, bool]:
    """Data of an attachment, and whether its checksum matches."""
    _, start = read_attachment_head(source, found.offset)
    record = source.read(found.offset, start + found.data_size + 4)
    crc = int.from_bytes(record[-4:], "little")
    intact = not crc or crc == zlib.crc32(memoryview(record)[RECORD_HEAD:-4])
    return record[start:-4], intact


def is_intact(source: Source, found: AttachmentIndex) -> bool:
    """Whether an attachment's checksum matches, in bounded memory."""
    _, start = read_attachment_head(source, found.offset)
    end = found.offset + start + found.data_size
    crc = int.from_bytes(source.read(end, 4), "little")
    return not crc or crc == source.checksum(found.offset + RECORD_HEAD, end)
