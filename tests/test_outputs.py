"""What is written under /mclass: topics, values placed by hand, layouts."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lichtblick import check_layout
from lopsided_results import CLASS_NAMES, STAMP_NS, estimate, maps, mode
from mcap.reader import make_reader
from written_output import (
    ENCODINGS,
    LOG_TIME_NS,
    STRANGE_ID,
    attachment,
    belief,
    layout,
    messages,
    model,
    write_everything,
)

from mclass import resources
from mclass.errors import LogError, MclassError, ModelError
from mclass.footprint import Grid
from mclass.logs.writer import LogWriter
from mclass.messages import proto_json, protobuf, ros
from mclass.outputs import channels as channels_module
from mclass.outputs.channels import Encoding, OutputChannels
from mclass.outputs.colors import BACKGROUND_COLOR, CLASS_COLORS
from mclass.outputs.layout import layout_for
from mclass.outputs.names import TopicTokens, display_text
from mclass.outputs.raster import occupancy, pack_cells
from mclass.results import BeliefBlock, ClassMaps, ObjectEstimate

TOKEN = re.compile(r"[A-Za-z](_?[A-Za-z0-9])*")

ROS_CHANNELS = {
    "/mclass/objects": "vision_msgs/msg/Detection3DArray",
    "/mclass/estimates": "mclass_msgs/msg/Estimates",
    "/mclass/markers": "visualization_msgs/msg/MarkerArray",
    "/mclass/grid": "foxglove_msgs/msg/Grid",
    "/mclass/belief": "mclass_msgs/msg/Belief",
    "/mclass/measurements": "mclass_msgs/msg/Measurements",
    "/mclass/grid/background": "nav_msgs/msg/OccupancyGrid",
    "/mclass/grid/books": "nav_msgs/msg/OccupancyGrid",
    "/mclass/grid/parts": "nav_msgs/msg/OccupancyGrid",
    "/mclass/pose/o1": "geometry_msgs/msg/PoseStamped",
    "/mclass/pose/box_1_a_STRANGE": "geometry_msgs/msg/PoseStamped",
}
OTHER_CHANNELS = {
    "/mclass/objects": "mclass.Objects",
    "/mclass/scene": "foxglove.SceneUpdate",
    "/mclass/grid": "foxglove.Grid",
    "/mclass/belief": "mclass.Belief",
    "/mclass/measurements": "mclass.Measurements",
    "/mclass/pose/o1": "foxglove.PoseInFrame",
    "/mclass/pose/box_1_a_STRANGE": "foxglove.PoseInFrame",
}


@pytest.fixture(scope="module")
def outputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("outputs")
    for encoding in ENCODINGS:
        write_everything(folder / f"{encoding}.mcap", encoding)
    return {encoding: folder / f"{encoding}.mcap" for encoding in ENCODINGS}


def decoded(path: Path, topic: str) -> list[Any]:
    """Values of all messages of a topic."""
    found = []
    for schema, channel, message in messages(path, topic):
        codecs: Any = {"cdr": ros, "protobuf": protobuf, "json": proto_json}
        found.append(codecs[channel.message_encoding].codec(schema.name).decode(message.data))
    return found


# Topics


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_channels_are_those_of_the_encoding(encoding: str, outputs: dict[str, Path]) -> None:
    with outputs[encoding].open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    strange = TopicTokens().token(STRANGE_ID)
    found = {}
    for channel in summary.channels.values():
        schema = summary.schemas[channel.schema_id]
        found[channel.topic.replace(strange, "box_1_a_STRANGE")] = schema.name
        pair = channel.message_encoding, schema.encoding
        if encoding == "ros2":
            assert pair == ("cdr", "ros2msg")
        elif encoding == "json" and channel.topic == "/mclass/objects":
            assert pair == ("json", "jsonschema")
        else:
            assert pair == ("protobuf", "protobuf")
    assert found == (ROS_CHANNELS if encoding == "ros2" else OTHER_CHANNELS)


@pytest.mark.parametrize(
    ("name", "token"),
    [
        ("o1", "o1"),
        ("Door_left", "Door_left"),
        ("12", "id_12"),
        ("7b_2", "id_7b_2"),
        ("a__b", "a_b_"),
        ("_a", "a_"),
        ("a/b", "a_b_"),
        (" ", "id_"),
        ("", "id_"),
        ("é", "id_"),
        ("5 é", "id_5_"),
    ],
)
def test_tokens_keep_what_they_can(name: str, token: str) -> None:
    made = TopicTokens().token(name)
    assert made == token or re.fullmatch(re.escape(token) + "[0-9a-f]{8}", made)
    assert (made == token) == (not token.endswith("_"))


@given(st.lists(st.text(max_size=60), max_size=8))
def test_tokens_are_valid_distinct_and_repeatable(names: list[str]) -> None:
    tokens = TopicTokens()
    made = [tokens.token(name) for name in names]
    assert all(TOKEN.fullmatch(token) and len(token) <= 64 for token in made)
    assert len(set(made)) == len(set(names))
    assert [tokens.token(name) for name in names] == made
    fresh = TopicTokens()
    assert [fresh.token(name) for name in reversed(names)] == made[::-1]


def test_made_collisions_are_resolved() -> None:
    natural = TopicTokens().token("a/b")
    tokens = TopicTokens()
    assert tokens.token(natural) == natural
    other = tokens.token("a/b")
    assert other != natural
    assert TOKEN.fullmatch(other)
    assert (tokens.token("id_1"), tokens.token("1")[:5]) == ("id_1", "id_1_")


def test_ids_of_megabytes_make_short_names() -> None:
    tokens = TopicTokens()
    assert tokens.token("x" * 2**22) != tokens.token("x" * 2**22 + "y")
    assert len(tokens.token("x" * 2**22)) < 64
    assert display_text("a\n\x00b" + "c" * 2**22) == "a  b" + "c" * 35 + "…"
    assert display_text("short é") == "short é"


def test_classes_with_odd_names_get_topics_of_their_own(tmp_path: Path) -> None:
    names = ("a b", "a/b", "ok")
    with LogWriter(tmp_path / "out.mcap") as writer:
        channels = OutputChannels(writer, "ros2", "odom", model(names))
        channels.write_maps(
            ClassMaps(
                Grid((0.0, 0.0), 1.0, 1, 1),
                0,
                0,
                np.array([0]),
                np.array([[0.1, 0.2, 0.3, 0.4]]),
                np.full(4, 0.25),
            )
        )
    percents = {}
    for topic in (TopicTokens().token(name) for name in names):
        (grid,) = decoded(tmp_path / "out.mcap", f"/mclass/grid/{topic}")
        percents[topic] = grid["data"].tolist()
    assert list(percents.values()) == [[20], [30], [40]]
    (full,) = decoded(tmp_path / "out.mcap", "/mclass/grid")
    assert [field["name"] for field in full["fields"]][:4] == [
        "p_background",
        "p_a b",
        "p_a/b",
        "p_ok",
    ]


def test_too_many_objects_leave_out_poses_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(channels_module, "MOST_CHANNELS", 7)
    with LogWriter(tmp_path / "out.mcap") as writer:
        channels = OutputChannels(writer, "protobuf", "odom", model())
        many = [estimate(f"o{index}") for index in range(4)]
        channels.write_objects(many, LOG_TIME_NS, STAMP_NS)
    assert channels.topics_left_out == {"/mclass/pose/o2", "/mclass/pose/o3"}
    (value,) = decoded(tmp_path / "out.mcap", "/mclass/objects")
    assert [entry["id"] for entry in value["objects"]] == ["o0", "o1", "o2", "o3"]


# Times and records


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_messages_bear_the_log_time_they_were_given(
    encoding: str, outputs: dict[str, Path]
) -> None:
    times = [message.log_time for _, _, message in messages(outputs[encoding], "/mclass/objects")]
    assert times == [LOG_TIME_NS - 5, LOG_TIME_NS]
    (grid,) = messages(outputs[encoding], "/mclass/grid")
    assert grid[2].log_time == grid[2].publish_time == STAMP_NS
    (last,) = messages(outputs[encoding], "/mclass/measurements")
    assert last[2].log_time == LOG_TIME_NS + 6


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_model_and_metadata_are_recorded(encoding: str, outputs: dict[str, Path]) -> None:
    assert attachment(outputs[encoding], "mclass.yaml") == b"# the model\nclasses: {}\n"
    with outputs[encoding].open("rb") as stream:
        (record,) = make_reader(stream).iter_metadata()
    assert record.name == "mclass"
    assert record.metadata["frame"] == "odom"
    assert json.loads(record.metadata["classes"]) == list(CLASS_NAMES)
    assert set(record.metadata) >= {"version", "model_hash", "input_hash", "settings"}


# Maps


def test_occupancy_is_row_by_row_in_percent() -> None:
    percent = occupancy(maps()).reshape(3, 4, 6)
    expected = np.full((3, 4, 6), -1)
    # Cells 7 and 8 are columns 1 and 2 of row 1, cell 16 is column 4 of row 2.
    expected[:, 1, 1] = [70, 20, 10]
    expected[:, 1, 2] = [50, 40, 10]
    expected[:, 2, 4] = [10, 0, 90]
    np.testing.assert_array_equal(percent, expected)


def test_packed_cells_hold_probabilities_and_colours() -> None:
    packed = pack_cells(maps(), ("background", "books", "parts"))
    assert packed.fields == (
        ("p_background", 0, 7),
        ("p_books", 4, 7),
        ("p_parts", 8, 7),
        ("red", 12, 1),
        ("green", 13, 1),
        ("blue", 14, 1),
        ("alpha", 15, 1),
    )
    assert (packed.cell_stride, packed.data.shape) == (16, (24, 16))
    probabilities = np.ascontiguousarray(packed.data[:, :12]).view("<f4")
    np.testing.assert_array_equal(probabilities[8], np.array([0.5, 0.4, 0.1], np.float32))
    np.testing.assert_array_equal(probabilities[9], np.array([0.5, 0.25, 0.25], np.float32))
    assert packed.data[9, 12:].tolist() == [0, 0, 0, 0]
    mixed = [
        0.1 * grey + 0.9 * orange
        for grey, orange in zip(BACKGROUND_COLOR, CLASS_COLORS[1], strict=True)
    ]
    assert packed.data[16, 12:].tolist() == [*np.rint(mixed), round(40 + 215 * 0.9)]
    assert packed.data[8, 15] == 40 + 108


def test_ros_grids_place_the_corner_and_the_rows(outputs: dict[str, Path]) -> None:
    (books,) = decoded(outputs["ros2"], "/mclass/grid/books")
    assert books["header"]["frame_id"] == "odom"
    assert books["header"]["stamp"] == {"sec": 1_700_000_000, "nanosec": 123_456_789}
    info = books["info"]
    assert (info["width"], info["height"], info["resolution"]) == (6, 4, 0.5)
    assert info["origin"]["position"] == {"x": -1.0, "y": 2.0, "z": 0.0}
    assert info["origin"]["orientation"] == {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    data = books["data"]
    assert (data[7], data[8], data[16], data[6], len(data)) == (20, 40, 0, -1, 24)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_full_grids_place_the_corner_and_the_rows(encoding: str, outputs: dict[str, Path]) -> None:
    (grid,) = decoded(outputs[encoding], "/mclass/grid")
    assert grid["frame_id"] == "odom"
    assert grid["pose"]["position"] == {"x": -1.0, "y": 2.0, "z": 0.0}
    assert grid["pose"]["orientation"]["w"] == 1.0
    assert grid["cell_size"] == {"x": 0.5, "y": 0.5}
    assert (grid["column_count"], grid["row_stride"], grid["cell_stride"]) == (6, 96, 16)
    data = bytes(grid["data"])
    assert len(data) == 4 * 96
    # Row 2, column 4, field p_parts at offset 8.
    assert np.frombuffer(data, "<f4", 1, 2 * 96 + 4 * 16 + 8)[0] == np.float32(0.9)


# Objects


def test_detections_carry_every_class(outputs: dict[str, Path]) -> None:
    first, second = decoded(outputs["ros2"], "/mclass/objects")
    assert [entry["id"] for entry in first["detections"]] == ["o1"]
    assert [entry["id"] for entry in second["detections"]] == ["o1", STRANGE_ID]
    assert second["header"]["stamp"] == {"sec": 1_700_000_000, "nanosec": 123_456_789}
    detection = second["detections"][0]
    results = detection["results"]
    assert [entry["hypothesis"]["class_id"] for entry in results] == [
        "background",
        "books",
        "parts",
    ]
    assert [entry["hypothesis"]["score"] for entry in results] == [0.1506, 0.849382, 1.8e-5]
    angle = math.radians(257.75)
    books, parts = results[1]["pose"], results[2]["pose"]
    assert books["pose"]["position"] == {"x": 4.0, "y": -2.5, "z": 0.0}
    assert books["pose"]["orientation"] == {
        "x": 0.0,
        "y": 0.0,
        "z": math.sin(angle / 2),
        "w": math.cos(angle / 2),
    }
    covariance = np.zeros(36)
    covariance[[0, 7, 35]] = [0.05**2, 0.061**2, math.radians(9.125) ** 2]
    np.testing.assert_allclose(books["covariance"], covariance, rtol=1e-12)
    assert parts["pose"]["position"] == {"x": 1.25, "y": 7.5, "z": 0.0}
    assert parts["pose"]["orientation"]["z"] == pytest.approx(math.sin(math.radians(15.0)))
    assert not parts["covariance"].any()
    assert results[0]["pose"]["pose"]["position"] == {"x": 4.0, "y": -2.5, "z": 0.0}
    assert detection["bbox"]["center"] == books["pose"]


@pytest.mark.parametrize(
    ("encoding", "topic"),
    [("ros2", "/mclass/estimates"), ("protobuf", "/mclass/objects"), ("json", "/mclass/objects")],
)
def test_complete_objects_say_all_of_them(
    encoding: str, topic: str, outputs: dict[str, Path]
) -> None:
    _, latest = decoded(outputs[encoding], topic)
    entry, tied = latest["objects"]
    assert (entry["id"], entry["class_name"], entry["tie"]) == ("o1", "books", [])
    assert (entry["x"], entry["y"], entry["x_std"], entry["y_std"]) == (4.0, -2.5, 0.05, 0.061)
    assert (entry["measurements"], entry["labels"]) == (12, ["books"])
    assert (entry["stamp_ns"], entry["log_time_ns"]) == (STAMP_NS, LOG_TIME_NS)
    assert entry["joint_maximum"]["class_name"] == "parts"
    assert entry["modes"][1]["mass"] == 0.25
    assert [entry["name"] for entry in entry["classes"]] == ["background", "books", "parts"]
    assert (tied["tie"], tied["labels"]) == (["books", "parts"], [])


def test_poses_are_published_when_they_change(outputs: dict[str, Path]) -> None:
    for encoding in ENCODINGS:
        # The first of the two writes held an equal but distinct estimate of o1.
        assert len(messages(outputs[encoding], "/mclass/pose/o1")) == 2
    (pose,) = decoded(outputs["ros2"], f"/mclass/pose/{TopicTokens().token(STRANGE_ID)}")
    assert pose["header"]["stamp"] == {"sec": 1_700_000_000, "nanosec": 123_456_782}
    assert pose["pose"]["position"] == {"x": -3.0, "y": 1.5, "z": 0.0}
    assert pose["pose"]["orientation"]["z"] == pytest.approx(math.sin(math.radians(0.25)))


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_objects_that_stay_cost_no_pose_and_change_no_byte(
    encoding: Encoding, tmp_path: Path
) -> None:
    """An unchanged instance is encoded once; its bytes are as if encoded anew."""
    steps: list[list[ObjectEstimate]] = []
    ids = ("a", "bb", "ccc")
    current = {name: estimate(name) for name in ids}
    for step in range(7):
        name = ids[step % 3]
        current = {**current, name: estimate(name, measurements=step + 1, labels=("l" * step,))}
        steps.append([current[key] for key in ids[: step + 1]])
    topics = ["/mclass/objects"]
    topics += ["/mclass/estimates", "/mclass/markers"] if encoding == "ros2" else ["/mclass/scene"]
    contents = []
    for fresh in (False, True):
        path = tmp_path / f"{fresh}.mcap"
        with LogWriter(path) as writer:
            channels = OutputChannels(writer, encoding, "odom", model())
            for index, shown in enumerate(steps):
                again = [ObjectEstimate(**vars(entry)) for entry in shown] if fresh else shown
                channels.write_objects(again, index, STAMP_NS)
        contents.append([[entry[2].data for entry in messages(path, topic)] for topic in topics])
        poses = [len(messages(path, f"/mclass/pose/{name}")) for name in ids]
        assert poses == ([7, 6, 5] if fresh else [3, 2, 2])
    assert contents[0] == contents[1]


# Markers and scenes


def test_markers_begin_with_a_clean_slate(outputs: dict[str, Path]) -> None:
    _, latest = decoded(outputs["ros2"], "/mclass/markers")
    markers = latest["markers"]
    assert [
        (entry["ns"], entry["id"], entry["type"], entry["action"]) for entry in markers[:5]
    ] == [
        ("", 0, 0, 3),
        ("o1", 0, 9, 0),
        ("o1", 1, 1, 0),
        ("o1", 2, 0, 0),
        ("o1", 3, 0, 0),
    ]
    keys = [(entry["ns"], entry["id"]) for entry in markers[1:]]
    assert len(set(keys)) == len(keys) == 4 + 3
    assert all(entry["header"]["frame_id"] == "odom" for entry in markers)
    heavy, light = markers[3], markers[4]
    assert heavy["color"]["a"] == 0.75
    assert light["color"]["a"] == 0.25
    assert heavy["pose"]["position"] == {"x": 4.0, "y": -2.5, "z": 0.0}
    assert light["pose"]["orientation"]["z"] == pytest.approx(math.sin(math.radians(38.75)))
    assert heavy["scale"]["x"] == pytest.approx(0.2)
    assert markers[1]["text"] == "o1\nbooks 85%"
    # Both classes are as likely, and less likely than that there is nothing.
    assert markers[5]["text"] == "box 1/a  é\nbooks = parts 20% (background 60%)"


def test_scenes_hold_an_entity_an_object(outputs: dict[str, Path]) -> None:
    _, latest = decoded(outputs["protobuf"], "/mclass/scene")
    first, second = latest["entities"]
    assert (first["id"], second["id"]) == ("o1", TopicTokens().token(STRANGE_ID))
    assert (first["frame_id"], first["frame_locked"]) == ("odom", True)
    assert first["timestamp"] == {"seconds": 1_700_000_000, "nanos": 123_456_789}
    assert first["lifetime"] == {"seconds": 0, "nanos": 0}
    heavy, light = first["arrows"]
    assert (heavy["color"]["a"], light["color"]["a"]) == (0.75, 0.25)
    assert heavy["shaft_length"] + heavy["head_length"] == pytest.approx(0.2)
    assert heavy["pose"]["orientation"]["w"] == pytest.approx(math.cos(math.radians(128.875)))
    assert first["cubes"][0]["pose"]["position"] == {"x": 4.0, "y": -2.5, "z": 0.0}
    assert first["texts"][0]["text"] == "o1\nbooks 85%"
    assert len(second["arrows"]) == 1


# Nothing wrong gets out


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_nan_is_refused(encoding: Encoding, tmp_path: Path) -> None:
    nan = float("nan")
    bad_maps = ClassMaps(**{**vars(maps()), "untouched": np.array([nan, 0.5, 0.5])})
    bad_belief = BeliefBlock(
        **{**vars(belief()[0]), "log_density": np.full((3, 2, 4), nan, np.float32)}
    )
    with LogWriter(tmp_path / "out.mcap") as writer:
        channels = OutputChannels(writer, encoding, "odom", model())
        for bad in (
            estimate(probabilities=(nan, 0.5, 0.5)),
            estimate(position=(0.0, nan)),
            estimate(modes=(mode(0.0, 1.0, nan),)),
        ):
            with pytest.raises(ModelError, match="object 'o1' holds a value that is not a number"):
                channels.write_objects([bad], LOG_TIME_NS, STAMP_NS)
        with pytest.raises(ModelError, match="class map"):
            channels.write_maps(bad_maps)
        with pytest.raises(ModelError, match="the belief holds"):
            channels.write_belief(bad_belief)


def test_stamps_beyond_ros_time_are_refused(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "out.mcap") as writer:
        channels = OutputChannels(writer, "ros2", "odom", model())
        with pytest.raises(LogError, match="cannot hold this message"):
            channels.write_objects([estimate()], LOG_TIME_NS, 2**31 * 1_000_000_000)


def test_unbounded_deviations_are_written(tmp_path: Path) -> None:
    unsure = estimate(modes=(mode(0.0, 1.0, math.inf),))
    for encoding in ENCODINGS:
        with LogWriter(tmp_path / f"{encoding}.mcap") as writer:
            OutputChannels(writer, encoding, "odom", model()).write_objects([unsure], 1, 1)
    (value,) = decoded(tmp_path / "json.mcap", "/mclass/objects")
    assert value["objects"][0]["modes"][0]["std"] == math.inf


# Layouts


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_the_attached_layout_shows_what_was_written(
    encoding: str, outputs: dict[str, Path]
) -> None:
    content = layout(outputs[encoding])
    check_layout(content)
    view = content["configById"]["3D!mclass"]
    assert view["followTf"] == "odom"
    # The grid spans x from -1 to 2 and y from 2 to 4.
    assert view["cameraState"]["targetOffset"] == [0.5, 3.0, 0.0]
    assert view["cameraState"]["distance"] == pytest.approx(3.75)
    visible = {topic for topic, settings in view["topics"].items() if settings["visible"]}
    drawn = "/mclass/markers" if encoding == "ros2" else "/mclass/scene"
    assert visible == {"/mclass/grid", drawn}
    with outputs[encoding].open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    topics = {channel.topic for channel in summary.channels.values()}
    assert set(view["topics"]) <= topics
    plotted = [path["value"] for path in content["configById"]["Plot!mclass"]["paths"]]
    source = "/mclass/estimates" if encoding == "ros2" else "/mclass/objects"
    assert plotted == [
        f'{source}.objects[:]{{id=="o1"}}.classes[{index}].probability' for index in range(3)
    ]


def test_the_shipped_layout_leaves_the_frame_to_the_viewer() -> None:
    shipped = json.loads(resources.read_text("configs", "mclass_layout.json"))
    assert shipped == layout_for("", ())
    check_layout(shipped)
    view = shipped["configById"]["3D!mclass"]
    assert "followTf" not in view
    visible = {topic for topic, settings in view["topics"].items() if settings["visible"]}
    assert visible == {"/mclass/grid", "/mclass/markers", "/mclass/scene"}


def test_class_maps_wear_the_colours_of_their_classes(outputs: dict[str, Path]) -> None:
    topics = layout(outputs["ros2"])["configById"]["3D!mclass"]["topics"]
    assert topics["/mclass/grid/parts"]["maxColor"] == "#d55e00ff"
    assert topics["/mclass/grid/books"]["maxColor"] == "#0072b2ff"
    assert topics["/mclass/grid/books"]["unknownColor"] == "#00000000"


# Resources


def test_missing_files_are_named() -> None:
    with pytest.raises(MclassError, match=r"schemas/mclass/Nothing\.proto of mclass is missing"):
        resources.read_text("schemas", "mclass/Nothing.proto")
