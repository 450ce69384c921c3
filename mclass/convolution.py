"""S @ D where cells have many measurements each: few numbers a measurement, then a convolution.

Two properties of a table make its product with S cheap:

* Over range it is of low rank: every range node's row is a mixture of J shared ones, J about a
  dozen. A measurement at range r adds the J shares u(r), not a row.
* Over direction its rows are one curve, shifted. So it is enough to add up the shares by the
  direction of the sensor, and to convolve the sums with the J curves around the circle, by FFT,
  once for all measurements of a cell.

    sums[cell, direction, j] = sum_m spline(direction - direction_m) u_j(range_m)
    evidence[cell, k, bin] = sum_j (sums[cell, :, j] correlated with curve[:, j, k])[bin]

It is the same sum of the same spline in another order. All of it is in float64: an FFT mixes
orientations that are out of the question with those in question, and float32 would let the
rounding of the former show in the latter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numpy.fft import irfft, rfft
from scipy.sparse import csc_array, csr_array

from mclass.records import FloatArray, IntArray
from mclass.table import REACH, TOLERANCE, LikelihoodTable, error_growth, quintic_weights

_READING_ERROR = 1e-5
"""Error allowed, of either sign, for reading shares linearly between tabulated ranges."""

_TAPS = 2 * REACH
_FROM_POWERS = (
    np.array(
        [
            [1.0, 26.0, 66.0, 26.0, 1.0, 0.0],
            [-5.0, -50.0, 0.0, 50.0, 5.0, 0.0],
            [10.0, 20.0, -60.0, 20.0, 10.0, 0.0],
            [-10.0, 20.0, 0.0, -20.0, 10.0, 0.0],
            [5.0, -20.0, 30.0, -20.0, 5.0, 0.0],
            [-1.0, 5.0, -10.0, 10.0, -5.0, 1.0],
        ]
    )
    / 120.0
)
"""Powers of the place between two nodes to the weights of the six nodes around it."""


@dataclass(frozen=True)
class ConvolutionTable:
    """A `LikelihoodTable` taken apart.

    Attributes:
        bins: Orientation bins.
        n_directions: Direction nodes around the circle, a multiple of the bins.
        fine_step: Distance between the ranges at which shares are tabulated [m].
        shares: u at multiples of that, from 0 on, (ranges, J).
        curves: Conjugate spectra of the J curves for each class, (frequencies, J, k).
    """

    bins: int
    n_directions: int
    fine_step: float
    shares: FloatArray
    curves: FloatArray

    @property
    def size(self) -> int:
        """Numbers to be transformed for a row."""
        _, rank, k = self.curves.shape
        return self.n_directions * int(rank + k)

    def sums(
        self, starts: IntArray, ranges: FloatArray, directions: FloatArray, scale: FloatArray | None
    ) -> FloatArray:
        """Evidence of every row, (rows, k, bins).

        Args:
            starts: Row ``i`` owns entries ``starts[i]:starts[i + 1]`` of the others, (rows + 1,).
            ranges: Distances of sensor and cell [m], (p,).
            directions: World directions of the sensor seen from the cell [rad], (p,).
            scale: Weight of each measurement, (p,), or None for one each.
        """
        sums = self._deposit(starts, ranges, directions, scale)
        spectra = rfft(sums, n=self.n_directions, axis=1)
        product = np.matmul(spectra.transpose(1, 0, 2), self.curves)
        around = irfft(product, n=self.n_directions, axis=0)
        return np.asarray(around[:: self.n_directions // self.bins].transpose(1, 2, 0))

    def _deposit(
        self, starts: IntArray, ranges: FloatArray, directions: FloatArray, scale: FloatArray | None
    ) -> FloatArray:
        """Shares summed by direction, from REACH - 1 nodes before -pi on, (rows, nodes, J)."""
        rows, count = len(starts) - 1, len(ranges)
        place = directions * (self.n_directions / (2.0 * np.pi))
        node = np.floor(place)
        powers = np.empty((_TAPS, count))
        powers[0] = 1.0 if scale is None else scale
        place -= node
        for power in range(1, _TAPS):
            np.multiply(powers[power - 1], place, out=powers[power])
        width = self.n_directions + _TAPS
        first = node.astype(np.int32)
        first += np.repeat(
            np.arange(rows, dtype=np.int32) * width + (self.n_directions + 1) // 2, np.diff(starts)
        )
        deposit = csc_array(
            (
                np.matmul(powers.T, _FROM_POWERS, order="C").ravel(),
                _following(first, _TAPS),
                np.arange(0, _TAPS * count + 1, _TAPS, dtype=np.int32),
            ),
            shape=(rows * width, count),
        )
        sums = (deposit @ self._shares_at(ranges)).reshape(rows, width, -1)
        # What lies beyond half a turn continues at its other end.
        sums[:, :_TAPS] += sums[:, self.n_directions :]
        return np.asarray(sums)

    def _shares_at(self, ranges: FloatArray) -> FloatArray:
        """The J shares at each range, (p, J)."""
        place = ranges / self.fine_step
        below = place.astype(np.int32)
        weights = np.empty((len(ranges), 2))
        np.subtract(place, below, out=weights[:, 1])
        np.subtract(1.0, weights[:, 1], out=weights[:, 0])
        read = csr_array(
            (
                weights.ravel(),
                _following(below, 2),
                np.arange(0, 2 * len(ranges) + 1, 2, dtype=np.int32),
            ),
            shape=(len(ranges), len(self.shares)),
        )
        return np.asarray(read @ self.shares)


def _following(first: npt.NDArray[np.int32], count: int) -> npt.NDArray[np.int32]:
    """Each number and those after it, ``count`` in all, one behind the other."""
    numbers = np.empty((len(first), count), dtype=np.int32)
    for step in range(count):
        np.add(first, step, out=numbers[:, step])
    return numbers.ravel()


def take_apart(table: LikelihoodTable) -> ConvolutionTable:
    """Find the shares and curves of a table; what they leave out is about its tolerance."""
    coefficients = table.coefficients
    n_ranges, n_directions, k = coefficients.shape
    flat = coefficients.reshape(n_ranges, -1)
    tall, values, wide = np.linalg.svd(flat.T, full_matrices=False)
    rank = _rank(flat, tall * values, wide)
    curves = (tall[:, :rank] * values[:rank]).reshape(n_directions, k, rank)
    spectra = np.conj(rfft(curves, axis=0)).transpose(0, 2, 1)
    # Sums begin this many nodes before direction 0.
    lead = (n_directions + 1) // 2 + REACH - 1
    turn = np.exp(2j * np.pi * lead / n_directions * np.arange(len(spectra)))
    # Between two readings a curve of bend b strays from the straight line by b / 8.
    bend = np.abs(np.diff(flat, 2, axis=0)) / error_growth(flat[None])[0, 1:-1]
    finer = max(1, int(np.ceil(np.sqrt(bend.max() / (8.0 * _READING_ERROR)))))
    fine = np.arange(-1, (n_ranges - 2 * REACH) * finer + 3) / finer + REACH
    below, weights = quintic_weights(fine)
    nodes = below + np.arange(1 - REACH, 1 + REACH)[:, None]
    exact = np.einsum("tp,jtp->pj", weights, wide[:rank][:, np.minimum(nodes, n_ranges - 1)])
    # Straight lines through these stray to both sides alike, so the errors of many cancel.
    shares = exact[1:-1] - np.diff(exact, 2, axis=0) / 12.0
    return ConvolutionTable(
        bins=table.bins,
        n_directions=n_directions,
        fine_step=table.range_step / finer,
        shares=shares,
        curves=np.ascontiguousarray(spectra * turn[:, None, None]),
    )


def _rank(flat: FloatArray, tall: FloatArray, wide: FloatArray) -> int:
    """How many components reproduce every row to twice the tolerance of the table."""
    allowed = 2.0 * TOLERANCE * error_growth(flat[None])[0]
    rest = flat - tall[:, :1].T * wide[:1].T
    for rank in range(1, len(wide)):
        if np.all(np.abs(rest) <= allowed):
            return rank
        rest -= tall[:, rank : rank + 1].T * wide[rank : rank + 1].T
    return len(wide)
