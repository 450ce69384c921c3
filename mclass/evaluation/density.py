"""An object's belief over class and orientation, its place integrated out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from mclass.orientation import refine, resolution_factors
from mclass.records import FloatArray
from mclass.results import BeliefBlock

_FINE_BINS = 720
_NEGLIGIBLE = 25.0
"""Cells whose log mass is this far below the greatest are left out."""


@dataclass(frozen=True)
class JointDensity:
    """P(class) and p(orientation | class).

    Attributes:
        log_class: Log probability, background first, (1 + n,).
        log_density: Log orientation density given each class [1/rad] at m equally spaced
            angles from 0, (n, m).
    """

    log_class: FloatArray
    log_density: FloatArray

    def log_likelihood(self, class_index: int, orientation: float) -> float:
        """Log of P(class) p(orientation | class) [1/rad]."""
        curve = self.log_density[class_index]
        place = orientation / (2.0 * np.pi) % 1.0 * len(curve)
        below = int(place)
        share = place - below
        low, high = curve[below % len(curve)], curve[(below + 1) % len(curve)]
        value = low if share == 0.0 else (1.0 - share) * low + share * high
        return float(self.log_class[1 + class_index] + value)

    def level(self, class_index: int, orientation: float) -> float:
        """Mass of the smallest highest-density region of orientation that holds a value.

        Given the class. The region of 90 % covers the value if this is at most 0.9. Among
        angles of equal density those nearer to 0 come first, so that a flat density covers
        true orientations as often as it should.
        """
        curve = self.log_density[class_index]
        index = round(orientation / (2.0 * np.pi) % 1.0 * len(curve)) % len(curve)
        before = curve > curve[index]
        before[:index] |= curve[:index] == curve[index]
        return float(np.exp(curve[before]).sum() * 2.0 * np.pi / len(curve))


def joint_density(blocks: Sequence[BeliefBlock]) -> JointDensity:
    """Marginalise an object's full belief over its cells.

    Orientations are sampled finer than the belief's bins, so that a peak narrower than a bin
    keeps its height.

    Args:
        blocks: All blocks of one object's belief.
    """
    cell_mass = np.concatenate([block.log_cell_mass for block in blocks])
    kept = cell_mass > cell_mass.max() - _NEGLIGIBLE
    cell_class = np.concatenate([block.log_class_probability for block in blocks])[kept]
    density = np.concatenate([block.log_density for block in blocks])[kept].astype(np.float64)
    cell_class = cell_class + cell_mass[kept, None]
    factor = max(int(resolution_factors(density).max()), -(-_FINE_BINS // density.shape[-1]))
    fine = refine(density, factor)
    fine = fine - _log_integral(fine)[..., None]
    log_class = logsumexp(cell_class, axis=0)
    with np.errstate(divide="ignore"):
        joint = logsumexp(cell_class[:, 1:, None] + fine, axis=0)
    # A class without any mass says nothing about orientation.
    possible = np.isfinite(joint).all(axis=-1, keepdims=True)
    joint = np.where(possible, joint, 0.0)
    return JointDensity(
        log_class=log_class - logsumexp(log_class),
        log_density=joint - _log_integral(joint)[..., None],
    )


def _log_integral(log_density: FloatArray) -> FloatArray:
    """Log of the integral over the circle of exp(log_density), (..., m) to (...)."""
    return np.asarray(logsumexp(log_density, axis=-1) + np.log(2.0 * np.pi / log_density.shape[-1]))
