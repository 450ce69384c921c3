"""Batches made by hand, and columns put back into nested lists to compare with."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from mclass.logs.channels import ChannelInfo, MessageBatch
from mclass.logs.decode import Column, decoder_for


def channel(encoding: str, name: str, schema: bytes | str, schema_encoding: str) -> ChannelInfo:
    data = schema.encode() if isinstance(schema, str) else schema
    return ChannelInfo(1, "/topic", encoding, name, schema_encoding, data, None, {})


def batch(source: ChannelInfo, messages: Sequence[bytes], before: bytes = b"") -> MessageBatch:
    """Messages behind one another with a byte between, so that nothing is aligned by chance."""
    buffer = bytearray(before)
    offsets = []
    for message in messages:
        buffer += b"\x7f"
        offsets.append(len(buffer))
        buffer += message
    lengths = [len(message) for message in messages]
    times = np.arange(len(messages), dtype=np.int64)
    return MessageBatch(
        source,
        bytes(buffer),
        np.array(offsets, dtype=np.int64),
        np.array(lengths, dtype=np.int64),
        times,
        0,
    )


def nested(column: Column) -> list[Any]:
    """The column's value for each message: a value, or lists for sequences."""
    rows: list[Any] = column.values.tolist()
    for offsets in reversed(column.offsets):
        rows = [rows[a:b] for a, b in itertools.pairwise(offsets.tolist())]
    return rows


def same(actual: Any, expected: Any) -> bool:
    """Equality element by element, types included, with NaN equal to itself."""
    if isinstance(expected, list | tuple | np.ndarray):
        return len(actual) == len(expected) and all(
            same(a, b) for a, b in zip(actual, expected, strict=True)
        )
    if isinstance(expected, float):
        return bool(actual == expected or (np.isnan(actual) and np.isnan(expected)))
    return type(actual) is type(expected) and bool(actual == expected)


def pick(value: Any, path: str) -> Any:
    """What lies at a path in an object of nested attributes, lists for its sequences."""
    name, _, rest = path.partition(".")
    plain = name.removesuffix("[]")
    inner = getattr(value, plain) if plain else value
    if isinstance(inner, np.ndarray):
        inner = inner.tolist()
    if name.endswith("[]"):
        return [pick(item, rest) for item in inner]
    if rest:
        return pick(inner, rest)
    for seconds, nanoseconds in (("sec", "nanosec"), ("seconds", "nanos")):
        if hasattr(inner, nanoseconds):
            return int(getattr(inner, seconds)) * 10**9 + int(getattr(inner, nanoseconds))
    return inner


def assert_decoded(source: ChannelInfo, messages: Sequence[Any], payloads: Sequence[bytes]) -> None:
    """All of a batch is read, and every path of it equals what ``pick`` finds in the messages."""
    decoder = decoder_for(source)
    columns = decoder.columns(batch(source, payloads), list(decoder.paths))
    assert columns.failures == {}
    assert columns.rows.tolist() == list(range(len(messages)))
    assert_columns(columns.values, messages, decoder.paths)


def assert_columns(
    values: dict[str, Column] | Any, messages: Iterable[Any], paths: Iterable[str]
) -> None:
    """Every path of the columns equals what ``pick`` finds in the messages."""
    messages = list(messages)
    for path in paths:
        expected = [pick(message, path) for message in messages]
        assert same(nested(values[path]), expected), path
