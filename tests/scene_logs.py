"""Small logs of JSON messages with ROS and Foxglove types, for the tests of `mclass.logs`."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer

from mclass.classes import ClassModel
from mclass.logs.measurements import LogContents, read_measurements
from mclass.logs.reader import LogReader
from mclass.messages import proto_files, protobuf
from mclass.model import LogSettings, Model

Message = dict[str, Any]

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
OPTICAL = (-0.5, 0.5, -0.5, 0.5)
LABELS = ("cup", "jug")


def make_model(label_names: Sequence[str] = LABELS, **log: Any) -> Model:
    classes = ClassModel(
        ("thing",), tuple(label_names), np.log([0.5, 0.5]), np.full(len(label_names), -3.0), {}
    )
    return Model("test.yaml", "", "m", classes, log=LogSettings(**log))


class SceneLog:
    """Writes messages as JSON; topics are made when first written to."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = path.open("wb")
        self._writer = Writer(self._file)
        self._writer.start("", "test")
        self._channels: dict[tuple[str, str], int] = {}

    def add(self, topic: str, schema: str, log_time_ns: int, message: Mapping[str, Any]) -> None:
        self.raw(topic, schema, log_time_ns, json.dumps(message).encode())

    def raw(self, topic: str, schema: str, log_time_ns: int, data: bytes) -> None:
        key = (topic, schema)
        if key not in self._channels:
            identity = self._writer.register_schema(schema, "jsonschema", b"{}") if schema else 0
            self._channels[key] = self._writer.register_channel(topic, "json", identity)
        self._writer.add_message(self._channels[key], log_time_ns, data, log_time_ns)

    def protobuf(self, topic: str, schema: str, log_time_ns: int, message: Message) -> None:
        key = (topic, schema)
        if key not in self._channels:
            data = proto_files.descriptor_set(schema)
            identity = self._writer.register_schema(schema, "protobuf", data)
            self._channels[key] = self._writer.register_channel(topic, "protobuf", identity)
        data = protobuf.codec(schema).encode(message)
        self._writer.add_message(self._channels[key], log_time_ns, data, log_time_ns)

    def odometry(
        self,
        time: float,
        x: float,
        y: float,
        yaw: float,
        *,
        topic: str = "/odom",
        child: str = "base_link",
        covariance: Sequence[float] | None = None,
        quaternion: Sequence[float] | None = None,
    ) -> None:
        turn = quaternion or (0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2))
        self.add(
            topic,
            "nav_msgs/msg/Odometry",
            at(time),
            {
                "header": header(time, "odom"),
                "child_frame_id": child,
                "pose": {
                    "pose": {"position": xyz(x, y, 0.0), "orientation": xyzw(turn)},
                    "covariance": list(covariance or [0.0] * 36),
                },
            },
        )

    def transform(
        self,
        time: float,
        parent: str,
        child: str,
        translation: Sequence[float],
        quaternion: Sequence[float],
        *,
        topic: str = "/tf_static",
    ) -> None:
        link = {
            "header": header(time, parent),
            "child_frame_id": child,
            "transform": {"translation": xyz(*translation), "rotation": xyzw(quaternion)},
        }
        self.add(topic, "tf2_msgs/msg/TFMessage", at(time), {"transforms": [link]})

    def camera(
        self,
        time: float,
        *,
        topic: str = "/camera/camera_info",
        frame: str = "camera",
        k: Sequence[float] = (500.0, 500.0, 320.0, 240.0),
        d: Sequence[float] = (),
        size: tuple[int, int] = (640, 480),
        model: str = "plumb_bob",
        **more: Any,
    ) -> None:
        self.add(
            topic,
            "sensor_msgs/msg/CameraInfo",
            at(time),
            {
                "header": header(time, frame),
                "width": size[0],
                "height": size[1],
                "distortion_model": model,
                "d": list(d),
                "k": [k[0], 0.0, k[2], 0.0, k[1], k[3], 0.0, 0.0, 1.0],
                **more,
            },
        )

    def detections(
        self,
        time: float,
        found: Sequence[Message],
        *,
        topic: str = "/camera/detections",
        frame: str = "camera",
        delay: float = 0.1,
    ) -> None:
        self.add(
            topic,
            "vision_msgs/msg/Detection2DArray",
            at(time + delay),
            {"header": header(time, frame), "detections": list(found)},
        )

    def close(self) -> Path:
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.close()
        return self.path


def read(path: Path, model: Model | None = None, **bounds: int) -> LogContents:
    """Measurements; nothing may be lost on the way."""
    with LogReader.open(path) as reader:
        contents = read_measurements(reader, model or make_model(), **bounds)
    check_records(contents)
    return contents


def check_records(contents: LogContents) -> None:
    """What always holds of measurements."""
    found, frames = contents.measurements, contents.measurements.frames
    assert contents.detections == len(found) + contents.tally.total
    assert np.isfinite(frames.poses_world_sensor).all()
    assert (np.diff(frames.stamps_ns) >= 0).all()
    assert (np.diff(contents.track.stamps_ns) > 0).all()
    assert (np.diff(found.frame_index) >= 0).all()
    assert (np.diff(found.label_offsets) > 0).all()
    assert found.label_offsets[-1] == len(found.labels) == len(found.scores)
    for row in range(len(found)):
        labels = found.labels[found.label_offsets[row] : found.label_offsets[row + 1]]
        assert (np.diff(labels) > 0).all()
    assert (np.isnan(found.directions[:, 0]) == np.isnan(found.directions[:, 1])).all()
    used = set(found.object_index.tolist()) - {-1}
    assert used == set(range(len(found.object_ids)))


def at(time: float) -> int:
    return START + round(time * SECOND)


def stamp(time: float) -> Message:
    seconds, rest = divmod(at(time), SECOND)
    return {"sec": seconds, "nanosec": rest}


def header(time: float, frame: str) -> Message:
    return {"stamp": stamp(time), "frame_id": frame}


def xyz(x: float, y: float, z: float) -> Message:
    return {"x": float(x), "y": float(y), "z": float(z)}


def xyzw(values: Sequence[float]) -> Message:
    return dict(zip("xyzw", (float(value) for value in values), strict=True))


def box(left: float, top: float, right: float, bottom: float) -> Message:
    center = {"x": (left + right) / 2, "y": (top + bottom) / 2}
    return {
        "center": {"position": center, "theta": 0.0},
        "size_x": right - left,
        "size_y": bottom - top,
    }


def detection(
    labels: Mapping[str, float] | Sequence[tuple[str, float]],
    bbox: Message | None = None,
    identity: str = "",
) -> Message:
    pairs = labels.items() if isinstance(labels, Mapping) else labels
    return {
        "results": [{"hypothesis": {"class_id": name, "score": score}} for name, score in pairs],
        "bbox": bbox or box(300.0, 200.0, 340.0, 280.0),
        "id": identity,
    }


def standing_robot(log: SceneLog, seconds: int = 3) -> None:
    """A robot at (1, 2) that looks along y, with a camera 0.2 m ahead of its centre."""
    for step in range(10 * seconds + 1):
        log.odometry(step / 10, 1.0, 2.0, np.pi / 2)
    log.transform(0.0, "base_link", "camera", (0.2, 0.0, 0.5), OPTICAL)
    log.camera(0.0)
