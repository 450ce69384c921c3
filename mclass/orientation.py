"""Densities over orientation: finer than their bins, and their modes.

A log belief is smooth over the circle even where the belief itself is narrower than a bin, so
it is interpolated first (quintic spline through the bins, exact to the fourth derivative)
and exponentiated after.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from mclass.records import BoolArray, FloatArray, IntArray
from mclass.results import OrientationMode
from mclass.splines import spline_coefficients

_MAX_FACTOR = 64
_VALUES_AT_ONCE = 2**16
"""Refined values that the processor's cache holds."""

_MIN_MASS = 1e-3
"""Modes lighter than this are joined to their neighbour."""

_MIN_PROMINENCE = 1.01
"""A peak must rise this much above the saddle beside it to be a mode of its own."""


@lru_cache(maxsize=16)
def _refinement(bins: int, factor: int) -> FloatArray:
    """Matrix that takes values at the bins to values at ``bins * factor`` angles."""
    impulse = np.zeros(bins)
    impulse[0] = 1.0
    coefficients = spline_coefficients(impulse, axis=0)
    # The response to an impulse at bin 0: the basis at every fine angle, weighed and summed.
    distance = np.arange(bins * factor) / factor
    basis = _quintic_basis(np.minimum(distance, bins - distance))
    spread = np.zeros(bins * factor)
    spread[::factor] = coefficients
    response = np.fft.irfft(np.fft.rfft(basis) * np.fft.rfft(spread), n=bins * factor)
    # Column b is the same curve, b bins later.
    shifts = np.remainder(
        np.arange(bins * factor)[None, :] - factor * np.arange(bins)[:, None], bins * factor
    )
    matrix: FloatArray = response[shifts]
    matrix.flags.writeable = False
    return matrix


def _quintic_basis(distance: FloatArray) -> FloatArray:
    """Cardinal quintic B-spline at a non-negative distance."""
    total = np.zeros_like(distance)
    for knot, sign in ((3.0, 1.0), (2.0, -6.0), (1.0, 15.0)):
        rest = np.maximum(knot - distance, 0.0)
        square = rest * rest
        total += sign * square * square * rest
    return total / 120.0


def refine(log_values: FloatArray, factor: int) -> FloatArray:
    """Log values at ``factor`` times as many angles, (..., bins) to (..., bins * factor)."""
    if factor == 1:
        return log_values
    return np.asarray(log_values @ _refinement(log_values.shape[-1], factor))


def peaks(log_values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Greatest value at the bins and how sharply the curve bends down there, (...) each.

    The bend is how far the bins on both sides lie below, together.
    """
    bins = log_values.shape[-1]
    # To look where it is and take it is faster than `max` along a short axis.
    place = log_values.argmax(axis=-1)
    first = bins * np.arange(place.size).reshape(place.shape)
    flat = log_values.reshape(-1)
    left, middle, right = (flat[first + (place + step) % bins] for step in (-1, 0, 1))
    with np.errstate(invalid="ignore"):
        return middle, 2.0 * middle - left - right


def resolution_factors(log_values: FloatArray) -> IntArray:
    """How much finer than its bins each density must be sampled, a power of two, (...).

    The spacing is brought below the standard deviation that the curvature at the peak implies:
    then a plain sum is the integral to nine digits.
    """
    _, bend = peaks(log_values)
    needed = np.ceil(np.log2(np.maximum(1.3 * np.sqrt(np.maximum(bend, 0.0)), 1.0)))
    return np.asarray(np.minimum(2 ** needed.astype(np.int64), _MAX_FACTOR))


def log_mean_exp(log_values: FloatArray, rough: BoolArray | None = None) -> FloatArray:
    """Log of the mean over the circle of exp(log_values), (..., bins) to (...).

    Rows that are minus infinity throughout stay so.

    Args:
        log_values: (..., bins).
        rough: Rows so unlikely that the mean over their bins is good enough, (...).
    """
    flat = log_values.reshape(-1, log_values.shape[-1])
    result = np.full(len(flat), -np.inf)
    finite = np.isfinite(flat[:, 0])
    factors = np.where(finite, 1, 0)
    exact = np.flatnonzero(finite if rough is None else finite & ~rough.ravel())
    factors[exact] = resolution_factors(flat if len(exact) == len(flat) else flat[exact])
    for factor in np.flatnonzero(np.bincount(factors)):
        if factor == 0:
            continue
        rows = np.flatnonzero(factors == factor)
        step = max(1, _VALUES_AT_ONCE // (flat.shape[-1] * int(factor)))
        for start in range(0, len(rows), step):
            chunk = rows[start : start + step]
            result[chunk] = _log_mean_exp_of(refine(flat[chunk], int(factor)))
    return result.reshape(log_values.shape[:-1])


def _log_mean_exp_of(log_values: FloatArray) -> FloatArray:
    """Log of the mean of finite values along the last axis; the values are destroyed."""
    peak, _ = peaks(log_values)
    log_values -= peak[..., None]
    np.exp(log_values, out=log_values)
    return np.asarray(np.log(log_values.mean(axis=-1)) + peak)


def find_modes(density: FloatArray) -> tuple[OrientationMode, ...]:
    """Every mode of a density over the circle, heaviest first (paper eq. 24's grid search).

    The circle is cut at the minima between the peaks. Peaks that carry almost nothing or
    hardly rise are joined to the neighbour across the higher saddle, so masses sum to 1.

    Args:
        density: Non-negative values at equally spaced angles from 0, any scale, (m,).

    Returns:
        Angle [rad, 0..2 pi), found between the samples by a parabola through the logarithm;
        mass; standard deviation [rad] of the part between the saddles.
    """
    count = len(density)
    total = density.sum()
    peaks, saddles = _peaks_and_saddles(density)
    masses = _masses_between(density, saddles)
    while len(peaks) > 1:
        before, after = density[saddles], density[np.roll(saddles, -1)]
        higher = np.maximum(before, after)
        weak = (masses < _MIN_MASS * total) | (density[peaks] < _MIN_PROMINENCE * higher)
        if not weak.any():
            break
        least = int(np.flatnonzero(weak)[np.argmin(density[peaks][weak])])
        gone = least if before[least] >= after[least] else (least + 1) % len(peaks)
        neighbour = (gone - 1) % len(peaks)
        if density[peaks[gone]] > density[peaks[neighbour]]:
            peaks[neighbour] = peaks[gone]
        peaks = np.delete(peaks, gone)
        saddles = np.delete(saddles, gone)
        masses = _masses_between(density, saddles)
    modes = []
    for i, peak in enumerate(peaks):
        start = saddles[i]
        length = (saddles[(i + 1) % len(peaks)] - start - 1) % count + 1
        part = density[(start + np.arange(length)) % count]
        offset = start + np.arange(length) - (start + (peak - start) % count)
        mean = (part @ offset) / part.sum()
        variance = (part @ (offset - mean) ** 2) / part.sum()
        step = 2.0 * np.pi / count
        with np.errstate(divide="ignore", invalid="ignore"):
            around = np.log(density[np.arange(peak - 1, peak + 2) % count])
            angle = (peak + parabola_vertex(*around)) * step
        modes.append(
            OrientationMode(
                orientation=float(angle % (2.0 * np.pi)),
                mass=float(masses[i] / total),
                std=float(np.sqrt(variance) * step),
            )
        )
    # Equal masses differ by rounding: the smaller angle goes first.
    return tuple(sorted(modes, key=lambda mode: (-round(mode.mass, 9), mode.orientation)))


def _peaks_and_saddles(density: FloatArray) -> tuple[IntArray, IntArray]:
    """Indices of the peaks and, for each, of the lowest point between it and the one before."""
    rising = density > np.roll(density, 1)
    # A plateau's first sample stands for it; a flat circle has one peak at its maximum.
    peaks = np.flatnonzero(rising & (density >= np.roll(density, -1)))
    if len(peaks) == 0:
        peaks = np.array([int(np.argmax(density))])
    saddles = []
    for before, peak in zip(np.roll(peaks, 1), peaks, strict=True):
        span = (peak - before - 1) % len(density) + 1
        between = (before + np.arange(span)) % len(density)
        # On a flat valley floor the middle stands for all of it.
        low = np.flatnonzero(density[between] <= density[between].min() * (1.0 + 1e-6))
        saddles.append(between[low[len(low) // 2]])
    return peaks, np.array(saddles)


def _masses_between(density: FloatArray, saddles: IntArray) -> FloatArray:
    """Sum of the density from each saddle to the next around the circle, (k,)."""
    if len(saddles) == 1:
        return np.array([density.sum()])
    sums = np.concatenate([[0.0], np.cumsum(density)])
    following = np.roll(saddles, -1)
    direct = sums[following] - sums[saddles]
    return np.asarray(np.where(following > saddles, direct, sums[-1] + direct))


def parabola_vertex(left: float, middle: float, right: float) -> float:
    """Offset in samples, within half of one, of the vertex of a parabola through three values."""
    bend = left - 2.0 * middle + right
    if not bend < -1e-12:
        return 0.0
    return float(np.clip(0.5 * (left - right) / bend, -0.5, 0.5))
