"""Inputs that fuzzing starts from: small and valid, one for each kind of thing a target reads."""

from __future__ import annotations

import io
import json
import re
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from log_bytes import KINDS
from mcap.writer import Writer

from fuzz import targets
from mclass.logs.reader import LogReader

_ROOT = Path(__file__).parents[2]
_LONGEST = 4096


def seeds(target: str) -> Iterable[bytes]:
    """Inputs for a target."""
    return _SEEDS[target]()


def _logs() -> Iterator[bytes]:
    for options in KINDS.values():
        yield _small_log(options)


def _small_log(options: Mapping[str, Any]) -> bytes:
    """A few chunks, two channels, an attachment and a metadata record in about a kilobyte."""
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=90, **options)
    writer.start("ros2", "test")
    schema = writer.register_schema("pkg/msg/A", "ros2msg", b"float64 x")
    channels = [
        writer.register_channel("/a", "cdr", schema, {"qos": "reliable"}),
        writer.register_channel("/b", "json", 0),
    ]
    for number in range(4):
        time = 100 + number
        writer.add_message(channels[number % 2], time, b"payload %d" % number, time)
    writer.add_attachment(1, 2, "a.txt", "text/plain", b"attached")
    writer.add_metadata("m", {"key": "value"})
    writer.finish()  # type: ignore[no-untyped-call]
    return stream.getvalue()


def _models() -> Iterator[bytes]:
    """The model files that ship, without their comments, and small ones with all keys in them."""
    for path in sorted((_ROOT / "configs").glob("*.yaml")):
        yield re.sub(rb"(?m)[ \t]*(#.*)?$\n?", b"\n", path.read_bytes()).replace(b"\n\n", b"\n")
    for section in _MODEL_SECTIONS:
        yield _SMALL_MODEL + section


_SMALL_MODEL = b"""viewpoints: {f: {position: [0, 10], covariance: 10}}
classes: {a: {labels: {a: {probability: 0.5, views: [f]}}}}
"""
_MODEL_SECTIONS = (
    b"length_unit: dm\nbackground: {prior: 2, likelihood: {a: 1.0e-3}}\n",
    b"log: {tf: {parent: map, child: base}, detections: /d, min_score: 0.5, labels: {'0': a}}\n",
    b"log: {odometry: {topic: /p, x: p.x, y: p.y, heading: p.yaw, stamp: t}, max_gap: 1}\n",
    b"log: {detections: {topic: /b, label: 'b[].n', score: 'b[].s', id: 'b[].i', box: 'b[].r',"
    b" box_format: corners, stamp: t, frame: camera}}\n",
    b"log: {camera: {fx: 500, fy: 500, cx: 320, cy: 240, width: 640, height: 480,"
    b" distortion_model: plumb_bob, distortion: [0.1, 0, 0, 0, 0],"
    b" mount: {position: [0.1, 0, 0.2], rpy_deg: [0, 5, 0]}}}\n",
    b"grid: {cell_size: 1, orientation_bins: 36, footprint: ray, range: [2, 40],"
    b" origin: [-1, 2], size: [30, 20]}\nobjects: {o1: {position: [5, 5]}}\n",
    b"inference: {preset: robust, probabilities: true, detection_probability: 0.9,"
    b" false_alarm: 0.02, silence: true, view_margin: 0.2, outside_probability: 0.001,"
    b" correlation: {range: 0.3, direction_deg: 6.9}, pointing_std_deg: 2.9}\n",
    b"inference: {preset: paper, pose_uncertainty: true, drift: 0.1, score_weights: [[0, 0.5],"
    b" [1, 1]], association: false, one_cause: true, trajectory_samples: 3, correlation: false}\n",
    b"inference: &i {preset: paper}\ngrid: {range: &r [0.2, 4.0], cell_size: .1}\n",
)


def _definitions() -> Iterator[bytes]:
    for encoding in ("cdr", "ros1"):
        for channel in targets.channels_of_samples(encoding):
            yield channel.schema_data


def _messages(encoding: str) -> Callable[[], Iterator[bytes]]:
    def pieces() -> Iterator[bytes]:
        channels = targets.channels_of_samples(encoding)
        payloads = _sample_payloads(encoding)
        for number, channel in enumerate(channels):
            found = payloads.get(channel.schema_name) or _own_payloads(encoding)
            yield targets.pack_pieces(number, found)
            yield targets.pack_pieces(targets.OWN_SCHEMA, [channel.schema_data, *found])

    return pieces


def _own_payloads(encoding: str) -> list[bytes]:
    """Messages of the schemas that ``targets`` adds to those of the sample logs."""
    if encoding == "json":
        box = {"x": 1.5, "label": "mug"}
        thing = {
            "stamp": {"sec": 5, "nsec": 7},
            "date": "2025-06-21T09:30:00.25Z",
            "valid": True,
            "image": "AAEC",
            "count": -3,
            "matrix": [[1, 2.5], []],
            "boxes": [box, {"x": None}],
        }
        return [
            json.dumps(thing).encode(),
            b'{"boxes": [{"label": "\\u00e9"}], "other": {"a": [1]}}',
        ]
    if encoding == "ros1":
        # Without the wide string's codes and with nothing aligned: lengths, then content.
        item = _text(b"x") + struct.pack("<I", 2) + 2 * (_text(b"\7") + struct.pack("<q", -9))
        head = b"\1" + b"\2\3\4" + _text(b"name")
        times = struct.pack("<5I", 2, 5, 6, 7, 8)
        numbers = struct.pack("<IddH", 2, 1.5, -2.5, 77)
        return [head + times + struct.pack("<I", 2) + 2 * item + numbers, head + bytes(14)]
    return [bytes(40), bytes([0, 1]) + bytes(42)]


def _text(content: bytes) -> bytes:
    return struct.pack("<I", len(content)) + content


def _sample_payloads(encoding: str) -> dict[str, list[bytes]]:
    """The first two messages of every schema in the sample logs."""
    found: dict[str, list[bytes]] = {}
    for path in sorted(targets.SAMPLES.glob("*.mcap")):
        with LogReader.open(path) as reader:
            wanted = [c.id for c in reader.channels if c.message_encoding == encoding]
            for batch in reader.batches(wanted):
                payloads = found.setdefault(batch.channel.schema_name, [])
                for row in range(min(len(batch), 2 - len(payloads))):
                    start = int(batch.offsets[row])
                    stop = start + int(batch.lengths[row])
                    payloads.append(bytes(memoryview(batch.buffer)[start:stop]))
    return found


_SEEDS: Mapping[str, Callable[[], Iterator[bytes]]] = {
    "reader": _logs,
    "carry_over": _logs,
    "model": _models,
    "definitions": _definitions,
    "cdr": _messages("cdr"),
    "ros1": _messages("ros1"),
    "protobuf": _messages("protobuf"),
    "json": _messages("json"),
    "readback": targets.readback_seeds,
}
