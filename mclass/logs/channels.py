"""Channels of a log, and their messages as they come out of its chunks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from mclass.records import IntArray


@dataclass(frozen=True)
class ChannelInfo:
    """A channel and its schema.

    Attributes:
        id: Number in the log.
        topic: Name.
        message_encoding: ``cdr``, ``protobuf``, ``json``, ``ros1``, ...
        schema_name: Message type; empty when the channel has no schema.
        schema_encoding: ``ros2msg``, ``protobuf``, ...; empty when there is no schema.
        schema_data: The schema itself.
        message_count: Messages in the log; None when unknown without reading all of it.
        metadata: Of the channel.
    """

    id: int
    topic: str
    message_encoding: str
    schema_name: str
    schema_encoding: str
    schema_data: bytes
    message_count: int | None
    metadata: Mapping[str, str]


@dataclass(frozen=True)
class MessageBatch:
    """Messages of one channel out of one chunk, in file order.

    Message ``i`` is ``buffer[offsets[i] : offsets[i] + lengths[i]]``.

    Attributes:
        channel: Of all of them.
        buffer: The chunk's records.
        offsets: Where payloads begin in ``buffer``, (n,).
        lengths: Bytes of the payloads, (n,).
        log_times_ns: Log times [ns], (n,); those beyond 2262 count as 2^63 - 1.
        first_index: Number of the first message within its channel, from 0; the others
            follow without gap.
    """

    channel: ChannelInfo
    buffer: memoryview | bytes
    offsets: IntArray
    lengths: IntArray
    log_times_ns: IntArray
    first_index: int

    def __len__(self) -> int:
        return len(self.offsets)
