"""One output with everything in it, hand-made and lopsided, in any encoding."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from lopsided_results import CLASS_NAMES, STAMP_NS, estimate, maps, mode
from mcap.reader import make_reader

from mclass.classes import ClassModel
from mclass.footprint import Grid
from mclass.logs.writer import LogWriter
from mclass.model import GridSettings, Model
from mclass.outputs.channels import Encoding, OutputChannels
from mclass.records import Frames, LabelMeasurements
from mclass.results import BeliefBlock, ObjectEstimate

ENCODINGS: tuple[Encoding, ...] = ("ros2", "protobuf", "json")
LOG_TIME_NS = STAMP_NS + 50_000_000
STRANGE_ID = "box 1/a\n\x07é"


def model(class_names: tuple[str, ...] = CLASS_NAMES) -> Model:
    priors = np.full(1 + len(class_names), 1.0 / (1 + len(class_names)))
    classes = ClassModel(class_names, ("books", "parts"), np.log(priors), np.zeros(2), {})
    return Model(
        "office.yaml", "# the model\nclasses: {}\n", "m", classes, grid=GridSettings(cell_size=0.05)
    )


def objects() -> tuple[ObjectEstimate, ...]:
    """Two objects: one tied, with an id that is no topic name."""
    tied = estimate(
        STRANGE_ID,
        probabilities=(0.6, 0.2, 0.2),
        tie=(0, 1),
        position=(-3.0, 1.5),
        modes=(mode(0.5, 1.0, 3.0),),
        labels=(),
        stamp_ns=STAMP_NS - 7,
    )
    return estimate("o1"), tied


def belief(object_id: str = "", blocks: int = 2, shift: float = 0.0) -> list[BeliefBlock]:
    """Three cells a block on a grid of 4 rows and 6 columns; the first block begins at cell 2."""
    made = []
    for block in range(blocks):
        cells = np.array([2, 3, 5]) + 6 * block
        numbers = np.arange(3.0) + 10.0 * block + shift
        made.append(
            BeliefBlock(
                object_id=object_id,
                grid=Grid((-1.0, 2.0), 0.5, 4, 6),
                stamp_ns=STAMP_NS,
                log_time_ns=LOG_TIME_NS,
                block=block,
                blocks=blocks,
                cells=cells,
                log_cell_mass=-numbers,
                log_class_probability=np.log([[0.5, 0.3, 0.2]] * 3) - numbers[:, None],
                log_density=np.arange(24, dtype=np.float32).reshape(3, 2, 4) + np.float32(block),
                measurements=np.array([1, 2, 3]) + block,
            )
        )
    return made


def measurements(frames: int = 3, covariances: bool = True) -> LabelMeasurements:
    """Two rows in each frame but the first, which is empty; the second row has no direction."""
    index = np.repeat(np.arange(1, frames), 2)
    rows = len(index)
    counts = np.resize([2, 1], rows)
    directions = np.linspace(-3.0, 3.0, 2 * rows).reshape(rows, 2) / 7.0
    directions[1::2] = np.nan
    rng = np.random.default_rng(5)
    return LabelMeasurements(
        frames=Frames(
            stamps_ns=STAMP_NS + np.arange(frames) * 3,
            log_times_ns=LOG_TIME_NS + np.arange(frames) * 3,
            poses_world_sensor=rng.normal(size=(frames, 3)),
            covariances=rng.normal(size=(frames, 3, 3)) if covariances else None,
            view_directions=np.full((frames, 2), np.nan),
        ),
        frame_index=index,
        directions=directions,
        object_index=np.resize([1, -1, 0], rows),
        object_ids=("o1", STRANGE_ID),
        label_offsets=np.concatenate([[0], np.cumsum(counts)]),
        labels=np.resize([0, 1, 1], counts.sum()),
        scores=rng.uniform(size=counts.sum()),
        label_names=("books", "parts"),
    )


def write_everything(path: Path, encoding: Encoding, prefix: str = "/mclass") -> OutputChannels:
    """Write an output that holds a message of each kind."""
    with LogWriter(path, profile="ros2" if encoding == "ros2" else "") as writer:
        channels = OutputChannels(writer, encoding, "odom", model(), prefix)
        channels.write_header(LOG_TIME_NS, input_hash="sha256:00", settings={"every": 2})
        channels.write_objects(objects()[:1], LOG_TIME_NS - 5, STAMP_NS - 5)
        channels.write_objects(objects(), LOG_TIME_NS, STAMP_NS)
        channels.write_maps(maps())
        for block in (*belief(), *belief("o1", 1, 0.5)):
            channels.write_belief(block)
        channels.write_measurements(measurements())
        channels.write_layout(LOG_TIME_NS)
    return channels


def messages(path: Path, topic: str) -> list[tuple[Any, Any, Any]]:
    """Schema, channel and message of one topic, read by the format's own library."""
    with path.open("rb") as stream:
        return list(make_reader(stream, validate_crcs=True).iter_messages([topic]))


def attachment(path: Path, name: str) -> bytes:
    with path.open("rb") as stream:
        found = [entry for entry in make_reader(stream).iter_attachments() if entry.name == name]
    return bytes(found[-1].data)


def layout(path: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(attachment(path, "mclass_layout.json"))
    return content
