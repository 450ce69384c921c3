"""The grid, and which of its cells a detection points at (paper section IV)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mclass.records import FloatArray, IntArray


@dataclass(frozen=True)
class Grid:
    """Square cells on the ground plane; cell (row 0, column 0) is the lower-left one.

    Attributes:
        origin: Lower-left corner of cell (0, 0) in the world frame [m].
        cell_size: Edge length [m].
        rows: Number of rows, growing with y.
        columns: Number of columns, growing with x.
    """

    origin: tuple[float, float]
    cell_size: float
    rows: int
    columns: int

    def centers(self, cells: IntArray) -> FloatArray:
        """Centres [m] of flat cell indices (row * columns + column), (..., 2)."""
        row, column = np.divmod(cells, self.columns)
        x = self.origin[0] + (column + 0.5) * self.cell_size
        y = self.origin[1] + (row + 0.5) * self.cell_size
        return np.stack([x, y], axis=-1)

    def cell_at(self, x: float, y: float) -> int | None:
        """Flat index of the cell that holds a point [m], None outside the grid."""
        column = int(np.floor((x - self.origin[0]) / self.cell_size))
        row = int(np.floor((y - self.origin[1]) / self.cell_size))
        inside = 0 <= row < self.rows and 0 <= column < self.columns
        return row * self.columns + column if inside else None
