"""Gaussian mixtures over viewpoints: where a label is returned from, in the object's frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mclass.errors import ModelError
from mclass.logarithms import logsumexp
from mclass.records import FloatArray

_LOG_2PI = float(np.log(2.0 * np.pi))


@dataclass(frozen=True)
class ViewpointMixture:
    """Weighted sum of viewpoint Gaussians (paper eqs. 8 and 10, exponent as in 25).

    Attributes:
        weights: w_m, not renormalised, (m,).
        means: q_m [m] in the object's frame, (m, 2).
        covariances: Sigma_m [m²] in the object's frame, (m, 2, 2).
        bearing_means: Mean bearing [rad] of the wrapped Gaussian (7), (m,); unused where
            the variance is infinite.
        bearing_variances: Its variance [rad²], (m,); infinite for a viewpoint without a
            bearing term, which then is a plain 2-D density.
    """

    weights: FloatArray
    means: FloatArray
    covariances: FloatArray
    bearing_means: FloatArray
    bearing_variances: FloatArray

    def __post_init__(self) -> None:
        count = len(self.weights)
        shapes = (self.means.shape, self.covariances.shape)
        if shapes != ((count, 2), (count, 2, 2)):
            raise ModelError(f"a mixture of {count} viewpoints has arrays of shape {shapes}")
        every = (self.weights, self.means, self.covariances)
        if not all(np.isfinite(values).all() for values in every):
            raise ModelError("a mixture of viewpoints holds a number that is not finite")
        if np.any(self.weights <= 0.0):
            raise ModelError("a viewpoint's weight is not positive")
        if not np.allclose(self.covariances, self.covariances.swapaxes(1, 2)):
            raise ModelError("a viewpoint's covariance is not symmetric")
        if np.any(np.linalg.eigvalsh(self.covariances) <= 0.0):
            raise ModelError("a viewpoint's covariance is not positive definite")
        if not np.all(self.bearing_variances > 0.0):
            raise ModelError("a viewpoint's bearing variance is not positive")

    @property
    def has_bearing(self) -> bool:
        """Whether any component depends on the bearing."""
        return bool(np.any(np.isfinite(self.bearing_variances)))

    def log_density(
        self,
        views: FloatArray,
        bearings: FloatArray | None = None,
        position_covariances: FloatArray | None = None,
    ) -> FloatArray:
        """Log of the mixture density (paper eq. 10 without P(label | class)).

        log p(v) = log sum_m w_m N(v; q_m, Sigma_m + Sigma_v) chi(bearing; mean_m, variance_m)

        Args:
            views: Sensor positions in the object's frame [m], (..., 2).
            bearings: Bearings of the object from the sensor's heading [rad], (...);
                taken as 0 when None.
            position_covariances: Covariance of each view [m²] in the object's frame,
                (..., 2, 2), widening every component exactly.

        Returns:
            Natural log density [1/m², or 1/(m² rad) with a bearing term], (...).
        """
        terms = np.empty((len(self.weights), *views.shape[:-1]))
        for m, (mean, covariance) in enumerate(zip(self.means, self.covariances, strict=True)):
            total = (
                covariance if position_covariances is None else covariance + position_covariances
            )
            terms[m] = np.log(self.weights[m]) + _log_gaussian_2d(views - mean, total)
            variance = self.bearing_variances[m]
            if np.isfinite(variance):
                angle = np.zeros(views.shape[:-1]) if bearings is None else bearings
                terms[m] += log_wrapped_gaussian(angle - self.bearing_means[m], float(variance))
        # In place, as tables are mostly this: a third of the time of the general function.
        peak = terms.max(axis=0)
        terms -= peak
        np.exp(terms, out=terms)
        return np.asarray(np.log(terms.sum(axis=0)) + peak)


def _log_gaussian_2d(offsets: FloatArray, covariances: FloatArray) -> FloatArray:
    """Log N(offset; 0, covariance) for (..., 2) offsets; the inverse is written out."""
    xx, xy, yy = covariances[..., 0, 0], covariances[..., 0, 1], covariances[..., 1, 1]
    determinant = xx * yy - xy * xy
    dx, dy = offsets[..., 0], offsets[..., 1]
    squared = (yy * dx * dx - 2.0 * xy * dx * dy + xx * dy * dy) / determinant
    return np.asarray(-0.5 * squared - _LOG_2PI - 0.5 * np.log(determinant))


def log_wrapped_gaussian(angles: FloatArray, variance: float) -> FloatArray:
    """Log of the wrapped Gaussian density at angles from its mean (paper eq. 7).

    Args:
        angles: Differences from the mean [rad], any shape, any winding.
        variance: Of the unwrapped Gaussian [rad²].

    Returns:
        Natural log density [1/rad], same shape.
    """
    wrapped = np.remainder(angles + np.pi, 2.0 * np.pi) - np.pi
    # Windings further out than eight standard deviations past pi add less than rounding.
    windings = int(np.ceil((8.0 * np.sqrt(variance) + np.pi) / (2.0 * np.pi)))
    shifts = 2.0 * np.pi * np.arange(-windings, windings + 1)
    exponents = -0.5 * (wrapped[..., None] - shifts) ** 2 / variance
    return np.asarray(logsumexp(exponents, axis=-1) - 0.5 * (_LOG_2PI + np.log(variance)))
