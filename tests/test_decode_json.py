"""JSON with schemas, with foreign schemas and with none."""

from __future__ import annotations

import json
import math
import re
from typing import Any

import numpy as np
import pytest
from decoding import batch, channel, nested, same
from hypothesis import given, settings
from hypothesis import strategies as st

from mclass.errors import LogError
from mclass.logs.channels import ChannelInfo
from mclass.logs.decode import Columns, decoder_for

STAMP = {"type": "object", "properties": {"nsec": {"type": "integer"}, "sec": {"type": "integer"}}}
SCHEMA = {
    "type": "object",
    "properties": {
        "stamp": STAMP,
        "lifetime": {"title": "duration", **STAMP},
        "date": {"type": "string", "format": "date-time"},
        "frame": {"type": ["null", "string"]},
        "count": {"type": "integer"},
        "valid": {"type": "boolean"},
        "image": {"type": "string", "contentEncoding": "base64"},
        "matrix": {"type": "array", "items": {"type": "array", "items": {"type": "number"}}},
        "boxes": {"type": "array", "items": {"$ref": "#/$defs/a~1b"}},
        "parent": {"$ref": "#"},
        "odd.name": {"type": "number"},
    },
    "$defs": {
        "a/b": {
            "allOf": [{"properties": {"x": {"type": "number"}}}],
            "properties": {"labels": {"type": "array", "items": {"type": "string"}}},
        }
    },
}


def json_channel(schema: Any = None, encoding: str = "jsonschema") -> ChannelInfo:
    return channel("json", "Thing", "" if schema is None else json.dumps(schema), encoding)


def decode(source: ChannelInfo, messages: list[Any], *paths: str) -> Columns:
    decoder = decoder_for(source)
    made = batch(source, [json.dumps(message).encode() for message in messages])
    decoder.learn(made)
    return decoder.columns(made, paths)


def test_paths_of_a_schema() -> None:
    paths = decoder_for(json_channel(SCHEMA)).paths
    own = {path: kind for path, kind in paths.items() if not path.startswith("parent.")}
    assert own == {
        "stamp": "time",
        "lifetime": "int",
        "date": "time",
        "frame": "string",
        "count": "int",
        "valid": "bool",
        "image": "bytes",
        "matrix[][]": "float",
        "boxes[].x": "float",
        "boxes[].labels[]": "string",
    }
    assert not any(path.startswith("parent.parent") for path in paths)


def test_values_by_a_schema() -> None:
    message = {
        "stamp": {"sec": 1700000000, "nsec": 7},
        "lifetime": {"sec": -1, "nsec": 5},
        "date": "2023-11-14T22:13:20.25Z",
        "frame": "odom",
        "count": "12",
        "valid": True,
        "image": "aGk=",
        "matrix": [[1, 2.5], [], [3]],
        "boxes": [{"x": 1, "labels": ["a", "b"]}, {"x": 2.5, "labels": []}],
    }
    empty = {"stamp": {"sec": 0, "nsec": 0}, "lifetime": 4, "date": 3, "count": 2.0}
    source = json_channel(SCHEMA)
    expected = {
        "stamp": [1700000000000000007, 0],
        "lifetime": [-999999995, 4],
        "date": [1700000000250000000, 3],
        "frame": ["odom", ""],
        "count": [12, 2],
        "valid": [True, False],
        "image": [b"hi", b""],
        "matrix[][]": [[[1.0, 2.5], [], [3.0]], []],
        "boxes[].x": [[1.0, 2.5], []],
        "boxes[].labels[]": [[["a", "b"], []], []],
    }
    columns = decode(source, [message, empty], *expected)
    assert columns.failures == {}
    for path, values in expected.items():
        assert same(nested(columns.values[path]), values), path
    dtypes = {path: columns.values[path].values.dtype for path in ("stamp", "boxes[].x", "valid")}
    assert dtypes == {"stamp": np.int64, "boxes[].x": np.float64, "valid": np.bool_}


@pytest.mark.parametrize(
    ("text", "nanoseconds"),
    [
        ("1970-01-01T00:00:00Z", 0),
        ("1970-01-02t00:00:01z", 86401 * 10**9),
        ("1969-12-31T23:59:59.5+00:00", -(10**9) // 2),
        ("2000-03-01T01:30:00+01:30", 951868800 * 10**9),
        ("2000-02-29T22:30:00.123456789123-01:30", 951868800123456789),
        ("2016-12-31T23:59:60Z", 1483228800 * 10**9),
    ],
)
def test_dates(text: str, nanoseconds: int) -> None:
    columns = decode(json_channel(SCHEMA), [{"date": text}], "date")
    assert columns.values["date"].values.tolist() == [nanoseconds]


@pytest.mark.parametrize(
    ("seconds", "nanoseconds"),
    [("sec", "nsec"), ("sec", "nanosec"), ("secs", "nsecs"), ("seconds", "nanos")],
)
def test_stamps_in_every_spelling(seconds: str, nanoseconds: str) -> None:
    stamp = {seconds: 3, nanoseconds: 4}
    columns = decode(json_channel(), [{"header": {"stamp": stamp}}], "header.stamp")
    assert columns.values["header.stamp"].values.tolist() == [3_000_000_004]


@pytest.mark.parametrize("schema", ["", "{}", "uint8 x", '{"type": "object"}', "[1]", "{" * 9000])
def test_learns_paths_from_messages(schema: str) -> None:
    source = channel("json", "Thing", schema, "ros2msg")
    messages = [
        {"t": {"sec": 1, "nsec": 2}, "n": 1, "date": "2020-01-01T00:00:00Z", "boxes": []},
        {"n": 2.5, "k": 3, "id": 7, "boxes": [{"x": None}, {"x": 1, "ok": False}]},
        {"id": "seven", "boxes": [{"x": 2.5, "labels": [["a"], []]}], "a.b": 1, "c[]": 2, "": 3},
    ]
    made = batch(source, [json.dumps(message).encode() for message in messages])
    decoder = decoder_for(source)
    assert decoder.paths == {}
    decoder.learn(made)
    assert decoder.paths == {
        "t": "time",
        "n": "float",
        "date": "time",
        "k": "int",
        "id": "string",
        "boxes[].x": "float",
        "boxes[].ok": "bool",
        "boxes[].labels[][]": "string",
    }
    columns = decoder.columns(made, ["id", "boxes[].x", "boxes[].labels[][]"])
    assert columns.rows.tolist() == [0, 1, 2]
    assert nested(columns.values["id"]) == ["", "7", "seven"]
    assert same(nested(columns.values["boxes[].x"]), [[], [math.nan, 1.0], [2.5]])
    assert nested(columns.values["boxes[].labels[][]"]) == [[], [[], []], [[["a"], []]]]


def test_learned_integers_may_turn_out_fractions() -> None:
    source = json_channel()
    decoder = decoder_for(source)
    decoder.learn(batch(source, [b'{"x": 1}']))
    later = decoder.columns(batch(source, [b'{"x": 2}', b'{"x": 2.5}']), ["x"])
    assert later.values["x"].values.tolist() == [2.0, 2.5]


def test_empty_lists_are_empty_columns() -> None:
    columns = decode(json_channel(SCHEMA), [{"boxes": []}, {}], "boxes[].x", "boxes[].labels[]")
    assert columns.values["boxes[].x"].values.dtype == np.float64
    assert columns.values["boxes[].x"].values.shape == (0,)
    assert [offsets.tolist() for offsets in columns.values["boxes[].labels[]"].offsets] == [
        [0, 0, 0],
        [0],
    ]


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (b"", "not a JSON object"),
        (b"\xff\xfe\x00", "not a JSON object"),
        (b"[1, 2]", "not a JSON object"),
        (b"null", "not a JSON object"),
        (b'{"count": 3', "not a JSON object"),
        (b'{"count": ' + b"9" * 5000 + b"}", "not a JSON object"),
        (b"[" * 100_000, "not a JSON object"),
        (b'{"count": 1, "boxes": 3}', "an array was expected"),
        (b'{"count": 1, "boxes": {"x": 1}}', "an array was expected"),
        (b'{"count": 1, "boxes": [3]}', "an object was expected"),
        (b'{"count": 1, "boxes": [{"x": "wide"}]}', r"boxes\[\].x is missing or no float"),
        (b'{"count": 1, "boxes": [{"x": true}]}', r"boxes\[\].x is missing or no float"),
        (b'{"count": 1, "boxes": [{"x": 1' + b"0" * 400 + b"}]}", r"boxes\[\].x is missing"),
        (b'{"boxes": []}', "count is missing or no int"),
        (b'{"count": 1.5}', "count is missing or no int"),
        (b'{"count": true}', "count is missing or no int"),
        (b'{"count": 9223372036854775808}', "count is missing or no int"),
        (b'{"count": 1, "frame": 2.5}', "frame is missing or no string"),
        (b'{"count": 1, "image": "a"}', "image is missing or no bytes"),
        (b'{"count": 1, "valid": 1}', "valid is missing or no bool"),
    ],
)
def test_leaves_out_what_contradicts_the_schema(message: bytes, reason: str) -> None:
    source = json_channel(SCHEMA)
    good = b'{"count": 5, "boxes": [{"x": 2}]}'
    columns = decoder_for(source).columns(
        batch(source, [good, message, good]), ["count", "boxes[].x", "frame", "image", "valid"]
    )
    assert columns.rows.tolist() == [0, 2]
    assert columns.values["count"].values.tolist() == [5, 5]
    assert nested(columns.values["boxes[].x"]) == [[2.0], [2.0]]
    ((said, count),) = columns.failures.items()
    assert count == 1
    assert re.search(reason, said)


@pytest.mark.parametrize(
    "date", ["2020-13-01T00:00:00Z", "2020-01-01", "yesterday", {"sec": 1}, [1], 2**70, None]
)
def test_leaves_out_what_is_no_time(date: Any) -> None:
    columns = decode(json_channel(SCHEMA), [{"date": date}], "date")
    assert columns.failures == {"date is missing or no time": 1}


def test_half_characters_do_not_get_through() -> None:
    source = json_channel(SCHEMA)
    made = batch(source, [b'{"frame": "\\ud83d\\ude00 \\ud83d!"}'])
    columns = decoder_for(source).columns(made, ["frame"])
    assert columns.values["frame"].values.tolist() == ["\U0001f600 \ufffd!"]


def test_schemas_that_unfold_without_end_are_refused() -> None:
    levels = {
        f"L{level}": {
            "properties": {name: {"$ref": f"#/$defs/L{level + 1}"} for name in ("a", "b")}
        }
        for level in range(40)
    }
    with pytest.raises(LogError, match="/topic: the schema has more than"):
        decoder_for(json_channel({"$ref": "#/$defs/L0", "$defs": levels}))


def test_unknown_path_is_the_callers_mistake() -> None:
    with pytest.raises(KeyError, match="nothing"):
        decode(json_channel(SCHEMA), [{}], "nothing")


_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**70), 2**70) | st.floats() | st.text(max_size=4),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from(["a", "b", "sec", "nsec"]), inner, max_size=3)
    ),
    max_leaves=12,
)


@settings(deadline=None)
@given(st.lists(_VALUES, max_size=4))
def test_anything_is_decoded_or_counted(messages: list[Any]) -> None:
    source = json_channel()
    decoder = decoder_for(source)
    made = batch(source, [json.dumps(message).encode() for message in messages])
    decoder.learn(made)
    columns = decoder.columns(made, list(decoder.paths))
    assert len(columns.rows) + sum(columns.failures.values()) == len(messages)
    for column in columns.values.values():
        assert len(nested(column)) == len(columns.rows)
