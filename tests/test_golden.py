"""The outputs of the sample logs, decoded, are what they were.

After an intended change, ``python tests/test_golden.py`` writes the expectations anew; look at
what changed before committing it. Messages are decoded by other projects' readers.
"""

from __future__ import annotations

import json
import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory as ProtobufDecoder
from mcap_ros2.decoder import DecoderFactory as RosDecoder
from sample_runs import SAMPLE_NAMES, estimated

GOLDEN = Path(__file__).parent / "golden"
DECODERS = (RosDecoder(), ProtobufDecoder())
_LONG = 16
"""More numbers than this are kept as how many they are and two sums over them."""


def decoded(output: Path) -> dict[str, Any]:
    """Every new channel: its type, how many messages, and the last one in short."""
    channels: dict[str, Any] = {}
    with output.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            if not channel.topic.startswith("/mclass"):
                continue
            assert schema is not None
            entry = channels.setdefault(channel.topic, {"messages": 0})
            entry["messages"] += 1
            entry |= {"type": schema.name, "encoding": channel.message_encoding}
            if channel.message_encoding == "json":
                entry["last"] = short(json.loads(message.data))
                continue
            decoders = (d.decoder_for(channel.message_encoding, schema) for d in DECODERS)
            decode = next(decoder for decoder in decoders if decoder is not None)
            entry["last"] = short(plain(decode(message.data)))
    return dict(sorted(channels.items()))


def plain(value: Any) -> Any:
    """A decoded message as dictionaries, lists, texts and numbers."""
    if hasattr(value, "DESCRIPTOR"):
        return {field.name: plain(getattr(value, field.name)) for field in value.DESCRIPTOR.fields}
    if hasattr(value, "_full_text"):
        return {name: plain(getattr(value, name)) for name in value.__slots__}
    if isinstance(value, str | bytes | int | float):
        return value
    return [plain(entry) for entry in value]


def short(value: Any) -> Any:
    """The same without long lists of numbers."""
    if isinstance(value, dict):
        if "cell_stride" in value:
            value = {**value, "data": grid_fields(value)}
        return {key: short(entry) for key, entry in value.items()}
    if isinstance(value, bytes):
        value = np.frombuffer(value, dtype=np.int8).tolist()
    if isinstance(value, list):
        if len(value) > _LONG and isinstance(value[0], int | float):
            return sums(value)
        return [short(entry) for entry in value]
    if isinstance(value, float):
        return float(f"{value:.9g}") if math.isfinite(value) else str(value)
    return value


def grid_fields(grid: dict[str, Any]) -> dict[str, Any]:
    """The numbers in a Foxglove grid, by field: float32 probabilities and bytes of colour."""
    data, stride = grid["data"], grid["cell_stride"]
    found = {}
    for field in grid["fields"]:
        number = np.dtype({1: "u1", 7: "<f4"}[field["type"]])
        shape, offset = (len(data) // stride,), field["offset"]
        found[field["name"]] = np.ndarray(shape, number, data, offset, (stride,)).tolist()
    return found


def sums(numbers: list[float]) -> dict[str, Any]:
    """How many, their sum, and their sum weighted by place: order matters, too."""
    values = np.array(numbers, dtype=float)
    finite = np.where(np.isfinite(values), values, 0.0)
    weighted = finite @ np.arange(1.0, len(values) + 1.0) / len(values)
    return {
        "numbers": len(values),
        "infinite": int(len(values) - np.isfinite(values).sum()),
        "sum": float(f"{finite.sum():.9g}"),
        "weighted": float(f"{weighted:.9g}"),
    }


def assert_same(found: Any, expected: Any, where: str) -> None:
    """Equal in structure, texts and counts; numbers to a millionth."""
    assert type(found) is type(expected), where
    if isinstance(expected, dict):
        assert list(found) == list(expected), where
        for key in expected:
            assert_same(found[key], expected[key], f"{where}.{key}")
    elif isinstance(expected, list):
        assert len(found) == len(expected), where
        for index, (a, b) in enumerate(zip(found, expected, strict=True)):
            assert_same(a, b, f"{where}[{index}]")
    elif isinstance(expected, float):
        assert found == pytest.approx(expected, rel=1e-6, abs=1e-7), where
    else:
        assert found == expected, where


@pytest.mark.parametrize("name", SAMPLE_NAMES)
def test_outputs_are_what_they_were(name: str, tmp_path: Path) -> None:
    expected = json.loads((GOLDEN / f"{name}.json").read_text(encoding="utf-8"))
    assert_same(decoded(estimated(name, tmp_path)), expected, name)


def test_comparison_can_fail() -> None:
    expected = short({"a": [float(i) for i in range(40)], "b": [1.0, 2.0], "c": "text"})
    for found in (
        {"a": [float(i) for i in range(40)][::-1], "b": [1.0, 2.0], "c": "text"},
        {"a": [float(i) for i in range(40)], "b": [1.0, 2.00001], "c": "text"},
        {"a": [float(i) for i in range(40)], "b": [1.0, 2.0], "c": "other"},
        {"a": [float(i) for i in range(40)], "b": [1.0, 2.0]},
    ):
        with pytest.raises(AssertionError):
            assert_same(short(found), expected, "")


def write_expectations() -> None:
    with tempfile.TemporaryDirectory() as folder:
        for name in SAMPLE_NAMES:
            document = decoded(estimated(name, Path(folder)))
            lines = (f"{json.dumps(t)}: {json.dumps(c)}" for t, c in document.items())
            text = "{\n" + ",\n".join(lines) + "\n}\n"
            (GOLDEN / f"{name}.json").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    write_expectations()
