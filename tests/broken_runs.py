"""Whole runs of the commands over small logs, and what must hold of every one of them."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from click.testing import CliRunner
from log_bytes import KINDS
from mcap.reader import make_reader
from mcap.writer import Writer
from scene_logs import SceneLog, box, detection, standing_robot

from mclass.commands.cli import main

MODEL = """
length_unit: m
background: {prior: 1.0, likelihood: 0.01}
viewpoints:
  front: {position: [0, 1.5], covariance: 0.8}
  back: {position: [0, -1.5], covariance: 0.8}
classes:
  cup:
    labels:
      cup: {probability: 0.6, views: {front: 1}}
      jug: {probability: 0.3, views: {back: 1}}
  jug:
    labels:
      jug: {probability: 0.6, views: {front: 1}}
grid: {cell_size: 0.25, orientation_bins: 16, range: [0.2, 3]}
inference: {preset: paper}
"""
WIDE = box(250.0, 200.0, 450.0, 280.0)
"""A box whose cone holds cells' centres."""
DETECTIONS = 5


@dataclass(frozen=True)
class Run:
    """How a command ended."""

    code: int
    document: dict[str, Any]
    stderr: str
    output: Path

    @property
    def used(self) -> int:
        return int(self.document["measurements"]["used"])

    @property
    def skipped(self) -> dict[str, int]:
        found: dict[str, int] = self.document["measurements"]["skipped"]
        return found

    @property
    def damage(self) -> list[str]:
        found: list[str] = self.document["damage"]
        return found


class Workplace:
    """A folder with a model file, in which logs are written and estimated."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.model = folder / "model.yaml"
        self.model.write_text(MODEL, encoding="utf-8")

    def estimate(self, data: bytes, *options: str | Path) -> Run:
        """Estimate a log given as bytes; checks what holds however it ends."""
        log, output = self.folder / "log.mcap", self.folder / "out.mcap"
        log.write_bytes(data)
        output.unlink(missing_ok=True)
        words = ("estimate", log, "-c", self.model, "-o", output, "--format", "json", *options)
        done = CliRunner().invoke(main, [str(word) for word in words])
        check_end(done)
        assert log.read_bytes() == data, "the input was touched"
        assert output.exists() == (done.exit_code in (0, 3))
        left = {path.name for path in self.folder.iterdir()}
        assert left <= {"log.mcap", "out.mcap", "model.yaml"}, "something was left behind"
        if done.exit_code == 1:
            assert "log.mcap" in done.stderr, "the sentence names the log"
            return Run(1, {}, done.stderr, output)
        run = Run(done.exit_code, json.loads(done.stdout), done.stderr, output)
        assert (run.code == 3) == bool(run.damage)
        check_numbers(run.document)
        read_whole(output.read_bytes())
        return run

    def inspect(self, data: bytes, *options: str) -> Run:
        """`inspect log` of a log given as bytes."""
        log = self.folder / "log.mcap"
        log.write_bytes(data)
        words = ("inspect", "log", str(log), "-c", str(self.model), "--format", "json", *options)
        done = CliRunner().invoke(main, words)
        check_end(done)
        if done.exit_code == 1:
            return Run(1, {}, done.stderr, log)
        document = json.loads(done.stdout)
        assert (done.exit_code == 3) == bool(document["damage"])
        return Run(done.exit_code, document, done.stderr, log)


def check_end(done: Any) -> None:
    """A command ends with a known code, and says what is wrong in one line if it fails."""
    assert done.exit_code in (0, 1, 3), done.stderr
    assert done.exception is None or isinstance(done.exception, SystemExit)
    assert "Traceback" not in done.output
    assert "unexpected" not in done.stderr, done.stderr
    assert (done.exit_code == 1) == done.stderr.startswith("Error: "), done.stderr
    assert done.stderr.count("\n") == (done.exit_code == 1), done.stderr


def check_numbers(value: Any) -> None:
    """No NaN, no infinity; class probabilities sum to one."""
    if isinstance(value, dict):
        if "class_probabilities" in value:
            assert abs(sum(value["class_probabilities"].values()) - 1.0) <= 1e-9
        value = list(value.values())
    if isinstance(value, list):
        for inner in value:
            check_numbers(inner)
    elif isinstance(value, float):
        assert value - value == 0.0, "no number"


def read_whole(data: bytes) -> list[tuple[Any, ...]]:
    """Every message, attachment and metadata record, by the format's own library with checks."""
    reader = make_reader(io.BytesIO(data), validate_crcs=True)
    found: list[tuple[Any, ...]] = []
    for schema, channel, message in reader.iter_messages(log_time_order=False):
        described = (schema.name, schema.encoding, schema.data) if schema else ()
        about = (channel.topic, channel.message_encoding, sorted(channel.metadata.items()))
        times = (message.log_time, message.publish_time, message.sequence)
        found.append(("message", *about, *described, *times, message.data))
    for entry in reader.iter_attachments():
        created = (entry.log_time, entry.create_time)
        found.append(("attachment", entry.name, entry.media_type, *created, entry.data))
    found.extend(
        ("metadata", record.name, sorted(record.metadata.items()))
        for record in reader.iter_metadata()
    )
    return found


def carried_over(data: bytes, prefix: str = "/mclass/") -> list[tuple[Any, ...]]:
    """What `read_whole` finds that the run did not add."""
    own = {"mclass", "mclass.yaml", "mclass_layout.json"}
    return [
        entry
        for entry in read_whole(data)
        if not (entry[1].startswith(prefix) if entry[0] == "message" else entry[1] in own)
    ]


def scene(path: Path, fill: Callable[[SceneLog], object], *, robot: bool = True) -> bytes:
    """A log of JSON messages: a robot that stands, and what ``fill`` adds."""
    log = SceneLog(path)
    if robot:
        standing_robot(log)
    fill(log)
    data = log.close().read_bytes()
    path.unlink()
    return data


def add_detections(log: SceneLog, times: Iterable[float] | None = None) -> None:
    """Detections of one object."""
    for number, time in enumerate(times or [0.5 + 0.4 * i for i in range(DETECTIONS)]):
        label = "cup" if number % 3 else "jug"
        log.detections(time, [detection({label: 0.9}, WIDE, "o")])


def of_kind(data: bytes, kind: str, chunk_size: int = 1500) -> bytes:
    """The same content as another kind of file, with what nobody can read beside it."""
    reader = make_reader(io.BytesIO(data))
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=chunk_size, **KINDS[kind])
    writer.start("", "test")
    schemas: dict[int, int] = {}
    channels: dict[int, int] = {}
    strange = writer.register_schema("a/b/c", "unheard-of", b"\x00\xff")
    odd = writer.register_channel("/odd", "\x01encoding", strange, {"k\n": "v\x00"})
    bare = writer.register_channel("/bare", "", 0)
    for number, (schema, channel, message) in enumerate(reader.iter_messages()):
        if channel.id not in channels:
            assert schema is not None
            if schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(
                    schema.name, schema.encoding, schema.data
                )
            channels[channel.id] = writer.register_channel(
                channel.topic, channel.message_encoding, schemas[schema.id]
            )
        times = (message.log_time, message.publish_time)
        writer.add_message(channels[channel.id], times[0], message.data, times[1], number)
        if number % 7 == 0:
            writer.add_message(odd, times[0], bytes([number % 256]) * 9, 3, number)
            writer.add_message(bare, times[0], b"", times[1], 0)
    writer.add_attachment(5, 6, "map.png", "image/png", bytes(range(256)))
    writer.add_attachment(5, 6, "map.png", "image/png", b"the same name again")
    writer.add_metadata("rosbag2", {"serialized_metadata": "x: 1\n", "é": "\x00"})
    writer.finish()  # type: ignore[no-untyped-call]
    return stream.getvalue()
