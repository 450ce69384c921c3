"""Protobuf against Google's own classes, on Foxglove's and on random schemas."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
from decoding import assert_columns, assert_decoded, batch, channel, nested, same
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf import descriptor_pool, message_factory
from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)
from google.protobuf.duration_pb2 import Duration
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mclass.errors import LogError
from mclass.logs.channels import ChannelInfo
from mclass.logs.decode import decoder_for, is_absent

F = FieldDescriptorProto
RANGES: dict[Any, tuple[int, int]] = {
    F.TYPE_INT32: (-(2**31), 2**31 - 1),
    F.TYPE_SINT32: (-(2**31), 2**31 - 1),
    F.TYPE_SFIXED32: (-(2**31), 2**31 - 1),
    F.TYPE_UINT32: (0, 2**32 - 1),
    F.TYPE_FIXED32: (0, 2**32 - 1),
    F.TYPE_INT64: (-(2**63), 2**63 - 1),
    F.TYPE_SINT64: (-(2**63), 2**63 - 1),
    F.TYPE_SFIXED64: (-(2**63), 2**63 - 1),
    F.TYPE_UINT64: (0, 2**64 - 1),
    F.TYPE_FIXED64: (0, 2**64 - 1),
    F.TYPE_ENUM: (-(2**31), 2**31 - 1),
}
SCALARS = (*RANGES, F.TYPE_BOOL, F.TYPE_FLOAT, F.TYPE_DOUBLE, F.TYPE_STRING, F.TYPE_BYTES)
STAMPS = {".google.protobuf.Timestamp": Timestamp, ".google.protobuf.Duration": Duration}

_serial = itertools.count()


def file_set(file: Any) -> bytes:
    """A file and all it depends on, serialised."""
    seen: dict[str, Any] = {}

    def visit(one: Any) -> None:
        if one.name not in seen:
            for dependency in one.dependencies:
                visit(dependency)
            seen[one.name] = one

    visit(file)
    files = FileDescriptorSet()
    for one in seen.values():
        one.CopyToProto(files.file.add())
    return files.SerializeToString()


def proto_channel(message: type[Message]) -> ChannelInfo:
    descriptor = message.DESCRIPTOR
    return channel("protobuf", descriptor.full_name, file_set(descriptor.file), "protobuf")


@st.composite
def message_types(draw: st.DrawFn, depth: int, name: str) -> DescriptorProto:
    """A random message type; its nested types are declared within it."""
    message = DescriptorProto(name=name)
    numbers = draw(
        st.lists(
            st.one_of(st.integers(1, 20), st.sampled_from((16, 2048, 2**29 - 1))),
            min_size=1,
            max_size=5,
            unique=True,
        )
    )
    for number in numbers:
        field = message.field.add(name=f"f{number}", number=number)
        field.label = draw(st.sampled_from((F.LABEL_OPTIONAL, F.LABEL_REPEATED)))
        kind = draw(st.sampled_from(("scalar", "scalar", "stamp", "message")))
        if kind == "message" and depth:
            message.nested_type.append(draw(message_types(depth - 1, f"M{number}")))
            field.type, field.type_name = F.TYPE_MESSAGE, f"M{number}"
        elif kind == "stamp":
            field.type, field.type_name = F.TYPE_MESSAGE, draw(st.sampled_from(sorted(STAMPS)))
        else:
            field.type = draw(st.sampled_from(SCALARS))
            if field.type == F.TYPE_ENUM:
                field.type_name = ".random.Choice"
            elif field.label == F.LABEL_REPEATED and field.type not in (
                F.TYPE_STRING,
                F.TYPE_BYTES,
            ):
                field.options.packed = True
    return message


def qualify(message: DescriptorProto, name: str, *, packed: bool) -> None:
    """Give nested types their full names; pack numbers or not."""
    for field in message.field:
        if field.type == F.TYPE_MESSAGE and not field.type_name.startswith("."):
            field.type_name = f"{name}.{field.type_name}"
        if field.options.packed:
            field.options.packed = packed
    for inner in message.nested_type:
        qualify(inner, f"{name}.{inner.name}", packed=packed)


def make_class(root: DescriptorProto, *, packed: bool) -> type[Message]:
    """A class of Google's for a message type."""
    file = FileDescriptorProto(name=f"random{next(_serial)}.proto", package="random")
    file.syntax = "proto3"
    file.dependency.extend(["google/protobuf/timestamp.proto", "google/protobuf/duration.proto"])
    file.message_type.add().CopyFrom(root)
    qualify(file.message_type[0], f".random.{root.name}", packed=packed)
    choice = file.enum_type.add(name="Choice")
    choice.value.add(name="NONE", number=0)
    choice.value.add(name="SEVEN", number=7)
    pool = descriptor_pool.DescriptorPool()
    for known in (Timestamp, Duration):
        pool.AddSerializedFile(known.DESCRIPTOR.file.serialized_pb)
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(f"random.{root.name}"))


def draw_scalar(draw: st.DrawFn, type_: int) -> Any:
    if type_ in RANGES:
        low, high = RANGES[type_]
        return draw(st.one_of(st.integers(low, high), st.sampled_from((low, high, 0, 127, 128))))
    strategies: dict[int, st.SearchStrategy[Any]] = {
        F.TYPE_BOOL: st.booleans(),
        F.TYPE_FLOAT: st.floats(width=32),
        F.TYPE_DOUBLE: st.floats(),
        F.TYPE_STRING: st.text(max_size=6),
        F.TYPE_BYTES: st.binary(max_size=6),
    }
    return draw(strategies[type_])


def fill(draw: st.DrawFn, message: Any) -> None:
    """Set some of the fields of a message, at any depth."""
    for field in message.DESCRIPTOR.fields:
        repeated = field.is_repeated
        for _ in range(draw(st.integers(0, 3 if repeated else 1))):
            if field.type != F.TYPE_MESSAGE:
                value = draw_scalar(draw, field.type)
                if repeated:
                    getattr(message, field.name).append(value)
                else:
                    setattr(message, field.name, value)
                continue
            inner = getattr(message, field.name)
            inner = inner.add() if repeated else inner
            inner.SetInParent()
            if field.message_type.full_name.startswith("google."):
                inner.seconds = draw(st.integers(-(9 * 10**9), 9 * 10**9))
                inner.nanos = draw(st.integers(0, 10**9 - 1))
            else:
                fill(draw, inner)


@st.composite
def encoded(draw: st.DrawFn) -> tuple[ChannelInfo, list[Any], list[bytes]]:
    """Messages of a random type: some the merger of two, numbers packed or not or both."""
    root = draw(message_types(2, "Root"))
    classes = [make_class(root, packed=packed) for packed in (True, False)]
    payloads = []
    for _ in range(draw(st.integers(1, 3))):
        payload = b""
        for _ in range(draw(st.integers(1, 2))):
            message = draw(st.sampled_from(classes))()
            fill(draw, message)
            payload += message.SerializeToString()
        payloads.append(payload)
    payloads *= draw(st.sampled_from((1, 20, 60)))
    messages = [classes[0].FromString(payload) for payload in payloads]
    return proto_channel(classes[0]), messages, payloads


SLOW = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])


@SLOW
@given(encoded())
def test_random_messages_as_google_reads_them(
    case: tuple[ChannelInfo, list[Any], list[bytes]],
) -> None:
    assert_decoded(*case)


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
        for _ in range(data.draw(st.integers(0, 2)) if content else 0):
            content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
        damaged.append(bytes(content))
    together = decoder.columns(batch(source, damaged), paths)
    alone = [decoder.columns(batch(source, [content]), paths) for content in damaged]
    assert together.rows.tolist() == [row for row, one in enumerate(alone) if len(one.rows)]
    assert sum(together.failures.values()) == len(damaged) - len(together.rows)
    for path in paths:
        expected = [value for one in alone for value in nested(one.values[path])]
        assert same(nested(together.values[path]), expected)


@st.composite
def alike(draw: st.DrawFn) -> tuple[ChannelInfo, list[Any], list[bytes]]:
    """Many messages without lists, most of them with the same fields as another one."""
    root = draw(message_types(2, "Root"))
    for message in (root, *root.nested_type, *(m for n in root.nested_type for m in n.nested_type)):
        for field in message.field:
            field.label = F.LABEL_OPTIONAL
            field.options.ClearField("packed")
    make = make_class(root, packed=True)
    messages: list[Any] = []
    for _ in range(draw(st.integers(1, 3))):
        first: Any = make()
        fill(draw, first)
        for number in range(draw(st.sampled_from((1, 30, 70)))):
            messages.append(make())
            messages[-1].CopyFrom(first)
            vary(messages[-1], number)
    messages = draw(st.permutations(messages))
    payloads = [message.SerializeToString() for message in messages]
    return proto_channel(make), messages, payloads


def vary(message: Any, number: int) -> None:
    """Change the values that are there; mostly each takes as many bytes as before."""
    for field, value in message.ListFields():
        if field.type == F.TYPE_MESSAGE:
            vary(value, number)
        elif field.type in (F.TYPE_FLOAT, F.TYPE_DOUBLE):
            setattr(message, field.name, value * 0.5 + number)
        elif field.type == F.TYPE_STRING:
            setattr(message, field.name, value[:-1] + chr(number % 32 + 65))
        elif field.type == F.TYPE_BYTES:
            setattr(message, field.name, value[:-1] + bytes([number]))
        elif field.type not in (F.TYPE_BOOL, F.TYPE_ENUM):
            setattr(message, field.name, value ^ (number % 8))


@SLOW
@given(alike())
def test_messages_alike_as_google_reads_them(
    case: tuple[ChannelInfo, list[Any], list[bytes]],
) -> None:
    assert_decoded(*case)


@SLOW
@given(alike(), st.data())
def test_one_message_changed_among_those_alike(
    case: tuple[ChannelInfo, list[Any], list[bytes]], data: st.DataObject
) -> None:
    source, _, payloads = case
    decoder = decoder_for(source)
    paths = list(decoder.paths)
    for _ in range(data.draw(st.integers(1, 4))):
        row = data.draw(st.integers(0, len(payloads) - 1))
        content = bytearray(payloads[row])
        if content:
            content[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
        payloads[row] = bytes(content)
    together = decoder.columns(batch(source, payloads), paths)
    alone = [decoder.columns(batch(source, [content]), paths) for content in payloads]
    assert together.rows.tolist() == [row for row, one in enumerate(alone) if len(one.rows)]
    for path in paths:
        expected = [value for one in alone for value in nested(one.values[path])]
        assert same(nested(together.values[path]), expected)


def test_skeletons_of_every_kind_of_field() -> None:
    file = FileDescriptorProto(name="hand.proto", package="hand", syntax="proto2")
    root, inner = file.message_type.add(name="Root"), file.message_type.add(name="Inner")
    root.field.append(one(F.TYPE_MESSAGE, 1, type_name=".hand.Inner"))
    root.field.append(one(F.TYPE_STRING, 2, default_value="none"))
    root.field.append(one(F.TYPE_SINT64, 3, default_value="-7"))
    root.field.append(one(F.TYPE_MESSAGE, 4, type_name=STAMP))
    root.field.append(one(F.TYPE_UINT32, 5))
    inner.field.append(one(F.TYPE_FLOAT, 1))
    inner.field.append(one(F.TYPE_FIXED64, 2))
    files = FileDescriptorSet(file=[file])
    source = channel("protobuf", "hand.Root", files.SerializeToString(), "protobuf")
    decoder = decoder_for(source)
    # The inner message in two parts, the first one's float superseded; a string; a varint of
    # ten bytes (sint64: the least there is); 3 s and -1 ns; field 5 as a string, so unknown.
    full = (
        b"\x0a\x0e\x0d\x00\x00\x80\x3f\x11\xfe\xff\xff\xff\xff\xff\xff\xff"
        b"\x0a\x05\x0d\x00\x00\x20\xc0"
        b"\x12\x02%b\x18" + b"\xff" * 9 + b"\x01"
        b"\x22\x0d\x08\x03\x10" + b"\xff" * 9 + b"\x01\x2a\x01x"
    )
    short = b"\x18\x05"
    payloads = [full % (b"a" + bytes([65 + row % 3])) for row in range(40)] + [short] * 30
    payloads += [b"", b"\x12\x00\x28\x96\x01"]
    columns = decoder.columns(batch(source, payloads), list(decoder.paths))
    names = ("f1.f1", "f1.f2", "f2", "f3", "f4", "f5")
    rows = list(zip(*(columns.values[name].values.tolist() for name in names), strict=True))
    least, stamp = -(2**63), 3 * 10**9 - 1
    assert rows[:40] == [
        (-2.5, 2**64 - 2, f"a{'ABC'[row % 3]}", least, stamp, 0) for row in range(40)
    ]
    assert rows[40:70] == [(0.0, 0, "none", -3, 0, 0)] * 30
    assert rows[70:] == [(0.0, 0, "none", -7, 0, 0), (0.0, 0, "", -7, 0, 150)]
    assert all(column.values.base is None for column in columns.values.values())


def test_foxglove_messages() -> None:
    poses = []
    for step in range(40):
        pose = PoseInFrame(frame_id="odom")
        pose.timestamp.FromNanoseconds(1700000000_000000000 + step * 50_000_001)
        pose.pose.position.x = step * 0.5
        pose.pose.position.y = -1.25 if step % 3 else 0.0
        pose.pose.orientation.w = 1.0
        poses.append(pose)
    source = proto_channel(PoseInFrame)
    decoder = decoder_for(source)
    assert dict(decoder.paths) == {
        "timestamp": "time",
        "frame_id": "string",
        **{f"pose.position.{axis}": "float" for axis in "xyz"},
        **{f"pose.orientation.{axis}": "float" for axis in "xyzw"},
    }
    made = batch(source, [pose.SerializeToString() for pose in poses])
    assert_columns(decoder.columns(made, list(decoder.paths)).values, poses, decoder.paths)


def test_levels_of_nested_messages() -> None:
    annotations = ImageAnnotations()
    for name, pairs in (("door", [("id", "o1"), ("score", "0.5")]), ("box", [])):
        text = annotations.texts.add(text=name)
        text.position.x = 3.5
        for key, value in pairs:
            text.metadata.add(key=key, value=value)
    source = proto_channel(ImageAnnotations)
    decoder = decoder_for(source)
    made = batch(source, [b"", annotations.SerializeToString()])
    columns = decoder.columns(made, ["texts[].text", "texts[].metadata[].value"])
    assert nested(columns.values["texts[].text"]) == [[], ["door", "box"]]
    offsets = columns.values["texts[].metadata[].value"].offsets
    assert [level.tolist() for level in offsets] == [[0, 0, 2], [0, 2, 2]]
    assert columns.values["texts[].metadata[].value"].values.tolist() == ["o1", "0.5"]


def hand_channel(syntax: str, *fields: FieldDescriptorProto) -> ChannelInfo:
    """A channel of messages ``hand.Root`` with these fields and a few types to use."""
    file = FileDescriptorProto(name="hand.proto", package="hand", syntax=syntax)
    root = file.message_type.add(name="Root")
    root.field.extend(fields)
    entry = root.nested_type.add(name="Entry")
    entry.options.map_entry = True
    choice = file.enum_type.add(name="Choice")
    for number, name in ((4, "FOUR"), (0, "NONE"), (-1, "MINUS")):
        choice.value.add(name=name, number=number)
    files = FileDescriptorSet(file=[file])
    return channel("protobuf", "hand.Root", files.SerializeToString(), "protobuf")


def one(type_: Any, number: int = 1, **more: Any) -> FieldDescriptorProto:
    return F(name=f"f{number}", number=number, type=type_, label=F.LABEL_OPTIONAL, **more)


def many(type_: Any, number: int = 1, **more: Any) -> FieldDescriptorProto:
    return F(name=f"f{number}", number=number, type=type_, label=F.LABEL_REPEATED, **more)


def test_defaults_of_fields_left_out() -> None:
    source = hand_channel(
        "proto2",
        one(F.TYPE_DOUBLE, 1, default_value="-inf"),
        one(F.TYPE_INT32, 2, default_value="-7"),
        one(F.TYPE_BOOL, 3, default_value="true"),
        one(F.TYPE_STRING, 4, default_value="a"),
        one(F.TYPE_BYTES, 5, default_value="\\001b"),
        one(F.TYPE_ENUM, 6, type_name=".hand.Choice", default_value="MINUS"),
        one(F.TYPE_ENUM, 7, type_name=".hand.Choice"),
        one(F.TYPE_UINT64, 8),
    )
    decoder = decoder_for(source)
    columns = decoder.columns(batch(source, [b""]), list(decoder.paths))
    assert [column.values.tolist() for column in columns.values.values()] == [
        [-math.inf],
        [-7],
        [True],
        ["a"],
        [b"\x01b"],
        [-1],
        [4],
        [0],
    ]


@pytest.mark.parametrize("count", [1, 40])
def test_optional_numbers_are_absent_or_zero(count: int) -> None:
    fields = [one(F.TYPE_DOUBLE, n, proto3_optional=True, oneof_index=n - 1) for n in (1, 2)]
    source = hand_channel("proto3", *fields, one(F.TYPE_FLOAT, 3))
    nan = b"\x09\x00\x00\x00\x00\x00\x00\xf8\xff"
    payloads = [b"", b"\x09" + bytes(8), nan] * count
    columns = decoder_for(source).columns(batch(source, payloads), ["f1", "f2", "f3"])
    first, second, third = (columns.values[name].values for name in ("f1", "f2", "f3"))
    assert is_absent(first).tolist() == [True, False, False] * count
    assert np.isnan(first).tolist() == [True, False, True] * count
    assert is_absent(second).all()
    assert third.tolist() == [0.0, 0.0, 0.0] * count


def test_maps_groups_and_messages_in_themselves_are_left_out() -> None:
    source = hand_channel(
        "proto3",
        many(F.TYPE_MESSAGE, 1, type_name=".hand.Root.Entry"),
        one(F.TYPE_GROUP, 2, type_name=".hand.Root"),
        many(F.TYPE_MESSAGE, 3, type_name=".hand.Root"),
        one(F.TYPE_INT32, 4),
    )
    assert dict(decoder_for(source).paths) == {"f4": "int"}


def test_unknown_fields_and_foreign_wire_types_are_skipped() -> None:
    source = hand_channel("proto3", one(F.TYPE_INT32, 1), many(F.TYPE_FLOAT, 2))
    # Field 1 as a varint 5 and as eight bytes, field 2 as a varint, field 99 as a string.
    payload = b"\x08\x05" + b"\x09" + bytes(8) + b"\x10\x01" + b"\x9a\x06\x02hi"
    columns = decoder_for(source).columns(batch(source, [payload]), ["f1", "f2[]"])
    assert columns.failures == {}
    assert nested(columns.values["f1"]) == [5]
    assert nested(columns.values["f2[]"]) == [[]]


STAMP = ".google.protobuf.Timestamp"


@pytest.mark.parametrize("others", [1, 40])
@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"\x08", "a field reaches beyond its message"),
        (b"\x88", "a number does not end"),
        (b"\x08\x80", "a number does not end"),
        (b"\x08" + b"\xff" * 10 + b"\x01", "a number does not end"),
        (b"\x00\x01", "no protobuf field"),
        (b"\x0b\x0c", "no protobuf field"),
        (b"\x0e\x01", "no protobuf field"),
        (b"\x80\x80\x80\x80\x10\x01", "no protobuf field"),
        (b"\x31\x01\x02", "a field reaches beyond its message"),
        (b"\x12\x05hi", "a field reaches beyond its message"),
        (b"\x12\xff\xff\xff\xff\xff\xff\xff\xff\xff\x01hi", "a field reaches beyond its message"),
        (b"\x12\xff\xff\xff\xff\xff\xff\xff\xff\x7fhi", "a field reaches beyond its message"),
        (b"\x1a\x03\x08\x96\x81", "a number does not end"),
        (b"\x22\x03abc", "packed numbers do not fill their field"),
        (b"\x2a\x02\x01\x80", "a number does not end"),
        (b"\x2a\x0b" + b"\x80" * 10 + b"\x01", "a number does not end"),
        (b"\x1a\x0a\x08\xff\xff\xff\xff\xff\xff\xff\xff\x7f", "a stamp is out of range"),
        (b"\x1a\x0b\x08\x80\x80\x80\x80\x80\x80\x80\x80\x80\x01", "a stamp is out of range"),
    ],
)
def test_lying_payloads_are_left_out(payload: bytes, reason: str, others: int) -> None:
    source = hand_channel(
        "proto3",
        one(F.TYPE_INT64, 1),
        one(F.TYPE_STRING, 2),
        one(F.TYPE_MESSAGE, 3, type_name=STAMP),
        many(F.TYPE_FIXED32, 4),
        many(F.TYPE_UINT32, 5),
    )
    good = b"\x08\x96\x01\x12\x02hi\x1a\x02\x08\x01\x2a\x03\x01\x96\x01"
    decoder = decoder_for(source)
    made = batch(source, [good] * others + [payload, good])
    columns = decoder.columns(made, list(decoder.paths))
    assert columns.rows.tolist() == [*range(others), others + 1]
    ((said, count),) = columns.failures.items()
    assert reason in said
    assert count == 1
    assert nested(columns.values["f1"]) == [150] * (others + 1)
    assert nested(columns.values["f3"]) == [10**9] * (others + 1)
    assert nested(columns.values["f5[]"]) == [[1, 150]] * (others + 1)


def test_a_hundred_thousand_elements_in_one_message() -> None:
    annotations = ImageAnnotations()
    for number in range(100_000):
        annotations.circles.add(thickness=number)
    source = proto_channel(ImageAnnotations)
    made = batch(source, [annotations.SerializeToString()])
    columns = decoder_for(source).columns(made, ["circles[].thickness"])
    assert np.array_equal(columns.values["circles[].thickness"].values, np.arange(100_000.0))


def _doubling(levels: int) -> FileDescriptorSet:
    file = FileDescriptorProto(name="a.proto", package="hand")
    for level in range(levels):
        message = file.message_type.add(name="Root" if level == 0 else f"T{level}")
        for number in (1, 2):
            field = message.field.add(name=f"f{number}", number=number, type=F.TYPE_MESSAGE)
            field.type_name = f".hand.T{level + 1}"
    file.message_type.add(name=f"T{levels}")
    return FileDescriptorSet(file=[file])


@pytest.mark.parametrize(
    ("schema", "message"),
    [
        (b"", "does not define the message"),
        (b"\xff\xff", "is not a protobuf FileDescriptorSet"),
        (b"syntax = 'proto3';", "is not a protobuf FileDescriptorSet|does not define"),
        (
            hand_channel("proto3", one(F.TYPE_MESSAGE, type_name=".hand.Lost")).schema_data,
            "hand.Root.f1 is a 'hand.Lost', which is not defined",
        ),
        (
            hand_channel("proto3", one(F.TYPE_INT32), many(F.TYPE_INT32)).schema_data,
            "two fields of number 1",
        ),
        (
            hand_channel("proto2", one(F.TYPE_INT32, default_value="x")).schema_data,
            "default 'x' of 'f1' is no int",
        ),
        (_doubling(40).SerializeToString(), "more than"),
    ],
)
def test_unusable_schemas_are_refused(schema: bytes, message: str) -> None:
    with pytest.raises(LogError, match=message) as caught:
        decoder_for(channel("protobuf", "hand.Root", schema, "protobuf"))
    assert caught.value.topic == "/topic"


VARINTS = (
    F.TYPE_INT32,
    F.TYPE_UINT32,
    F.TYPE_SINT32,
    F.TYPE_INT64,
    F.TYPE_UINT64,
    F.TYPE_SINT64,
    F.TYPE_BOOL,
    F.TYPE_ENUM,
)


@pytest.mark.parametrize("bits", [0, 1, 0x7FFF_FFFF, 0x8000_0000, 0x12_8000_0003, 2**64 - 1])
def test_varints_wider_than_their_field_are_cut_as_google_cuts_them(bits: int) -> None:
    root = DescriptorProto(name="Root")
    for number, type_ in enumerate(VARINTS, start=1):
        type_name = ".random.Choice" if type_ == F.TYPE_ENUM else None
        root.field.append(one(type_, number, type_name=type_name))
    google = make_class(root, packed=True)
    digits = [bits >> shift & 0x7F for shift in range(0, 70, 7)]
    varint = bytes(digit | 0x80 for digit in digits[:-1]) + bytes(digits[-1:])
    payload = b"".join(bytes([number << 3]) + varint for number in range(1, len(VARINTS) + 1))
    source = proto_channel(google)
    decoder = decoder_for(source)
    columns = decoder.columns(batch(source, [payload]), list(decoder.paths))
    assert_columns(columns.values, [google.FromString(payload)], decoder.paths)
