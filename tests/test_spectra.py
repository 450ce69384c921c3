"""Evidence from spectra: the same spline as the table's, whatever bins it is seen at."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from models import toy_model
from numpy.fft import irfft

from mclass.observation import paper_terms
from mclass.records import FloatArray
from mclass.spectra import SpectralTable, spectral_table
from mclass.table import REACH, TOLERANCE, LikelihoodTable, build_table, quintic_weights

BINS = 24


def spline(table: LikelihoodTable, look_range: float, direction: float) -> FloatArray:
    """The table's spline at one range, and every bin as seen from a direction, (k, bins)."""
    taps = np.arange(1 - REACH, 1 + REACH)
    row, row_weights = quintic_weights(np.array([look_range / table.range_step + REACH]))
    aspects = direction - 2.0 * np.pi * np.arange(table.bins) / table.bins
    column, column_weights = quintic_weights(aspects * table.n_directions / (2.0 * np.pi))
    nodes = (column[:, None] + taps) % table.n_directions
    around = table.coefficients[row[0] + taps][:, nodes]
    return np.asarray(np.einsum("r,rbtk,tb->kb", row_weights[:, 0], around, column_weights))


def at_bins(table: SpectralTable, *columns: FloatArray) -> FloatArray:
    """Evidence of rows, (rows, k, bins)."""
    starts, ranges, directions, scale = columns
    spectra = table.spectra_of(starts.astype(np.int64), ranges, directions, scale)
    return np.asarray(irfft(spectra, n=table.bins))


# So few bins that high frequencies fold several times, even and odd numbers, and plenty.
@pytest.mark.parametrize("bins", [1, 4, 5, BINS, 144])
def test_sums_of_splines(bins: int) -> None:
    table = build_table(paper_terms(toy_model(unit=1.0))[0], bins, 1.0, 20.0)
    rng = np.random.default_rng(3)
    ranges, directions = rng.uniform(1.0, 20.0, 7), rng.uniform(-np.pi, np.pi, 7)
    scale = rng.uniform(0.1, 1.0, 7)
    starts = np.array([0, 0, 3, 4, 4, 7])
    found = at_bins(spectral_table(table), starts, ranges, directions, scale)
    each = [w * spline(table, r, d) for r, d, w in zip(ranges, directions, scale, strict=True)]
    expected = np.array(
        [np.sum([np.zeros_like(each[0]), *each[a:b]], axis=0) for a, b in pairwise(starts)]
    )
    np.testing.assert_allclose(found, expected, rtol=0, atol=3 * TOLERANCE)
    np.testing.assert_array_equal(found[[0, 3]], 0.0)
    assert np.ptp(expected[1]) > 1.0 or bins == 1
