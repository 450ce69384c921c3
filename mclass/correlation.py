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
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.sparse import coo_array

from mclass.blockwise import blocks
from mclass.records import BoolArray, FloatArray, IntArray
from mclass.table import REACH, quintic_weights

_NODES_PER_WIDTH = 2.0
_TAPS = 2 * REACH
_FREQUENCIES = 1024
_LOOKS_AT_ONCE = 2**12
"""Looks of which all that is known of their nodes fits the cache."""

_CELLS_AT_ONCE = 64
_RANGES_TOGETHER = 8
"""Lattices reach over a multiple of so many nodes, so that few kernels do for all."""


def shared_votes(
    looked: BoolArray,
    ranges: FloatArray,
    directions: FloatArray,
    range_width: float,
    direction_width: float,
) -> FloatArray:
    """Weight of every look at every cell, at most 1; 0 where a cell was not looked at, (m, k).

    Args:
        looked: Which looks were at which cells, (m, k).
        ranges: Of sensors from cells [m], (m, k).
        directions: Of sensors seen from cells [rad], (m, k).
        range_width: l_r [m].
        direction_width: l_d [rad].
    """
    weights = np.zeros(looked.shape)
    step = int(np.clip(_LOOKS_AT_ONCE // max(1, looked.shape[1]), 1, _CELLS_AT_ONCE))
    for part in blocks(len(looked), step):
        mask = looked[part]
        cell, _ = np.nonzero(mask)
        if len(cell):
            weights[part][mask] = _weights(
                cell,
                ranges[part][mask] * (_NODES_PER_WIDTH / range_width),
                directions[part][mask],
                direction_width,
            )
    return weights


def _weights(
    cells: IntArray, ranges: FloatArray, directions: FloatArray, direction_width: float
) -> FloatArray:
    """Weights of looks at a few cells, their ranges in nodes, (p,)."""
    nearest = np.floor(ranges.min())
    n_ranges = int(ranges.max() - nearest) + _TAPS
    lattice = _Lattice(
        cells=int(cells[-1]) + 1,
        n_ranges=-(-n_ranges // _RANGES_TOGETHER) * _RANGES_TOGETHER,
        # Whole nodes to a quarter turn: worlds are often turned by that.
        n_directions=4 * max(_TAPS, int(np.ceil(np.pi / 2.0 * _NODES_PER_WIDTH / direction_width))),
    )
    parts = list(blocks(len(cells), _LOOKS_AT_ONCE))

    def spreads() -> Iterator[coo_array]:
        for part in parts:
            yield lattice.spread(cells[part], ranges[part] - nearest, directions[part])

    # Where there is but one it need not be made again.
    once = list(spreads()) if len(parts) == 1 else None
    counts = np.zeros(lattice.size)
    for spread in once or spreads():
        counts += spread.T @ np.ones(spread.shape[0])
    smooth = lattice.smoothed(counts, direction_width)
    read = np.concatenate([np.atleast_1d(spread @ smooth) for spread in once or spreads()])
    # Each counts itself, rounding apart.
    return np.asarray(1.0 / np.maximum(read, 1.0))


@dataclass(frozen=True)
class _Lattice:
    """Nodes over range and direction, for each of some cells."""

    cells: int
    n_ranges: int
    n_directions: int

    @property
    def size(self) -> int:
        """Nodes in all."""
        return self.cells * self.n_ranges * self.n_directions

    def spread(self, cells: IntArray, ranges: FloatArray, directions: FloatArray) -> coo_array:
        """How much of each look is in each node, (p, nodes); ranges in nodes."""
        row, row_shares = quintic_weights(ranges)
        column, column_shares = quintic_weights(directions * (self.n_directions / (2.0 * np.pi)))
        taps = np.arange(_TAPS)[:, None]
        rows = (taps + (cells * self.n_ranges + row)) * self.n_directions
        columns = np.remainder(taps + column, self.n_directions)
        # Node by node around each look, not look by look: numbers side by side are alike.
        shares = row_shares[:, None] * column_shares
        nodes = rows.astype(np.int32)[:, None] + columns.astype(np.int32)
        looks = np.broadcast_to(np.arange(len(cells), dtype=np.int32), nodes.shape)
        places = looks.ravel(), nodes.ravel()
        return coo_array((shares.ravel(), places), shape=(len(cells), self.size))

    def smoothed(self, counts: FloatArray, direction_width: float) -> FloatArray:
        """Counts convolved with the kernel, (nodes,)."""
        around = np.arange(self.n_directions)
        width = direction_width * self.n_directions / (2.0 * np.pi)
        columns = _kernel(self.n_directions, width)[np.minimum(around, self.n_directions - around)][
            np.abs(np.subtract.outer(around, around))
        ]
        along = np.arange(self.n_ranges)
        rows = _kernel(self.n_ranges, _NODES_PER_WIDTH)[np.abs(np.subtract.outer(along, along))]
        mixed = counts.reshape(-1, self.n_directions) @ columns
        mixed = mixed.reshape(self.cells, self.n_ranges, self.n_directions)
        return np.asarray(np.matmul(rows, mixed).ravel())


@lru_cache(maxsize=32)
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
