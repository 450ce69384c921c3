"""How time grows with measurements, touched cells, and what else is in a log."""

from __future__ import annotations

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
IMAGES = (0, 100, 400)


def measure(folder: Path, runs: int) -> tuple[str, list[Row]]:
    rows = []
    times = [_estimate(runs, *scene.hall(10_000, count)) for count in MEASUREMENTS]
    rows.append(_fit("measurements", MEASUREMENTS, times, "in a hall of 10,000 cells"))
    # So many measurements that every cell is seen as often as in any other hall.
    times = [_estimate(runs, *scene.hall(count, count)) for count in CELLS]
    rows.append(_fit("touched cells", CELLS, times, "each seen equally often"))
    model = parse_model(generated.MODEL, "model")
    sizes, times = [], []
    for images in IMAGES:
        path = folder / f"{images}.mcap"
        generated.write_ros(path, 20_000, images=images, size=2**20)

        def read(path: Path = path) -> None:
            with LogReader.open(path) as reader:
                read_measurements(reader, model)

        sizes.append(path.stat().st_size)
        times += fastest(runs, read)
        path.unlink()
    found = ", ".join(
        f"{size / 2**20:,.0f} MB: {seconds:.2f} s"
        for size, seconds in zip(sizes, times, strict=True)
    )
    rows.append(Row("reading 40,000 messages beside images", found, "flat"))
    return "### Growth (2 threads)", rows


def _estimate(runs: int, model: Model, measurements: LabelMeasurements) -> float:
    def run() -> None:
        problem = prepare(model, measurements)
        for _ in GridEstimate(problem, cuts_every(measurements, None), 2).blocks():
            pass

    return fastest(1 if len(measurements) > 100_000 else runs, run)[0]


def _fit(what: str, counts: tuple[int, ...], times: list[float], note: str) -> Row:
    """Slope of log time over log count: 1 is linear; below 1 a constant part is still seen."""
    slope = np.polyfit(np.log(counts[1:]), np.log(times[1:]), 1)[0]
    found = ", ".join(
        f"{count:,}: {seconds:.2f} s" for count, seconds in zip(counts, times, strict=True)
    )
    return Row(f"{what}, {note}", f"{found}; exponent {slope:.2f}", "at most 1")
