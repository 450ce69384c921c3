"""How time grows with measurements, touched cells, and what else is in a log."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from mclass.config.model_file import parse_model
from mclass.inference import GridEstimate, cuts_every, prepare
from mclass.logs.measurements import read_measurements
from mclass.logs.reader import LogReader
from mclass.model import Model
from mclass.records import LabelMeasurements

from . import generated, scene
from .tables import Row, fastest

MEASUREMENTS = (1_000, 10_000, 100_000, 1_000_000)
CELLS = (2_500, 10_000, 40_000, 160_000)
IMAGES = (0, 100, 400, 1_600)
CONSTANT = 10_000
"""Fewer measurements or cells cost less than the tables."""


def measure(folder: Path, runs: int) -> tuple[str, list[Row]]:
    times = [_estimate(runs, *scene.hall(2_500, count)) for count in MEASUREMENTS]
    rows = [_fit("measurements", MEASUREMENTS, times, "in a hall of 2,500 cells")]
    # So many measurements that every cell is seen as often as in any other hall.
    times = [_estimate(runs, *scene.hall(count, count)) for count in CELLS]
    rows.append(_fit("touched cells", CELLS, times, "each seen equally often"))
    for apart, where in ((True, "in other chunks"), (False, "in the same chunks")):
        rows.append(_beside_images(folder, runs, where, apart=apart))
    return "### Growth (processor time of 2 threads)", rows


def _estimate(runs: int, model: Model, measurements: LabelMeasurements) -> float:
    def run() -> None:
        problem = prepare(model, measurements)
        for _ in GridEstimate(problem, cuts_every(measurements, None), 2).blocks():
            pass

    runs = 1 if len(measurements) >= 100_000 else runs
    return fastest(runs, run, clock=time.process_time)[0]


def _beside_images(folder: Path, runs: int, where: str, *, apart: bool) -> Row:
    """Time to read the same messages from logs that hold more and more images."""
    model = parse_model(generated.MODEL, "model")
    path = folder / "images.mcap"

    def read() -> None:
        with LogReader.open(path) as reader:
            read_measurements(reader, model)

    found = []
    for images in IMAGES:
        generated.write_ros(path, 20_000, images=images, size=2**20, apart=apart)
        [seconds] = fastest(runs, read, clock=time.process_time)
        found.append(f"{path.stat().st_size / 2**20:,.0f} MB: {seconds:.2f} s")
        path.unlink()
    return Row(
        f"reading 40,000 messages, images {where}", ", ".join(found), "flat" if apart else ""
    )


def _fit(what: str, counts: tuple[int, ...], times: list[float], note: str) -> Row:
    """Slope of log time over log count: 1 is linear; below 1 a constant part is still seen."""
    many = [index for index, count in enumerate(counts) if count >= CONSTANT]
    slope = np.polyfit(np.log([counts[i] for i in many]), np.log([times[i] for i in many]), 1)[0]
    found = ", ".join(
        f"{count:,}: {seconds:.2f} s" for count, seconds in zip(counts, times, strict=True)
    )
    from_on = f"exponent from {CONSTANT:,} on {slope:.2f}"
    return Row(f"{what}, {note}", f"{found}; {from_on}", "1: linear")
