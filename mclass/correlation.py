"""Looks from one place share one vote.

A detector that sees an object from nearly the same viewpoint again errs in the same way again.
Each look's evidence is therefore divided by the number of looks around it,

    w = 1 / sum_n exp(-1/2 [(Δrange / l_r)² + (Δdirection / l_d)²]),

the sum taken over all looks at the same cell, itself included. The sum is read from a lattice
over range and direction, so its cost grows with the looks, not with their pairs.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mclass.records import FloatArray, IntArray

_NODES_PER_WIDTH = 2.0


@dataclass
class LookLattice:
    """Counts looks at cells around each viewpoint: deposit all of them, then read.

    Attributes:
        cells: Number of cells.
        reach: Greatest range of any look [m].
        range_width: l_r [m].
        direction_width: l_d [rad].
    """

    cells: int
    reach: float
    range_width: float
    direction_width: float
    _smooth: FloatArray | None = None
    _counts: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        self._range_step = self.range_width / _NODES_PER_WIDTH
        n_ranges = int(np.ceil(self.reach / self._range_step)) + 2
        n_directions = max(4, int(np.ceil(2.0 * np.pi * _NODES_PER_WIDTH / self.direction_width)))
        self._direction_step = 2.0 * np.pi / n_directions
        self._counts = np.zeros((self.cells, n_ranges, n_directions))

    def deposit(self, cells: IntArray, ranges: FloatArray, directions: FloatArray) -> None:
        """Add looks: number of the cell, range [m] and direction [rad] of each, (p,)."""
        nodes, shares = self._nodes(cells, ranges, directions)
        total = np.bincount(nodes.ravel(), weights=shares.ravel(), minlength=self._counts.size)
        self._counts += total.reshape(self._counts.shape)
        self._smooth = None

    def weights(self, cells: IntArray, ranges: FloatArray, directions: FloatArray) -> FloatArray:
        """Weight of looks that were deposited, (p,)."""
        if self._smooth is None:
            self._smooth = self._smoothed()
        nodes, shares = self._nodes(cells, ranges, directions)
        return np.asarray(1.0 / (shares * self._smooth.ravel()[nodes]).sum(axis=0))

    def _nodes(
        self, cells: IntArray, ranges: FloatArray, directions: FloatArray
    ) -> tuple[IntArray, FloatArray]:
        """The four lattice nodes around each look and its shares in them, (4, p) each."""
        _, n_ranges, n_directions = self._counts.shape
        row, row_share = _split(ranges / self._range_step)
        column, column_share = _split(np.remainder(directions, 2.0 * np.pi) / self._direction_step)
        low = (cells * n_ranges + row) * n_directions
        left, right = column % n_directions, (column + 1) % n_directions
        nodes = np.stack(
            [low + left, low + right, low + n_directions + left, low + n_directions + right]
        )
        shares = np.stack(
            [
                (1.0 - row_share) * (1.0 - column_share),
                (1.0 - row_share) * column_share,
                row_share * (1.0 - column_share),
                row_share * column_share,
            ]
        )
        return nodes, shares

    def _smoothed(self) -> FloatArray:
        """The counts convolved with the kernel."""
        _, n_ranges, n_directions = self._counts.shape
        row = np.abs(np.subtract.outer(np.arange(n_ranges), np.arange(n_ranges)))
        around = np.abs(np.subtract.outer(np.arange(n_directions), np.arange(n_directions)))
        around = np.minimum(around, n_directions - around)
        rows = _kernel(self._range_step * row, self.range_width, self._range_step)
        columns = _kernel(self._direction_step * around, self.direction_width, self._direction_step)
        return np.asarray((rows @ self._counts) @ columns)


def _split(coordinates: FloatArray) -> tuple[IntArray, FloatArray]:
    """Lattice node below each coordinate, and the share of the node above."""
    below = np.floor(coordinates)
    return below.astype(np.int64), coordinates - below


def _kernel(gaps: FloatArray, width: float, step: float) -> FloatArray:
    """Gaussian of the gaps, narrowed by what sharing between nodes widens it.

    Sharing a look between two nodes, and reading between two nodes, each add a sixth of the
    squared step to the variance.
    """
    narrowed = np.sqrt(width**2 - step**2 / 3.0)
    return np.asarray(np.exp(-0.5 * (gaps / narrowed) ** 2) * (width / narrowed))
