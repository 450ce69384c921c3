"""A term's log likelihood, tabulated over the range and world direction of the sensor.

For one cell the sensor stands in one world direction, so over the orientation bins the
likelihood is one row of a table, and evidence from all measurements is a sparse matrix of
interpolation weights times that table:

    log_belief[cells, classes * bins] += S @ D

D has a row for every node of a lattice over range and direction; S has for every measurement
the 36 weights of a biquintic B-spline. The table's coefficients are prefiltered, so the spline
passes through the exact values, and the lattice is refined until it does so between its nodes
as well. The high order keeps the lattice coarse: a cubic of the same accuracy needs ten times
as many nodes.

Rows of neighbouring directions are one curve over the aspect, shifted, so only the curves are
kept, and neither S nor D is ever written out: see `mclass.spectra` and `mclass.convolution`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mclass.observation import Term
from mclass.records import FloatArray
from mclass.splines import half_way_values, spline_coefficients

TOLERANCE = 4e-6
"""Error allowed between the nodes."""

_DEPTH = 8.0
"""So far below the best view; farther down it may grow by e for every two."""

_MOST_GROWTH = 6.0
"""But by no more powers of e: where measurements contradict each other, only tails are left."""

_BIN_TOLERANCE = 2e-4
"""Error allowed between orientation bins, where errors of either sign largely cancel."""

_PROBED = 4
"""Of so many nodes along one axis one is looked at for errors along the other."""

_MOST_BINS = 288
_PADDING = 20
"""Range nodes sampled beyond those used: a prefilter's wrong boundary fades by 0.43 a node."""

REACH = 3
"""Nodes that a spline needs on either side."""

_MAX_BYTES = 2**25


@dataclass(frozen=True)
class LikelihoodTable:
    """D for one term.

    Attributes:
        bins: Orientation bins.
        range_step: Distance between range nodes [m]; the node before the first is at range
            ``-REACH`` steps.
        coefficients: Of the spline over range and the direction of the sensor from an object
            of orientation 0, (range nodes, direction nodes, classes of the term).
    """

    bins: int
    range_step: float
    coefficients: FloatArray

    @property
    def n_directions(self) -> int:
        """Direction nodes around the circle, a multiple of the bins."""
        return int(self.coefficients.shape[1])


def quintic_weights(coordinates: FloatArray) -> tuple[npt.NDArray[np.int32], FloatArray]:
    """Lattice index below each coordinate and the weights of its six B-spline taps, (6, p)."""
    below = np.floor(coordinates)
    t = coordinates - below
    square, cube = t * t, t * t * t
    fourth, fifth = square * square, cube * square
    weights = np.empty((6, len(t)))
    weights[0] = (1.0 - t) ** 5
    weights[1] = 26.0 - 50.0 * t + 20.0 * (square + cube - fourth) + 5.0 * fifth
    weights[2] = 66.0 - 60.0 * square + 30.0 * fourth - 10.0 * fifth
    weights[3] = 26.0 + 50.0 * t + 20.0 * (square - cube - fourth) + 10.0 * fifth
    weights[4] = 1.0 + 5.0 * (t + fourth - fifth) + 10.0 * (square + cube)
    weights[5] = fifth
    weights /= 120.0
    return below.astype(np.int32), weights


def build_table(
    term: Term, bins: int, min_range: float, max_range: float, position_variance: float = 0.0
) -> LikelihoodTable:
    """Tabulate a term for ranges from 0 to ``max_range`` [m] and ``bins`` orientations.

    The lattice starts from the narrowest viewpoint and is refined, range and direction apart,
    until interpolation is as good as the tolerance between the nodes from ``min_range`` on, or
    the table's memory limit is reached. An isotropic variance of the sensor's position [m²]
    widens every viewpoint.
    """
    deviations = [
        np.sqrt(np.linalg.eigvalsh(entry.mixture.covariances).min()) for entry in term.likelihoods
    ]
    range_step = min(float(min(deviations)) / 2.0, max_range / 4.0)
    n_directions = bins * max(1, -(-64 // bins))
    while True:
        n_ranges = int(np.ceil(max_range / range_step)) + 1 + 2 * _PADDING
        ranges: FloatArray = range_step * np.arange(-_PADDING, n_ranges - _PADDING, dtype=float)
        range_error, direction_error = _interpolation_errors(
            term, ranges, _circle(n_directions), min_range, position_variance
        )
        if max(range_error, direction_error) <= 1.0:
            break
        finer_step = range_step / _refinement(range_error)
        finer_count = bins * int(np.ceil(n_directions / bins * _refinement(direction_error)))
        nodes = (max_range / finer_step + 2 * REACH) * finer_count
        if nodes * len(term.classes) * 16 > _MAX_BYTES:
            break
        range_step, n_directions = finer_step, finer_count
    samples = _evaluate(term, ranges, _circle(n_directions), position_variance)
    coefficients = spline_coefficients(spline_coefficients(samples, 1, mirrored=True), 2)
    kept = coefficients[:, _PADDING - REACH : len(ranges) - _PADDING + REACH]
    return LikelihoodTable(bins, range_step, np.ascontiguousarray(kept.transpose(1, 2, 0)))


def resolving_bins(terms: Sequence[Term], bins: int, min_range: float, max_range: float) -> int:
    """Orientation bins that resolve the terms: ``bins`` or a small multiple of it.

    Between its bins a belief is interpolated; where a term has kinks narrower than a bin, many
    measurements would add up their interpolation errors.
    """
    ranges = np.linspace(min_range, max_range, 12)
    most = max(4, -(-_MOST_BINS // bins))
    for factor in range(1, most):
        count = bins * factor
        errors = [_aspect_error(term, ranges, count) for term in terms if len(term.classes)]
        if max(errors, default=0.0) <= _BIN_TOLERANCE:
            return count
    return bins * most


def _aspect_error(term: Term, ranges: FloatArray, count: int) -> float:
    """Greatest error of a spline through ``count`` aspects, half-way between them."""
    aspects = _circle(count)
    samples = _evaluate(term, ranges, aspects)
    between = _evaluate(term, ranges, aspects + aspects[1] / 2.0)
    error = np.abs(half_way_values(samples, 2) - between)
    return float((error / error_growth(samples)).max())


def error_growth(samples: FloatArray) -> FloatArray:
    """How much more an error may be where the likelihood is low, (k, ranges, aspects)."""
    depth = samples.max(axis=(0, 2), keepdims=True) - samples
    return np.asarray(np.exp(np.clip((depth - _DEPTH) / 2.0, 0.0, _MOST_GROWTH)))


def _refinement(error: float) -> float:
    """How much finer an axis must be: the error falls with the sixth power of the spacing."""
    return float(np.clip(1.05 * error ** (1.0 / 6.0), 1.0, 4.0)) if error > 1.0 else 1.0


def _circle(count: int) -> FloatArray:
    """Equally spaced angles from 0 [rad], (count,)."""
    return np.asarray(2.0 * np.pi * np.arange(count) / count)


def _evaluate(
    term: Term, ranges: FloatArray, aspects: FloatArray, position_variance: float = 0.0
) -> FloatArray:
    """The term at every pair of range and aspect, (k, ranges, aspects).

    A negative range is the view from the other side: the function goes on smoothly there.
    """
    directions = np.stack([np.cos(aspects), np.sin(aspects)], axis=-1)
    spread = np.eye(2) * position_variance if position_variance > 0.0 else None
    return term.log_likelihood(ranges[:, None, None] * directions[None, :, :], None, spread)


def _interpolation_errors(
    term: Term,
    ranges: FloatArray,
    aspects: FloatArray,
    min_range: float,
    position_variance: float,
) -> tuple[float, float]:
    """Greatest errors half-way between nodes along range and direction, in tolerances.

    Along each axis at every few nodes of the other: the term varies little from one to the next.
    """
    used = slice(int(np.searchsorted(ranges, min_range)), len(ranges) - _PADDING)
    some_aspects, some_ranges = aspects[::_PROBED], ranges[used][::_PROBED]
    samples = _evaluate(term, ranges, some_aspects, position_variance)
    between = _evaluate(
        term, ranges + (ranges[1] - ranges[0]) / 2.0, some_aspects, position_variance
    )
    error = np.abs(half_way_values(samples, 1, mirrored=True) - between) / error_growth(samples)
    range_error = float(error[:, used].max()) / TOLERANCE
    samples = _evaluate(term, some_ranges, aspects, position_variance)
    between = _evaluate(term, some_ranges, aspects + aspects[1] / 2.0, position_variance)
    error = np.abs(half_way_values(samples, 2) - between) / error_growth(samples)
    return range_error, float(error.max()) / TOLERANCE
