"""The whole estimate of the grid against direct evaluation and against a kernel in C."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import time
from collections.abc import Callable
from concurrent.futures import Executor, ProcessPoolExecutor
from functools import lru_cache, partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mclass.belief import posterior
from mclass.footprint import tiles
from mclass.gridmap import tile_pairs
from mclass.inference import GridEstimate, cuts_every, prepare
from mclass.model import Model
from mclass.observation import paper_terms
from mclass.records import FloatArray, LabelMeasurements

from . import scene
from .tables import Row, fastest

COUNT = 2000
THREADS = 2
DIRECT_CELLS = {3: 20, 10: 1}
"""Cells that direct evaluation is timed on, by the number of classes."""

RANGE_STEP = 0.065
SEEN = 60
"""How often a cell is seen in the hall whose beliefs are read out."""


def measure(folder: Path, runs: int) -> tuple[str, list[Row]]:
    rows = []
    library = compiled(folder)
    with ProcessPoolExecutor(1, get_context("spawn")) as elsewhere:
        for classes, bins in ((3, 72), (10, 360)):
            rows += _one_size(classes, bins, library, elsewhere, runs)
    summing, reading, touched = read_out()
    rows.append(
        Row(
            f"read-out of {touched:,} touched cells, each seen {SEEN} times, 1 thread",
            f"{reading:.2f} s; filter {summing:.2f} s: {reading / summing:.2f} of it",
            "less than 1",
        )
    )
    return "### Filter", rows


def _one_size(
    classes: int, bins: int, library: ctypes.CDLL | None, elsewhere: Executor, runs: int
) -> list[Row]:
    """So many classes and bins; NumPy works elsewhere, where mclass keeps no memory for it."""
    model, measurements = scene.field(classes, bins, COUNT)
    cells = DIRECT_CELLS[classes]
    functions: list[Callable[[], object]] = [
        partial(estimate, model, measurements, THREADS),
        lambda: elsewhere.submit(_direct_elsewhere, classes, bins, cells).result(),
    ]
    if library is not None:
        kernel = Kernel(library, model, measurements)
        functions += [partial(kernel.run, 1), partial(kernel.run, 4)]
    times = fastest(runs, *functions)
    ours, numpy = times[0], times[1] * 5000 / cells
    rows = [
        Row(
            f"{COUNT:,} measurements × 5,000 cells × {classes} classes × {bins} bins: mclass, "
            f"{THREADS} threads",
            f"{ours:.2f} s",
        ),
        Row(
            f"NumPy direct evaluation in float64, in a process of its own "
            f"(measured on {cells} cells, scaled)",
            f"{numpy:.1f} s: mclass is {numpy / ours:.0f} times faster",
            "at least 40 times",
        ),
    ]
    for kind, seconds in zip(("nearest row", "linear between 4 rows"), times[2:], strict=False):
        error = _kernel_error(kernel, 1 if kind == "nearest row" else 4, model, measurements)
        rows.append(
            Row(
                f"C kernel, {kind}, {THREADS} threads; its error {error:.0e}",
                f"{seconds:.2f} s: mclass takes {ours / seconds:.1f} times that",
                "at most 2 times",
            )
        )
    rows.append(
        Row(
            "mclass's greatest error of log beliefs above e^-20 of their peak, against float64",
            f"{greatest_error(model, measurements, 40):.1e}",
            "below 1e-3",
        )
    )
    return rows


def estimate(model: Model, measurements: LabelMeasurements, threads: int) -> None:
    """From poses and detections to the beliefs of all cells."""
    problem = prepare(model, measurements)
    for _ in GridEstimate(problem, cuts_every(measurements, None), threads).blocks():
        pass


def chosen_cells(model: Model, count: int) -> tuple[NDArray[np.int64], FloatArray]:
    """Flat indices of some cells all over the field, and their centres."""
    grid = model.grid
    assert grid.size is not None
    columns, rows = (round(length / grid.cell_size) for length in grid.size)
    cells = np.linspace(0, columns * rows - 1, count).astype(np.int64)
    centers = np.stack([cells % columns + 0.5, cells // columns + 0.5], axis=-1) * grid.cell_size
    return cells, centers


def direct(model: Model, measurements: LabelMeasurements, count: int) -> FloatArray:
    """Every Gaussian evaluated for every cell, measurement, class and bin, (cells, n, bins)."""
    _, centers = chosen_cells(model, count)
    bins = model.grid.orientation_bins
    orientations = 2.0 * np.pi * np.arange(bins) / bins
    cosine, sine = np.cos(orientations), np.sin(orientations)
    total = np.zeros((count, len(model.classes.class_names), bins))
    for label in range(len(model.classes.label_names)):
        positions = measurements.frames.poses_world_sensor[measurements.labels == label, :2]
        offset = (positions[None] - centers[:, None])[..., None]
        x = offset[:, :, 0] * cosine + offset[:, :, 1] * sine
        y = offset[:, :, 1] * cosine - offset[:, :, 0] * sine
        for true in range(total.shape[1]):
            entry = model.classes.likelihoods[true, label]
            mixture = entry.mixture
            parts = []
            for weight, mean, covariance in zip(
                mixture.weights, mixture.means, mixture.covariances, strict=True
            ):
                variance = covariance[0, 0]
                squared = (x - mean[0]) ** 2 + (y - mean[1]) ** 2
                height = np.log(entry.probability * weight / (2.0 * np.pi * variance))
                parts.append(height - 0.5 * squared / variance)
            value = parts[0] if len(parts) == 1 else np.logaddexp(*parts)
            total[:, true] += value.sum(axis=1)
    return total


@lru_cache(maxsize=1)
def _field(classes: int, bins: int) -> tuple[Model, LabelMeasurements]:
    return scene.field(classes, bins, COUNT)


def _direct_elsewhere(classes: int, bins: int, cells: int) -> None:
    direct(*_field(classes, bins), cells)


def _greatest(found: NDArray[np.floating], wanted: FloatArray) -> float:
    """Difference where log beliefs are within 20 of the greatest of their cell."""
    matters = wanted > wanted.max(axis=(1, 2), keepdims=True) - 20.0
    return float(np.abs(found - wanted)[matters].max())


def greatest_error(model: Model, measurements: LabelMeasurements, count: int) -> float:
    """Of the filter."""
    exact = direct(model, measurements, count)
    chosen, _ = chosen_cells(model, count)
    problem = prepare(model, measurements)
    assert problem.grid is not None
    engine = problem.engine
    worst = 0.0
    for tile in tiles(problem.grid, problem.looks.pointing):
        inside = np.flatnonzero(np.isin(tile.cells, chosen))
        if len(inside):
            pairs = tile_pairs(problem.looks, problem.grid, tile, None)
            found = engine.evidence(pairs).classes[inside, :, :: engine.bins // engine.shown_bins]
            worst = max(worst, _greatest(found, exact[np.searchsorted(chosen, tile.cells[inside])]))
    return worst


def _kernel_error(
    kernel: Kernel, rows: int, model: Model, measurements: LabelMeasurements
) -> float:
    """Of the kernel."""
    chosen, _ = chosen_cells(model, 40)
    return _greatest(kernel.run(rows)[chosen], direct(model, measurements, 40))


def read_out() -> tuple[float, float, int]:
    """Seconds for summing and for reading out the beliefs of a whole hall, and its cells."""
    # A sector of 0.6 rad and 4 m covers 480 cells.
    model, measurements = scene.hall(160_000, SEEN * 160_000 // 480)
    problem = prepare(model, measurements)
    assert problem.grid is not None
    summing = reading = 0.0
    touched = 0
    for tile in tiles(problem.grid, problem.looks.pointing):
        start = time.perf_counter()
        evidence = problem.engine.evidence(tile_pairs(problem.looks, problem.grid, tile, None))
        middle = time.perf_counter()
        belief = posterior(evidence, model.classes.log_priors, problem.engine.shown_bins)
        np.exp(belief.log_class_probability)
        reading += time.perf_counter() - middle
        summing += middle - start
        touched += int(np.count_nonzero(evidence.looks))
    return summing, reading, touched


def compiled(folder: Path) -> ctypes.CDLL | None:
    """The kernel, where there is a compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        return None
    library = folder / "kernel.so"
    flags = ["-O3", "-march=native", "-fopenmp", "-shared", "-fPIC"]
    source = Path(__file__).with_name("kernel.c")
    subprocess.run([compiler, *flags, str(source), "-o", str(library), "-lm"], check=True)
    return ctypes.CDLL(str(library))


class Kernel:
    """The kernel with its table, both from the model on in every run."""

    def __init__(self, library: ctypes.CDLL, model: Model, measurements: LabelMeasurements) -> None:
        self._library = library
        self._model = model
        self._measurements = measurements

    def run(self, rows: int) -> NDArray[np.float32]:
        model, measurements = self._model, self._measurements
        problem = prepare(model, measurements)
        assert problem.grid is not None
        bins = model.grid.orientation_bins
        ranges = RANGE_STEP * np.arange(round(scene.MAX_RANGE / RANGE_STEP) + 2)
        angles = 2.0 * np.pi * np.arange(bins) / bins
        directions = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        views = ranges[:, None, None] * directions
        table = np.stack(
            [term.log_likelihood(views).swapaxes(0, 1) for term in paper_terms(model.classes)]
        )
        table = table[..., -np.arange(2 * bins) % bins]
        centers = problem.grid.centers(np.arange(problem.grid.rows * problem.grid.columns))
        pointing = problem.looks.pointing.select(np.arange(len(measurements)))
        cells, classes = len(centers), len(model.classes.class_names)
        belief = np.empty((cells, classes, bins), dtype=np.float32)
        nothing = np.empty(cells, dtype=np.float32)
        arrays = [
            *(np.ascontiguousarray(column) for column in (*centers.T, *pointing.positions.T)),
            np.ascontiguousarray(pointing.directions[:, 0]),
            pointing.widths,
            measurements.labels.astype(np.int32),
            np.ascontiguousarray(table, dtype=np.float32),
            model.classes.background_log_likelihood.astype(np.float32),
            belief,
            nothing,
        ]
        at = [array.ctypes.data_as(ctypes.c_void_p) for array in arrays]
        number = ctypes.c_double
        self._library.omp_set_num_threads(THREADS)
        self._library.gather(
            *(cells, at[0], at[1], len(measurements), at[2], at[3], at[4], at[5], at[6]),
            *(number(scene.MIN_RANGE), number(scene.MAX_RANGE), at[7], len(ranges)),
            *(number(RANGE_STEP), classes, bins, at[8], at[9], at[10], rows),
        )
        return belief
