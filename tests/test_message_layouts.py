"""One detection in every layout: released message definitions, field names, field paths."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from mcap.writer import Writer
from mcap_protobuf.writer import Writer as ProtobufWriter
from mcap_ros2.writer import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore
from scene_logs import (
    OPTICAL,
    SceneLog,
    at,
    detection,
    header,
    make_model,
    read,
    stamp,
    standing_robot,
    xyz,
    xyzw,
)

from mclass.errors import LogError
from mclass.logs.guesses import guess_detection_fields
from mclass.logs.measurements import LogContents
from mclass.model import FieldMapping, Model

NORTH = math.pi / 2
# The box from 270 to 420 pixels at a focal length of 500 around 320.
EXPECTED = [[NORTH - math.atan(0.2), NORTH + math.atan(0.1)]]

HEADER = """
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
GEOMETRY = """
================================================================================
MSG: geometry_msgs/PoseWithCovariance
Pose pose
float64[36] covariance
================================================================================
MSG: geometry_msgs/Pose
Point position
Quaternion orientation
================================================================================
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
"""
POSE_2D = """
================================================================================
MSG: geometry_msgs/Pose2D
float64 x
float64 y
float64 theta
"""
CENTER_2D = """
================================================================================
MSG: vision_msgs/Pose2D
vision_msgs/Point2D position
float64 theta
================================================================================
MSG: vision_msgs/Point2D
float64 x
float64 y
"""
ARRAY = """std_msgs/Header header
vision_msgs/Detection2D[] detections
================================================================================
MSG: vision_msgs/Detection2D
"""

# Foxy and before: hypotheses name their class "id", a detection its object "tracking_id".
FOXY = """std_msgs/Header header
vision_msgs/ObjectHypothesisWithPose[] results
vision_msgs/BoundingBox2D bbox
sensor_msgs/Image source_img
bool is_tracking
string tracking_id
================================================================================
MSG: vision_msgs/ObjectHypothesisWithPose
string id
float64 score
geometry_msgs/PoseWithCovariance pose
================================================================================
MSG: vision_msgs/BoundingBox2D
geometry_msgs/Pose2D center
float64 size_x
float64 size_y
================================================================================
MSG: sensor_msgs/Image
std_msgs/Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data
"""
# The oldest has neither an object's id nor text for a class.
DASHING = FOXY.replace("string id", "int64 id").replace(
    "bool is_tracking\nstring tracking_id\n", ""
)
GALACTIC = """std_msgs/Header header
vision_msgs/ObjectHypothesisWithPose[] results
vision_msgs/BoundingBox2D bbox
string id
================================================================================
MSG: vision_msgs/ObjectHypothesisWithPose
vision_msgs/ObjectHypothesis hypothesis
geometry_msgs/PoseWithCovariance pose
================================================================================
MSG: vision_msgs/ObjectHypothesis
string class_id
float64 score
================================================================================
MSG: vision_msgs/BoundingBox2D
geometry_msgs/Pose2D center
float64 size_x
float64 size_y
"""
HUMBLE = GALACTIC.replace("geometry_msgs/Pose2D center", "vision_msgs/Pose2D center")

YOLO = """std_msgs/Header header
yolo_msgs/Detection[] detections
================================================================================
MSG: yolo_msgs/Detection
int32 class_id
string class_name
float64 score
string id
yolo_msgs/BoundingBox2D bbox
yolo_msgs/Mask mask
================================================================================
MSG: yolo_msgs/BoundingBox2D
yolo_msgs/Pose2D center
yolo_msgs/Vector2 size
================================================================================
MSG: yolo_msgs/Pose2D
yolo_msgs/Point2D position
float64 theta
================================================================================
MSG: yolo_msgs/Point2D
float64 x
float64 y
================================================================================
MSG: yolo_msgs/Vector2
float64 x
float64 y
================================================================================
MSG: yolo_msgs/Mask
int32 height
int32 width
yolo_msgs/Point2D[] data
"""

ODOMETRY = (
    """std_msgs/Header header
string child_frame_id
geometry_msgs/PoseWithCovariance pose
geometry_msgs/TwistWithCovariance twist
================================================================================
MSG: geometry_msgs/TwistWithCovariance
Twist twist
float64[36] covariance
================================================================================
MSG: geometry_msgs/Twist
Vector3 linear
Vector3 angular
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
"""
    + GEOMETRY
    + HEADER
)
TRANSFORM = (
    """geometry_msgs/TransformStamped[] transforms
================================================================================
MSG: geometry_msgs/TransformStamped
std_msgs/Header header
string child_frame_id
Transform transform
================================================================================
MSG: geometry_msgs/Transform
Vector3 translation
Quaternion rotation
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
"""
    + GEOMETRY
    + HEADER
)
CAMERA_INFO = (
    """std_msgs/Header header
uint32 height
uint32 width
string distortion_model
float64[] d
float64[9] k
float64[9] r
float64[12] p
uint32 binning_x
uint32 binning_y
RegionOfInterest roi
================================================================================
MSG: sensor_msgs/RegionOfInterest
uint32 x_offset
uint32 y_offset
uint32 height
uint32 width
bool do_rectify
"""
    + HEADER
)
K = [500.0, 0.0, 320.0, 0.0, 500.0, 240.0, 0.0, 0.0, 1.0]


def write_ros2(path: Path, schema: str, definition: str, messages: Iterable[Any]) -> Path:
    """A standing robot with a camera, as `standing_robot`, and detections of one type."""
    with path.open("wb") as file:
        writer = Ros2Writer(file)
        odometry = writer.register_msgdef("nav_msgs/msg/Odometry", ODOMETRY)
        transform = writer.register_msgdef("tf2_msgs/msg/TFMessage", TRANSFORM)
        camera = writer.register_msgdef("sensor_msgs/msg/CameraInfo", CAMERA_INFO)
        found = writer.register_msgdef(schema, definition)
        quarter = xyzw((0.0, 0.0, math.sin(NORTH / 2), math.cos(NORTH / 2)))
        for step in range(31):
            pose = {"position": xyz(1.0, 2.0, 0.0), "orientation": quarter}
            message = {
                "header": header(step / 10, "odom"),
                "child_frame_id": "base_link",
                "pose": {"pose": pose, "covariance": [0.0] * 36},
                "twist": {
                    "twist": {"linear": xyz(0, 0, 0), "angular": xyz(0, 0, 0)},
                    "covariance": [0.0] * 36,
                },
            }
            writer.write_message("/odom", odometry, message, at(step / 10))
        link = {
            "header": header(0.0, "base_link"),
            "child_frame_id": "camera",
            "transform": {"translation": xyz(0.2, 0.0, 0.5), "rotation": xyzw(OPTICAL)},
        }
        writer.write_message("/tf_static", transform, {"transforms": [link]}, at(0.0))
        calibration = {
            "header": header(0.0, "camera"),
            "height": 480,
            "width": 640,
            "distortion_model": "plumb_bob",
            "d": [0.0] * 5,
            "k": K,
            "r": [0.0] * 9,
            "p": [0.0] * 12,
            "binning_x": 0,
            "binning_y": 0,
            "roi": {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False},
        }
        writer.write_message("/camera/camera_info", camera, calibration, at(0.0))
        for message in messages:
            writer.write_message("/camera/detections", found, message, at(1.1))
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def check(contents: LogContents, identity: str | None = "a") -> None:
    """The one detection of all layouts: a cup and a jug between 270 and 420 pixels."""
    found = contents.measurements
    np.testing.assert_allclose(found.directions, EXPECTED, atol=1e-9)
    np.testing.assert_allclose(found.frames.poses_world_sensor, [[1.0, 2.2, NORTH]], atol=1e-12)
    assert [found.label_names_of(row) for row in range(len(found))] == [("cup", "jug")]
    np.testing.assert_allclose(found.scores, [0.75, 0.5])
    assert found.object_ids == ((identity,) if identity else ())
    assert found.stamps_ns.tolist() == [at(1.0)]
    assert contents.tally.counts == {}
    assert contents.pose_tally.counts == {}
    assert contents.unreadable == {}


def _old_hypothesis(identity: str | int, score: float) -> Mapping[str, Any]:
    return {"id": identity, "score": score, "pose": _POSE}


_POSE = {
    "pose": {"position": xyz(0, 0, 0), "orientation": xyzw((0, 0, 0, 1))},
    "covariance": [0.0] * 36,
}
_IMAGE = {
    "header": header(0.0, ""),
    "height": 0,
    "width": 0,
    "encoding": "",
    "is_bigendian": 0,
    "step": 0,
    "data": b"",
}
_OLD_BOX = {"center": {"x": 345.0, "y": 240.0, "theta": 0.0}, "size_x": 150.0, "size_y": 50.0}
_NEW_BOX = {
    "center": {"position": {"x": 345.0, "y": 240.0}, "theta": 0.0},
    "size_x": 150.0,
    "size_y": 50.0,
}
_NEW_RESULTS = [
    {"hypothesis": {"class_id": name, "score": score}, "pose": _POSE}
    for name, score in (("jug", 0.5), ("cup", 0.75))
]
LAYOUTS: dict[str, tuple[str, dict[str, Any], str | None]] = {
    "foxy": (
        FOXY + POSE_2D,
        {
            "header": header(1.0, "camera"),
            "results": [_old_hypothesis("jug", 0.5), _old_hypothesis("cup", 0.75)],
            "bbox": _OLD_BOX,
            "source_img": _IMAGE,
            "is_tracking": True,
            "tracking_id": "a",
        },
        "a",
    ),
    "dashing": (
        DASHING + POSE_2D,
        {
            "header": header(1.0, "camera"),
            "results": [_old_hypothesis(7, 0.5), _old_hypothesis(0, 0.75)],
            "bbox": _OLD_BOX,
            "source_img": _IMAGE,
        },
        None,
    ),
    "galactic": (
        GALACTIC + POSE_2D,
        {
            "header": header(1.0, "camera"),
            "results": _NEW_RESULTS,
            "bbox": _OLD_BOX,
            "id": "a",
        },
        "a",
    ),
    "humble": (
        HUMBLE + CENTER_2D,
        {
            "header": header(1.0, "camera"),
            "results": _NEW_RESULTS,
            "bbox": _NEW_BOX,
            "id": "a",
        },
        "a",
    ),
}


@pytest.mark.parametrize("array", [True, False], ids=["array", "single"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_released_layout_of_vision_msgs(tmp_path: Path, layout: str, array: bool) -> None:
    definition, message, identity = LAYOUTS[layout]
    name = "vision_msgs/msg/Detection2D"
    if array:
        name, definition = name + "Array", ARRAY + definition
        # The array's header may name no frame; that of its detections then counts.
        message = {"header": header(1.0, ""), "detections": [message]}
    path = write_ros2(tmp_path / "a.mcap", name, definition + GEOMETRY + HEADER, [message])
    contents = read(path, make_model(labels={"7": "jug", "0": "cup"}))
    check(contents, identity)
    assert contents.encoding == "ros2"


def test_yolo_detections(tmp_path: Path) -> None:
    found = [
        {
            "class_id": number,
            "class_name": name,
            "score": score,
            "id": "a",
            "bbox": {
                "center": {"position": {"x": 345.0, "y": 240.0}, "theta": 0.0},
                "size": {"x": 150.0, "y": 50.0},
            },
            "mask": {"height": 0, "width": 0, "data": [{"x": 1.0, "y": 2.0}] * number},
        }
        for number, name, score in ((3, "jug", 0.5), (1, "cup", 0.75))
    ]
    message = {"header": header(1.0, "camera"), "detections": found}
    path = write_ros2(tmp_path / "a.mcap", "yolo_msgs/msg/DetectionArray", YOLO + HEADER, [message])
    contents = read(path)
    assert contents.tally.counts.pop("merged with another detection of the same id") == 1
    check(contents)


def test_a_turned_box_is_as_wide_as_its_corners(tmp_path: Path) -> None:
    definition, message, _ = LAYOUTS["humble"]
    turned = {
        "center": {"position": {"x": 345.0, "y": 240.0}, "theta": NORTH},
        "size_x": 50.0,
        "size_y": 150.0,
    }
    path = write_ros2(
        tmp_path / "a.mcap",
        "vision_msgs/msg/Detection2D",
        definition + GEOMETRY + HEADER,
        [{**message, "bbox": turned}],
    )
    check(read(path))


def ros1_types() -> Typestore:
    """ROS 1 with its vision_msgs: numbers for classes, no ids, and the header's sequence."""
    store = get_typestore(Stores.ROS1_NOETIC)
    definitions = {
        "vision_msgs/msg/Detection2DArray": "std_msgs/Header header\n"
        "vision_msgs/Detection2D[] detections\n",
        "vision_msgs/msg/Detection2D": "std_msgs/Header header\n"
        "vision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox2D bbox\nsensor_msgs/Image source_img\n",
        "vision_msgs/msg/ObjectHypothesisWithPose": "int64 id\nfloat64 score\n"
        "geometry_msgs/PoseWithCovariance pose\n",
        "vision_msgs/msg/BoundingBox2D": "geometry_msgs/Pose2D center\n"
        "float64 size_x\nfloat64 size_y\n",
        "tf/msg/tfMessage": "geometry_msgs/TransformStamped[] transforms\n",
    }
    types: dict[str, Any] = {}
    for name, text in definitions.items():
        types.update(get_types_from_msg(text, name))
    store.register(types)
    return store


def test_ros_1(tmp_path: Path) -> None:
    store = ros1_types()
    make = {name.rpartition("/")[2]: store.types[name] for name in store.types}
    path = tmp_path / "a.mcap"

    def head(time: float, frame: str) -> Any:
        seconds, rest = divmod(at(time), 10**9)
        stamp_ = store.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)
        return make["Header"](seq=1, stamp=stamp_, frame_id=frame)

    def pose(x: float, y: float, turn: tuple[float, ...]) -> Any:
        quaternion = make["Quaternion"](*turn)
        return make["Pose"](position=make["Point"](x, y, 0.0), orientation=quaternion)

    def with_covariance(inner: Any) -> Any:
        return make["PoseWithCovariance"](pose=inner, covariance=np.zeros(36))

    still = make["Vector3"](0.0, 0.0, 0.0)
    twist = make["TwistWithCovariance"](
        twist=make["Twist"](linear=still, angular=still), covariance=np.zeros(36)
    )
    quarter = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))
    messages: list[tuple[str, str, float, Any]] = [
        (
            "/odom",
            "nav_msgs/msg/Odometry",
            step / 10,
            make["Odometry"](
                header=head(step / 10, "odom"),
                # Old frame names begin with a slash.
                child_frame_id="/base_link",
                pose=with_covariance(pose(1.0, 2.0, quarter)),
                twist=twist,
            ),
        )
        for step in range(31)
    ]
    mount = make["Transform"](
        translation=make["Vector3"](0.2, 0.0, 0.5), rotation=make["Quaternion"](*OPTICAL)
    )
    # Published again and again instead of latched, as ROS 1 did.
    for time in (0.0, 0.5, 1.0):
        link = make["TransformStamped"](
            header=head(time, "base_link"), child_frame_id="camera", transform=mount
        )
        messages.append(("/tf", "tf/msg/tfMessage", time, make["tfMessage"](transforms=[link])))
    region = make["RegionOfInterest"](0, 0, 0, 0, False)
    calibration = make["CameraInfo"](
        header=head(0.0, "camera"),
        height=480,
        width=640,
        distortion_model="plumb_bob",
        D=np.zeros(5),
        K=np.array(K),
        R=np.zeros(9),
        P=np.zeros(12),
        binning_x=0,
        binning_y=0,
        roi=region,
    )
    messages.append(("/camera/camera_info", "sensor_msgs/msg/CameraInfo", 0.0, calibration))
    nowhere = with_covariance(pose(0.0, 0.0, (0.0, 0.0, 0.0, 1.0)))
    image = make["Image"](head(0.0, ""), 0, 0, "", 0, 0, np.zeros(3, np.uint8))
    found = make["Detection2D"](
        header=head(1.0, "camera"),
        results=[
            make["ObjectHypothesisWithPose"](id=number, score=score, pose=nowhere)
            for number, score in ((7, 0.5), (0, 0.75))
        ],
        bbox=make["BoundingBox2D"](make["Pose2D"](345.0, 240.0, 0.0), 150.0, 50.0),
        source_img=image,
    )
    array = make["Detection2DArray"](header=head(1.0, "camera"), detections=[found])
    messages.append(("/camera/detections", "vision_msgs/msg/Detection2DArray", 1.1, array))
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros1", "test")
        channels: dict[str, int] = {}
        for topic, name, time, message in messages:
            if topic not in channels:
                text, _ = store.generate_msgdef(name, ros_version=1)
                schema = writer.register_schema(
                    name.replace("/msg/", "/"), "ros1msg", text.encode()
                )
                channels[topic] = writer.register_channel(topic, "ros1", schema)
            data = bytes(store.serialize_ros1(message, name))
            writer.add_message(channels[topic], at(time), data, at(time))
        writer.finish()  # type: ignore[no-untyped-call]
    contents = read(path, make_model(labels={"7": "jug", "0": "cup"}))
    check(contents, None)
    assert contents.encoding == "protobuf"
    assert contents.track.child_frame == "base_link"


def _proto_stamp(message: Any, time: float) -> None:
    message.FromNanoseconds(at(time))


def test_foxglove_protobuf(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file, ProtobufWriter(file) as writer:
        for step in range(31):
            pose = Odometry(frame_id="odom", body_frame_id="base_link")
            _proto_stamp(pose.timestamp, step / 10)
            pose.pose.position.x, pose.pose.position.y = 1.0, 2.0
            pose.pose.orientation.z = pose.pose.orientation.w = math.sqrt(0.5)
            writer.write_message("/odom", pose, at(step / 10), at(step / 10))
        links = FrameTransforms()
        link = links.transforms.add(parent_frame_id="base_link", child_frame_id="camera")
        link.translation.x, link.translation.z = 0.2, 0.5
        link.rotation.x, link.rotation.y, link.rotation.z, link.rotation.w = OPTICAL
        writer.write_message("/tf", links, at(0.0), at(0.0))
        calibration = CameraCalibration(
            frame_id="camera", width=640, height=480, distortion_model="plumb_bob", K=K
        )
        _proto_stamp(calibration.timestamp, 0.0)
        writer.write_message("/calibration", calibration, at(0.0), at(0.0))
        annotations = ImageAnnotations()
        outline = annotations.points.add(type=PointsAnnotation.LINE_LOOP)
        for x, y in ((270, 200), (420, 200), (420, 280), (270, 280)):
            outline.points.add(x=x, y=y)
        for name, score in (("jug", "0.5"), ("cup", "0.75")):
            text = annotations.texts.add(text=name)
            text.position.x, text.position.y = 270, 196
            _proto_stamp(text.timestamp, 1.0)
            text.metadata.add(key="id", value="a")
            text.metadata.add(key="score", value=score)
        writer.write_message("/annotations", annotations, at(1.1), at(1.1))
    contents = read(path)
    check(contents)
    assert (contents.encoding, contents.frame) == ("protobuf", "odom")


_LABELS = [{"class": "jug", "score": 0.5}, {"class": "cup", "score": 0.75}]
_HEAD = {"stamp": stamp(1.0), "frame_id": "camera"}
_TWO = [("jug", 0.5), ("cup", 0.75)]
GUESSES: dict[str, Mapping[str, Any]] = {
    "lists within": {
        "timestamp": stamp(1.0),
        "frame_id": "camera",
        "detections": [
            {"id": "a", "labels": _LABELS, "bbox": {"x": 270, "y": 200, "width": 150, "height": 80}}
        ],
    },
    "centre and size": {
        "header": _HEAD,
        "objects": [
            {
                "objectId": "a",
                "label": name,
                "confidence": score,
                "center": {"x": 345.0, "y": 240.0},
                "size": {"x": 150.0, "y": 80.0},
            }
            for name, score in _TWO
        ],
    },
    "corners beside the label": {
        "header": _HEAD,
        "boxes": [
            {
                "track_id": "a",
                "id": index,
                "class_name": name,
                "class_id": 9,
                "prob": score,
                "xmin": 270,
                "ymin": 200,
                "xmax": 420,
                "ymax": 280,
            }
            for index, (name, score) in enumerate(_TWO)
        ],
    },
    "left top right bottom": {
        "header": _HEAD,
        "items": [
            {
                "object_id": "a",
                "name": name,
                "probability": score,
                "rect": {"left": 270, "top": 200, "right": 420, "bottom": 280},
            }
            for name, score in _TWO
        ],
    },
    "a list of four numbers": {
        "header": _HEAD,
        "found": [
            {"id": "a", "label": name, "score": score, "bbox": [270.0, 200.0, 150.0, 80.0]}
            for name, score in _TWO
        ],
    },
    "lists beside each other": {
        "header": _HEAD,
        "ids": ["a", "a"],
        "labels": ["jug", "cup"],
        "scores": [0.5, 0.75],
        "boxes": [[270.0, 200.0, 150.0, 80.0]] * 2,
    },
    "one detection a message": {
        "stamp_ns": at(1.0),
        "frame": "camera",
        "id": "a",
        "labels": ["jug", "cup"],
        "box": {"cx": 345.0, "cy": 240.0, "w": 150.0, "h": 80.0},
    },
}


@pytest.mark.parametrize("layout", GUESSES)
def test_fields_are_guessed_by_name(tmp_path: Path, layout: str) -> None:
    log = SceneLog(tmp_path / "a.mcap")
    standing_robot(log)
    message = dict(GUESSES[layout])
    # The first messages hold nothing, as detectors' first messages do.
    empty = {key: [] if isinstance(value, list) else value for key, value in message.items()}
    if layout != "one detection a message":
        for key in ("header", "timestamp"):
            if key in message:
                silent = {"stamp": stamp(0.5), "frame_id": "camera"}
                empty[key] = silent if key == "header" else stamp(0.5)
        log.add("/found", "my.Type", at(0.5), empty)
    log.add("/found", "my.Type", at(1.1), message)
    contents = read(log.close())
    contents.tally.counts.pop("merged with another detection of the same id", None)
    found = contents.measurements
    np.testing.assert_allclose(found.directions, EXPECTED, atol=1e-9)
    assert found.label_names_of(0) == ("cup", "jug")
    assert found.object_ids == ("a",)
    if layout != "one detection a message":
        assert found.scores.tolist() == [0.75, 0.5]
        assert found.frames.stamps_ns.tolist() == [at(0.5), at(1.0)]
    assert contents.tally.counts == {}


@pytest.mark.parametrize(
    "paths",
    [
        {"status[].name": "string", "status[].level": "int", "status[].message": "string"},
        {"name[]": "string", "position[]": "float", "velocity[]": "float"},
        {"level": "int", "name": "string", "msg": "string", "line": "int", "id": "int"},
        {"markers[].id": "int", "markers[].ns": "string", "markers[].scale.x": "float"},
        {"x": "float", "y": "float", "width": "float", "height": "float"},
    ],
)
def test_other_types_are_not_taken_for_detections(paths: Mapping[str, str]) -> None:
    assert guess_detection_fields(paths) is None


def mapping_model(**fields: str) -> Model:
    return make_model(detections=(FieldMapping("/found", fields),))


def test_fields_that_the_model_file_maps(tmp_path: Path) -> None:
    log = SceneLog(tmp_path / "a.mcap")
    standing_robot(log)
    log.add(
        "/found",
        "",
        at(1.1),
        {
            "when": stamp(1.0),
            "who": "camera",
            "things": [
                {
                    "tag": "a",
                    "guesses": [{"what": n, "sure": s} for n, s in _TWO],
                    "area": {"x": 345.0, "y": 240.0, "width": 150.0, "height": 80.0},
                }
            ],
        },
    )
    path = log.close()
    fields = {
        "label": "things[].guesses[].what",
        "score": "things[].guesses[].sure",
        "id": "things[].tag",
        "box": "things[].area",
        "stamp": "when",
        "frame": "who",
    }
    mapping = FieldMapping("/found", fields, "center")
    check(read(path, make_model(detections=(mapping,))))
    # Brackets may be left out.
    bare = {key: value.replace("[]", "") for key, value in fields.items()}
    with pytest.raises(LogError, match="holds no box"):
        read(path, make_model(detections=(FieldMapping("/found", {**bare, "box": "things.tag"}),)))
    check(
        read(
            path,
            make_model(
                detections=(FieldMapping("/found", {**bare, "box": "things[].area"}, "center"),)
            ),
        )
    )
    with pytest.raises(LogError, match=r"no field 'thing.what'.*things\[\].tag") as caught:
        read(path, mapping_model(label="thing.what"))
    assert caught.value.topic == "/found"


def test_poses_that_the_model_file_maps(tmp_path: Path) -> None:
    log = SceneLog(tmp_path / "a.mcap")
    for step in range(11):
        log.add(
            "/state",
            "",
            at(step / 10),
            {"t": stamp(step / 10), "east": 1.0, "north": 2.0, "course": {"yaw": NORTH}},
        )
    log.transform(0.0, "base_link", "camera", (0.2, 0.0, 0.5), OPTICAL)
    log.camera(0.0)
    log.detections(0.5, [detection({"cup": 1.0})])
    path = log.close()
    fields = {"x": "east", "y": "north", "heading": "course.yaw", "stamp": "t"}
    contents = read(path, make_model(odometry=FieldMapping("/state", fields)))
    expected = [[1.0, 2.2, NORTH]]
    np.testing.assert_allclose(contents.measurements.frames.poses_world_sensor, expected)
    assert contents.frame == "world"
    with pytest.raises(LogError, match="Fields present: t, east"):
        read(path, make_model(odometry=FieldMapping("/state")))


def test_poses_are_guessed_where_only_the_topic_is_named(tmp_path: Path) -> None:
    log = SceneLog(tmp_path / "a.mcap")
    for step in range(11):
        log.add(
            "/state",
            "my.State",
            at(step / 10),
            {
                "header": header(step / 10, "map"),
                "where": {
                    "position": {"x": 1.0, "y": 2.0},
                    "orientation": xyzw((0, 0, math.sin(NORTH / 2), math.cos(NORTH / 2))),
                },
            },
        )
    log.camera(0.0)
    log.detections(0.5, [detection({"cup": 1.0})])
    contents = read(log.close(), make_model(odometry=FieldMapping("/state")))
    np.testing.assert_allclose(contents.measurements.frames.poses_world_sensor, [[1.0, 2.0, NORTH]])
    assert contents.frame == "map"
