"""Rigid motions in space, in batches, and chains of them through a tree of frames.

Quaternions are (..., 4) in the order x, y, z, w and of unit length. ``Transforms`` named
``a_b`` place frame b in frame a: a point p of b is ``rotate(q, p) + t`` in a, and
``compose(a_b, b_c)`` is ``a_c``.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from mclass.errors import ModelError
from mclass.records import BoolArray, FloatArray, IntArray

OPTICAL_ROTATION = np.array([-0.5, 0.5, -0.5, 0.5])
"""Optical frame (z forward, x right) in the body frame (x forward, y left), REP 103."""

MAX_DISTANCE = 1e9
"""Nothing is further away [m]; larger numbers are rubbish, and their squares overflow."""


@dataclass(frozen=True)
class Transforms:
    """A batch of rigid transforms.

    Attributes:
        translations: Position of the inner frame's origin [m], (..., 3).
        rotations_xyzw: Its orientation, (..., 4).
    """

    translations: FloatArray
    rotations_xyzw: FloatArray

    def __post_init__(self) -> None:
        if self.translations.shape[-1:] != (3,) or self.rotations_xyzw.shape[-1:] != (4,):
            shapes = (self.translations.shape, self.rotations_xyzw.shape)
            raise ModelError(f"transforms need (..., 3) and (..., 4) arrays, not {shapes}")

    def __len__(self) -> int:
        return len(self.translations)

    def take(self, rows: IntArray | BoolArray) -> Transforms:
        """The transforms of some rows."""
        return Transforms(self.translations[rows], self.rotations_xyzw[rows])

    def repeat(self, count: int) -> Transforms:
        """``count`` rows of the only row."""
        return Transforms(
            np.broadcast_to(self.translations.reshape(3), (count, 3)),
            np.broadcast_to(self.rotations_xyzw.reshape(4), (count, 4)),
        )


def identity(count: int) -> Transforms:
    """``count`` transforms that change nothing."""
    return Transforms(np.zeros((count, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)))


def normalize_quaternions(quaternions: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Unit quaternions, and which could be had: zero and non-finite ones become no rotation.

    Args:
        quaternions: (..., 4), any length.

    Returns:
        Unit quaternions (..., 4) and a mask (...), False where the input means nothing.
    """
    # Scaled by the largest component first, else squares of tiny or huge ones are lost.
    largest = np.max(np.abs(quaternions), axis=-1)
    valid = np.isfinite(largest) & (largest > 1e-12)
    none = np.array([0.0, 0.0, 0.0, 1.0])
    safe = np.where(valid[..., None], quaternions, none)
    safe = safe / np.where(valid, largest, 1.0)[..., None]
    return safe / np.linalg.norm(safe, axis=-1, keepdims=True), valid


def finite_rows(values: FloatArray, limit: float = np.inf) -> BoolArray:
    """Which rows of an array (n, k) hold only finite numbers of at most a size, (n,)."""
    return np.asarray((np.isfinite(values) & (np.abs(values) <= limit)).all(axis=1))


def multiply(a: FloatArray, b: FloatArray) -> FloatArray:
    """Hamilton product: rotation b, then a, (..., 4)."""
    ax, ay, az, aw = np.moveaxis(a, -1, 0)
    bx, by, bz, bw = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ],
        axis=-1,
    )


def conjugate(quaternions: FloatArray) -> FloatArray:
    """The opposite rotation, (..., 4)."""
    return np.asarray(quaternions * np.array([-1.0, -1.0, -1.0, 1.0]))


def rotate(quaternions: FloatArray, vectors: FloatArray) -> FloatArray:
    """Vectors turned by unit quaternions; (..., 4) and (..., 3) broadcast to (..., 3)."""
    axis, scalar = quaternions[..., :3], quaternions[..., 3:]
    twice = 2.0 * np.cross(axis, vectors)
    return np.asarray(vectors + scalar * twice + np.cross(axis, twice))


def from_roll_pitch_yaw(angles: FloatArray) -> FloatArray:
    """Quaternions of rotations about the fixed x, y and z axes, in this order.

    Args:
        angles: Roll, pitch, yaw [rad], (..., 3).

    Returns:
        (..., 4).
    """
    cosine = np.cos(0.5 * angles)
    sine = np.sin(0.5 * angles)
    (cr, cp, cy), (sr, sp, sy) = np.moveaxis(cosine, -1, 0), np.moveaxis(sine, -1, 0)
    return np.stack(
        [
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ],
        axis=-1,
    )


def from_heading(headings: FloatArray) -> FloatArray:
    """Quaternions of rotations about z by headings [rad], (...) to (..., 4)."""
    zero = np.zeros_like(headings)
    return np.stack([zero, zero, np.sin(0.5 * headings), np.cos(0.5 * headings)], axis=-1)


def headings(quaternions: FloatArray) -> FloatArray:
    """Yaw [rad] in (-pi, pi] of the rotated x axis, (..., 4) to (...).

    Where that axis is vertical the yaw is taken from the y axis, which then is level.
    """
    x, y, z, w = np.moveaxis(quaternions, -1, 0)
    forward_x, forward_y = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + z * w)
    left_x, left_y = 2.0 * (x * y - z * w), 1.0 - 2.0 * (x * x + z * z)
    vertical = np.hypot(forward_x, forward_y) < 1e-9
    return np.asarray(
        np.where(vertical, np.arctan2(-left_x, left_y), np.arctan2(forward_y, forward_x))
    )


def slerp(start: FloatArray, end: FloatArray, fractions: FloatArray) -> FloatArray:
    """Rotations along the shorter great arc between two, at constant speed.

    Args:
        start: Unit quaternions, (..., 4).
        end: Unit quaternions, (..., 4).
        fractions: 0 at the start, 1 at the end, (...).

    Returns:
        Unit quaternions, (..., 4).
    """
    cosine = np.sum(start * end, axis=-1)
    end = np.where(cosine[..., None] < 0.0, -end, end)
    # From chord lengths: the arc cosine loses half the digits of small angles.
    angle = 2.0 * np.arctan2(
        np.linalg.norm(end - start, axis=-1), np.linalg.norm(end + start, axis=-1)
    )
    small = angle < 1e-9
    sine = np.where(small, 1.0, np.sin(angle))
    before = np.where(small, 1.0 - fractions, np.sin((1.0 - fractions) * angle) / sine)
    after = np.where(small, fractions, np.sin(fractions * angle) / sine)
    mixed = before[..., None] * start + after[..., None] * end
    return np.asarray(mixed / np.linalg.norm(mixed, axis=-1, keepdims=True))


def compose(a_b: Transforms, b_c: Transforms) -> Transforms:
    """Frame c in frame a; the batches broadcast."""
    translations = rotate(a_b.rotations_xyzw, b_c.translations) + a_b.translations
    rotations = multiply(*np.broadcast_arrays(a_b.rotations_xyzw, b_c.rotations_xyzw))
    return Transforms(translations, rotations)


def inverse(a_b: Transforms) -> Transforms:
    """Frame a in frame b."""
    back = conjugate(a_b.rotations_xyzw)
    return Transforms(rotate(back, -a_b.translations), back)


def transform_points(a_b: Transforms, points_b: FloatArray) -> FloatArray:
    """Points of frame b in frame a, (..., 3)."""
    return rotate(a_b.rotations_xyzw, points_b) + a_b.translations


def bracket(
    stamps_ns: IntArray, query_ns: IntArray, max_gap_ns: int
) -> tuple[IntArray, FloatArray, BoolArray]:
    """Where times lie between samples, and whether the samples are close enough.

    A time between two samples is covered if these are at most ``max_gap_ns`` apart, a time
    before the first or after the last if it is at most ``max_gap_ns`` away (the sample is
    held there); a time that meets a sample always is.

    Args:
        stamps_ns: Strictly increasing, (n,), n >= 1.
        query_ns: (q,).
        max_gap_ns: The widest gap that may be bridged.

    Returns:
        Index of the sample before (at most n - 2, or 0), fraction of the way to the next in
        [0, 1], and the mask of covered times, each (q,).
    """
    if len(stamps_ns) == 1:
        covered = np.abs(query_ns - stamps_ns[0]) <= max_gap_ns
        return np.zeros(len(query_ns), np.int64), np.zeros(len(query_ns)), covered
    before = np.searchsorted(stamps_ns, query_ns, side="right") - 1
    before = np.clip(before, 0, len(stamps_ns) - 2)
    since, span = query_ns - stamps_ns[before], np.diff(stamps_ns)[before]
    inside = (since >= 0) & (since <= span)
    outside_by = np.where(since < 0, -since, since - span)
    met = (since == 0) | (since == span)
    covered = met | np.where(inside, span <= max_gap_ns, outside_by <= max_gap_ns)
    return before, np.clip(since / span, 0.0, 1.0), covered


@dataclass(frozen=True)
class Link:
    """One edge of a frame tree.

    Attributes:
        parent: Outer frame.
        child: Inner frame.
        stamps_ns: Strictly increasing, (n,), n >= 1; meaningless when static.
        transforms: ``parent_child``, (n,).
        static: Whether the first transform holds for ever.
    """

    parent: str
    child: str
    stamps_ns: IntArray
    transforms: Transforms
    static: bool

    def at(self, query_ns: IntArray, max_gap_ns: int) -> tuple[Transforms, BoolArray]:
        """The link at times (q,): translations linear, rotations along great arcs."""
        if self.static:
            first = Transforms(self.transforms.translations[0], self.transforms.rotations_xyzw[0])
            return first.repeat(len(query_ns)), np.ones(len(query_ns), bool)
        before, fraction, covered = bracket(self.stamps_ns, query_ns, max_gap_ns)
        after = np.minimum(before + 1, len(self.stamps_ns) - 1)
        start, end = self.transforms.take(before), self.transforms.take(after)
        moved = end.translations - start.translations
        return (
            Transforms(
                start.translations + fraction[:, None] * moved,
                slerp(start.rotations_xyzw, end.rotations_xyzw, fraction),
            ),
            covered,
        )


@dataclass(frozen=True)
class TransformTree:
    """Frames joined by links; of several links between two frames the first counts."""

    links: Sequence[Link] = ()
    _neighbours: Mapping[str, dict[str, tuple[Link, bool]]] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        neighbours: dict[str, dict[str, tuple[Link, bool]]] = {}
        for link in self.links:
            neighbours.setdefault(link.parent, {}).setdefault(link.child, (link, True))
            neighbours.setdefault(link.child, {}).setdefault(link.parent, (link, False))
        object.__setattr__(self, "_neighbours", neighbours)

    @property
    def frames(self) -> tuple[str, ...]:
        """All frames, in the order of the links."""
        return tuple(self._neighbours)

    def __contains__(self, frame: str) -> bool:
        return frame in self._neighbours

    def path(
        self, outer: str, inner: str, *, static_only: bool = False
    ) -> list[tuple[Link, bool]] | None:
        """Links from one frame to another and whether each is walked from parent to child.

        The shortest chain; None if the frames are not joined.
        """
        reached: dict[str, list[tuple[Link, bool]]] = {outer: []}
        queue = deque([outer])
        while queue and inner not in reached:
            frame = queue.popleft()
            for neighbour, (link, down) in self._neighbours.get(frame, {}).items():
                if neighbour not in reached and (link.static or not static_only):
                    reached[neighbour] = [*reached[frame], (link, down)]
                    queue.append(neighbour)
        return reached.get(inner)

    def ancestors(self, frame: str, *, static_only: bool = False) -> list[str]:
        """The frame, its parent, and so on to the root."""
        chain = [frame]
        while True:
            parents = [
                link.parent
                for link, down in self._neighbours.get(chain[-1], {}).values()
                if not down and (link.static or not static_only) and link.parent not in chain
            ]
            if not parents:
                return chain
            chain.append(parents[0])

    def lookup(
        self, outer: str, inner: str, query_ns: IntArray, max_gap_ns: int
    ) -> tuple[Transforms, BoolArray] | None:
        """``outer_inner`` at times, and at which of them every link is covered.

        Args:
            outer: Frame to express the other in.
            inner: The other.
            query_ns: (q,).
            max_gap_ns: As in `bracket`, for every moving link.

        Returns:
            Transforms and mask, (q,), or None if the frames are not joined.
        """
        path = self.path(outer, inner)
        if path is None:
            return None
        total, valid = identity(len(query_ns)), np.ones(len(query_ns), bool)
        for link, down in path:
            step, covered = link.at(query_ns, max_gap_ns)
            total = compose(total, step if down else inverse(step))
            valid = valid & covered
        return total, valid
