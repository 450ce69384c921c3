"""A joint belief in a few numbers: class, place, orientation modes (paper eqs. 22 and 24)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from mclass.geometry import wrap_angle
from mclass.orientation import find_modes, log_mean_exp, refine, resolution_factors
from mclass.records import FloatArray
from mclass.results import ObjectEstimate, OrientationMode

NEGLIGIBLE = 30.0
"""Cells whose log belief is this far below the best are left out of summaries."""

_TIE = 1e-6
_FINE_BINS = 576
"""Orientations at which modes are sought, at least."""


@dataclass(frozen=True)
class Readout:
    """Joint log beliefs of some cells after one measurement, and what follows from them.

    Attributes:
        log_likelihood: Of the cells, (a, n, bins).
        log_joint: Log of prior times evidence of each cell, background first, (a, 1 + n).
        centers: Of the cells [m], (a, 2).
    """

    log_likelihood: FloatArray
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
    classes = probabilities[1:]
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
    weights = np.exp(log_mass - log_mass[peak])
    offset = readout.centers - readout.centers[peak]
    near = np.where(np.abs(offset).max(axis=1) <= 2.5 * cell_size, weights, 0.0)
    mean = weights @ offset / weights.sum()
    variance = weights @ (offset - mean) ** 2 / weights.sum() + cell_size**2 / 12.0
    return readout.centers[peak] + near @ offset / near.sum(), np.sqrt(variance)


def _orientation_marginal(readout: Readout, index: int) -> FloatArray:
    """Orientation density given a class, position summed out, any scale, (fine bins,)."""
    log_mass = readout.log_joint[:, 1 + index]
    peak = log_mass.max()
    bins = readout.log_likelihood.shape[-1]
    if not np.isfinite(peak):
        return np.ones(bins)
    kept = np.flatnonzero(log_mass > peak - NEGLIGIBLE)
    values = readout.log_likelihood[kept, index]
    outer = log_mass[kept] - log_mean_exp(values)
    factor = int(resolution_factors(values).max())
    marginal = logsumexp(refine(values, factor) + outer[:, None], axis=0)
    further = max(1, 2 ** int(np.ceil(np.log2(_FINE_BINS / (bins * factor)))))
    marginal = refine(marginal, further)
    return np.asarray(np.exp(marginal - marginal.max()))


def _highest(density: FloatArray, modes: tuple[OrientationMode, ...]) -> float:
    """Orientation [rad] of the mode with the greatest density."""
    peak = 2.0 * np.pi * int(np.argmax(density)) / len(density)
    angles = np.array([mode.orientation for mode in modes])
    return float(angles[np.argmin(np.abs(wrap_angle(angles - peak)))])


def _joint_map(readout: Readout) -> tuple[int, float, float, float]:
    """Paper eq. (24) to the letter: class index, x, y [m], orientation [rad]."""
    mean = log_mean_exp(readout.log_likelihood)
    outer = readout.log_joint[:, 1:] - np.where(np.isfinite(mean), mean, 0.0)
    density = readout.log_likelihood.max(axis=-1) + outer
    best = density.max()
    if not np.isfinite(best):
        return 0, float(readout.centers[0, 0]), float(readout.centers[0, 1]), 0.0
    cells, classes = np.nonzero(density > best - 1.0)
    bins = readout.log_likelihood.shape[-1]
    factor = max(1, _FINE_BINS * 8 // bins)
    fine = refine(readout.log_likelihood[cells, classes], factor) + outer[cells, classes, None]
    winner, angle = np.unravel_index(int(np.argmax(fine)), fine.shape)
    x, y = readout.centers[cells[winner]]
    orientation = 2.0 * np.pi * float(angle) / (bins * factor)
    return int(classes[winner]), float(x), float(y), orientation
