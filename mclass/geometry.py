"""Planar rigid motions, SE(2) (paper section II.B).

The only convention: a pose is an array (..., 3) of x [m], y [m], heading [rad], counter-clockwise
from the x axis; ``pose_a_b`` is frame b seen from frame a, so that
``compose(pose_a_b, pose_b_c)`` is ``pose_a_c``. A twist (..., 3) is forward, leftward and
turning motion (vx dt [m], vy dt [m], omega dt [rad]) in the moving frame itself.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from mclass.records import FloatArray, IntArray

_SMALL_ANGLE = 1e-4

NO_WIDTH = 1e-9
"""Boxes that open less than this [rad] are rays."""


def wrap_angle(angles: npt.ArrayLike) -> FloatArray:
    """Angles [rad] brought to (-pi, pi], same shape."""
    wrapped = np.pi - np.remainder(np.pi - np.asarray(angles, dtype=float), 2.0 * np.pi)
    # A remainder next to a full turn rounds to -pi.
    return np.where(wrapped <= -np.pi, np.pi, wrapped)


def opening_angles(directions: FloatArray) -> FloatArray:
    """Turn from right edges to left ones [rad], [0, 2 pi), across that from pi to -pi too.

    Args:
        directions: Azimuths of right and left edges [rad], (..., 2); NaN stays NaN.
    """
    openings = np.remainder(directions[..., 1] - directions[..., 0], 2.0 * np.pi)
    # An opening of a full turn less rounding is a box without width.
    return np.where(openings > 2.0 * np.pi - NO_WIDTH, 0.0, openings)


def rotate(headings: npt.ArrayLike, points: FloatArray) -> FloatArray:
    """R(heading) applied to points (paper eq. 1); headings (...), points (..., 2)."""
    cosine, sine = np.cos(headings), np.sin(headings)
    x, y = points[..., 0], points[..., 1]
    return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)


def transform_points(pose_a_b: FloatArray, points_b: FloatArray) -> FloatArray:
    """Points of frame b in frame a: X ∘ q = R q + t (paper eq. 2), (..., 2)."""
    return rotate(pose_a_b[..., 2], points_b) + pose_a_b[..., :2]


def compose(pose_a_b: FloatArray, pose_b_c: FloatArray) -> FloatArray:
    """Pose of frame c in frame a, (..., 3); heading in (-pi, pi]."""
    position = transform_points(pose_a_b, pose_b_c[..., :2])
    heading = wrap_angle(pose_a_b[..., 2] + pose_b_c[..., 2])
    return np.concatenate([position, heading[..., None]], axis=-1)


def inverse(pose_a_b: FloatArray) -> FloatArray:
    """Pose of frame a in frame b: (R, t) becomes (Rᵀ, −Rᵀ t), (..., 3)."""
    position = rotate(-pose_a_b[..., 2], -pose_a_b[..., :2])
    return np.concatenate([position, wrap_angle(-pose_a_b[..., 2])[..., None]], axis=-1)


def relative_pose(pose_w_a: FloatArray, pose_w_b: FloatArray) -> FloatArray:
    """Pose of frame b seen from frame a: inverse(pose_w_a) then pose_w_b, (..., 3).

    The positions are subtracted before anything is rotated, so that nothing is lost far
    from the world's origin.
    """
    offset = rotate(-pose_w_a[..., 2], pose_w_b[..., :2] - pose_w_a[..., :2])
    heading = wrap_angle(pose_w_b[..., 2] - pose_w_a[..., 2])
    return np.concatenate([offset, heading[..., None]], axis=-1)


def _sine_terms(angles: FloatArray) -> tuple[FloatArray, FloatArray]:
    """sin(a)/a and (1 - cos(a))/a, by series where a is too small to divide by."""
    small = np.abs(angles) < _SMALL_ANGLE
    safe = np.where(small, 1.0, angles)
    sine = np.where(small, 1.0 - angles**2 / 6.0, np.sin(safe) / safe)
    versine = np.where(small, angles / 2.0 - angles**3 / 24.0, (1.0 - np.cos(safe)) / safe)
    return sine, versine


def exp(twists: FloatArray) -> FloatArray:
    """Pose reached by a constant twist in unit time: the solution of (4), (..., 3).

    The heading keeps its winding: half a turn more than pi stays as it is.
    """
    x, y, angle = twists[..., 0], twists[..., 1], twists[..., 2]
    sine, versine = _sine_terms(angle)
    return np.stack([sine * x - versine * y, versine * x + sine * y, angle], axis=-1)


def log(poses: FloatArray) -> FloatArray:
    """The twist of least turning whose `exp` is the pose, (..., 3)."""
    x, y = poses[..., 0], poses[..., 1]
    angle = wrap_angle(poses[..., 2])
    sine, versine = _sine_terms(angle)
    norm = sine**2 + versine**2
    return np.stack(
        [(sine * x + versine * y) / norm, (sine * y - versine * x) / norm, angle], axis=-1
    )


def interpolate_poses(
    stamps_ns: IntArray, poses_world_body: FloatArray, query_ns: IntArray
) -> FloatArray:
    """Poses at other times, along the constant twist between neighbouring poses on SE(2).

    Outside the first and last stamp the nearest pose is held; callers decide how far
    that may be trusted.

    Args:
        stamps_ns: Strictly increasing, (n,), n >= 1.
        poses_world_body: (n, 3).
        query_ns: Times asked for, any order, (q,).

    Returns:
        Poses, (q, 3), headings in (-pi, pi].
    """
    if len(stamps_ns) == 1:
        return np.broadcast_to(poses_world_body[0], (len(query_ns), 3)).copy()
    after = np.clip(np.searchsorted(stamps_ns, query_ns, side="right"), 1, len(stamps_ns) - 1)
    before = after - 1
    span = stamps_ns[after] - stamps_ns[before]
    fraction = np.clip((query_ns - stamps_ns[before]) / span, 0.0, 1.0)
    start = poses_world_body[before]
    twist = log(relative_pose(start, poses_world_body[after]))
    return compose(start, exp(fraction[:, None] * twist))


def integrate_twists(
    stamps_ns: IntArray, velocities: FloatArray, start: FloatArray | None = None
) -> FloatArray:
    """Poses of a body from its own velocities, each held to the next stamp: (4) solved.

    Args:
        stamps_ns: Strictly increasing, (n,).
        velocities: Forward and leftward speed [m/s], turn rate [rad/s], body frame, (n, 3).
        start: Pose at the first stamp, (3,); the origin when None.

    Returns:
        Pose at each stamp, (n, 3).
    """
    seconds = np.diff(stamps_ns) * 1e-9
    steps = exp(velocities[:-1] * seconds[:, None])
    headings = np.concatenate([[0.0], np.cumsum(steps[:, 2])])
    moves = rotate(headings[:-1], steps[:, :2])
    positions = np.concatenate([np.zeros((1, 2)), np.cumsum(moves, axis=0)])
    poses = np.concatenate([positions, wrap_angle(headings)[:, None]], axis=-1)
    return poses if start is None else compose(np.asarray(start, dtype=float), poses)
