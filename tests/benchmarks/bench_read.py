"""Reading poses and detections, from memory and from the file, against message by message."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from mclass.config.model_file import parse_model
from mclass.logs.decode import decoder_for
from mclass.logs.measurements import read_measurements
from mclass.logs.reader import LogReader

from . import generated
from .tables import Row, fastest

PAIRS = 100_000

_POSE = [
    f"pose.pose.{part}"
    for part in (
        *(f"position.{axis}" for axis in "xyz"),
        *(f"orientation.{axis}" for axis in "xyzw"),
    )
]
ODOMETRY = ["header.stamp", "header.frame_id", "child_frame_id", *_POSE, "pose.covariance"]
DETECTIONS = [
    "header.stamp",
    "header.frame_id",
    "detections[].id",
    "detections[].results[].hypothesis.class_id",
    "detections[].results[].hypothesis.score",
    *(f"detections[].bbox.center.position.{axis}" for axis in "xyz"),
    *(f"detections[].bbox.center.orientation.{axis}" for axis in "xyzw"),
    *(f"detections[].bbox.size.{axis}" for axis in "xyz"),
]
POSES = ["timestamp", "frame_id", *(path.removeprefix("pose.") for path in _POSE)]
OWN_DETECTIONS = [
    "timestamp",
    "frame_id",
    "detections[].id",
    "detections[].labels[].name",
    "detections[].labels[].score",
    *(f"detections[].box.{part}" for part in ("center_x", "center_y", "width", "height")),
    *(f"detections[].bearing.{side}" for side in ("right", "left")),
]


def _read_pose(message: Any) -> object:
    at, turn = message.pose.position, message.pose.orientation
    stamp = message.timestamp.seconds, message.timestamp.nanos
    return stamp, message.frame_id, at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w


def _read_detections(message: Any) -> object:
    found = []
    for one in message.detections:
        labels = [(label.name, label.score) for label in one.labels]
        box, bearing = one.box, one.bearing
        sides = (bearing.right, bearing.left) if one.HasField("bearing") else None
        found.append((one.id, labels, box.center_x, box.center_y, box.width, box.height, sides))
    return message.timestamp.seconds, message.timestamp.nanos, message.frame_id, found


def measure(folder: Path, runs: int) -> tuple[str, list[Row]]:
    ros, proto = folder / "ros.mcap", folder / "protobuf.mcap"
    generated.write_ros(ros, PAIRS)
    generated.write_protobuf(proto, PAIRS)
    rows = []
    for topic, paths, name, wanted in (
        ("/odom", ODOMETRY, generated.ODOMETRY, 8),
        ("/detections", DETECTIONS, generated.DETECTIONS, 3),
    ):
        messages, deserialise = _payloads(ros, topic), _rosbags(ros, topic, name)
        rows += _compare(runs, ros, topic, paths, messages, deserialise, "rosbags", wanted)
        del messages
    for topic, paths, read in (
        ("/pose", POSES, _read_pose),
        ("/detections", OWN_DETECTIONS, _read_detections),
    ):
        messages, decode = _payloads(proto, topic), _mcap_protobuf(proto, topic)
        rows += _compare(runs, proto, topic, paths, messages, decode, "mcap_protobuf", 3, read)
        del messages
    model = parse_model(generated.MODEL, "model")

    def whole() -> None:
        with LogReader.open(ros) as reader:
            read_measurements(reader, model)

    (seconds,) = fastest(runs, whole)
    rate = 2 * PAIRS / seconds
    rows.append(Row("both, placed and matched, ready for inference", f"{rate:,.0f} messages/s"))
    return f"### Reading: {2 * PAIRS:,} ROS 2 messages, {2 * PAIRS:,} protobuf messages", rows


def _compare(
    runs: int,
    path: Path,
    topic: str,
    paths: Sequence[str],
    messages: Sequence[bytes],
    decode: Callable[[bytes], Any],
    other: str,
    wanted: int,
    read: Callable[[Any], object] | None = None,
) -> list[Row]:
    """Decoding to columns against decoding to objects: in memory, then with reading the file.

    Objects whose numbers and strings only come to be when they are asked for are asked for what
    the columns hold, by ``read``.
    """
    with LogReader.open(path) as reader:
        (channel,) = (channel for channel in reader.channels if channel.topic == topic)
        decoder = decoder_for(channel)
        batches = list(reader.batches([channel.id]))
    name = f"{channel.message_encoding} {topic}"

    def whole(message: bytes) -> object:
        return decode(message) if read is None else read(decode(message))

    def decode_ours() -> None:
        for batch in batches:
            decoder.columns(batch, paths)

    def parse_theirs() -> None:
        for message in messages:
            decode(message)

    def decode_theirs() -> None:
        for message in messages:
            whole(message)

    def read_ours() -> None:
        with LogReader.open(path) as reader:
            for batch in reader.batches([channel.id]):
                decoder.columns(batch, paths)

    def read_theirs() -> None:
        with path.open("rb") as stream:
            for _, _, message in make_reader(stream).iter_messages(topics=[topic]):
                whole(message.data)

    times = fastest(runs, decode_ours, decode_theirs, read_ours, read_theirs)
    rates = [len(messages) / seconds for seconds in times]
    lazy, fields = [], "" if read is None else " and its fields are read,"
    if read is not None:
        ours, theirs = (len(messages) / time for time in fastest(runs, decode_ours, parse_theirs))
        lazy = [
            Row(
                f"{name}, in memory: {other} parses, none of its fields read, "
                f"{theirs:,.0f} messages/s",
                f"{ours:,.0f} messages/s, {ours / theirs:.1f} times as many",
            )
        ]
    return [
        *lazy,
        Row(
            f"{name}, in memory: {other} decodes{fields} {rates[1]:,.0f} messages/s",
            f"{rates[0]:,.0f} messages/s, {rates[0] / rates[1]:.1f} times as many",
            f"at least {wanted} times",
        ),
        Row(
            f"{name}, from the file: mcap and {other} read {rates[3]:,.0f} messages/s",
            f"{rates[2]:,.0f} messages/s, {rates[2] / rates[3]:.1f} times as many",
            f"at least {wanted} times",
        ),
    ]


def _payloads(path: Path, topic: str) -> list[bytes]:
    with LogReader.open(path) as reader:
        channels = [channel.id for channel in reader.channels if channel.topic == topic]
        return [
            bytes(batch.buffer[offset : offset + length])
            for batch in reader.batches(channels)
            for offset, length in zip(batch.offsets.tolist(), batch.lengths.tolist(), strict=True)
        ]


def _schema(path: Path, topic: str) -> bytes:
    with LogReader.open(path) as reader:
        return next(c.schema_data for c in reader.channels if c.topic == topic)


def _rosbags(path: Path, topic: str, name: str) -> Callable[[bytes], Any]:
    store = get_typestore(Stores.ROS2_HUMBLE)
    types = get_types_from_msg(_schema(path, topic).decode(), name)
    store.register({key: value for key, value in types.items() if key not in store.fielddefs})
    return lambda message: store.deserialize_cdr(message, name)


def _mcap_protobuf(path: Path, topic: str) -> Callable[[bytes], Any]:
    with LogReader.open(path) as reader:
        name = next(c.schema_name for c in reader.channels if c.topic == topic)
    schema = Schema(id=1, name=name, encoding="protobuf", data=_schema(path, topic))
    decoder = DecoderFactory().decoder_for("protobuf", schema)
    assert decoder is not None
    return decoder
