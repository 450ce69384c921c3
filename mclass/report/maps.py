"""Class maps over time, and which way each cell faces, packed for a page."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from mclass.footprint import Grid
from mclass.records import FloatArray, IntArray
from mclass.results import BeliefBlock, ClassMaps

SCALE = 10_000
"""Probabilities are whole numbers of ten-thousandths: the four digits that are shown."""

NOTHING = 0xFFFF
"""Of cells that are not touched, and of directions where every one is as good."""

MOST_BYTES = 3_500_000
"""Of the packed maps; of more only some are kept, evenly chosen."""

_FLAT = 0.01
"""Densities whose logarithm varies by less name no direction."""

Words = npt.NDArray[np.uint16]


@dataclass
class CellFacts:
    """What beliefs say of the cells of each map, beside the class probabilities.

    Attributes:
        orientations: Degrees of the highest density given each class, by (stamp, log time) of
            the map, then for the cells of each block.
    """

    orientations: dict[tuple[int, int], list[tuple[IntArray, FloatArray, IntArray]]] = field(
        default_factory=dict
    )

    def add(self, block: BeliefBlock) -> None:
        """Take what one block of the grid's belief says."""
        entries = self.orientations.setdefault((block.stamp_ns, block.log_time_ns), [])
        entries.append((block.cells, highest_degrees(block.log_density), block.measurements))


def highest_degrees(log_density: npt.NDArray[np.floating[Any]]) -> FloatArray:
    """Angle of the highest density [deg, 0..360), NaN where it is flat.

    Args:
        log_density: At equally spaced angles from 0, (..., bins).

    Returns:
        Found between the bins by a parabola, (...).
    """
    bins = log_density.shape[-1]
    values = log_density.astype(np.float64)
    peak = np.argmax(values, axis=-1)
    left, middle, right = (
        np.take_along_axis(values, ((peak + step) % bins)[..., None], axis=-1)[..., 0]
        for step in (-1, 0, 1)
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        offset = 0.5 * (left - right) / (left - 2.0 * middle + right)
    offset = np.clip(np.where(np.isfinite(offset), offset, 0.0), -0.5, 0.5)
    degrees = np.remainder((peak + offset) * 360.0 / bins, 360.0)
    is_flat = values.max(axis=-1) - values.min(axis=-1) < _FLAT
    return np.where(is_flat, np.nan, degrees)


def pack_maps(maps: Sequence[ClassMaps], facts: CellFacts) -> dict[str, Any]:
    """Maps of one grid as JSON can hold them; ``{}`` when there are none.

    Every map has planes of 16-bit numbers over the window of touched cells, rows from below:
    P of the background and of each class, degrees of the highest density given each class, and
    how many measurements pointed there. Each map but the first is given as the difference from
    the one before; then come all low bytes, all high bytes, zlib and base64.

    Args:
        maps: Oldest first, at least the last of which is kept.
        facts: What the beliefs of the same times say.
    """
    maps = [found for found in maps if len(found.cells)]
    if not maps:
        return {}
    grid, window = _window(maps)
    stored = len(maps)
    values = np.stack([_planes(found, window, grid, facts) for found in maps])
    kept = list(range(stored))
    while len(data := _packed(values[kept])) > MOST_BYTES and len(kept) > 1:
        # Every other one, counted from the last.
        kept = kept[::-2][::-1]
    return {
        "origin": [float(grid.origin[0]), float(grid.origin[1])],
        "cell_size": float(grid.cell_size),
        "rows": grid.rows,
        "columns": grid.columns,
        "first_row": window.first_row,
        "first_column": window.first_column,
        "scale": SCALE,
        "prior": [round(float(value), 6) for value in maps[-1].untouched],
        "stamps_ns": [str(int(maps[index].stamp_ns)) for index in kept],
        "stored": stored,
        "data": data,
    }


@dataclass(frozen=True)
class _Window:
    """Where the touched cells lie in the whole grid."""

    first_row: int
    first_column: int


def _window(maps: Sequence[ClassMaps]) -> tuple[Grid, _Window]:
    """The smallest grid that holds all touched cells, and its place in the whole one."""
    grid = maps[-1].grid
    cells = np.unique(np.concatenate([found.cells for found in maps]))
    rows, columns = np.divmod(cells, grid.columns)
    window = _Window(int(rows.min()), int(columns.min()))
    corner = (
        grid.origin[0] + window.first_column * grid.cell_size,
        grid.origin[1] + window.first_row * grid.cell_size,
    )
    shape = (int(rows.max()) - window.first_row + 1, int(columns.max()) - window.first_column + 1)
    return Grid(corner, grid.cell_size, *shape), window


def _planes(found: ClassMaps, window: _Window, grid: Grid, facts: CellFacts) -> Words:
    """All planes of one map, (planes, rows * columns)."""

    def inside(cells: IntArray) -> IntArray:
        rows, columns = np.divmod(cells, found.grid.columns)
        at = (rows - window.first_row) * grid.columns + columns - window.first_column
        return np.asarray(at)

    classes = found.class_probabilities.shape[1]
    planes = np.full((2 * classes, grid.rows * grid.columns), NOTHING, dtype=np.uint16)
    planes[:classes, inside(found.cells)] = np.rint(SCALE * found.class_probabilities.T)
    for cells, degrees, counts in facts.orientations.get((found.stamp_ns, found.log_time_ns), ()):
        at = inside(cells)
        whole = np.where(np.isnan(degrees), NOTHING, np.rint(degrees) % 360)
        planes[classes : 2 * classes - 1, at] = whole.T
        planes[-1, at] = np.minimum(counts, NOTHING - 1)
    return planes


def _packed(values: Words) -> str:
    """As `pack_maps` says."""
    steps = values.copy()
    steps[1:] -= values[:-1]
    flat = steps.ravel()
    halves = np.concatenate([flat & 0xFF, flat >> 8]).astype(np.uint8)
    return base64.b64encode(zlib.compress(halves.tobytes(), 6)).decode("ascii")
