"""A drive as an MCAP log, with the truth and the model attached."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol, TypeAlias

from mclass.config.find import MODEL_FILE_NAME
from mclass.logs.pending import PendingFile
from mclass.logs.writer import LogWriter
from mclass.messages import proto_files, proto_json, protobuf, ros
from mclass.messages.prepared import Value
from mclass.progress import Progress, unheard
from mclass.simulation.messages import Message, foxglove_messages, ros_messages
from mclass.simulation.world import Drive

Encoding: TypeAlias = Literal["ros2", "protobuf", "json"]

TRUTH_NAME = "truth.json"
METADATA_NAME = "mclass_simulation"

_TOLD_EVERY = 256


class _Codec(Protocol):
    def encode(self, value: Value) -> bytes: ...


@dataclass(frozen=True)
class _Format:
    """How a log of one encoding is made."""

    profile: str
    message_encoding: str
    schema_encoding: str
    messages: Callable[[Drive], Iterator[Message]]
    schema: Callable[[str], bytes]
    codec: Callable[[str], _Codec]


_FORMATS: dict[Encoding, _Format] = {
    "ros2": _Format(
        "ros2",
        "cdr",
        "ros2msg",
        ros_messages,
        lambda name: ros.schema_text(name).encode(),
        ros.codec,
    ),
    "protobuf": _Format(
        "",
        "protobuf",
        "protobuf",
        foxglove_messages,
        proto_files.descriptor_set,
        protobuf.codec,
    ),
    "json": _Format(
        "",
        "json",
        "jsonschema",
        foxglove_messages,
        lambda name: proto_json.schema_text(name).encode(),
        proto_json.codec,
    ),
}


def write_log(
    drive: Drive,
    output: Path,
    encoding: Encoding = "ros2",
    *,
    overwrite: bool = False,
    progress: Progress = unheard,
) -> None:
    """Write a drive; messages are in the order of their log times.

    Args:
        drive: To write.
        output: Path of the log.
        encoding: Of all its messages.
        overwrite: Replace an existing file.
        progress: Told how far the work is.

    Raises:
        LogError: If the log cannot be written; nothing is left behind then.
    """
    form = _FORMATS[encoding]
    schemas: dict[str, str] = {}
    encoded: list[tuple[int, str, bytes]] = []
    for count, message in enumerate(form.messages(drive)):
        if count % _TOLD_EVERY == 0:
            progress("encoding", count, 0, "messages")
        schemas[message.topic] = message.schema_name
        data = form.codec(message.schema_name).encode(message.value)
        encoded.append((message.log_time_ns, message.topic, data))
    encoded.sort(key=lambda entry: entry[0])
    start_ns = encoded[0][0]
    with LogWriter(output, source=None, profile=form.profile, overwrite=overwrite) as writer:
        channels = {
            topic: writer.add_channel(
                topic, form.message_encoding, name, form.schema_encoding, form.schema(name)
            )
            for topic, name in schemas.items()
        }
        for count, (log_time_ns, topic, data) in enumerate(encoded):
            if count % _TOLD_EVERY == 0:
                progress("writing", count, len(encoded), "messages")
            writer.write(channels[topic], log_time_ns, data)
        progress("writing", len(encoded), len(encoded), "messages")
        writer.attach(TRUTH_NAME, "application/json", truth_text(drive).encode(), start_ns)
        if drive.scenario.model is not None:
            source = drive.scenario.model.source.encode()
            writer.attach(MODEL_FILE_NAME, "application/yaml", source, start_ns)
        about = {"scenario": drive.scenario.name, "seed": str(drive.seed)}
        writer.add_metadata(METADATA_NAME, about)


def write_truth_and_log(
    drive: Drive,
    truth_path: Path,
    output: Path,
    encoding: Encoding = "ros2",
    *,
    overwrite: bool = False,
    progress: Progress = unheard,
) -> None:
    """Write a drive as `write_log` does, and its truth to a file of its own: both or neither.

    Raises:
        LogError: If either cannot be written.
    """
    truth_file = PendingFile(truth_path, overwrite=overwrite, source=None)
    try:
        truth_file.open()
        truth_file.write(truth_text(drive).encode())
        write_log(drive, output, encoding, overwrite=overwrite, progress=progress)
        truth_file.publish()
    finally:
        truth_file.discard()


def truth_text(drive: Drive) -> str:
    """What really stood where, as JSON: metres, degrees in [0, 360)."""
    scenario = drive.scenario
    model, camera = scenario.model, scenario.camera
    present = dict.fromkeys(item.class_name for item in scenario.objects)
    document = {
        "name": scenario.name,
        "frame": scenario.world_frame,
        "units": {"x": "m", "y": "m", "phi": "deg"},
        "classes": model.classes.class_names if model else list(present),
        "objects": [
            {
                "id": item.object_id,
                "class": item.class_name,
                "x": item.position[0],
                "y": item.position[1],
                "phi": _degrees(item.orientation) % 360.0,
                "against_wall": item.against_wall,
            }
            for item in scenario.objects
        ],
        "camera_mount": {
            **dict(zip("xyz", camera.mount_xyz, strict=True)),
            "rpy_deg": [_degrees(angle) for angle in camera.mount_rpy],
        },
    }
    return json.dumps(document, indent=1) + "\n"


def _degrees(angle: float) -> float:
    """Degrees as they were typed: what conversion to radians and back adds is rounded away."""
    return round(math.degrees(angle), 9)
