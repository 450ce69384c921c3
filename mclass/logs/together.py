"""Small batches of messages made large: arrays pay for many messages at once.

Where images lie between a robot's poses, a chunk holds few of either.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from mclass.logs.channels import MessageBatch

_MANY = 256
"""Batches of so many messages are left as they are."""

_BYTES = 1 << 20
"""Payloads of so many bytes wait at most."""


def together(batches: Iterable[MessageBatch]) -> Iterator[MessageBatch]:
    """The same messages, those of each channel in the same order, in larger batches.

    Where messages of several chunks are together, ``first_index`` is that of the first one;
    if a chunk between was lost, the others do not follow without gap.
    """
    waiting: dict[int, list[MessageBatch]] = {}
    for batch in batches:
        small = waiting.setdefault(batch.channel.id, [])
        if len(batch) < _MANY:
            small.append(_alone(batch))
        full = sum(map(len, small)) >= _MANY or sum(len(b.buffer) for b in small) >= _BYTES
        if small and (full or len(batch) >= _MANY):
            yield _joined(small)
            small.clear()
        if len(batch) >= _MANY:
            yield batch
    for small in waiting.values():
        if small:
            yield _joined(small)


def _alone(batch: MessageBatch) -> MessageBatch:
    """A batch that does not keep its chunk in memory."""
    buffer = memoryview(batch.buffer)
    stops = batch.offsets + batch.lengths
    pieces = [
        buffer[start:stop]
        for start, stop in zip(batch.offsets.tolist(), stops.tolist(), strict=True)
    ]
    return _with_buffer([batch], b"".join(pieces))


def _joined(batches: list[MessageBatch]) -> MessageBatch:
    return _with_buffer(batches, b"".join(batch.buffer for batch in batches))


def _with_buffer(batches: list[MessageBatch], buffer: bytes) -> MessageBatch:
    """Messages of one channel that stand end to end in a buffer."""
    lengths = np.concatenate([batch.lengths for batch in batches])
    return MessageBatch(
        batches[0].channel,
        buffer,
        np.cumsum(lengths) - lengths,
        lengths,
        np.concatenate([batch.log_times_ns for batch in batches]),
        batches[0].first_index,
    )
