"""Protobuf and its JSON form, against Google's runtime and compiler and Foxglove's classes."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from typing import Any

import grpc_tools  # type: ignore[import-untyped]
import jsonschema
import numpy as np
import pytest
from google.protobuf import descriptor_pool, message_factory
from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from grpc_tools import protoc
from hypothesis import given
from hypothesis import strategies as st

from mclass import resources
from mclass.errors import LogError, MclassError
from mclass.messages import proto_files, proto_json, protobuf
from mclass.messages.prepared import Prepared

OURS = ("mclass.Detections", "mclass.Objects", "mclass.Belief", "mclass.Measurements")
FOXGLOVE = (
    "foxglove.Grid",
    "foxglove.SceneUpdate",
    "foxglove.PoseInFrame",
    "foxglove.FrameTransforms",
    "foxglove.CameraCalibration",
    "foxglove.ImageAnnotations",
    "foxglove.Odometry",
)


def runtime_class(name: str) -> Any:
    """Google's class for a message, made from nothing but the schema that we embed."""
    pool = descriptor_pool.DescriptorPool()
    for file in FileDescriptorSet.FromString(proto_files.descriptor_set(name)).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


def without_json_names(file: FileDescriptorProto) -> FileDescriptorProto:
    """Compilers differ in whether they state the JSON names that follow from the names."""
    copy = FileDescriptorProto()
    copy.CopyFrom(file)
    for message in copy.message_type:
        for field in message.field:
            field.ClearField("json_name")
    return copy


@pytest.mark.parametrize("name", OURS)
def test_descriptors_are_what_the_compiler_makes(name: str, tmp_path: Path) -> None:
    root = Path(str(resources.folder("schemas")))
    out = tmp_path / "set.bin"
    includes = Path(grpc_tools.__file__).parent / "_proto"
    path = f"{name.replace('.', '/')}.proto"
    command = ["protoc", f"-I{root}", f"-I{includes}", "--include_imports"]
    assert protoc.main([*command, f"--descriptor_set_out={out}", path]) == 0
    compiled = FileDescriptorSet.FromString(out.read_bytes())
    ours = FileDescriptorSet.FromString(proto_files.descriptor_set(name))
    assert [without_json_names(file) for file in ours.file] == [
        without_json_names(file) for file in compiled.file
    ]


@pytest.mark.parametrize("name", FOXGLOVE)
def test_foxglove_descriptors_are_the_official_ones(name: str) -> None:
    files = proto_files.files_of(name)
    assert files[-1].name == name.replace(".", "/") + ".proto"
    for file in files:
        if not file.name.startswith("foxglove/"):
            continue
        stem = file.message_type[0].name
        module = importlib.import_module(f"foxglove_schemas_protobuf.{stem}_pb2")
        official = FileDescriptorProto()
        module.DESCRIPTOR.CopyToProto(official)
        assert file == without_json_names(official)


@pytest.mark.parametrize("name", OURS + FOXGLOVE)
def test_descriptor_sets_are_complete_and_ordered(name: str) -> None:
    known: set[str] = set()
    for file in FileDescriptorSet.FromString(proto_files.descriptor_set(name)).file:
        assert known.issuperset(file.dependency)
        known.add(file.name)
    assert runtime_class(name).DESCRIPTOR.full_name == name


def test_bytes_counted_by_hand() -> None:
    data = protobuf.codec("mclass.Detections").encode(
        {
            "timestamp": {"seconds": 300, "nanos": 0},
            "frame_id": "é",
            "detections": [{"labels": [{"name": "c1", "score": -2.5}]}, {"box": {}}],
        }
    )
    assert data.hex(" ") == " ".join(
        [
            "0a 03 08 ac 02",  # timestamp, 3 bytes: seconds 300 = 0b10_0101100
            "12 02 c3 a9",
            "1a 0f 0a 0d 0a 02 63 31 11 00 00 00 00 00 00 04 c0",
            "1a 02 1a 00",
        ]
    )


def belief_value() -> dict[str, Any]:
    return {
        "timestamp": {"seconds": 1, "nanos": 5},
        "frame_id": "odom",
        "stamp_ns": -3,
        "object_id": "o/1 \n",
        "block": 2,
        "blocks": 2**32 - 1,
        "cells": np.array([0, 2**40, -1]),
        "log_cell_mass": np.array([-np.inf, -0.0, 1e-300]),
        "log_density": np.arange(6, dtype=np.float32).reshape(3, 2),
        "class_names": ["", "a"],
    }


def test_runtime_reads_arrays_and_signs() -> None:
    message = runtime_class("mclass.Belief").FromString(
        protobuf.codec("mclass.Belief").encode(belief_value())
    )
    assert (message.timestamp.seconds, message.timestamp.nanos) == (1, 5)
    assert (message.stamp_ns, message.block, message.blocks) == (-3, 2, 2**32 - 1)
    assert list(message.cells) == [0, 2**40, -1]
    assert str(list(message.log_cell_mass)) == "[-inf, -0.0, 1e-300]"
    assert list(message.log_density) == [0, 1, 2, 3, 4, 5]
    assert list(message.class_names) == ["", "a"]
    assert message.object_id == "o/1 \n"


def test_what_the_runtime_writes_is_read() -> None:
    message = runtime_class("mclass.Belief")(
        stamp_ns=-3, cells=[7, -8], log_density=[0.5], class_names=["x", ""], block=300
    )
    decoded = protobuf.codec("mclass.Belief").decode(message.SerializeToString())
    assert (decoded["stamp_ns"], decoded["block"], decoded["blocks"]) == (-3, 300, 0)
    assert decoded["cells"].tolist() == [7, -8]
    assert decoded["log_density"].dtype == np.float32
    assert decoded["class_names"] == ["x", ""]
    assert decoded["timestamp"] == {"seconds": 0, "nanos": 0}
    assert decoded["log_cell_mass"].shape == (0,)


def test_repeated_numbers_in_pieces_are_joined() -> None:
    """Writers may split a packed field or not pack it at all."""
    one = protobuf.codec("mclass.Belief").encode({"cells": np.array([1, 2])})
    other = protobuf.codec("mclass.Belief").encode({"cells": np.array([3])})
    single = b"\x79" + (4).to_bytes(8, "little")  # field 15, eight bytes
    unknown = b"\xa0\x1f\x05"  # field 500, a varint
    decoded = protobuf.codec("mclass.Belief").decode(one + unknown + other + single)
    assert decoded["cells"].tolist() == [1, 2, 3, 4]


@pytest.mark.parametrize(
    "data",
    [b"\x0a", b"\x0a\x05ab", b"\xff" * 11, b"\x08\x01", b"\x0b", b"\x0a\x02\x08", b"\x79\x00"],
)
def test_bytes_that_are_no_message_are_refused(data: bytes) -> None:
    with pytest.raises(LogError, match=r"mclass\.Belief"):
        protobuf.codec("mclass.Belief").decode(data)


@pytest.mark.parametrize(
    ("value", "what"),
    [
        ({"unknown": 1}, "unknown"),
        ({"block": -1}, "-1"),
        ({"block": 2**32}, "4294967296"),
        ({"block": 0.5}, "__index__"),
        ({"cells": np.array([0.5])}, "float64"),
        ({"object_id": 3}, "encode"),
        ({"timestamp": (1, 2, 3)}, "takes 2 values, not 3"),
    ],
)
def test_values_that_do_not_fit_are_refused(value: dict[str, Any], what: str) -> None:
    with pytest.raises(LogError, match=what):
        protobuf.codec("mclass.Belief").encode(value)


def test_unknown_messages_are_refused() -> None:
    with pytest.raises(MclassError, match="Nothing"):
        protobuf.codec("mclass.Nothing")


@pytest.mark.parametrize(
    "text",
    [
        "message M {",
        "message M { oneof a { int32 b = 1; } }",
        "message M { map<string, int32> a = 1; }",
        "message M { Missing a = 1; }",
        "service S { }",
        'syntax = "proto2";',
    ],
)
def test_files_beyond_the_reader_are_refused(text: str) -> None:
    with pytest.raises(MclassError, match=r"x\.proto"):
        proto_files.parse_file("x.proto", text)


finite = st.floats(allow_nan=False, allow_infinity=False)
text = st.text(st.characters(exclude_categories=["Cs"]), max_size=6)
objects = st.lists(
    st.fixed_dictionaries(
        {
            "id": text,
            "stamp_ns": st.integers(-(2**63), 2**63 - 1),
            "labels": st.lists(text, max_size=3),
            "measurements": st.integers(0, 2**32 - 1),
            "x": finite,
            "classes": st.lists(
                st.fixed_dictionaries({"name": text, "probability": finite}), max_size=2
            ),
            "joint_maximum": st.fixed_dictionaries({"orientation": finite}),
        }
    ),
    max_size=3,
)


@given(objects)
def test_round_trips_and_runtime_agree(items: list[dict[str, Any]]) -> None:
    value = {"frame": "odom", "objects": items}
    prepared = {"frame": "odom", "objects": [Prepared(item) for item in items]}
    data = protobuf.codec("mclass.Objects").encode(value)
    assert protobuf.codec("mclass.Objects").encode(prepared) == data
    assert OBJECTS.FromString(data).SerializeToString(deterministic=True) == data
    text_data = proto_json.codec("mclass.Objects").encode(prepared)
    assert proto_json.codec("mclass.Objects").encode(value) == text_data
    jsonschema.validate(json.loads(text_data), OBJECTS_SCHEMA)
    for decoded in (
        protobuf.codec("mclass.Objects").decode(data),
        proto_json.codec("mclass.Objects").decode(text_data),
    ):
        assert decoded["frame"] == "odom"
        for item, given_item in zip(decoded["objects"], items, strict=True):
            for key in ("id", "stamp_ns", "labels", "measurements", "x"):
                assert item[key] == given_item[key]
            assert [entry["probability"] for entry in item["classes"]] == [
                entry["probability"] for entry in given_item["classes"]
            ]
            assert (
                item["joint_maximum"]["orientation"] == given_item["joint_maximum"]["orientation"]
            )


OBJECTS = runtime_class("mclass.Objects")
OBJECTS_SCHEMA = json.loads(proto_json.schema_text("mclass.Objects"))


def test_json_keeps_large_integers_as_text_and_times_as_numbers() -> None:
    data = proto_json.codec("mclass.Objects").encode({"stamp_ns": 1700000000123456789})
    assert json.loads(data) == {"stamp_ns": "1700000000123456789", "frame": "", "objects": []}
    data = proto_json.codec("mclass.Detections").encode({"timestamp": (17, 5)})
    assert json.loads(data)["timestamp"] == {"sec": 17, "nsec": 5}
    assert proto_json.codec("mclass.Detections").decode(data)["timestamp"] == {
        "seconds": 17,
        "nanos": 5,
    }


def test_numbers_that_are_optional_are_absent_or_written() -> None:
    looks = [{"bearing": {"left": 0.0}}, {"bearing": {}}, {}]
    value = {"detections": looks}
    data = protobuf.codec("mclass.Detections").encode(value)
    found = runtime_class("mclass.Detections").FromString(data).detections
    assert [one.bearing.HasField("left") for one in found] == [True, False, False]
    assert not any(one.bearing.HasField("right") for one in found)
    written = json.loads(proto_json.codec("mclass.Detections").encode(value))["detections"]
    assert [one["bearing"] for one in written] == [{"left": 0.0}, {}, {}]


def test_json_holds_bytes_and_surrogate_halves() -> None:
    codec = proto_json.codec("foxglove.Grid")
    data = codec.encode({"frame_id": "a\ud800", "data": b"\x00\xff"})
    assert json.loads(data)["data"] == "AP8="
    decoded = codec.decode(data)
    assert (decoded["frame_id"], decoded["data"]) == ("a\ud800", b"\x00\xff")


@pytest.mark.parametrize(
    "data", [b"", b"[]", b'{"objects": 3}', b'{"frame": 1}', b'{"stamp_ns": "x"}', b"[" * 100_000]
)
def test_json_that_is_no_message_is_refused(data: bytes) -> None:
    with pytest.raises(LogError, match=r"mclass\.Objects"):
        proto_json.codec("mclass.Objects").decode(data)


def test_json_refuses_nan() -> None:
    with pytest.raises(LogError, match=r"mclass\.Objects cannot hold"):
        proto_json.codec("mclass.Objects").encode({"objects": [{"x": float("nan")}]})


def test_json_says_null_for_infinity() -> None:
    codec = proto_json.codec("mclass.Objects")
    data = codec.encode({"objects": [{"x_std": np.inf}]})
    assert json.loads(data)["objects"][0]["x_std"] is None
    decoded = codec.decode(data)["objects"][0]
    assert (decoded["x_std"], decoded["y_std"]) == (np.inf, 0.0)


@pytest.mark.parametrize("name", ["Detections", "Objects"])
def test_shipped_json_schemas_are_those_embedded(name: str) -> None:
    shipped = resources.read_text("schemas", f"mclass/{name}.schema.json")
    assert shipped == proto_json.schema_text(f"mclass.{name}")
    jsonschema.Draft202012Validator.check_schema(json.loads(shipped))
