"""Threads: how much faster, and the same results."""

from __future__ import annotations

import hashlib
from functools import partial
from pathlib import Path

from mclass.inference import GridEstimate, cuts_every, prepare
from mclass.model import Model
from mclass.records import LabelMeasurements

from . import scene
from .tables import Row, fastest

THREADS = (1, 2, 4)


def measure(folder: Path, runs: int) -> tuple[str, list[Row]]:
    model, measurements = scene.hall(40_000, 10_000)
    times = fastest(runs, *(partial(_digest, model, measurements, n) for n in THREADS))
    digests = {_digest(model, measurements, n) for n in THREADS}
    found = ", ".join(f"{n}: {seconds:.2f} s" for n, seconds in zip(THREADS, times, strict=True))
    return "### Threads", [
        Row("10,000 measurements, 40,000 cells", found),
        Row("results of 1, 2 and 4 threads", "equal" if len(digests) == 1 else "differ", "equal"),
    ]


def _digest(model: Model, measurements: LabelMeasurements, threads: int) -> str:
    digest = hashlib.sha256()
    problem = prepare(model, measurements)
    for block in GridEstimate(problem, cuts_every(measurements, None), threads).blocks():
        digest.update(block.log_class_probability.tobytes())
        digest.update(block.log_density.tobytes())
    return digest.hexdigest()
