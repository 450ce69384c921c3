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
from functools import reduce

import numpy as np
import numpy.typing as npt
from numpy.fft import irfft, rfft
from scipy.sparse import csc_array, csr_array

from mclass.blockwise import blocks
from mclass.records import FloatArray, IntArray
from mclass.table import REACH, LikelihoodTable, error_growth, quintic_weights

_LEFT_OUT = 8e-6
"""Error allowed, of either sign, for leaving out what adds least to a table."""

_READING_ERROR = 1e-5
"""Error allowed, of either sign, for reading shares linearly between tabulated ranges."""

ComplexArray = npt.NDArray[np.complex128]

_AT_ONCE = 2**16
"""Measurements that are read and deposited together: fewer take longer, more hold more memory."""

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
        phases: Direction nodes a bin.
        fine_step: Distance between the ranges at which shares are tabulated [m].
        shares: u at multiples of that, from 0 on, (ranges, J).
        curves: Conjugate spectra of the J curves for each class, one for the nodes of each
            phase: matrices (frequencies, 2 phases * J, 2 k) of real numbers, which take the
            real and imaginary parts of sums to those of evidence.
    """

    bins: int
    phases: int
    fine_step: float
    shares: FloatArray
    curves: FloatArray

    @property
    def size(self) -> int:
        """Numbers to be transformed for a row."""
        return self.bins * sum(self.curves.shape[1:]) // 2

    def spectra(
        self, starts: IntArray, ranges: FloatArray, directions: FloatArray, scale: FloatArray | None
    ) -> ComplexArray:
        """Spectra over orientation of every row's evidence, (frequencies, rows, k).

        Args:
            starts: Row ``i`` owns entries ``starts[i]:starts[i + 1]`` of the others, (rows + 1,).
            ranges: Distances of sensor and cell [m], (p,).
            directions: World directions of the sensor seen from the cell [rad], (p,).
            scale: Weight of each measurement, (p,), or None for one each.
        """
        counts = np.diff(starts)
        filled = np.flatnonzero(counts)
        if len(filled) < len(counts):
            whole = np.zeros((len(self.curves), len(counts), self.curves.shape[2] // 2), complex)
            if len(filled):
                own = np.append(starts[filled], starts[-1])
                whole[:, filled] = self.spectra(own, ranges, directions, scale)
            return whole
        rows = len(counts)
        n_directions = self.bins * self.phases
        width = n_directions + _TAPS
        place = directions * (n_directions / (2.0 * np.pi))
        node = np.floor(place)
        place -= node
        first = node.astype(np.int32)
        first += np.repeat(
            np.arange(rows, dtype=np.int32) * width + (n_directions + 1) // 2, counts
        )
        sums = reduce(
            np.add,
            (
                _deposit(first[part], place[part], rows * width)
                @ self._shares_at(ranges[part], None if scale is None else scale[part])
                for part in blocks(len(ranges), _AT_ONCE)
            ),
        ).reshape(rows, width, -1)
        # What lies beyond half a turn continues at its other end.
        sums[:, :_TAPS] += sums[:, n_directions:]
        by_bin = sums[:, :n_directions].reshape(rows, self.bins, -1)
        spectra = rfft(by_bin, axis=1).view(float)
        return np.asarray(np.matmul(spectra.transpose(1, 0, 2), self.curves).view(complex))

    def _shares_at(self, ranges: FloatArray, scale: FloatArray | None) -> FloatArray:
        """The J shares at each range, (p, J)."""
        place = ranges / self.fine_step
        below = place.astype(np.int32)
        weights = np.empty((len(ranges), 2))
        np.subtract(place, below, out=weights[:, 1])
        np.subtract(1.0, weights[:, 1], out=weights[:, 0])
        if scale is not None:
            weights *= scale[:, None]
        read = csr_array(
            (
                weights.ravel(),
                _following(below, 2),
                np.arange(0, 2 * len(ranges) + 1, 2, dtype=np.int32),
            ),
            shape=(len(ranges), len(self.shares)),
        )
        return np.asarray(read @ self.shares)


def at_bins(spectra: ComplexArray, bins: int) -> FloatArray:
    """Evidence at the orientation bins, (frequencies, rows, n) to (rows, n, bins)."""
    return np.asarray(irfft(spectra, n=bins, axis=0).transpose(1, 2, 0))


def _deposit(first: npt.NDArray[np.int32], place: FloatArray, count: int) -> csc_array:
    """How much of each measurement lies at which node, (count, p).

    Args:
        first: The first of six nodes around each measurement, (p,).
        place: Where it lies between the third and the fourth, 0 to 1, (p,).
        count: Nodes in all.
    """
    powers = np.empty((_TAPS, len(first)))
    powers[0] = 1.0
    for power in range(1, _TAPS):
        np.multiply(powers[power - 1], place, out=powers[power])
    return csc_array(
        (
            np.matmul(powers.T, _FROM_POWERS, order="C").ravel(),
            _following(first, _TAPS),
            np.arange(0, _TAPS * len(first) + 1, _TAPS, dtype=np.int32),
        ),
        shape=(count, len(first)),
    )


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
    # Where larger errors are allowed, components need not fit as closely.
    growth = error_growth(flat[None])[0]
    by_range = np.exp(np.log(growth).mean(axis=1))
    by_view = np.exp(np.log(growth / by_range[:, None]).mean(axis=0))
    tall, values, wide = np.linalg.svd((flat / by_range[:, None] / by_view).T, full_matrices=False)
    tall *= by_view[:, None]
    wide *= by_range
    rank = _rank(flat, tall * values, wide, _LEFT_OUT * growth)
    curves = (tall[:, :rank] * values[:rank]).reshape(n_directions, k, rank)
    # Sums begin this many nodes before direction 0.
    curves = np.roll(curves, (n_directions + 1) // 2 + REACH - 1, axis=0)
    spectra = np.conj(rfft(curves.reshape(table.bins, -1, k, rank), axis=0))
    # Between two readings a curve of bend b strays from the straight line by b / 8.
    bend = np.abs(np.diff(flat, 2, axis=0)) / growth[1:-1]
    finer = max(1, int(np.ceil(np.sqrt(bend.max() / (8.0 * _READING_ERROR)))))
    fine = np.arange(-1, (n_ranges - 2 * REACH) * finer + 3) / finer + REACH
    below, weights = quintic_weights(fine)
    nodes = below + np.arange(1 - REACH, 1 + REACH)[:, None]
    exact = np.einsum("tp,jtp->pj", weights, wide[:rank][:, np.minimum(nodes, n_ranges - 1)])
    # Straight lines through these stray to both sides alike, so the errors of many cancel.
    shares = exact[1:-1] - np.diff(exact, 2, axis=0) / 12.0
    return ConvolutionTable(
        bins=table.bins,
        phases=n_directions // table.bins,
        fine_step=table.range_step / finer,
        shares=shares,
        curves=_real_matrices(spectra.swapaxes(2, 3).reshape(len(spectra), -1, k)),
    )


def _real_matrices(matrices: ComplexArray) -> FloatArray:
    """Matrices that do to pairs of real numbers what others do to complex ones.

    BLAS multiplies small real matrices twice as fast.
    """
    count, rows, columns = matrices.shape
    real = np.empty((count, rows, 2, columns, 2))
    real[:, :, 0, :, 0] = real[:, :, 1, :, 1] = matrices.real
    real[:, :, 0, :, 1] = matrices.imag
    real[:, :, 1, :, 0] = -matrices.imag
    return real.reshape(count, 2 * rows, 2 * columns)


def _rank(flat: FloatArray, tall: FloatArray, wide: FloatArray, allowed: FloatArray) -> int:
    """How many components reproduce every row well enough."""
    rest = flat - tall[:, :1].T * wide[:1].T
    for rank in range(1, len(wide)):
        if np.all(np.abs(rest) <= allowed):
            return rank
        rest -= tall[:, rank : rank + 1].T * wide[rank : rank + 1].T
    return len(wide)
