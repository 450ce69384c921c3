"""Directions on the ground plane in which boxes, bearings and 3-D boxes lie."""

from __future__ import annotations

import numpy as np

from mclass import camera, transforms
from mclass.camera import Calibrations
from mclass.geometry import opening_angles, wrap_angle
from mclass.records import BoolArray, FloatArray, IntArray

NOT_FINITE = "box not finite"
NEGATIVE_SIZE = "box of negative size"
OUTSIDE = "box outside the image"
NO_FOCAL_LENGTH = "camera without focal length"
BEYOND_LENS = "box beyond what the lens can show"
OVERHEAD = "box straight above or below the sensor"
AROUND = "box around the sensor"
REASONS = (
    "",
    NOT_FINITE,
    NEGATIVE_SIZE,
    OUTSIDE,
    NO_FOCAL_LENGTH,
    BEYOND_LENS,
    OVERHEAD,
    AROUND,
)
"""Why a box has no direction, by the codes that the functions here return; 0 if it has one."""

_CODES = {reason: code for code, reason in enumerate(REASONS)}
# Beyond every image, yet small enough to be added up.
_MAX_PIXEL = 1e12
# Angles of more turns than this have no digits left for a direction.
_MAX_BEARING = 1e6
_CORNERS = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])


def box_directions(
    calibrations: Calibrations,
    rows: IntArray,
    rotations_world_optical: FloatArray,
    boxes: FloatArray,
) -> tuple[FloatArray, IntArray]:
    """Right and left edge of image boxes, at the box's centre row, on the ground plane.

    Boxes are clipped to the image. For a camera mounted on its side the upper and lower edge
    at the centre column take the place of left and right.

    Args:
        calibrations: Of the camera.
        rows: Calibration of each box, (n,).
        rotations_world_optical: Full 3-D orientation of the optical frame, (n, 4).
        boxes: Left, top, right, bottom [pixel], (n, 4).

    Returns:
        World azimuths of right and left edge [rad], (n, 2), NaN where there is none, and codes
        of `REASONS`, (n,).
    """
    codes = np.zeros(len(boxes), np.int64)
    finite = transforms.finite_rows(boxes)
    boxes = np.clip(np.where(finite[:, None], boxes, 0.0), -_MAX_PIXEL, _MAX_PIXEL)
    low, high = boxes[:, :2], boxes[:, 2:]
    negative = np.asarray((high < low).any(axis=1))
    size = calibrations.image_sizes[rows]
    bounds = np.where(size > 0, size, np.inf)
    outside = np.asarray(((high < 0) | (low > bounds)).any(axis=1))
    unknown = np.asarray((size <= 0).any(axis=1))
    low = np.where(unknown[:, None], low, np.clip(low, 0.0, bounds))
    high = np.where(unknown[:, None], high, np.clip(high, 0.0, bounds))
    blind = ~camera.has_focal_length(calibrations.intrinsics)[rows]
    middle = 0.5 * (low + high)
    sideways = _is_sideways(rotations_world_optical)[:, None]
    first = np.where(sideways, _with(middle, low, 1), _with(middle, low, 0))
    second = np.where(sideways, _with(middle, high, 1), _with(middle, high, 0))
    azimuths, solved, level = [], np.ones(len(boxes), bool), np.ones(len(boxes), bool)
    for pixels in (first, second, middle):
        rays, valid = camera.pixel_rays(calibrations, rows, pixels)
        azimuth, is_level = camera.ray_azimuths(rotations_world_optical, rays)
        azimuths.append(azimuth)
        solved &= valid
        level &= is_level
    for wrong, reason in (
        (~level, OVERHEAD),
        (~solved, BEYOND_LENS),
        (blind, NO_FOCAL_LENGTH),
        (outside & ~unknown, OUTSIDE),
        (negative, NEGATIVE_SIZE),
        (~finite, NOT_FINITE),
    ):
        codes[wrong] = _CODES[reason]
    edges = camera.order_edges(*azimuths)
    return np.where((codes == 0)[:, None], edges, np.nan), codes


def view_directions(
    calibrations: Calibrations, rows: IntArray, rotations_world_optical: FloatArray
) -> FloatArray:
    """Right and left border of the image, at its centre row, on the ground plane.

    Args:
        calibrations: Of the camera.
        rows: Calibration at each look, (m,).
        rotations_world_optical: Full 3-D orientation at each look, (m, 4).

    Returns:
        World azimuths [rad], (m, 2); NaN where the image size or a ray is unknown.
    """
    size = calibrations.image_sizes
    known = np.asarray((size > 0).all(axis=1))
    middle = 0.5 * size
    rays, solved = [], []
    own = np.arange(len(size))
    # Unprojected once for each calibration, as looks are many and these are few.
    for pixels in (
        _with(middle, np.zeros_like(size), 0),
        _with(middle, size, 0),
        _with(middle, np.zeros_like(size), 1),
        _with(middle, size, 1),
        middle,
    ):
        ray, valid = camera.pixel_rays(calibrations, own, pixels)
        rays.append(ray[rows])
        solved.append((valid & known)[rows])
    sideways = _is_sideways(rotations_world_optical)
    azimuths, usable = [], solved[4]
    for across, along in ((0, 2), (1, 3), (4, 4)):
        ray = np.where(sideways[:, None], rays[along], rays[across])
        azimuth, level = camera.ray_azimuths(rotations_world_optical, ray)
        azimuths.append(azimuth)
        usable = usable & level & np.where(sideways, solved[along], solved[across])
    return np.where(usable[:, None], camera.order_edges(*azimuths), np.nan)


def bearing_directions(
    rotations_world_sensor: FloatArray, bearings: FloatArray, *, optical: bool
) -> tuple[FloatArray, IntArray]:
    """Right and left edge of bearings, measured in the sensor's level plane.

    Args:
        rotations_world_sensor: (n, 4).
        bearings: Right and left [rad], counter-clockwise from straight ahead, (n, 2).
        optical: Whether straight ahead is z, as in an optical frame, and not x.

    Returns:
        As `box_directions`.
    """
    finite = transforms.finite_rows(bearings, _MAX_BEARING)
    safe = np.where(finite[:, None], bearings, 0.0)
    width = opening_angles(safe)
    azimuths = []
    level = np.ones(len(bearings), bool)
    for angle in (safe[:, 0], safe[:, 1], safe[:, 0] + 0.5 * width):
        zero = np.zeros_like(angle)
        ahead, left = np.cos(angle), np.sin(angle)
        rays = np.stack([-left, zero, ahead] if optical else [ahead, left, zero], axis=1)
        azimuth, is_level = camera.ray_azimuths(rotations_world_sensor, rays)
        azimuths.append(azimuth)
        level &= is_level
    codes = np.where(finite, np.where(level, 0, _CODES[OVERHEAD]), _CODES[NOT_FINITE])
    edges = camera.order_edges(*azimuths)
    return np.where((codes == 0)[:, None], edges, np.nan), codes


def volume_directions(
    rotations_world_sensor: FloatArray, volumes: FloatArray, shifts: FloatArray
) -> tuple[FloatArray, IntArray]:
    """Horizontal extent of 3-D boxes as seen from the sensor.

    Args:
        rotations_world_sensor: Full 3-D orientation of the frame that boxes are in, (n, 4).
        volumes: Position (3), orientation (4), size (3) in that frame, (n, 10).
        shifts: From the sensor to that frame's origin, in the world, (n, 3).

    Returns:
        As `box_directions`.
    """
    sizes = volumes[:, 7:]
    turns, turned = transforms.normalize_quaternions(volumes[:, 3:7])
    # A point has no orientation that could be wrong, and all zeros is one that was left out.
    untold = np.asarray((sizes == 0).all(axis=1) | (volumes[:, 3:7] == 0).all(axis=1))
    finite = transforms.finite_rows(volumes[:, [0, 1, 2, 7, 8, 9]], transforms.MAX_DISTANCE) & (
        turned | untold
    )
    safe = np.where(finite[:, None], volumes, 0.0)
    centers = transforms.rotate(rotations_world_sensor, safe[:, :3]) + shifts
    corners = _CORNERS * safe[:, None, 7:]
    corners = transforms.rotate(turns[:, None], corners)
    corners = transforms.rotate(rotations_world_sensor[:, None], corners) + centers[:, None]
    center, level = camera.azimuths(centers)
    directions, _ = camera.azimuths(corners)
    offsets = wrap_angle(directions - center[:, None])
    right, left = offsets.min(axis=1), offsets.max(axis=1)
    codes = np.zeros(len(volumes), np.int64)
    codes[left - right >= np.pi] = _CODES[AROUND]
    codes[~level] = _CODES[OVERHEAD]
    codes[(safe[:, 7:] < 0).any(axis=1)] = _CODES[NEGATIVE_SIZE]
    codes[~finite] = _CODES[NOT_FINITE]
    edges = wrap_angle(center[:, None] + np.stack([right, left], axis=1))
    return np.where((codes == 0)[:, None], edges, np.nan), codes


def hull(directions: FloatArray, rows: IntArray, n_rows: int) -> FloatArray:
    """Smallest arcs around the first arc of each row that hold all of the row's arcs.

    Args:
        directions: Right and left [rad], (n, 2); NaN for none.
        rows: Row of each arc, (n,).
        n_rows: Number of rows.

    Returns:
        Right and left [rad] in (-pi, pi], (n_rows, 2); NaN for rows without an arc.
    """
    usable = np.flatnonzero(transforms.finite_rows(directions))
    result = np.full((n_rows, 2), np.nan)
    # One arc alone stays as it is, to the last bit.
    alone = np.bincount(rows[usable], minlength=n_rows)[rows[usable]] == 1
    result[rows[usable[alone]]] = directions[usable[alone]]
    usable = usable[~alone]
    if not len(usable):
        return result
    rows, right = rows[usable], directions[usable, 0]
    width = opening_angles(directions[usable])
    _, first = np.unique(rows, return_index=True)
    reference = np.full(n_rows, np.nan)
    reference[rows[first]] = right[first] + 0.5 * width[first]
    # Measured from the middle of each arc, so that wide ones do not wrap.
    start = wrap_angle(right + 0.5 * width - reference[rows]) - 0.5 * width
    lowest, highest = np.full(n_rows, np.inf), np.full(n_rows, -np.inf)
    np.minimum.at(lowest, rows, start)
    np.maximum.at(highest, rows, start + width)
    filled = rows[first]
    arcs = np.stack([lowest[filled], highest[filled]], axis=1) + reference[filled, None]
    result[filled] = wrap_angle(arcs)
    return result


def _with(middle: FloatArray, edge: FloatArray, axis: int) -> FloatArray:
    """The middle with one coordinate taken from an edge."""
    result = middle.copy()
    result[:, axis] = edge[:, axis]
    return result


def _is_sideways(rotations_world_optical: FloatArray) -> BoolArray:
    """Whether the image's rows run up and down rather than level."""
    right = transforms.rotate(rotations_world_optical, np.array([1.0, 0.0, 0.0]))
    down = transforms.rotate(rotations_world_optical, np.array([0.0, 1.0, 0.0]))
    # A camera that looks down has both level; its rows then count as they are.
    return np.asarray(np.abs(right[:, 2]) > np.abs(down[:, 2]) + 0.1)
