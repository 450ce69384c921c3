"""A joint belief in a few numbers: class, place, orientation modes (paper eqs. 22 and 24)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mclass.geometry import wrap_angle
from mclass.logarithms import logsumexp
from mclass.orientation import find_modes, parabola_vertex, refine, resolution_factors
from mclass.records import FloatArray
from mclass.results import ObjectEstimate, OrientationMode

NEGLIGIBLE = 25.0
"""Cells whose log belief is this far below the best are left out of summaries."""

_PEAK_GAIN = 0.3
"""More than a log belief can rise between a peak's bin and the peak, unless it is hopeless."""

_TIE = 1e-6
_FINE_BINS = 576
"""Orientations at which modes are sought, at least."""


@dataclass(frozen=True)
class Readout:
    """Joint log belief of some cells after one measurement, up to one constant.

    Attributes:
        log_likelihood: Of the measurements given class and orientation, (a, n, bins).
        log_outer: Log of what multiplies it: priors and footprint factors, (a, n).
        log_joint: Orientation integrated out, background first, (a, 1 + n).
        centers: Of the cells [m], (a, 2).
    """

    log_likelihood: FloatArray
    log_outer: FloatArray
    log_joint: FloatArray
    centers: FloatArray


def summarise(
    readout: Readout,
    *,
    object_id: str,
    stamp_ns: int,
    log_time_ns: int,
    labels: tuple[str, ...],
    measurements: int,
    cell_size: float,
    known: bool,
) -> ObjectEstimate:
    """An object's class, place and orientation modes from its joint belief (eqs. 22 and 24)."""
    log_total = logsumexp(readout.log_joint)
    probabilities = np.exp(logsumexp(readout.log_joint, axis=0) - log_total)
    probabilities /= probabilities.sum()
    # Among themselves: beside a certain background all classes would seem equal.
    log_classes = logsumexp(readout.log_joint[:, 1:], axis=0)
    peak = log_classes.max()
    classes = np.exp(log_classes - peak) if np.isfinite(peak) else np.ones(len(log_classes))
    classes /= classes.sum()
    best = int(np.argmax(classes))
    tied = np.flatnonzero(classes >= classes[best] - _TIE)
    poses = np.empty((len(classes), 3))
    modes: tuple[OrientationMode, ...] = ()
    spread = np.zeros(2)
    for index in range(len(classes)):
        place, deviation = _place(readout, index, cell_size, known=known)
        density = _orientation_marginal(readout, index)
        found = find_modes(density)
        poses[index] = [*place, _highest(density, found)]
        if index == best:
            modes, spread = found, deviation
    return ObjectEstimate(
        object_id=object_id,
        stamp_ns=stamp_ns,
        log_time_ns=log_time_ns,
        labels=labels,
        measurements=measurements,
        class_probabilities=probabilities,
        class_index=best,
        tie=tuple(int(i) for i in tied) if len(tied) > 1 else (),
        position=poses[best, :2].copy(),
        position_std=spread,
        class_poses=poses,
        modes=modes,
        joint_map=_joint_map(readout),
    )


def orientation_densities(readout: Readout, bins: int) -> FloatArray:
    """p(orientation | class) with the position summed out [1/rad], bin b at 2 pi b / bins.

    Returns:
        (n, bins); flat for a class of no probability. Peaks narrower than a bin may fall
        between the bins.
    """
    densities = np.empty((readout.log_likelihood.shape[1], bins))
    for index, row in enumerate(densities):
        fine = _orientation_marginal(readout, index)
        fine = fine / (fine.mean() * 2.0 * np.pi)
        row[:] = np.interp(np.arange(bins) / bins, np.arange(len(fine)) / len(fine), fine, period=1)
    return densities


def _place(
    readout: Readout, index: int, cell_size: float, *, known: bool
) -> tuple[FloatArray, FloatArray]:
    """Mode of the position given a class, finer than a cell, and its standard deviation [m]."""
    if known:
        return readout.centers[0], np.zeros(2)
    log_mass = readout.log_joint[:, 1 + index]
    peak = int(np.argmax(log_mass))
    if not np.isfinite(log_mass[peak]):
        return readout.centers.mean(axis=0), readout.centers.std(axis=0)
    # Averaged readouts hold a cell once for every trajectory.
    centers, cell = np.unique(readout.centers, axis=0, return_inverse=True)
    weights = np.bincount(cell, weights=np.exp(log_mass - log_mass[peak]))
    peak = int(np.argmax(weights))
    offset = centers - centers[peak]
    near = np.where(np.abs(offset).max(axis=1) <= 2.5 * cell_size, weights, 0.0)
    mean = weights @ offset / weights.sum()
    variance = weights @ (offset - mean) ** 2 / weights.sum() + cell_size**2 / 12.0
    return centers[peak] + near @ offset / near.sum(), np.sqrt(variance)


def _orientation_marginal(readout: Readout, index: int) -> FloatArray:
    """Orientation density given a class, position summed out, any scale, (fine bins,)."""
    log_mass = readout.log_joint[:, 1 + index]
    peak = log_mass.max()
    bins = readout.log_likelihood.shape[-1]
    if not np.isfinite(peak):
        return np.ones(bins)
    kept = np.flatnonzero(log_mass > peak - NEGLIGIBLE)
    values = readout.log_likelihood[kept, index] + readout.log_outer[kept, index, None]
    factor = int(resolution_factors(values).max())
    fine = refine(values, factor)
    highest = fine.max(axis=0)
    marginal = np.log(np.exp(fine - highest).sum(axis=0)) + highest - fine.max()
    further = max(1, 2 ** int(np.ceil(np.log2(_FINE_BINS / (bins * factor)))))
    return np.asarray(np.exp(refine(marginal, further)))


def _highest(density: FloatArray, modes: tuple[OrientationMode, ...]) -> float:
    """Orientation [rad] of the mode with the greatest density."""
    # Equal peaks differ by rounding: the smaller angle is taken.
    first = int(np.argmax(density >= density.max() * (1.0 - 1e-9)))
    peak = 2.0 * np.pi * first / len(density)
    angles = np.array([mode.orientation for mode in modes])
    return float(angles[np.argmin(np.abs(wrap_angle(angles - peak)))])


def _joint_map(readout: Readout) -> tuple[int, float, float, float]:
    """Paper eq. (24) to the letter: class index, x, y [m], orientation [rad]."""
    peaks = readout.log_likelihood.max(axis=-1) + readout.log_outer
    best = peaks.max()
    if not np.isfinite(best):
        return 0, float(readout.centers[0, 0]), float(readout.centers[0, 1]), 0.0
    cells, classes = np.nonzero(peaks > best - _PEAK_GAIN)
    factor = max(1, _FINE_BINS // readout.log_likelihood.shape[-1])
    fine = refine(readout.log_likelihood[cells, classes], factor)
    fine += readout.log_outer[cells, classes, None]
    winner, angle = np.unravel_index(int(np.argmax(fine)), fine.shape)
    curve = fine[winner]
    vertex = parabola_vertex(*curve[np.arange(angle - 1, angle + 2) % len(curve)])
    x, y = readout.centers[cells[winner]]
    orientation = 2.0 * np.pi * ((float(angle) + vertex) / len(curve) % 1.0)
    return int(classes[winner]), float(x), float(y), orientation
