"""CDR and ROS 1 against rosbags, on real and on random message definitions."""

from __future__ import annotations

import itertools
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from decoding import assert_columns, assert_decoded, batch, channel, nested, same
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from mclass.errors import LogError
from mclass.logs.channels import ChannelInfo
from mclass.logs.decode import Columns, decoder_for

SEPARATOR = "=" * 80
INTEGERS = {f"{sign}int{bits}": (sign, bits) for sign in ("", "u") for bits in (8, 16, 32, 64)}
NUMBERS = (*INTEGERS, "float32", "float64", "bool")

ROS2 = get_typestore(Stores.ROS2_HUMBLE)
ROS1 = get_typestore(Stores.ROS1_NOETIC)
_serial = itertools.count()


@dataclass(frozen=True)
class Kind:
    """A field of a random definition: its type (a name, or fields) and its array length."""

    type: str | tuple[Kind, ...]
    array: int | None


def kinds(depth: int) -> st.SearchStrategy[Kind]:
    simple = st.sampled_from((*NUMBERS, "string", "Time", "Duration"))
    types: st.SearchStrategy[Any] = simple
    if depth:
        types = st.one_of(simple, structs(depth - 1))
    return st.builds(Kind, types, st.sampled_from((None, None, -1, -1, 1, 3)))


def structs(depth: int) -> st.SearchStrategy[tuple[Kind, ...]]:
    return st.lists(kinds(depth), min_size=1, max_size=4).map(tuple)


def _single(type_: str | tuple[Kind, ...]) -> st.SearchStrategy[Any]:
    if isinstance(type_, tuple):
        return st.tuples(*(values(kind) for kind in type_))
    if type_ in INTEGERS:
        sign, bits = INTEGERS[type_]
        low, high = (0, 2**bits - 1) if sign else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
        return st.integers(low, high)
    if type_.startswith("float"):
        return st.floats(width=int(type_[5:]))  # type: ignore[arg-type]
    if type_ == "bool":
        return st.booleans()
    if type_ == "string":
        return st.text(max_size=9)
    low = 0 if type_ == "Time" else -(2**31)
    return st.tuples(st.integers(low, 2**31 - 1), st.integers(0, 10**9 - 1))


def values(kind: Kind) -> st.SearchStrategy[Any]:
    single = _single(kind.type)
    if kind.array is None:
        return single
    if kind.array == -1:
        return st.lists(single, max_size=3)
    return st.lists(single, min_size=kind.array, max_size=kind.array)


class Encoder:
    """rosbags with one more message type."""

    def __init__(self, root: tuple[Kind, ...], store: Typestore, *, ros1: bool) -> None:
        self.store, self.ros1 = store, ros1
        self.texts: dict[str, str] = {}
        self.name = self.define(root)
        types: dict[str, Any] = {}
        for name, text in self.texts.items():
            types.update(get_types_from_msg(text, name))
        store.register(types)
        others = [name for name in self.texts if name != self.name]
        sections = [f"{SEPARATOR}\nMSG: {name}\n{self.texts[name]}" for name in others]
        schema = "\n".join([self.texts[self.name], *sections])
        encodings = ("ros1", "ros1msg") if ros1 else ("cdr", "ros2msg")
        self.channel = channel(encodings[0], self.name, schema, encodings[1])

    def define(self, fields: tuple[Kind, ...]) -> str:
        name = f"random/msg/T{next(_serial)}"
        lines = []
        for index, kind in enumerate(fields):
            if isinstance(kind.type, tuple):
                type_ = self.define(kind.type)
            elif kind.type in ("Time", "Duration"):
                type_ = kind.type.lower() if self.ros1 else f"builtin_interfaces/{kind.type}"
            else:
                type_ = kind.type
            array = "" if kind.array is None else "[]" if kind.array == -1 else f"[{kind.array}]"
            lines.append(f"{type_}{array} f{index}")
        self.texts[name] = "\n".join(lines)
        return name

    def build(self, fields: tuple[Kind, ...], values: tuple[Any, ...], name: str) -> Any:
        type_names = [line.split()[0].split("[")[0] for line in self.texts[name].splitlines()]
        return self.store.types[name](
            *(
                self.item(kind, value, type_name)
                for kind, value, type_name in zip(fields, values, type_names, strict=True)
            )
        )

    def item(self, kind: Kind, value: Any, type_name: str) -> Any:
        if kind.array is not None and kind.type in NUMBERS:
            return np.array(value, dtype=kind.type)
        if kind.array is not None:
            return [self.item(Kind(kind.type, None), item, type_name) for item in value]
        if isinstance(kind.type, tuple):
            return self.build(kind.type, value, type_name)
        if kind.type in ("Time", "Duration"):
            return self.store.types[f"builtin_interfaces/msg/{kind.type}"](*value)
        return value

    def encode(self, message: Any, *, little_endian: bool = True) -> bytes:
        if self.ros1:
            return bytes(self.store.serialize_ros1(message, self.name))
        return bytes(self.store.serialize_cdr(message, self.name, little_endian=little_endian))


@st.composite
def encoded(draw: st.DrawFn) -> tuple[ChannelInfo, list[Any], list[bytes]]:
    """A random definition with few or many messages of it, mixed in byte order."""
    root = draw(structs(2))
    ros1 = draw(st.booleans())
    encoder = Encoder(root, ROS1 if ros1 else ROS2, ros1=ros1)
    drawn = draw(st.lists(st.tuples(*(values(kind) for kind in root)), min_size=1, max_size=3))
    messages = [encoder.build(root, value, encoder.name) for value in drawn]
    messages *= draw(st.sampled_from((1, 20)))
    orders = draw(st.lists(st.booleans(), min_size=1, max_size=3))
    payloads = [
        encoder.encode(message, little_endian=order)
        for message, order in zip(messages, itertools.cycle(orders), strict=False)
    ]
    return encoder.channel, messages, payloads


SLOW = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])


@SLOW
@given(encoded())
def test_random_messages_as_rosbags_wrote_them(
    case: tuple[ChannelInfo, list[Any], list[bytes]],
) -> None:
    assert_decoded(*case)


@SLOW
@given(encoded(), st.data())
def test_cut_messages_are_left_out(
    case: tuple[ChannelInfo, list[Any], list[bytes]], data: st.DataObject
) -> None:
    source, messages, payloads = case
    decoder = decoder_for(source)
    bad = data.draw(st.sets(st.integers(0, len(payloads) - 1)))
    damaged = [
        payload[: data.draw(st.integers(0, len(payload) - 1))] if index in bad else payload
        for index, payload in enumerate(payloads)
    ]
    columns = decoder.columns(batch(source, damaged), list(decoder.paths))
    good = [index for index in range(len(payloads)) if index not in bad]
    assert columns.rows.tolist() == good
    assert sum(columns.failures.values()) == len(bad)
    assert_columns(columns.values, [messages[index] for index in good], decoder.paths)


@SLOW
@given(encoded(), st.data())
def test_damaged_messages_read_alike_alone_and_together(
    case: tuple[ChannelInfo, list[Any], list[bytes]], data: st.DataObject
) -> None:
    source, _, payloads = case
    decoder = decoder_for(source)
    paths = list(decoder.paths)
    damaged = []
    for payload in payloads:
        content = bytearray(payload)
        for _ in range(data.draw(st.integers(0, 2))):
            content[data.draw(st.integers(0, len(content) - 1))] = data.draw(
                st.sampled_from((0, 1, 4, 127, 255))
            )
        damaged.append(bytes(content))
    together = decoder.columns(batch(source, damaged), paths)
    alone = [decoder.columns(batch(source, [content]), paths) for content in damaged]
    assert together.rows.tolist() == [row for row, one in enumerate(alone) if len(one.rows)]
    assert together.failures == _summed(alone)
    for path in paths:
        expected = [value for one in alone for value in nested(one.values[path])]
        assert same(nested(together.values[path]), expected)


def _summed(parts: list[Columns]) -> dict[str, int]:
    total: dict[str, int] = {}
    for part in parts:
        for reason, count in part.failures.items():
            total[reason] = total.get(reason, 0) + count
    return total


@pytest.mark.parametrize("repeats", [1, 12])
def test_padding_within_and_between_elements(repeats: int) -> None:
    inner = (Kind("uint8", None), Kind("float64", None), Kind("uint16", None))
    outer = (Kind("string", None), Kind(inner, -1), Kind("uint8", None))
    root = (Kind(outer, -1), Kind(inner, -1), Kind(inner, 3))
    encoder = Encoder(root, ROS2, ros1=False)
    inners = [(number, number * 0.5, number + 300) for number in range(4)]
    outers = [("x" * number, inners[: number % 5], number) for number in range(7)]
    messages = [
        encoder.build(root, (outers[:count], inners[:count], inners[1:]), encoder.name)
        for count in (7, 0, 1, 3) * repeats
    ]
    decoder = decoder_for(encoder.channel)
    made = batch(encoder.channel, [encoder.encode(message) for message in messages])
    columns = decoder.columns(made, list(decoder.paths))
    assert columns.failures == {}
    assert_columns(columns.values, messages, decoder.paths)


def test_real_messages_as_rosbags_wrote_them() -> None:
    types = ROS2.types
    stamp = types["builtin_interfaces/msg/Time"]
    header = types["std_msgs/msg/Header"](stamp(1700000000, 123456789), "odom")
    pose = types["geometry_msgs/msg/Pose"](
        types["geometry_msgs/msg/Point"](1.5, -2.5, 0.25),
        types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.6, 0.8),
    )
    vector = types["geometry_msgs/msg/Vector3"]
    covariance = np.arange(36.0)
    odometry = types["nav_msgs/msg/Odometry"](
        header,
        "base_link",
        types["geometry_msgs/msg/PoseWithCovariance"](pose, covariance),
        types["geometry_msgs/msg/TwistWithCovariance"](
            types["geometry_msgs/msg/Twist"](vector(1.0, 2.0, 3.0), vector(4.0, 5.0, np.inf)),
            covariance + 0.5,
        ),
    )
    name = "nav_msgs/msg/Odometry"
    schema, _ = ROS2.generate_msgdef(name, ros_version=2)
    source = channel("cdr", name, schema, "ros2msg")
    decoder = decoder_for(source)
    payload = bytes(ROS2.serialize_cdr(odometry, name))
    columns = decoder.columns(batch(source, [payload, payload]), list(decoder.paths))
    assert columns.values["header.stamp"].values.tolist() == [1700000000123456789] * 2
    assert columns.values["pose.covariance"].values.shape == (2, 36)
    assert decoder.paths["twist.twist.angular.z"] == "float"
    assert_columns(columns.values, [odometry, odometry], decoder.paths)


LAYOUT = f"""
bool[3] flags
string name
float64[] wide
Item[] items
uint16 last
{SEPARATOR}
MSG: pkg/Item
uint8 tag
string text
"""
# flags; "hi" with its length, five bytes in; wide, behind a length and padding; two items.
LITTLE = (
    b"\0\1\0\0"
    b"\1\0\1\0"
    b"\3\0\0\0hi\0\0"
    b"\1\0\0\0" + struct.pack("<d", -0.25) + b"\2\0\0\0"
    b"\7\0\0\0\1\0\0\0\0"
    b"\x08\0\0\2\0\0\0x\0"
    b"\x34\x12"
)


def layout_columns(*payloads: bytes) -> Columns:
    source = channel("cdr", "pkg/msg/Root", LAYOUT, "ros2msg")
    decoder = decoder_for(source)
    assert dict(decoder.paths) == {
        "flags": "bool",
        "name": "string",
        "wide[]": "float",
        "items[].tag": "int",
        "items[].text": "string",
        "last": "int",
    }
    return decoder.columns(batch(source, payloads), list(decoder.paths))


def test_bytes_by_hand() -> None:
    columns = layout_columns(LITTLE, LITTLE)
    assert columns.failures == {}
    assert nested(columns.values["flags"]) == [[True, False, True]] * 2
    assert nested(columns.values["name"]) == ["hi", "hi"]
    assert nested(columns.values["wide[]"]) == [[-0.25]] * 2
    assert nested(columns.values["items[].tag"]) == [[7, 8]] * 2
    assert nested(columns.values["items[].text"]) == [["", "x"]] * 2
    assert nested(columns.values["last"]) == [0x1234] * 2


def test_an_array_of_nothing_is_there_wherever_it_stands() -> None:
    schema = f"Inner inner\nbyte[0] none\n{'=' * 80}\nMSG: pkg/Inner\nint8 number\nbyte[0] none"
    source = channel("cdr", "pkg/msg/Root", f"string name\n{schema}", "ros2msg")
    columns = decoder_for(source).columns(
        batch(source, [b"\0\1\0\0" + b"\1\0\0\0\0" + b"\7"]),
        ["none", "inner.none", "inner.number"],
    )
    assert {path: nested(column) for path, column in columns.values.items()} == {
        "none": [[]],
        "inner.none": [[]],
        "inner.number": [7],
    }
    last = channel("cdr", "pkg/msg/Root", "string name\nbyte[0] none", "ros2msg")
    columns = decoder_for(last).columns(batch(last, [b"\0\1\0\0" + bytes(4)]), ["none"])
    assert nested(columns.values["none"]) == [[]]


def _patched(at: int, value: bytes) -> bytes:
    return LITTLE[:at] + value + LITTLE[at + len(value) :]


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", "too short for a CDR header"),
        (b"\0\1\0", "too short for a CDR header"),
        (b"\0\1\0\0", "ends before its last field"),
        (_patched(1, b"\3"), "CDR header is not that of plain CDR"),
        (_patched(1, b"\7"), "CDR header is not that of plain CDR"),
        (_patched(0, b"\x2a"), "CDR header is not that of plain CDR"),
        (_patched(8, b"\xff\xff\xff\xff"), "a string is longer than its message"),
        (_patched(8, b"\0\0\0\x80"), "a string is longer than its message"),
        (_patched(16, b"\xff\xff\xff\xff"), "a sequence is longer than its message"),
        (_patched(28, b"\xff\xff\xff\xff"), "a sequence is longer than its message"),
        (_patched(36, b"\x20"), "a string is longer than its message"),
        (LITTLE[:-1], "ends before its last field"),
        (LITTLE + bytes(4), "goes on behind its last field"),
    ],
)
@pytest.mark.parametrize("others", [1, 40])
def test_lying_payloads_are_left_out(payload: bytes, reason: str, others: int) -> None:
    columns = layout_columns(*[LITTLE] * others, payload, LITTLE)
    assert columns.rows.tolist() == [*range(others), others + 1]
    ((said, count),) = columns.failures.items()
    assert reason in said
    assert count == 1
    assert nested(columns.values["items[].text"]) == [["", "x"]] * (others + 1)


def test_padding_behind_a_payload_is_allowed() -> None:
    assert layout_columns(LITTLE + bytes(3)).failures == {}


def test_strings_need_no_final_zero_and_no_sound_characters() -> None:
    odd = _patched(12, b"\xffi!")
    empty = LITTLE[:8] + bytes(4) + LITTLE[16:20] + bytes(4) + LITTLE[20:]
    columns = layout_columns(odd, empty)
    assert nested(columns.values["name"]) == ["\ufffdi!", ""]


def test_no_messages_are_empty_columns() -> None:
    columns = layout_columns()
    assert columns.rows.shape == (0,)
    assert columns.values["flags"].values.shape == (0, 3)
    assert [offsets.tolist() for offsets in columns.values["items[].tag"].offsets] == [[0]]


def test_only_what_is_wanted_is_returned() -> None:
    source = channel("cdr", "pkg/msg/Root", LAYOUT, "ros2msg")
    decoder = decoder_for(source)
    columns = decoder.columns(batch(source, [LITTLE]), ["last", "items[].tag", "last"])
    assert set(columns.values) == {"last", "items[].tag"}
    with pytest.raises(KeyError, match="lost"):
        decoder.columns(batch(source, [LITTLE]), ["lost"])


def test_a_hundred_thousand_elements_in_one_message() -> None:
    count = 100_000
    schema = f"Item[] items\n{SEPARATOR}\nMSG: pkg/Item\nstring text\nuint32 number"
    source = channel("ros1", "pkg/Root", schema, "ros1msg")
    items = b"".join(
        struct.pack("<I", number % 3) + b"abc"[: number % 3] + struct.pack("<I", number)
        for number in range(count)
    )
    payload = struct.pack("<I", count) + items
    decoder = decoder_for(source)
    columns = decoder.columns(batch(source, [payload, bytes(4)]), list(decoder.paths))
    assert columns.values["items[].number"].values.tolist() == list(range(count))
    assert columns.values["items[].text"].values[:4].tolist() == ["", "a", "ab", ""]
    assert columns.values["items[].text"].offsets[0].tolist() == [0, count, count]


def test_long_number_lists_keep_their_width() -> None:
    source = channel("ros1", "pkg/Root", "uint8[] data\nduration[] waits", "ros1msg")
    data = bytes(range(256)) * 4
    payload = struct.pack("<I", len(data)) + data + struct.pack("<Iii", 1, -2, 5)
    decoder = decoder_for(source)
    columns = decoder.columns(batch(source, [payload]), ["data[]", "waits[]"])
    assert columns.values["data[]"].values.dtype == np.uint8
    assert columns.values["data[]"].values.tobytes() == data
    assert columns.values["waits[]"].values.tolist() == [-1999999995]


def test_elements_without_bytes_cannot_be_claimed_without_end() -> None:
    schema = f"Empty[] items\n{SEPARATOR}\nMSG: pkg/Empty\n"
    source = channel("ros1", "pkg/Root", f"{schema}{SEPARATOR}\nMSG: pkg/X\nint8 a", "ros1msg")
    decoder = decoder_for(source)
    columns = decoder.columns(batch(source, [b"\xff\xff\xff\xff", bytes(4)]), [])
    assert columns.rows.tolist() == [1]
    assert columns.failures == {"a sequence is longer than its message": 1}


def _doubling(levels: int, dialect: str) -> str:
    last = "int8 x" if dialect == "ros2msg" else ""
    parts = [
        f"{SEPARATOR}\nMSG: p/T{level}\nT{level + 1} a\nT{level + 1} b" for level in range(levels)
    ]
    return "\n".join(["T0 t", *parts, f"{SEPARATOR}\nMSG: p/T{levels}\n{last}"])


@pytest.mark.parametrize(
    ("encoding", "schema", "schema_encoding", "message"),
    [
        ("cdr", "", "ros2msg", "is empty"),
        ("cdr", "# not here", "ros2msg", "defines no fields"),
        ("cdr", b"\xff\xfe", "ros2msg", "is not UTF-8"),
        ("cdr", "wstring w", "ros2msg", "'w' is a wstring"),
        ("cdr", _doubling(40, "ros2msg"), "ros2msg", "more than"),
        ("ros1", _doubling(40, "ros1msg"), "ros1msg", "more than"),
        ("ros1", "int8 x", "ros2msg", "cannot be decoded"),
        ("cdr", "int8 x", "protobuf", "cannot be decoded"),
        ("cdr", "module p {};", "ros2idl", "cannot be decoded"),
        ("", "", "", "cannot be decoded"),
    ],
)
def test_unusable_channels_are_refused(
    encoding: str, schema: bytes | str, schema_encoding: str, message: str
) -> None:
    with pytest.raises(LogError, match=message) as caught:
        decoder_for(channel(encoding, "p/msg/Root", schema, schema_encoding))
    assert caught.value.topic == "/topic"
    assert str(caught.value).startswith("topic /topic: ")
