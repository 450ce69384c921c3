"""S @ D where cells have few measurements each: a spectrum for each, turned as the sensor stands.

Over direction the rows of a table are one curve, shifted. So a measurement's curve is read at
its range, as a spectrum around the circle, where a shift is but a change of phase; the spectra
of a cell's measurements are added up, and transformed back once. It is the same spline, but for
frequencies so high that leaving them out shows less than the table's tolerance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numpy.fft import rfft
from scipy.sparse import csr_array

from mclass.records import FloatArray, IntArray
from mclass.table import REACH, TOLERANCE, LikelihoodTable, quintic_weights

ComplexArray = npt.NDArray[np.complex128]

_TAPS = np.arange(1 - REACH, 1 + REACH)


@dataclass(frozen=True)
class SpectralTable:
    """A `LikelihoodTable` as spectra.

    Attributes:
        bins: Orientation bins.
        n_directions: Direction nodes around the circle.
        range_step: Distance between range nodes [m]; the first is ``REACH`` before range 0.
        spectra: Of the curve at each range node, (range nodes, k, frequencies).
        taps: Waves at the nodes around a direction, (6, frequencies).
        near: Waves at nodes 0, 1, 2, ..., (m, frequencies).
        far: Waves at nodes 0, m, 2 m, ..., as far as the circle goes, (..., frequencies).
    """

    bins: int
    n_directions: int
    range_step: float
    spectra: ComplexArray
    taps: ComplexArray
    near: ComplexArray
    far: ComplexArray

    @property
    def size(self) -> int:
        """Numbers that a measurement adds to a row."""
        return int(np.prod(self.spectra.shape[1:]))

    def spectra_of(
        self, starts: IntArray, ranges: FloatArray, directions: FloatArray, scale: FloatArray | None
    ) -> ComplexArray:
        """Spectra over orientation of every row's evidence, (rows, k, lowest frequencies).

        Arguments as of `ConvolutionTable.spectra`.
        """
        shape = (-1, *self.spectra.shape[1:])
        spectra = np.asarray(self._at(ranges, scale) @ _real(self.spectra))
        spectra = spectra.view(complex).reshape(shape)
        spectra *= self._waves(directions)[:, None, :]
        own = np.arange(len(ranges), dtype=np.int32), starts
        belongs = csr_array((np.ones(len(ranges)), *own), shape=(len(starts) - 1, len(ranges)))
        return self._folded(np.asarray(belongs @ _real(spectra)).view(complex).reshape(shape))

    def _at(self, ranges: FloatArray, scale: FloatArray | None) -> csr_array:
        """Weights of the range nodes at each range, (p, range nodes)."""
        below, weights = quintic_weights(ranges / self.range_step + REACH)
        if scale is not None:
            weights *= scale
        return csr_array(
            (
                weights.T.ravel(),
                np.add.outer(below, _TAPS.astype(np.int32)).ravel(),
                np.arange(0, len(_TAPS) * len(ranges) + 1, len(_TAPS), dtype=np.int32),
            ),
            shape=(len(ranges), len(self.spectra)),
        )

    def _waves(self, directions: FloatArray) -> ComplexArray:
        """What turns a spectrum to each direction, (p, frequencies)."""
        below, weights = quintic_weights(directions * (self.n_directions / (2.0 * np.pi)))
        waves = (weights.T @ _real(self.taps)).view(complex)
        far, near = np.divmod(np.remainder(below, self.n_directions), len(self.near))
        waves *= self.near.take(near, axis=0)
        waves *= self.far.take(far, axis=0)
        return np.asarray(waves)

    def _folded(self, spectra: ComplexArray) -> ComplexArray:
        """Spectra as they are seen at the bins, where high frequencies look like lower ones."""
        count, seen = spectra.shape[-1], self.bins // 2 + 1
        if count < seen:
            return spectra
        folded = np.zeros((*spectra.shape[:-1], seen), dtype=complex)
        for first in range(0, count, self.bins):
            low = spectra[..., first : first + seen]
            folded[..., : low.shape[-1]] += low
            # And some of them look the other way round.
            top, bottom = min(first + self.bins, count - 1), first + self.bins - seen + 1
            if top >= bottom:
                mirrored = spectra[..., top : bottom - 1 : -1].conj()
                folded[..., first + self.bins - top :] += mirrored
        return folded


def spectral_table(table: LikelihoodTable) -> SpectralTable:
    """The spectra of a table's curves, as far as they matter."""
    n_directions = table.n_directions
    spectra = np.conj(rfft(table.coefficients, axis=1)) / n_directions
    if n_directions % 2 == 0:
        # Every other stands for the frequency's negative, too.
        spectra[:, -1] /= 2.0
    taps = _waves(_TAPS, spectra.shape[1], n_directions)
    # Nowhere is a wave read higher than at a node.
    _, at_node = quintic_weights(np.zeros(1))
    heights = 2.0 * np.abs(spectra) * np.abs(at_node.T @ taps)[:, :, None]
    left_out = np.cumsum(heights[:, ::-1], axis=1)[:, ::-1].max(axis=(0, 2))
    count = max(1, int(np.count_nonzero(left_out > TOLERANCE)))
    near = np.arange(int(np.sqrt(n_directions)))
    far = np.arange(0, n_directions, len(near))
    return SpectralTable(
        bins=table.bins,
        n_directions=n_directions,
        range_step=table.range_step,
        spectra=np.ascontiguousarray(table.bins * spectra[:, :count].transpose(0, 2, 1)),
        taps=_waves(_TAPS, count, n_directions),
        near=_waves(near, count, n_directions),
        far=_waves(far, count, n_directions),
    )


def _waves(nodes: IntArray, count: int, n_directions: int) -> ComplexArray:
    """Waves of so many frequencies, from 0 on, at direction nodes, (nodes, count)."""
    return np.exp(-2j * np.pi / n_directions * np.multiply.outer(nodes, np.arange(count)))


def _real(values: ComplexArray) -> FloatArray:
    """Complex numbers as pairs of real ones, (m, ...) to (m, numbers)."""
    return values.reshape(len(values), -1).view(float)
