"""Small logs of every kind as bytes, made with the reference writer, and ways to break them."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.data_stream import RecordBuilder
from mcap.reader import make_reader
from mcap.records import ChunkIndex, McapRecord
from mcap.summary import Summary
from mcap.writer import CompressionType, IndexType, Writer

from mclass.logs.reader import LogReader

MAGIC = b"\x89MCAP0\r\n"

KINDS: Mapping[str, Mapping[str, Any]] = {
    "zstd": {"compression": CompressionType.ZSTD},
    "lz4": {"compression": CompressionType.LZ4},
    "uncompressed": {"compression": CompressionType.NONE},
    "data_crc": {"compression": CompressionType.ZSTD, "enable_data_crcs": True},
    "unchunked": {"use_chunking": False},
    "no_message_index": {"index_types": IndexType.CHUNK | IndexType.ATTACHMENT},
    "no_chunk_index": {"index_types": IndexType.MESSAGE},
    "no_index": {"index_types": IndexType.NONE},
    "no_repeats": {"repeat_channels": False, "repeat_schemas": False},
    "no_statistics": {"use_statistics": False},
    "no_summary": {
        "index_types": IndexType.NONE,
        "repeat_channels": False,
        "repeat_schemas": False,
        "use_statistics": False,
        "use_summary_offsets": False,
    },
}
"""Options of the reference writer by the name of the kind."""


@dataclass(frozen=True, order=True)
class Message:
    """A message as tests compare it."""

    topic: str
    log_time: int
    data: bytes


ALL_MESSAGES = sorted(
    [
        Message(topic, 1000 + 10 * number, f"{topic} {number} ".encode() * (1 + number % 5))
        for number in range(24)
        for topic in ("/a", "/b")
    ]
    + [Message("/c", 2000 + number, bytes([number]) * 40) for number in range(24)]
)
"""What ``log_bytes`` holds, whatever the kind."""


def log_bytes(kind: str) -> bytes:
    """A log of several chunks with ``ALL_MESSAGES``; those of /c are in the last chunks only."""
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=500, **KINDS[kind])
    writer.start("ros2", "test")
    schema = writer.register_schema("pkg/msg/A", "ros2msg", b"float64 x")
    channels = {
        "/a": writer.register_channel("/a", "cdr", schema, {"qos": "reliable"}),
        "/b": writer.register_channel("/b", "json", 0),
    }
    writer.add_attachment(1, 2, "first.txt", "text/plain", b"first attachment")
    for message in sorted(ALL_MESSAGES, key=lambda message: message.log_time):
        if message.topic == "/c" and "/c" not in channels:
            channels["/c"] = writer.register_channel("/c", "cdr", schema)
        time = message.log_time
        writer.add_message(channels[message.topic], time, message.data, time - 1)
    writer.add_attachment(3, 4, "second.txt", "text/plain", b"second attachment")
    writer.add_metadata("settings", {"speed": "fast"})
    writer.finish()  # type: ignore[no-untyped-call]
    return stream.getvalue()


def record_bytes(record: McapRecord) -> bytes:
    """A whole record."""
    builder = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data


def summary_of(data: bytes) -> Summary:
    """The summary as the reference reader gives it."""
    summary = make_reader(io.BytesIO(data)).get_summary()
    assert summary is not None
    return summary


def data_end(data: bytes) -> int:
    """Where the data section of a whole log ends: the place of its end mark."""
    (summary_start,) = struct.unpack_from("<Q", data, len(data) - 28)
    return int(summary_start or len(data) - 37) - 13


def with_summary(data: bytes, edit: Callable[[Summary], None]) -> bytes:
    """The log with another summary, whose checksum is right."""
    summary = summary_of(data)
    edit(summary)
    start = data_end(data) + 13
    records: list[McapRecord] = [
        *summary.schemas.values(),
        *summary.channels.values(),
        *([summary.statistics] if summary.statistics else []),
        *summary.chunk_indexes,
        *summary.attachment_indexes,
        *summary.metadata_indexes,
    ]
    body = b"".join(map(record_bytes, records)) + struct.pack("<BQQQ", 2, 20, start, 0)
    return data[:start] + body + struct.pack("<I", zlib.crc32(body)) + MAGIC


def chunks_of(data: bytes) -> list[ChunkIndex]:
    """The chunk indexes of a whole log in file order."""
    return sorted(summary_of(data).chunk_indexes, key=lambda chunk: chunk.chunk_start_offset)


def reference_messages(data: bytes) -> list[Message]:
    """Messages as the reference reader gives them, sorted."""
    reader = make_reader(io.BytesIO(data), validate_crcs=True)
    return sorted(
        Message(channel.topic, message.log_time, message.data)
        for _, channel, message in reader.iter_messages(log_time_order=False)
    )


def written(path: Path, data: bytes) -> Path:
    """``path`` after writing ``data`` to it."""
    path.write_bytes(data)
    return path


def messages_of(reader: LogReader, *topics: str, **bounds: int) -> list[Message]:
    """Messages of some topics (all when none are given), sorted."""
    ids = [channel.id for channel in reader.channels if not topics or channel.topic in topics]
    return sorted(
        Message(
            batch.channel.topic,
            int(batch.log_times_ns[i]),
            bytes(batch.buffer[batch.offsets[i] : batch.offsets[i] + batch.lengths[i]]),
        )
        for batch in reader.batches(ids, **bounds)
        for i in range(len(batch))
    )
