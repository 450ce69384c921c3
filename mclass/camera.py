"""From pixels to rays to directions on the ground plane.

Pixel (0, 0) is the centre of the upper-left pixel, x to the right, y down. The optical frame
has z along the optical axis, x to the right and y down (REP 103). World z is up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mclass import transforms
from mclass.errors import ModelError
from mclass.records import BoolArray, FloatArray, IntArray

_PINHOLE = frozenset({"", "none", "pinhole"})
_BROWN_CONRADY = frozenset({"plumb_bob", "rational_polynomial", "brown_conrady", "radtan"})
_EQUIDISTANT = frozenset({"equidistant", "fisheye", "kannala_brandt", "kannala_brandt4"})
_N_BROWN_CONRADY = 12
_N_EQUIDISTANT = 4
_NEWTON_STEPS = 30


@dataclass(frozen=True)
class Calibrations:
    """Intrinsics of one camera, one row for each time they changed.

    Attributes:
        model: Name of the distortion model.
        intrinsics: fx, fy, cx, cy [pixel], (n, 4).
        coefficients: Of the distortion model, in its own order, (n, k).
        image_sizes: Width and height [pixel], (n, 2); 0 if unknown.
    """

    model: str
    intrinsics: FloatArray
    coefficients: FloatArray
    image_sizes: FloatArray

    def __len__(self) -> int:
        return len(self.intrinsics)


def is_known_model(model: str) -> bool:
    """Whether `pixel_rays` can undo a distortion model of this name."""
    return model.lower() in _PINHOLE | _BROWN_CONRADY | _EQUIDISTANT


def has_focal_length(intrinsics: FloatArray) -> BoolArray:
    """Which rows of intrinsics (n, 4) are those of a camera that was calibrated, (n,)."""
    focal = np.abs(intrinsics[:, :2]) > 1e-9
    return transforms.finite_rows(intrinsics) & focal[:, 0] & focal[:, 1]


def pixel_rays(
    calibrations: Calibrations, rows: IntArray, pixels: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Rays in the optical frame that pixels came in on.

    Args:
        calibrations: Known models are ``plumb_bob``, ``rational_polynomial`` (thin prism terms
            included), ``equidistant`` with its other names, and none; missing coefficients are 0.
        rows: The calibration of each pixel, (n,).
        pixels: (n, 2).

    Returns:
        Unit vectors (n, 3), and a mask (n,) that is False where no ray exists: a focal length
        of 0, a pixel that is not finite, or one beyond what the distortion can produce.

    Raises:
        ModelError: If the model is unknown or has more coefficients than it can have.
    """
    intrinsics, name = calibrations.intrinsics, calibrations.model.lower()
    usable = has_focal_length(intrinsics) & transforms.finite_rows(calibrations.coefficients)
    intrinsics = np.where(usable[:, None], intrinsics, 1.0)[rows]
    good = usable[rows] & transforms.finite_rows(pixels)
    points = np.where(good[:, None], (pixels - intrinsics[:, 2:]) / intrinsics[:, :2], 0.0)
    if name in _PINHOLE:
        rays, solved = _append_one(points), np.ones(len(points), bool)
    elif name in _BROWN_CONRADY:
        coefficients = np.where(usable[:, None], _pad(calibrations, _N_BROWN_CONRADY), 0.0)
        flat, solved = _undo_brown_conrady(points, coefficients, rows)
        rays = _append_one(flat)
    elif name in _EQUIDISTANT:
        coefficients = np.where(usable[:, None], _pad(calibrations, _N_EQUIDISTANT), 0.0)
        rays, solved = _undo_equidistant(points, coefficients, rows)
    else:
        raise ModelError(
            f"distortion model {calibrations.model!r} is unknown; known are plumb_bob, "
            "rational_polynomial and equidistant (fisheye, kannala_brandt)"
        )
    return rays / np.linalg.norm(rays, axis=1, keepdims=True), good & solved


def distort(points: FloatArray, coefficients: FloatArray) -> FloatArray:
    """Ideal image points (x/z, y/z) moved by Brown-Conrady distortion.

    Args:
        points: (n, 2).
        coefficients: k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, (n, 12) or (12,).

    Returns:
        (n, 2).
    """
    c = np.moveaxis(np.broadcast_to(coefficients, (len(points), _N_BROWN_CONRADY)), -1, 0)
    x, y = points[:, 0], points[:, 1]
    u = x * x + y * y
    radial = (1 + u * (c[0] + u * (c[1] + u * c[4]))) / (1 + u * (c[5] + u * (c[6] + u * c[7])))
    moved_x = x * radial + 2 * c[2] * x * y + c[3] * (u + 2 * x * x) + u * (c[8] + u * c[9])
    moved_y = y * radial + c[2] * (u + 2 * y * y) + 2 * c[3] * x * y + u * (c[10] + u * c[11])
    return np.stack([moved_x, moved_y], axis=-1)


def azimuths(vectors: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Directions on the ground plane [rad] of vectors (..., 3), and which are not vertical."""
    x, y = vectors[..., 0], vectors[..., 1]
    level = np.hypot(x, y) > 1e-9 * np.maximum(1.0, np.abs(vectors[..., 2]))
    return np.where(level, np.arctan2(y, x), 0.0), level


def ray_azimuths(
    rotations_world_optical: FloatArray, rays: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Directions on the ground plane of rays of an optical frame in full 3-D orientation.

    Args:
        rotations_world_optical: Unit quaternions x, y, z, w, (..., 4).
        rays: In the optical frame, (..., 3).

    Returns:
        Azimuths [rad] and the mask of rays that are not vertical, (...).
    """
    return azimuths(transforms.rotate(rotations_world_optical, rays))


def order_edges(first: FloatArray, second: FloatArray, center: FloatArray) -> FloatArray:
    """Right and left edge of the arc between two directions that holds a third.

    Which image edge is the right one depends on how the camera is rolled, and an arc may be
    wider than half a turn; the centre decides both.

    Args:
        first: Direction of one edge [rad], (n,).
        second: Direction of the other, (n,).
        center: Direction inside, (n,).

    Returns:
        Right and left edge, counter-clockwise from right to left, (n, 2).
    """
    turn = 2.0 * np.pi
    to_center = np.remainder(center - first, turn)
    to_second = np.remainder(second - first, turn)
    # A ray's three directions are equal up to rounding, which must not become a full turn.
    forward = (to_center <= to_second) | (to_center > turn - 1e-9)
    pairs = np.stack([first, second], axis=-1)
    return np.where(forward[:, None], pairs, pairs[:, ::-1])


def _append_one(points: FloatArray) -> FloatArray:
    return np.concatenate([points, np.ones((len(points), 1))], axis=1)


def _pad(calibrations: Calibrations, width: int) -> FloatArray:
    """Coefficients as (m, width); tilted-sensor terms beyond it must be zero."""
    given = calibrations.coefficients
    if np.any(given[:, width:] != 0.0):
        raise ModelError(
            f"distortion model {calibrations.model!r} has {given.shape[1]} coefficients, "
            f"of which only {width} can be used; calibrate without tilted sensor terms"
        )
    padded = np.zeros((len(given), width))
    padded[:, : given.shape[1]] = given[:, :width]
    return padded


def _undo_brown_conrady(
    distorted: FloatArray, coefficients: FloatArray, rows: IntArray
) -> tuple[FloatArray, BoolArray]:
    """Newton's method on `distort`, kept inside the part where the radius grows.

    Beyond it other points are distorted to the same place.
    """
    if not coefficients.any():
        return distorted, np.ones(len(distorted), bool)
    limit = _growing_radius(coefficients)[rows]
    points = _shrink(distorted, limit)
    error = np.full(len(points), np.inf)
    active = np.arange(len(points))
    for _ in range(_NEWTON_STEPS):
        at, c = points[active], coefficients[rows[active]]
        residual = distort(at, c) - distorted[active]
        error[active] = np.linalg.norm(residual, axis=1)
        going = error[active] > 1e-13 * (1.0 + np.linalg.norm(distorted[active], axis=1))
        if not going.any():
            break
        active, at, c, residual = active[going], at[going], c[going], residual[going]
        points[active] = _shrink(at + _newton_step(at, c, residual), limit[active])
    return points, error < 1e-9


def _shrink(points: FloatArray, limit: FloatArray) -> FloatArray:
    """Points pulled towards the centre until they are within a radius."""
    radius = np.linalg.norm(points, axis=1)
    factor = np.where(radius > limit, limit / np.where(radius > 0, radius, 1.0), 1.0)
    return points * factor[:, None]


def _newton_step(points: FloatArray, coefficients: FloatArray, residual: FloatArray) -> FloatArray:
    """Solve J step = -residual, J by central differences of the smooth `distort`."""
    h = 1e-6
    shift_x, shift_y = np.array([h, 0.0]), np.array([0.0, h])
    plus_x, minus_x = (
        distort(points + shift_x, coefficients),
        distort(points - shift_x, coefficients),
    )
    plus_y, minus_y = (
        distort(points + shift_y, coefficients),
        distort(points - shift_y, coefficients),
    )
    dx, dy = (plus_x - minus_x) / (2 * h), (plus_y - minus_y) / (2 * h)
    determinant = dx[:, 0] * dy[:, 1] - dy[:, 0] * dx[:, 1]
    safe = np.where(np.abs(determinant) < 1e-12, 1e-12, determinant)
    step_x = (dy[:, 0] * residual[:, 1] - dy[:, 1] * residual[:, 0]) / safe
    step_y = (dx[:, 1] * residual[:, 0] - dx[:, 0] * residual[:, 1]) / safe
    return np.stack([step_x, step_y], axis=-1)


def _growing_radius(coefficients: FloatArray) -> FloatArray:
    """Radius up to which the distorted radius grows, for each row of coefficients (m, 12)."""
    radii = np.tan(np.linspace(0.0, np.deg2rad(88.0), 441))
    c, u = np.moveaxis(coefficients, -1, 0)[..., None], radii**2
    above = 1 + u * (c[0] + u * (c[1] + u * c[4]))
    below = 1 + u * (c[5] + u * (c[6] + u * c[7]))
    above_slope = c[0] + u * (2 * c[1] + u * 3 * c[4])
    below_slope = c[5] + u * (2 * c[6] + u * 3 * c[7])
    slope = above * below + 2 * u * (above_slope * below - above * below_slope)
    return radii[_last_of_first_run((slope > 0) & (below > 0))]


def _last_of_first_run(growing: BoolArray) -> IntArray:
    """Index of the last True before the first False in each row, 0 if there is none."""
    width = growing.shape[1]
    length = np.where(growing.all(axis=1), width, np.argmin(growing, axis=1))
    return np.asarray(np.maximum(length - 1, 0))


def _undo_equidistant(
    points: FloatArray, coefficients: FloatArray, rows: IntArray
) -> tuple[FloatArray, BoolArray]:
    """Bisection on theta (1 + k1 theta² + ... + k4 theta⁸) = radius, theta in [0, pi]."""
    radius = np.linalg.norm(points, axis=1)
    # The curve is followed up to its first turn only: beyond it a radius has two angles.
    grid = np.linspace(0.0, np.pi, 721)
    growing = _equidistant_slope(grid, coefficients[:, None, :]) > 0
    high = grid[_last_of_first_run(growing)][rows]
    coefficients = coefficients[rows]
    solved = radius <= _equidistant_radius(high, coefficients)
    low = np.zeros(len(points))
    for _ in range(54):
        middle = 0.5 * (low + high)
        short = _equidistant_radius(middle, coefficients) < radius
        low, high = np.where(short, middle, low), np.where(short, high, middle)
    theta = 0.5 * (low + high)
    away = radius > 0
    unit = points / np.where(away, radius, 1.0)[:, None]
    rays = np.concatenate([np.sin(theta)[:, None] * unit, np.cos(theta)[:, None]], axis=1)
    return np.where(away[:, None], rays, [0.0, 0.0, 1.0]), solved


def _equidistant_radius(theta: FloatArray, coefficients: FloatArray) -> FloatArray:
    """Distorted radius at angles from the axis; theta (...), coefficients (..., 4)."""
    k1, k2, k3, k4 = np.moveaxis(coefficients, -1, 0)
    u = theta * theta
    return np.asarray(theta * (1 + u * (k1 + u * (k2 + u * (k3 + u * k4)))))


def _equidistant_slope(theta: FloatArray, coefficients: FloatArray) -> FloatArray:
    """Derivative of `_equidistant_radius`."""
    k1, k2, k3, k4 = np.moveaxis(coefficients, -1, 0)
    u = theta * theta
    return np.asarray(1 + u * (3 * k1 + u * (5 * k2 + u * (7 * k3 + u * 9 * k4))))
