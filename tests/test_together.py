"""Small batches joined: every message of every channel once, in order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from decoding import channel
from hypothesis import given
from hypothesis import strategies as st

from mclass.logs.channels import MessageBatch
from mclass.logs.together import together

CHANNELS = [replace(channel("json", f"c{number}", "", ""), id=number) for number in range(3)]


def made(source: int, sizes: list[int], first: int) -> MessageBatch:
    """Messages that say who they are, padded, with bytes of others before and between."""
    texts = [f"{source}/{first + index}".encode().ljust(size) for index, size in enumerate(sizes)]
    buffer, offsets = b"xx", []
    for text in texts:
        offsets.append(len(buffer))
        buffer += text + b"-" * (len(text) % 3)
    return MessageBatch(
        CHANNELS[source],
        buffer,
        np.array(offsets, np.int64),
        np.array([len(text) for text in texts], np.int64),
        np.arange(first, first + len(sizes), dtype=np.int64),
        first,
    )


SIZES = st.one_of(
    st.lists(st.integers(0, 40), max_size=5),
    st.just([10] * 255),
    st.just([10] * 256),
    st.just([700_000]),
)


@given(st.lists(st.tuples(st.integers(0, 2), SIZES), max_size=12))
def test_messages_are_the_same_in_fewer_batches(shape: list[tuple[int, list[int]]]) -> None:
    counts, batches = [0, 0, 0], []
    for source, sizes in shape:
        batches.append(made(source, sizes, counts[source]))
        counts[source] += len(sizes)
    joined = list(together(iter(batches)))
    assert len(joined) <= len(batches)
    for source, count in enumerate(counts):
        mine = [batch for batch in joined if batch.channel.id == source]
        texts = [
            bytes(batch.buffer[start : start + length]).split()[0]
            for batch in mine
            for start, length in zip(batch.offsets.tolist(), batch.lengths.tolist(), strict=True)
        ]
        assert texts == [f"{source}/{number}".encode() for number in range(count)]
        times = [time for batch in mine for time in batch.log_times_ns.tolist()]
        assert times == list(range(count))
        firsts = [batch.first_index for batch in mine if len(batch)]
        assert firsts == [int(batch.log_times_ns[0]) for batch in mine if len(batch)]


def test_many_small_batches_become_one() -> None:
    batches = [made(number % 2, [9, 9], 2 * (number // 2)) for number in range(100)]
    assert [len(batch) for batch in together(iter(batches))] == [100, 100]


def test_a_chunk_is_not_kept_in_memory() -> None:
    batch = made(0, [9, 9], 0)
    kept = list(together(iter([replace(batch, buffer=bytes(batch.buffer) + bytes(10**6))])))
    assert [len(one.buffer) for one in kept] == [18]
