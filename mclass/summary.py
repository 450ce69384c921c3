"""A joint belief in a few numbers: class, place, orientation modes (paper eqs. 22 and 24)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mclass.geometry import wrap_angle
from mclass.logarithms import logsumexp
from mclass.orientation import (
    find_modes,
    parabola_vertex,
    peaks,
    refine,
    resolution_factors,
)
from mclass.records import FloatArray
from mclass.results import ObjectEstimate, OrientationMode

NEGLIGIBLE = 25.0
"""Cells whose log belief is this far below the best are left out of summaries."""

_TIE = 1e-6
_EQUAL = 1e-9
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
    places, deviations = _places(readout, cell_size, known=known)
    poses[:, :2] = places
    modes: tuple[OrientationMode, ...] = ()
    for index, density in enumerate(_orientation_marginals(readout)):
        poses[index, 2] = _highest(density)
        if index == best:
            modes = find_modes(density)
            poses[index, 2] = _nearest(modes, poses[index, 2])
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
        position_std=deviations[best],
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
    angles = np.arange(bins) / bins
    for row, fine in zip(densities, _orientation_marginals(readout), strict=True):
        scaled = fine / (fine.mean() * 2.0 * np.pi)
        row[:] = np.interp(angles, np.arange(len(fine)) / len(fine), scaled, period=1)
    return densities


def _places(readout: Readout, cell_size: float, *, known: bool) -> tuple[FloatArray, FloatArray]:
    """Mode of the position given each class, finer than a cell, and its standard deviation [m].

    Both (n, 2).
    """
    count = readout.log_joint.shape[1] - 1
    if known:
        return np.tile(readout.centers[0], (count, 1)), np.zeros((count, 2))
    # Averaged readouts hold a cell once for every trajectory.
    points, cell = np.unique(readout.centers @ np.array([1.0, 1.0j]), return_inverse=True)
    centers = np.stack([points.real, points.imag], axis=1)
    places, deviations = np.empty((count, 2)), np.empty((count, 2))
    for index, log_mass in enumerate(readout.log_joint[:, 1:].T):
        most = log_mass.max()
        if not np.isfinite(most):
            places[index], deviations[index] = centers.mean(axis=0), centers.std(axis=0)
            continue
        weights = np.bincount(cell, weights=np.exp(log_mass - most))
        peak = int(np.argmax(weights))
        offset = centers - centers[peak]
        near = np.where(np.abs(offset).max(axis=1) <= 2.5 * cell_size, weights, 0.0)
        mean = weights @ offset / weights.sum()
        variance = weights @ (offset - mean) ** 2 / weights.sum() + cell_size**2 / 12.0
        places[index] = centers[peak] + near @ offset / near.sum()
        deviations[index] = np.sqrt(variance)
    return places, deviations


def _orientation_marginals(readout: Readout) -> Iterator[FloatArray]:
    """Orientation density given each class, position summed out, any scale, (fine bins,)."""
    bins = readout.log_likelihood.shape[-1]
    for index, log_mass in enumerate(readout.log_joint[:, 1:].T):
        peak = log_mass.max()
        if not np.isfinite(peak):
            yield np.ones(bins)
            continue
        kept = np.flatnonzero(log_mass > peak - NEGLIGIBLE)
        values = readout.log_likelihood[kept, index] + readout.log_outer[kept, index, None]
        factor = int(resolution_factors(values).max())
        fine = refine(values, factor)
        top = fine.max(axis=0)
        fine -= top
        np.exp(fine, out=fine)
        marginal = np.log(fine.sum(axis=0)) + (top - top.max())
        further = max(1, 2 ** int(np.ceil(np.log2(_FINE_BINS / (bins * factor)))))
        yield np.exp(refine(marginal, further))


def _highest(density: FloatArray) -> float:
    """Orientation [rad] where a density is greatest, found between its samples."""
    # Equal peaks differ by rounding: the smaller angle is taken.
    peak = int(np.argmax(density >= density.max() * (1.0 - _EQUAL)))
    with np.errstate(divide="ignore", invalid="ignore"):
        around = np.log(density[np.arange(peak - 1, peak + 2) % len(density)])
        angle = 2.0 * np.pi / len(density) * (peak + parabola_vertex(*around))
    return float(angle % (2.0 * np.pi))


def _nearest(modes: tuple[OrientationMode, ...], angle: float) -> float:
    """The orientation [rad] of the mode nearest to an angle."""
    angles = np.array([mode.orientation for mode in modes])
    return float(angles[np.argmin(np.abs(wrap_angle(angles - angle)))])


def _joint_map(readout: Readout) -> tuple[int, float, float, float]:
    """Paper eq. (24) to the letter: class index, x, y [m], orientation [rad]."""
    heights, bends = peaks(readout.log_likelihood)
    heights = heights + readout.log_outer
    best = heights.max()
    if not np.isfinite(best):
        return 0, float(readout.centers[0, 0]), float(readout.centers[0, 1]), 0.0
    # Between its bins a parabola rises by an eighth of its bend at most.
    cells, classes = np.nonzero(heights + bends / 4.0 >= best)
    factor = max(1, _FINE_BINS // readout.log_likelihood.shape[-1])
    fine = refine(readout.log_likelihood[cells, classes], factor)
    fine += readout.log_outer[cells, classes, None]
    # Of peaks that are equal but for rounding, the first is taken.
    winner, angle = np.unravel_index(int(np.argmax(fine >= fine.max() - _EQUAL)), fine.shape)
    curve = fine[winner]
    vertex = parabola_vertex(*curve[np.arange(angle - 1, angle + 2) % len(curve)])
    x, y = readout.centers[cells[winner]]
    orientation = 2.0 * np.pi * ((float(angle) + vertex) / len(curve) % 1.0)
    return int(classes[winner]), float(x), float(y), orientation
