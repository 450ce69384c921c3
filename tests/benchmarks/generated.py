"""Logs of any length, from a few messages whose stamps are set anew."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mclass.logs.writer import LogWriter
from mclass.messages import proto_files, protobuf, ros
from mclass.messages.prepared import Value

START_NS = 1_700_000_000 * 10**9
STEP_NS = 10**7
DIFFERENT = 500
"""So many messages are encoded, and used again and again."""

ODOMETRY = "nav_msgs/msg/Odometry"
DETECTIONS = "vision_msgs/msg/Detection3DArray"
POSE = "foxglove.PoseInFrame"
OWN_DETECTIONS = "mclass.Detections"
IMAGE = "sensor_msgs/msg/CompressedImage"
IMAGE_SCHEMA = b"std_msgs/Header header\nstring format\nuint8[] data\n"

MODEL = """
length_unit: m
background: {prior: 1.0, likelihood: 0.01}
viewpoints:
  front: {position: [0, 1.0], covariance: 0.1}
  back: {position: [0, -1.0], covariance: 0.1}
classes:
  cup:
    labels:
      cup: {probability: 0.5, views: {front: 0.5, back: 0.5}}
      jug: {probability: 0.4, views: {front: 0.5}}
  jug:
    labels:
      jug: {probability: 0.5, views: {front: 0.5, back: 0.5}}
      cup: {probability: 0.4, views: {front: 0.5}}
grid: {cell_size: 0.1, orientation_bins: 72, range: [0.2, 4.0]}
inference: {preset: paper}
"""


def _turn(heading: float) -> dict[str, float]:
    return {"z": float(np.sin(heading / 2)), "w": float(np.cos(heading / 2))}


def odometry() -> list[bytes]:
    """A robot going round."""
    codec = ros.codec(ODOMETRY)
    return [
        codec.encode(
            {
                "header": {"frame_id": "odom"},
                "child_frame_id": "base_link",
                "pose": {
                    "pose": {
                        "position": {"x": 3 * np.cos(angle), "y": 3 * np.sin(angle)},
                        "orientation": _turn(angle + np.pi / 2),
                    },
                    "covariance": np.eye(6).ravel() * 1e-4,
                },
            }
        )
        for angle in 2.0 * np.pi * np.arange(DIFFERENT) / DIFFERENT
    ]


def detections(boxes: int, *, ids: bool) -> list[bytes]:
    """Boxes in front of the robot."""
    codec = ros.codec(DETECTIONS)
    generator = np.random.default_rng(1)
    messages = []
    for _ in range(DIFFERENT):
        found = [
            {
                "header": {"frame_id": "base_link"},
                "results": [{"hypothesis": {"class_id": label, "score": 0.9}}],
                "bbox": {
                    "center": {
                        "position": {"x": 2.0, "y": float(y)},
                        "orientation": {"w": 1.0},
                    },
                    "size": {"x": 0.3, "y": 0.3, "z": 0.3},
                },
                "id": f"box_{index}" if ids else "",
            }
            for index, (y, label) in enumerate(
                zip(
                    generator.uniform(-1.0, 1.0, boxes),
                    generator.choice(["cup", "jug"], boxes).tolist(),
                    strict=True,
                )
            )
        ]
        messages.append(codec.encode({"header": {"frame_id": "base_link"}, "detections": found}))
    return messages


def _stamped(messages: list[bytes], count: int) -> Iterator[tuple[int, bytes]]:
    """So many of the messages in turn, each with its own time in header and log."""
    for number in range(count):
        time_ns = START_NS + number * STEP_NS
        message = bytearray(messages[number % len(messages)])
        struct.pack_into("<iI", message, 4, *divmod(time_ns, 10**9))
        yield time_ns, bytes(message)


def write_ros(
    path: Path,
    pairs: int,
    *,
    boxes: int = 3,
    ids: bool = True,
    images: int = 0,
    size: int = 0,
    apart: bool = False,
) -> None:
    """Odometry and detection arrays in turn; so many images of that size, noise.

    The images are beside the other messages or, apart, of the same times but behind them all.
    """
    with LogWriter(path, profile="ros2") as writer:
        moves, looks, pictures = (
            writer.add_channel(topic, "cdr", name, "ros2msg", text)
            for topic, name, text in (
                ("/odom", ODOMETRY, ros.schema_text(ODOMETRY).encode()),
                ("/detections", DETECTIONS, ros.schema_text(DETECTIONS).encode()),
                ("/image", IMAGE, IMAGE_SCHEMA),
            )
        )
        noise = np.random.default_rng(1).bytes(size)
        moved = _stamped(odometry(), pairs)
        looked = _stamped(detections(boxes, ids=ids), pairs)
        drawn = 0
        for number, (move, look) in enumerate(zip(moved, looked, strict=True), 1):
            writer.write(moves, *move)
            writer.write(looks, *look)
            while not apart and drawn < number * images // pairs:
                writer.write(pictures, move[0], noise)
                drawn += 1
        for number in range(drawn, images):
            writer.write(pictures, START_NS + number * pairs // images * STEP_NS, noise)
        writer.attach("mclass.yaml", "application/yaml", MODEL.encode(), START_NS)


def write_protobuf(path: Path, count: int, *, boxes: int = 3) -> None:
    """Foxglove poses and detections of ours in turn."""
    codecs = [protobuf.codec(name) for name in (POSE, OWN_DETECTIONS)]
    generator = np.random.default_rng(1)
    with LogWriter(path) as writer:
        channels = [
            writer.add_channel(
                topic, "protobuf", codec.name, "protobuf", proto_files.descriptor_set(codec.name)
            )
            for topic, codec in zip(("/pose", "/detections"), codecs, strict=True)
        ]
        for number in range(count):
            time_ns = START_NS + number * STEP_NS
            angle = 2.0 * np.pi * number / DIFFERENT
            stamp = divmod(time_ns, 10**9)
            places = generator.uniform(100.0, 500.0, (boxes, 2))
            pose: Value = {
                "timestamp": stamp,
                "frame_id": "odom",
                "pose": {
                    "position": {"x": 3 * np.cos(angle), "y": 3 * np.sin(angle)},
                    "orientation": _turn(angle),
                },
            }
            found = [
                {
                    "id": f"box_{index}",
                    "labels": [{"name": label, "score": 0.9}],
                    "box": {"center_x": x, "center_y": y, "width": 30.0, "height": 40.0},
                }
                for index, (x, y, label) in enumerate(
                    zip(*places.T, generator.choice(["cup", "jug", "bottle"], boxes), strict=True)
                )
            ]
            looks: Value = {"timestamp": stamp, "frame_id": "camera", "detections": found}
            for codec, channel, value in zip(codecs, channels, (pose, looks), strict=True):
                writer.write(channel, time_ns, codec.encode(value))
