"""Outputs as other projects read them, from nothing but what they embed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from lopsided_results import STAMP_NS, maps
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory as ProtobufDecoder
from mcap_ros2.decoder import DecoderFactory as RosDecoder
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from written_output import ENCODINGS, STRANGE_ID, belief, measurements, messages, write_everything

from mclass.outputs.names import TopicTokens


@pytest.fixture(scope="module")
def outputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("outputs")
    for encoding in ENCODINGS:
        write_everything(folder / f"{encoding}.mcap", encoding)
    return {encoding: folder / f"{encoding}.mcap" for encoding in ENCODINGS}


def topics_of(path: Path) -> list[str]:
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return sorted({channel.topic for channel in summary.channels.values()})


# rosbags


def rosbags_message(path: Path, topic: str) -> Any:
    """The last message of a topic, by the definition embedded with it."""
    schema, _, message = messages(path, topic)[-1]
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(schema.data.decode(), schema.name))
    decoded: Any = store.deserialize_cdr(message.data, schema.name)
    again = store.serialize_cdr(decoded, schema.name)
    assert bytes(again) == message.data
    return decoded


def test_rosbags_deserialises_every_channel(outputs: dict[str, Path]) -> None:
    path = outputs["ros2"]
    topics = topics_of(path)
    assert len(topics) == 11
    decoded = {topic: rosbags_message(path, topic) for topic in topics}

    detections = decoded["/mclass/objects"].detections
    assert [detection.id for detection in detections] == ["o1", STRANGE_ID]
    assert [result.hypothesis.class_id for result in detections[0].results] == [
        "background",
        "books",
        "parts",
    ]
    assert detections[0].results[1].pose.pose.position.y == -2.5
    parts = decoded["/mclass/grid/parts"]
    assert (parts.data[16], parts.data[7], parts.data[0]) == (90, 10, -1)
    assert decoded["/mclass/grid"].cell_stride == 16
    assert decoded["/mclass/markers"].markers[3].ns == "o1"
    assert decoded["/mclass/estimates"].objects[0].joint_maximum.class_name == "parts"
    assert decoded["/mclass/pose/o1"].header.stamp.nanosec == 123_456_789
    assert decoded["/mclass/belief"].object_id == "o1"
    np.testing.assert_array_equal(
        decoded["/mclass/belief"].log_density, belief("o1", 1)[0].log_density.ravel()
    )
    covariances = measurements().frames.covariances
    assert covariances is not None
    np.testing.assert_array_equal(
        decoded["/mclass/measurements"].frame_covariances, covariances.ravel()
    )


def test_rosbags_opens_the_file(outputs: dict[str, Path]) -> None:
    with AnyReader([outputs["ros2"]]) as reader:
        found = {connection.topic: connection for connection in reader.connections}
        assert sorted(found) == topics_of(outputs["ros2"])
        count = 0
        for connection, _, data in reader.messages():
            reader.deserialize(data, connection.msgtype)
            count += 1
    assert count == 6 + 3 + 4 + 3 + 1


def test_mcap_ros2_decodes_every_message(outputs: dict[str, Path]) -> None:
    with outputs["ros2"].open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[RosDecoder()])
        decoded: list[Any] = [entry[3] for entry in reader.iter_decoded_messages()]
    assert len(decoded) == 17


# rerun


def rerun_batch(path: Path, entity: str, column: str) -> Any:
    """The record batch of an entity that has a column."""
    # Its releases that read MCAP need Python 3.11.
    reader = pytest.importorskip("rerun.chunk").McapReader
    for chunk in reader(path).stream():
        if chunk.entity_path == entity and not chunk.is_static:
            batch = chunk.to_record_batch()
            if column in batch.schema.names:
                return batch
    raise AssertionError(f"rerun finds no {column} at {entity}")


@pytest.mark.parametrize("index", range(3))
def test_rerun_reads_occupancy_values_back(index: int, outputs: dict[str, Path]) -> None:
    name = ("background", "books", "parts")[index]
    batch = rerun_batch(outputs["ros2"], f"/mclass/grid/{name}", "GridMap:data")

    def only(column: str) -> Any:
        (row,) = batch.column(column).to_pylist()
        (value,) = row
        return value

    form = only("GridMap:format")
    assert (form["width"], form["height"]) == (6, 4)
    assert only("GridMap:cell_size") == 0.5
    assert only("GridMap:translation") == [-1.0, 2.0, 0.0]
    assert only("GridMap:quaternion") == [0.0, 0.0, 0.0, 1.0]
    assert only("CoordinateFrame:frame") == "odom"
    values = np.array(only("GridMap:data"), dtype=np.uint8).view(np.int8)
    expected = np.full(24, -1, dtype=np.int8)
    expected[maps().cells] = np.rint(100 * maps().class_probabilities[:, index])
    # Images begin at the top: rerun turns the rows round.
    np.testing.assert_array_equal(values.reshape(4, 6)[::-1], expected.reshape(4, 6))


@pytest.mark.parametrize("encoding", ["ros2", "protobuf"])
def test_rerun_places_poses(encoding: str, outputs: dict[str, Path]) -> None:
    token = TopicTokens().token(STRANGE_ID)
    columns = "InstancePoses3D:translations", "InstancePoses3D:quaternions"
    batch = rerun_batch(outputs[encoding], f"/mclass/pose/{token}", columns[0])
    translation, quaternion = (batch.column(column).to_pylist()[-1][0] for column in columns)
    assert translation == [-3.0, 1.5, 0.0]
    half = np.radians(0.25)
    np.testing.assert_allclose(quaternion, [0.0, 0.0, np.sin(half), np.cos(half)], atol=1e-7)


# Foxglove and protobuf


@pytest.mark.parametrize("encoding", ["protobuf", "json"])
def test_foxglove_classes_parse_their_messages(encoding: str, outputs: dict[str, Path]) -> None:
    path = outputs[encoding]
    ((_, _, message),) = messages(path, "/mclass/grid")
    grid = Grid.FromString(message.data)
    assert grid.SerializeToString(deterministic=True) == message.data
    assert [(field.name, field.offset) for field in grid.fields] == [
        ("p_background", 0),
        ("p_books", 4),
        ("p_parts", 8),
        ("red", 12),
        ("green", 13),
        ("blue", 14),
        ("alpha", 15),
    ]
    assert grid.fields[0].type == PackedElementField.FLOAT32
    assert grid.fields[6].type == PackedElementField.UINT8
    assert (grid.pose.position.x, grid.pose.position.y) == (-1.0, 2.0)
    assert (grid.cell_size.x, grid.column_count, len(grid.data)) == (0.5, 6, 4 * grid.row_stride)
    assert grid.timestamp.ToNanoseconds() == STAMP_NS

    scene = SceneUpdate.FromString(messages(path, "/mclass/scene")[-1][2].data)
    assert (
        scene.SerializeToString(deterministic=True) == messages(path, "/mclass/scene")[-1][2].data
    )
    assert [len(entity.arrows) for entity in scene.entities] == [2, 1]
    assert scene.entities[0].texts[0].billboard

    pose = PoseInFrame.FromString(messages(path, "/mclass/pose/o1")[-1][2].data)
    assert (pose.frame_id, pose.pose.position.x, pose.pose.position.y) == ("odom", 4.0, -2.5)


def test_mcap_protobuf_decodes_every_message(outputs: dict[str, Path]) -> None:
    with outputs["protobuf"].open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[ProtobufDecoder()])
        decoded: list[Any] = [entry[3] for entry in reader.iter_decoded_messages()]
    names = {type(message).DESCRIPTOR.full_name for message in decoded}
    assert names == {
        "mclass.Objects",
        "mclass.Belief",
        "mclass.Measurements",
        "foxglove.Grid",
        "foxglove.SceneUpdate",
        "foxglove.PoseInFrame",
    }
    beliefs = [entry for entry in decoded if type(entry).DESCRIPTOR.name == "Belief"]
    assert list(beliefs[1].log_density) == belief()[1].log_density.ravel().tolist()
    assert list(beliefs[1].cells) == [8, 9, 11]


def test_json_objects_fit_their_schema(outputs: dict[str, Path]) -> None:
    for schema, _, message in messages(outputs["json"], "/mclass/objects"):
        content = json.loads(message.data)
        validator = jsonschema.Draft202012Validator(json.loads(schema.data))
        validator.validate(content)
    assert content["stamp_ns"] == str(STAMP_NS)
    assert content["frame"] == "odom"
    assert content["objects"][1]["id"] == STRANGE_ID
    assert content["objects"][0]["classes"][1] == {
        "name": "books",
        "probability": 0.849382,
        "x": 4.0,
        "y": -2.5,
        "orientation": pytest.approx(np.radians(257.75)),
    }
