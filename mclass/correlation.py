"""Looks from one place share one vote.

A detector that sees an object from nearly the same viewpoint again errs in the same way again.
Each look's evidence is therefore divided by the number of looks around it,

    w = 1 / sum_n exp(-1/2 [(Δrange / l_r)² + (Δdirection / l_d)²]),

the sum taken over all looks at the same cell, itself included. The sum is read from a lattice
over range and direction, so its cost grows with the looks, not with their pairs: looks are
spread over nodes by quintic B-splines, convolved, and read by the same splines. The convolution
undoes the widening by both, so that where the nodes lie does not show.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from scipy.sparse import csr_array

from mclass.records import FloatArray, IntArray
from mclass.table import REACH, quintic_weights

_NODES_PER_WIDTH = 2.0
_TAPS = 2 * REACH
_FREQUENCIES = 1024
_LOOKS_AT_ONCE = 2**12


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
    _counts: FloatArray = field(init=False)
    _smooth: bool = False

    def __post_init__(self) -> None:
        self._range_step = self.range_width / _NODES_PER_WIDTH
        shape = lattice_shape(self.reach, self.range_width, self.direction_width)
        self._direction_step = 2.0 * np.pi / shape[1]
        self._counts = np.zeros((self.cells, *shape))

    def deposit(self, cells: IntArray, ranges: FloatArray, directions: FloatArray) -> None:
        """Add looks: number of the cell, range [m] and direction [rad] of each, (p,)."""
        assert not self._smooth, "all are deposited before any is read"
        counts = self._counts.ravel()
        for part in _parts(len(cells)):
            spread = self._spread(cells[part], ranges[part], directions[part])
            np.add.at(counts, spread.indices, spread.data)

    def weights(self, cells: IntArray, ranges: FloatArray, directions: FloatArray) -> FloatArray:
        """Weight of looks that were deposited, at most 1, (p,)."""
        if not self._smooth:
            self._smoothen()
        smooth, weights = self._counts.ravel(), np.empty(len(cells))
        for part in _parts(len(cells)):
            counts = self._spread(cells[part], ranges[part], directions[part]) @ smooth
            # Each counts itself, rounding apart.
            weights[part] = 1.0 / np.maximum(counts, 1.0)
        return weights

    def _spread(self, cells: IntArray, ranges: FloatArray, directions: FloatArray) -> csr_array:
        """How much of each look is in each lattice node, (p, nodes)."""
        _, n_ranges, n_directions = self._counts.shape
        row, row_shares = quintic_weights(ranges / self._range_step)
        column, column_shares = quintic_weights(directions / self._direction_step)
        taps = np.arange(_TAPS)
        kind = np.int32 if self._counts.size < 2**31 else np.int64
        rows = (((cells * n_ranges + row)[:, None] + taps) * n_directions).astype(kind)
        columns = np.remainder(column[:, None] + taps, n_directions).astype(kind)
        nodes = rows[:, :, None] + columns[:, None, :]
        shares = row_shares.T[:, :, None] * column_shares.T[:, None, :]
        starts = np.arange(0, _TAPS**2 * len(cells) + 1, _TAPS**2, dtype=kind)
        shape = (len(cells), self._counts.size)
        return csr_array((shares.ravel(), nodes.ravel(), starts), shape=shape)

    def _smoothen(self) -> None:
        """Convolve the counts with the kernel, in place: they are most of the memory in use."""
        _, n_ranges, n_directions = self._counts.shape
        row = np.abs(np.subtract.outer(np.arange(n_ranges), np.arange(n_ranges)))
        around = np.abs(np.subtract.outer(np.arange(n_directions), np.arange(n_directions)))
        around = np.minimum(around, n_directions - around)
        rows = _kernel(n_ranges, self.range_width / self._range_step)[row]
        columns = _kernel(n_directions, self.direction_width / self._direction_step)[around]
        for counts in self._counts:
            counts[:] = (rows @ counts) @ columns
        self._smooth = True


def lattice_shape(reach: float, range_width: float, direction_width: float) -> tuple[int, int]:
    """Nodes over range and direction of each cell's lattice; arguments as of `LookLattice`."""
    n_ranges = int(np.ceil(reach * _NODES_PER_WIDTH / range_width)) + _TAPS
    # Whole nodes to a quarter turn: worlds are often turned by that.
    quarter = int(np.ceil(np.pi / 2.0 * _NODES_PER_WIDTH / direction_width))
    return n_ranges, 4 * max(_TAPS, quarter)


def _parts(count: int) -> Iterator[slice]:
    """Looks of which all that is known of their nodes fits the cache."""
    for start in range(0, count, _LOOKS_AT_ONCE):
        yield slice(start, start + _LOOKS_AT_ONCE)


def _kernel(count: int, width: float) -> FloatArray:
    """What a Gaussian must be between nodes for spreading and reading to give it back.

    Args:
        count: Number of nodes.
        width: Of the Gaussian, in nodes.

    Returns:
        Values at distances of 0 to ``count`` - 1 nodes, (count,).
    """
    frequencies = np.pi * (np.arange(_FREQUENCIES) + 0.5) / _FREQUENCIES
    spline = np.sinc(frequencies / (2.0 * np.pi)) ** _TAPS
    spectrum = np.exp(-0.5 * (width * frequencies) ** 2) / spline**2
    waves = np.cos(np.outer(np.arange(count), frequencies))
    return np.asarray(np.sqrt(2.0 * np.pi) * width * (waves @ spectrum) / _FREQUENCIES)
