"""Whether an estimate fits into memory, found out before it starts."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mclass.errors import ModelError
from mclass.footprint import TILE_CELLS, tiles
from mclass.inference import Problem
from mclass.objects import FILTER_BYTES, pointed_cells
from mclass.records import FloatArray, IntArray

_BASE = 200 * 2**20
"""Programs, tables and what is worked on at the moment."""

_COPIES = 3
"""Of a map while it is packed."""

_OBJECT_COPIES = 4
"""Of an object's belief: before a step, what it adds, and after it, whole and in part."""

_GROUPS = (Path("/sys/fs/cgroup"), Path("/sys/fs/cgroup/memory"))
_LIMITS = (
    ("memory.max", "memory.current"),
    ("memory.limit_in_bytes", "memory.usage_in_bytes"),
)
_MEMORY_FILE = Path("/proc/meminfo")


@dataclass(frozen=True)
class Need:
    """What an estimate will hold in memory at its peak.

    Attributes:
        cells: In the grid.
        touched: Of them, those that some footprint may touch.
        n_bytes: In all.
    """

    cells: int
    touched: int
    n_bytes: int


def require_memory(problem: Problem, n_cuts: int, threads: int) -> None:
    """Refuse an estimate that would not fit.

    Args:
        problem: What is to be estimated.
        n_cuts: How many times maps are written.
        threads: Of the grid.

    Raises:
        ModelError: With the numbers and what to change.
    """
    if problem.grid is None:
        return
    free = available_bytes()
    need = memory_needed(problem, n_cuts, threads)
    if free is None or need.n_bytes <= free:
        return
    # Overlapping footprints were counted more than once: look closer.
    touched = sum(len(tile.cells) for tile in tiles(problem.grid, problem.looks.pointing))
    need = memory_needed(problem, n_cuts, threads, touched, _most_candidates(problem))
    if need.n_bytes <= free:
        return
    grid, settings = problem.grid, problem.model.grid
    often = f", {n_cuts:,} times each," if n_cuts > 1 else ""
    advice = "a greater period for --every, " if n_cuts > 1 else ""
    raise ModelError(
        f"{problem.model.name}: this does not fit into memory: {grid.rows:,} x {grid.columns:,} "
        f"cells, {need.touched:,} of them touched,{often} {problem.engine.n_classes} classes and "
        f"{problem.engine.bins} orientation bins need about {_gigabytes(need.n_bytes)}, and "
        f"{_gigabytes(free)} are free. Choose {advice}a greater grid.cell_size "
        f"({settings.cell_size:g} m now), fewer grid.orientation_bins, a shorter grid.range, or "
        "state grid.origin and grid.size."
    )


def memory_needed(
    problem: Problem,
    n_cuts: int,
    threads: int,
    touched: int | None = None,
    candidates: int | None = None,
) -> Need:
    """What a problem with a grid needs, rather too much than too little.

    Args:
        problem: What is to be estimated.
        n_cuts: How many times maps are written.
        threads: Of the grid.
        touched: Cells that footprints touch; bounded from above when None.
        candidates: Of the object with most of them; bounded from above when None.
    """
    grid, engine = problem.grid, problem.engine
    assert grid is not None
    cells = grid.rows * grid.columns
    areas = _cells_pointed_at(problem)
    if touched is None:
        touched = int(min(cells, areas.sum()))
    belief = engine.n_classes * engine.bins * 8
    maps = cells * (5 * (1 + engine.n_classes) + 8) * _COPIES
    probabilities = touched * (1 + engine.n_classes) * 16 * n_cuts
    at_work = TILE_CELLS * belief * 2 * (n_cuts + 1) * 2 * threads
    if candidates is None:
        candidates = int(min(touched, _by_object(problem, areas)))
    at_once = max(1, problem.model.inference.trajectory_samples) if candidates else 0
    followed = at_once * (candidates * belief * _OBJECT_COPIES + FILTER_BYTES)
    return Need(cells, touched, _BASE + maps + probabilities + at_work + followed)


def _cells_pointed_at(problem: Problem) -> FloatArray:
    """At most how many cells each detection points at, (n detections,)."""
    pointing = problem.looks.pointing.select(np.arange(problem.looks.n_detections))
    size = problem.model.grid.cell_size
    near, far = pointing.min_range, pointing.max_range
    widths = np.nan_to_num(pointing.widths)
    sector = widths / 2.0 * (far**2 - near**2) / size**2
    border = (2.0 * (far - near) + 2.0 * widths * far) / size
    pointed = np.isfinite(pointing.directions).all(axis=1)
    return np.asarray(np.where(pointed, sector + border + 1.0, 0.0))


def _owners(problem: Problem) -> IntArray:
    """Which object each detection may be of, -1 for none, (n detections,)."""
    owners: IntArray = problem.measurements.object_index
    if problem.model.inference.association and (owners < 0).all():
        # Which are of one object is found out later: perhaps all of them.
        return np.zeros_like(owners)
    return owners


def _by_object(problem: Problem, areas: FloatArray) -> float:
    """Cells that the detections of the object with most of them point at."""
    owners = _owners(problem)
    owned = owners >= 0
    if not owned.any():
        return 0.0
    return float(np.bincount(owners[owned], weights=areas[owned]).max())


def _most_candidates(problem: Problem) -> int:
    """Cells that detections of one object point at, of the object with most of them."""
    assert problem.grid is not None
    owners = _owners(problem)
    most = 0
    for index in range(int(owners.max(initial=-1)) + 1):
        found = pointed_cells(problem.grid, problem.looks.pointing, np.flatnonzero(owners == index))
        most = max(most, 0 if found is None else len(found.cells))
    return most


def available_bytes() -> int | None:
    """Memory that this process may still take; None where the system does not say."""
    found = []
    with contextlib.suppress(OSError, ValueError, StopIteration):
        lines = _MEMORY_FILE.read_text().splitlines()
        available = next(line for line in lines if line.startswith("MemAvailable:"))
        found.append(int(available.split()[1]) * 1024)
    for group in _GROUPS:
        for limit, used in _LIMITS:
            with contextlib.suppress(OSError, ValueError):
                left = int((group / limit).read_text()) - int((group / used).read_text())
                found.append(left + _reclaimable(group))
    return max(0, min(found)) if found else None


def _reclaimable(group: Path) -> int:
    """Bytes of files in a group's cache, which it gives up when memory is short."""
    with contextlib.suppress(OSError, ValueError):
        for line in (group / "memory.stat").read_text().splitlines():
            name, _, value = line.partition(" ")
            if name in ("inactive_file", "total_inactive_file"):
                return int(value)
    return 0


def _gigabytes(n_bytes: int) -> str:
    return f"{n_bytes / 1e9:,.1f} GB"
