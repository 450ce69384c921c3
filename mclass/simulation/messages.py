"""A drive as messages: the same content for ROS 2 and in Foxglove's schemas.

Foxglove's messages are mappings that the protobuf and the JSON encoder take alike.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from mclass import transforms
from mclass.records import FloatArray
from mclass.simulation.camera import mount_quaternion
from mclass.simulation.world import Drive

_SECOND_NS = 1_000_000_000
_CAMERA_FRAME = "camera_link"
_OPTICAL_FRAME = "camera_optical_frame"
_DISTORTION_MODEL = "plumb_bob"
_PLANAR = np.array([0, 1, 5])
"""Rows of x, y and yaw in a covariance over x, y, z, roll, pitch, yaw."""


@dataclass(frozen=True)
class Message:
    """One message, not yet encoded."""

    topic: str
    schema_name: str
    log_time_ns: int
    value: Mapping[str, Any]


@dataclass(frozen=True)
class _Pose:
    """One odometry pose with what belongs to it; vectors are (3,), the quaternion x, y, z, w."""

    stamp_ns: int
    position: FloatArray
    orientation: FloatArray
    covariance: FloatArray
    linear: FloatArray
    angular: FloatArray


@dataclass(frozen=True)
class _Detection:
    """One detection; the box is its centre, width and height [pixel]."""

    object_id: str
    labels: tuple[tuple[str, float], ...]
    box: tuple[float, float, float, float]


def ros_messages(drive: Drive) -> Iterator[Message]:
    """Messages of the standard ROS 2 packages, topic by topic."""
    scenario = drive.scenario
    offset = scenario.log_clock_offset_ns

    def header(stamp_ns: int, frame: str) -> dict[str, Any]:
        seconds, rest = divmod(stamp_ns, _SECOND_NS)
        return {"stamp": {"sec": seconds, "nanosec": rest}, "frame_id": frame}

    def transform(
        stamp_ns: int, link: tuple[str, str], translation: FloatArray, rotation: FloatArray
    ) -> dict[str, Any]:
        return {
            "header": header(stamp_ns, link[0]),
            "child_frame_id": link[1],
            "transform": {"translation": translation, "rotation": rotation},
        }

    tf = "tf2_msgs/msg/TFMessage"
    start = scenario.start_ns
    mounts = [transform(start, *mount) for mount in _mounts(drive)]
    yield Message("/tf_static", tf, start + offset, {"transforms": mounts})
    moving = (scenario.world_frame, scenario.robot_frame)
    for pose in _poses(drive):
        odometry = {
            "header": header(pose.stamp_ns, scenario.world_frame),
            "child_frame_id": scenario.robot_frame,
            "pose": {
                "pose": {"position": pose.position, "orientation": pose.orientation},
                "covariance": pose.covariance,
            },
            "twist": {"twist": {"linear": pose.linear, "angular": pose.angular}},
        }
        yield Message("/odom", "nav_msgs/msg/Odometry", pose.stamp_ns + offset, odometry)
        moved = transform(pose.stamp_ns, moving, pose.position, pose.orientation)
        yield Message("/tf", tf, pose.stamp_ns + offset, {"transforms": [moved]})
    width, height = scenario.camera.image_size
    camera_matrix, projection = _camera_matrices(drive)
    for stamp in drive.info_stamps_ns.tolist():
        info = {
            "header": header(stamp, _OPTICAL_FRAME),
            "width": width,
            "height": height,
            "distortion_model": _DISTORTION_MODEL,
            "d": np.zeros(5),
            "k": camera_matrix,
            "r": np.eye(3).ravel(),
            "p": projection,
        }
        yield Message("/camera/camera_info", "sensor_msgs/msg/CameraInfo", stamp + offset, info)
    for stamp, log_time, detections in _frames(drive):
        array = {
            "header": header(stamp, _OPTICAL_FRAME),
            "detections": [
                {
                    "header": header(stamp, _OPTICAL_FRAME),
                    "results": [
                        {
                            "hypothesis": {"class_id": label, "score": score},
                            "pose": {"pose": {"orientation": {"w": 1.0}}},
                        }
                        for label, score in detection.labels
                    ],
                    "bbox": {
                        "center": {"position": detection.box[:2]},
                        "size_x": detection.box[2],
                        "size_y": detection.box[3],
                    },
                    "id": detection.object_id,
                }
                for detection in detections
            ],
        }
        yield Message("/detections", "vision_msgs/msg/Detection2DArray", log_time, array)


def foxglove_messages(drive: Drive) -> Iterator[Message]:
    """Messages of Foxglove's schemas and our own detections, topic by topic."""
    scenario = drive.scenario
    offset = scenario.log_clock_offset_ns

    def transform(
        stamp_ns: int, link: tuple[str, str], translation: FloatArray, rotation: FloatArray
    ) -> dict[str, Any]:
        return {
            "timestamp": divmod(stamp_ns, _SECOND_NS),
            "parent_frame_id": link[0],
            "child_frame_id": link[1],
            "translation": translation,
            "rotation": rotation,
        }

    tf = "foxglove.FrameTransforms"
    start = scenario.start_ns
    mounts = [transform(start, *mount) for mount in _mounts(drive)]
    yield Message("/tf_static", tf, start + offset, {"transforms": mounts})
    moving = (scenario.world_frame, scenario.robot_frame)
    for pose in _poses(drive):
        odometry = {
            "timestamp": divmod(pose.stamp_ns, _SECOND_NS),
            "frame_id": scenario.world_frame,
            "body_frame_id": scenario.robot_frame,
            "pose": {"position": pose.position, "orientation": pose.orientation},
            "linear_velocity": pose.linear,
            "angular_velocity": pose.angular,
            "pose_covariance": pose.covariance,
        }
        yield Message("/odom", "foxglove.Odometry", pose.stamp_ns + offset, odometry)
        moved = transform(pose.stamp_ns, moving, pose.position, pose.orientation)
        yield Message("/tf", tf, pose.stamp_ns + offset, {"transforms": [moved]})
    width, height = scenario.camera.image_size
    camera_matrix, projection = _camera_matrices(drive)
    for stamp in drive.info_stamps_ns.tolist():
        calibration = {
            "timestamp": divmod(stamp, _SECOND_NS),
            "frame_id": _OPTICAL_FRAME,
            "width": width,
            "height": height,
            "distortion_model": _DISTORTION_MODEL,
            "D": np.zeros(5),
            "K": camera_matrix,
            "R": np.eye(3).ravel(),
            "P": projection,
        }
        yield Message(
            "/camera/calibration", "foxglove.CameraCalibration", stamp + offset, calibration
        )
    for stamp, log_time, detections in _frames(drive):
        array = {
            "timestamp": divmod(stamp, _SECOND_NS),
            "frame_id": _OPTICAL_FRAME,
            "detections": [
                {
                    "labels": detection.labels,
                    "id": detection.object_id,
                    "box": detection.box,
                }
                for detection in detections
            ],
        }
        yield Message("/detections", "mclass.Detections", log_time, array)


def _mounts(drive: Drive) -> list[tuple[tuple[str, str], FloatArray, FloatArray]]:
    """Parent and child, translation and rotation of every fixed frame."""
    scenario = drive.scenario
    body = (scenario.robot_frame, _CAMERA_FRAME)
    optical = (_CAMERA_FRAME, _OPTICAL_FRAME)
    return [
        (body, np.array(scenario.camera.mount_xyz), mount_quaternion(scenario.camera)),
        (optical, np.zeros(3), transforms.OPTICAL_ROTATION),
    ]


def _poses(drive: Drive) -> Iterator[_Pose]:
    """All odometry poses."""
    track = drive.track
    count = len(track.stamps_ns)
    zeros = np.zeros((count, 1))
    positions = np.concatenate([track.poses_world_child[:, :2], zeros], axis=1)
    covariances = np.zeros((count, 6, 6))
    if track.covariances is not None:
        covariances[:, _PLANAR[:, None], _PLANAR] = track.covariances
    columns = (
        track.stamps_ns.tolist(),
        positions,
        transforms.from_heading(track.poses_world_child[:, 2]),
        covariances.reshape(count, 36),
        np.concatenate([drive.twists[:, :2], zeros], axis=1),
        np.concatenate([zeros, zeros, drive.twists[:, 2:]], axis=1),
    )
    yield from (_Pose(*row) for row in zip(*columns, strict=True))


def _camera_matrices(drive: Drive) -> tuple[FloatArray, FloatArray]:
    """K (9,) and P (12,), row by row."""
    fx, fy, cx, cy = drive.scenario.camera.intrinsics
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return matrix.ravel(), np.concatenate([matrix, np.zeros((3, 1))], axis=1).ravel()


def _frames(drive: Drive) -> Iterator[tuple[int, int, list[_Detection]]]:
    """Stamp, log time and detections of every frame, empty ones included."""
    found, names = drive.detections, drive.scenario.label_names
    left, top, right, bottom = found.boxes.T
    boxes = np.stack([(left + right) / 2.0, (top + bottom) / 2.0, right - left, bottom - top], 1)
    ids = [item.object_id for item in drive.scenario.objects]
    detections = [
        _Detection(
            object_id=ids[id_index] if id_index >= 0 else "",
            labels=tuple((names[i], float(scores[i])) for i in np.flatnonzero(scores)),
            box=tuple(box),
        )
        for id_index, scores, box in zip(
            found.id_index.tolist(), found.scores, boxes.tolist(), strict=True
        )
    ]
    bounds = np.searchsorted(found.frame_index, np.arange(len(drive.frames) + 1)).tolist()
    stamps = drive.frames.stamps_ns.tolist()
    for frame, log_time in enumerate(drive.frames.log_times_ns.tolist()):
        yield stamps[frame], log_time, detections[bounds[frame] : bounds[frame + 1]]
