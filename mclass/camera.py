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
_POLE = 1e-12
# Pixels this many focal lengths from the axis belong to no image.
_MAX_SLOPE = 1e6


@dataclass(frozen=True)
class Calibrations:
    """Intrinsics of one camera, one row for each time they changed.

    Attributes:
        model: Name of the distortion model.
        intrinsics: fx, fy, cx, cy [pixel], (n, 4).
        coefficients: Of the distortion model, in its own order, (n, k).
        image_sizes: Width and height [pixel], (n, 2); 0 if unknown.
        rotations: Turn rays of the pixels into the optical frame, (n, 3, 3); None where both
            are one.
    """

    model: str
    intrinsics: FloatArray
    coefficients: FloatArray
    image_sizes: FloatArray
    rotations: FloatArray | None = None

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
    with np.errstate(over="ignore", invalid="ignore"):
        points = (pixels - intrinsics[:, 2:]) / intrinsics[:, :2]
    good = usable[rows] & transforms.finite_rows(points, _MAX_SLOPE)
    points = np.where(good[:, None], points, 0.0)
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
    if calibrations.rotations is not None:
        turns = np.where(usable[:, None, None], calibrations.rotations, np.eye(3))
        rays = np.einsum("nij,nj->ni", turns[rows], rays)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True), good & solved


def are_rotations(matrices: FloatArray) -> BoolArray:
    """Which of (n, 3, 3) matrices are rotations, as far as a calibration file's digits go."""
    safe = np.where(np.abs(matrices) <= 2.0, matrices, 0.0)
    products = np.einsum("nij,nkj->nik", safe, safe)
    return np.asarray(
        (np.abs(products - np.eye(3)) < 1e-3).all(axis=(1, 2)) & (np.linalg.det(safe) > 0)
    )


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
    """Newton's method on `_distort`, kept inside the part where the radius grows.

    Beyond it other points are distorted to the same place.
    """
    if not coefficients.any():
        return distorted, np.ones(len(distorted), bool)
    limit = _growing_radius(coefficients)[rows]
    points = _shrink(distorted, limit)
    tolerance = 1e-13 * (1.0 + np.linalg.norm(distorted, axis=1))
    error = np.full(len(points), np.inf)
    active = np.arange(len(points))
    for _ in range(_NEWTON_STEPS):
        # One calibration for all is the rule; it need not be copied for every point.
        c = coefficients if len(coefficients) == 1 else coefficients[rows[active]]
        moved, step = _distort(points[active], c, distorted[active])
        error[active] = np.hypot(moved[:, 0], moved[:, 1])
        going = error[active] > tolerance[active]
        if not going.any():
            break
        active = active[going]
        points[active] = _shrink(points[active] + step[going], limit[active])
    return points, error < 1e-9


def _distort(
    points: FloatArray, coefficients: FloatArray, goal: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """How far points are distorted beside their goal, and the Newton step towards it.

    Args:
        points: Ideal image points x/z, y/z, (n, 2).
        coefficients: k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, (n, 12) or (1, 12).
        goal: Where they should be distorted to, (n, 2).

    Returns:
        Offsets and steps, (n, 2) each.
    """
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = np.moveaxis(coefficients, -1, 0)
    x, y = points[:, 0], points[:, 1]
    u, xy = x * x + y * y, x * y
    above = 1 + u * (k1 + u * (k2 + u * k3))
    below = 1 + u * (k4 + u * (k5 + u * k6))
    # Newton's method may step onto a pole; from next to it, it goes on.
    below = np.where(np.abs(below) < _POLE, _POLE, below)
    radial = above / below
    slope = (k1 + u * (2 * k2 + 3 * u * k3) - radial * (k4 + u * (2 * k5 + 3 * u * k6))) / below
    off_x = x * radial + 2 * p1 * xy + p2 * (u + 2 * x * x) + u * (s1 + u * s2) - goal[:, 0]
    off_y = y * radial + p1 * (u + 2 * y * y) + 2 * p2 * xy + u * (s3 + u * s4) - goal[:, 1]
    prism_x, prism_y = 2 * (s1 + 2 * u * s2), 2 * (s3 + 2 * u * s4)
    shared = 2 * xy * slope + 2 * p1 * x + 2 * p2 * y
    xx = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x + x * prism_x
    yy = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x + y * prism_y
    x_by_y, y_by_x = shared + y * prism_x, shared + x * prism_y
    determinant = xx * yy - x_by_y * y_by_x
    safe = np.where(np.abs(determinant) < 1e-12, 1e-12, determinant)
    step_x = (x_by_y * off_y - yy * off_x) / safe
    step_y = (y_by_x * off_x - xx * off_y) / safe
    return np.stack([off_x, off_y], axis=1), np.stack([step_x, step_y], axis=1)


def _shrink(points: FloatArray, limit: FloatArray) -> FloatArray:
    """Points pulled towards the centre until they are within a radius."""
    radius = np.linalg.norm(points, axis=1)
    factor = np.where(radius > limit, limit / np.where(radius > 0, radius, 1.0), 1.0)
    return points * factor[:, None]


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
