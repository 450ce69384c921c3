"""CDR: bytes counted by hand, round trips, and what other projects' readers make of it."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap_ros2._dynamic import generate_dynamic
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from mclass.errors import LogError
from mclass.messages import cdr, ros
from mclass.messages.cdr import CdrCodec
from mclass.messages.definitions import parse_definitions
from mclass.messages.prepared import Prepared

LOPSIDED = """\
uint8 small
float64 wide
string name
int16 short
float32[] floats
bool flag
uint64[2] pair
pkg/Inner inner
pkg/Inner[] many
string[] names
================================================================================
MSG: pkg/Inner
float64 x
float64 y
"""


def lopsided_codec() -> CdrCodec:
    return CdrCodec(parse_definitions("pkg/Outer", LOPSIDED, "ros2msg"), "pkg/Outer")


def lopsided_value() -> dict[str, Any]:
    return {
        "small": 7,
        "wide": -2.5,
        "name": "ab",
        "short": -3,
        "floats": np.array([1.5, -0.25, 4.0], np.float32),
        "flag": True,
        "pair": [1, 2**64 - 1],
        "inner": {"x": 10.0, "y": 20.0},
        "many": [{"x": 1.0, "y": 2.0}, {"x": 3.0, "y": 4.0}],
        "names": ["", "é"],
    }


def lopsided_bytes() -> bytes:
    """The same message laid out by hand; offsets count from behind the header."""
    return b"".join(
        [
            b"\x00\x01\x00\x00",
            b"\x07" + bytes(7),  # 0: small, padding to 8
            struct.pack("<d", -2.5),  # 8
            struct.pack("<I", 3) + b"ab\0" + bytes(1),  # 16: name, padding to 24
            struct.pack("<h", -3) + bytes(2),  # 24: short, padding to 28
            struct.pack("<I3f", 3, 1.5, -0.25, 4.0),  # 28
            b"\x01" + bytes(3),  # 44: flag, padding to 48
            struct.pack("<2Q", 1, 2**64 - 1),  # 48
            struct.pack("<2d", 10.0, 20.0),  # 64
            struct.pack("<I", 2) + bytes(4),  # 80: count, padding to 88
            struct.pack("<4d", 1.0, 2.0, 3.0, 4.0),  # 88
            struct.pack("<I", 2),  # 120
            struct.pack("<I", 1) + b"\0" + bytes(3),  # 124: "", padding to 132
            struct.pack("<I", 3) + "é".encode() + b"\0",  # 132
        ]
    )


def test_layout_matches_the_hand_made_bytes() -> None:
    assert lopsided_codec().encode(lopsided_value()) == lopsided_bytes()


def test_bulk_and_single_values_give_the_same_bytes() -> None:
    value = lopsided_value()
    value["inner"] = np.array([10.0, 20.0])
    value["many"] = np.array([[1.0, 2.0], [3.0, 4.0]])
    assert lopsided_codec().encode(value) == lopsided_bytes()
    value["inner"] = (10, 20)
    value["many"] = [Prepared({"x": 1.0, "y": 2.0}), np.array([3.0, 4.0])]
    assert lopsided_codec().encode(value) == lopsided_bytes()


def test_decode_reads_the_hand_made_bytes() -> None:
    decoded = lopsided_codec().decode(lopsided_bytes())
    expected = lopsided_value()
    np.testing.assert_array_equal(decoded.pop("floats"), expected.pop("floats"))
    np.testing.assert_array_equal(
        decoded.pop("pair"), np.array(expected.pop("pair"), dtype=np.uint64)
    )
    assert decoded == expected


def test_function_encodes_like_the_codec() -> None:
    definitions = parse_definitions("pkg/Outer", LOPSIDED, "ros2msg")
    assert cdr.encode(definitions, "pkg/Outer", lopsided_value()) == lopsided_bytes()


@pytest.mark.parametrize("lead", range(9))
def test_prepared_messages_fit_wherever_they_begin(lead: int) -> None:
    text = "string lead\npkg/Item[] items\n===\nMSG: pkg/Item\nstring s\nfloat64 x\nuint8 u\n"
    codec = CdrCodec(parse_definitions("pkg/Root", text, "ros2msg"), "pkg/Root")
    items = [{"s": "a" * n, "x": float(n), "u": n} for n in range(5)]
    prepared = [Prepared(item) for item in items]
    plain = codec.encode({"lead": "l" * lead, "items": items})
    for _ in range(2):
        assert codec.encode({"lead": "l" * lead, "items": prepared}) == plain
    assert codec.encode({"lead": "l" * (lead + 3), "items": prepared}) == codec.encode(
        {"lead": "l" * (lead + 3), "items": items}
    )


def test_fields_left_out_are_zero() -> None:
    empty = lopsided_codec().decode(lopsided_codec().encode({}))
    assert empty["inner"] == {"x": 0.0, "y": 0.0}
    assert (empty["small"], empty["name"], empty["flag"], empty["many"]) == (0, "", False, [])
    assert empty["pair"].tolist() == [0, 0]


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"small": 256}, "256|255"),
        ({"small": "x"}, "integer"),
        ({"wide": "x"}, "float"),
        ({"name": 3}, "encode"),
        ({"pair": [1, 2, 3]}, "2 numbers are needed, not 3"),
        ({"pair": np.array([-1, 2])}, "-1 to 2"),
        ({"pair": [2, 0.5]}, "object values"),
        ({"pair": np.array([0.5, 2])}, "float64 values"),
        ({"inner": np.zeros(3)}, "2 numbers are needed, not 3"),
        ({"many": np.zeros((4, 3))}, "rows of 2"),
        ({"unknown": 1}, "unknown"),
    ],
)
def test_values_that_do_not_fit_are_refused(change: dict[str, Any], what: str) -> None:
    with pytest.raises(LogError, match=what):
        lopsided_codec().encode({**lopsided_value(), **change})


@pytest.mark.parametrize("end", [0, 3, 4, 5, 20, 60, 100, 139])
def test_messages_cut_short_are_refused(end: int) -> None:
    with pytest.raises(LogError, match="pkg/Outer"):
        lopsided_codec().decode(lopsided_bytes()[:end])


def test_lying_counts_are_refused_before_anything_is_allocated() -> None:
    data = bytearray(lopsided_bytes())
    data[4 + 80 : 4 + 84] = b"\xff\xff\xff\x7f"
    with pytest.raises(LogError, match="2147483647 elements"):
        lopsided_codec().decode(data)


def test_halves_of_surrogate_pairs_become_question_marks() -> None:
    codec = lopsided_codec()
    assert codec.decode(codec.encode({"name": "a\ud800b"}))["name"] == "a?b"


numbers = st.floats(allow_nan=False)
poses = st.fixed_dictionaries({"position": st.tuples(numbers, numbers, numbers)})
estimates = st.lists(
    st.fixed_dictionaries(
        {
            "id": st.text(st.characters(exclude_categories=["Cs"]), max_size=9),
            "stamp_ns": st.integers(-(2**63), 2**63 - 1),
            "labels": st.lists(st.text(st.characters(exclude_categories=["Cs"]), max_size=4)),
            "measurements": st.integers(0, 2**32 - 1),
            "x": numbers,
            "modes": st.lists(
                st.fixed_dictionaries({"orientation": numbers, "mass": numbers, "std": numbers}),
                max_size=3,
            ),
        }
    ),
    max_size=3,
)


@given(estimates, st.text(st.characters(exclude_categories=["Cs"]), max_size=9))
def test_round_trip_and_rosbags_agree(objects: list[dict[str, Any]], frame: str) -> None:
    codec = ros.codec("mclass_msgs/msg/Estimates")
    data = codec.encode({"header": {"frame_id": frame}, "objects": objects})
    decoded = codec.decode(data)
    message: Any = ESTIMATES_STORE.deserialize_cdr(data, "mclass_msgs/msg/Estimates")
    assert decoded["header"]["frame_id"] == message.header.frame_id == frame
    assert len(decoded["objects"]) == len(message.objects) == len(objects)
    for ours, theirs, value in zip(decoded["objects"], message.objects, objects, strict=True):
        for name in ("id", "stamp_ns", "labels", "measurements", "x"):
            assert ours[name] == getattr(theirs, name) == value[name]
        assert ours["modes"] == value["modes"]
        assert [vars(mode)["mass"] for mode in theirs.modes] == [
            mode["mass"] for mode in value["modes"]
        ]


def rosbags_store(name: str) -> Any:
    """A type store that knows nothing but the schema that we embed."""
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(ros.schema_text(name), name))
    return store


ESTIMATES_STORE = rosbags_store("mclass_msgs/msg/Estimates")


@pytest.mark.parametrize(
    "name",
    [
        "vision_msgs/msg/Detection3DArray",
        "nav_msgs/msg/OccupancyGrid",
        "foxglove_msgs/msg/Grid",
        "visualization_msgs/msg/MarkerArray",
        "geometry_msgs/msg/PoseStamped",
        "nav_msgs/msg/Odometry",
        "sensor_msgs/msg/CameraInfo",
        "tf2_msgs/msg/TFMessage",
        "vision_msgs/msg/Detection2DArray",
        "mclass_msgs/msg/Belief",
        "mclass_msgs/msg/Measurements",
        "mclass_msgs/msg/Estimates",
    ],
)
def test_other_projects_read_every_schema(name: str) -> None:
    data = ros.codec(name).encode({})
    store = rosbags_store(name)
    message = store.deserialize_cdr(data, name)
    assert bytes(store.serialize_cdr(message, name)) == data
    assert generate_dynamic(name, ros.schema_text(name))[name](data) is not None


@pytest.mark.parametrize(
    "name",
    [
        "nav_msgs/msg/OccupancyGrid",
        "visualization_msgs/msg/MarkerArray",
        "geometry_msgs/msg/PoseStamped",
        "nav_msgs/msg/Odometry",
        "sensor_msgs/msg/CameraInfo",
        "tf2_msgs/msg/TFMessage",
    ],
)
def test_standard_definitions_are_those_of_humble(name: str) -> None:
    assert rosbags_store(name).generate_msgdef(name, ros_version=2) == get_typestore(
        Stores.ROS2_HUMBLE
    ).generate_msgdef(name, ros_version=2)
