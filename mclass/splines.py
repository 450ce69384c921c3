"""Quintic splines through equally spaced samples, by FFT.

A B-spline with coefficients c passes through samples s when c, weighed by the spline's values at
the nodes, is s: a convolution, undone by dividing spectra. Samples are taken around a circle,
or mirrored at both ends.
"""

from __future__ import annotations

import numpy as np

from mclass.records import FloatArray

_AT_NODES = (66.0, 26.0, 1.0)
"""120 times the B-spline at its middle node and at the next ones on either side."""

_HALF_WAY = (1682.0, 237.0, 1.0)
"""3840 times the B-spline half a step from its middle and a step and two farther out."""


def spline_coefficients(samples: FloatArray, axis: int, *, mirrored: bool = False) -> FloatArray:
    """Coefficients of the spline through the samples along an axis, same shape."""
    return _filtered(samples, axis, half_way=False, mirrored=mirrored)


def half_way_values(samples: FloatArray, axis: int, *, mirrored: bool = False) -> FloatArray:
    """The spline through the samples, half-way from each to the next along an axis, same shape."""
    return _filtered(samples, axis, half_way=True, mirrored=mirrored)


def _filtered(samples: FloatArray, axis: int, *, half_way: bool, mirrored: bool) -> FloatArray:
    """Samples convolved, around the circle, with what makes coefficients or values of them."""
    values = np.moveaxis(samples, axis, -1)
    count = values.shape[-1]
    if mirrored:
        values = np.concatenate([values, values[..., -2:0:-1]], axis=-1)
    around = values.shape[-1]
    angle = 2.0 * np.pi * np.arange(around // 2 + 1) / around
    at_nodes = _AT_NODES[0] + 2.0 * sum(
        weight * np.cos(step * angle) for step, weight in enumerate(_AT_NODES[1:], 1)
    )
    transfer = 120.0 / at_nodes.astype(complex)
    if half_way:
        between = sum(weight * np.cos((k + 0.5) * angle) for k, weight in enumerate(_HALF_WAY))
        transfer *= np.exp(0.5j * angle) * between / 1920.0
    filtered = np.fft.irfft(np.fft.rfft(values) * transfer, n=around)
    return np.moveaxis(filtered[..., :count], -1, axis)
