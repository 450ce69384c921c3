"""Pose tracks from odometry, poses, transforms or velocities, cleaned of what cannot be used."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from mclass import geometry, transforms
from mclass.blockwise import blockwise
from mclass.logs.decode import ABSENT, Column, is_absent
from mclass.logs.detections import TextArray, clean_frames, read_stamps
from mclass.logs.families import VelocityFamily
from mclass.logs.fields import PoseFields
from mclass.logs.tables import Table
from mclass.records import BoolArray, FloatArray, IntArray, PoseTrack, Tally
from mclass.transforms import TransformTree

UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])
_MAX_SPEED = 1e4
_MAX_HEADING = 1e6
# Of a 6 by 6 matrix in rows: x, y and the rotation about z.
_PLANAR = np.array([0, 1, 5, 6, 7, 11, 30, 31, 35])


@dataclass(frozen=True)
class Track:
    """A `PoseTrack` and what else is known of it.

    Attributes:
        poses: The track.
        tilts: Rotation of the body against its own heading (roll and pitch), (n, 4).
        tally: Poses left out or mended, by reason.
        clock: Whether stamps are header stamps or, for want of these, log times.
        still: Whether the one pose holds for ever.
    """

    poses: PoseTrack
    tilts: FloatArray
    tally: Tally = field(default_factory=Tally)
    clock: Literal["header", "log"] = "header"
    still: bool = False

    def __len__(self) -> int:
        return len(self.poses.stamps_ns)

    def covered(self, query_ns: IntArray, max_gap_ns: int) -> BoolArray:
        """At which times there is a pose, as `transforms.bracket` says."""
        if not len(self) or self.still:
            return np.full(len(query_ns), bool(len(self)))
        return transforms.bracket(self.poses.stamps_ns, query_ns, max_gap_ns)[2]

    def at(self, query_ns: IntArray) -> tuple[FloatArray, FloatArray, FloatArray | None]:
        """Planar poses (q, 3), tilts (q, 4) and covariances (q, 3, 3) or None at covered times."""
        stamps = self.poses.stamps_ns
        planar = geometry.interpolate_poses(stamps, self.poses.poses_world_child, query_ns)
        before, fraction, _ = transforms.bracket(stamps, query_ns, 0)
        after = np.minimum(before + 1, len(stamps) - 1)
        tilts = transforms.slerp(self.tilts[before], self.tilts[after], fraction)
        covariances = None
        if self.poses.covariances is not None:
            weight = fraction[:, None, None]
            first, second = self.poses.covariances[before], self.poses.covariances[after]
            covariances = (1.0 - weight) * first + weight * second
        return planar, tilts, covariances


def read_pose_track(table: Table, fields: PoseFields, *, by_log_time: bool = False) -> Track:
    """Poses of one channel.

    Args:
        table: The channel's messages, with `planar_covariances` for covariances.
        fields: Where they are.
        by_log_time: Stamp poses by log time, whatever their headers say.
    """
    tally = Tally()
    places = np.stack([table.floats(path) for path in fields.position], axis=1)
    usable = transforms.finite_rows(places)
    tally.add("position not finite", int((~usable).sum()))
    near = transforms.finite_rows(places, transforms.MAX_DISTANCE)
    tally.add("position further than 1e9 m", int((usable & ~near).sum()))
    usable &= near
    turns, turned = _orientations(table, fields)
    tally.add("orientation is no rotation", int((usable & ~turned).sum()))
    usable &= turned
    frame, child = "", ""
    if fields.frame is not None:
        frame, same = _one_name(clean_frames(table.values(fields.frame)), usable)
        tally.add("pose in another world frame", int((usable & ~same).sum()))
        usable &= same
    if fields.child is not None:
        child, same = _one_name(clean_frames(table.values(fields.child)), usable)
        tally.add("pose of another frame", int((usable & ~same).sum()))
        usable &= same
    header = read_stamps(table, [fields.stamp] if fields.stamp else [])
    stamped = header != 0
    clock: Literal["header", "log"] = "header"
    if by_log_time or not stamped[usable].any():
        clock = "log"
    stamps = table.log_times_ns
    if clock == "header":
        stamps = np.where(stamped, header, table.log_times_ns)
        tally.add("pose without stamp (log time used)", int((usable & ~stamped).sum()))
    rows = np.flatnonzero(usable)
    rows = rows[_sorted_once(stamps[rows], tally)]
    covariances = _covariances(table, fields, rows, tally)
    headings = transforms.headings(turns[rows])
    return Track(
        PoseTrack(
            frame=frame,
            child_frame=child,
            stamps_ns=stamps[rows],
            poses_world_child=np.column_stack([places[rows, :2], headings]),
            covariances=covariances,
        ),
        _tilts(turns[rows], headings),
        tally,
        clock,
    )


def read_velocity_track(table: Table, family: VelocityFamily, max_gap_ns: int) -> Track:
    """Velocities integrated on SE(2) from the origin (paper eq. 4)."""
    tally = Tally()
    columns = [f"{family.linear}.x", f"{family.linear}.y", f"{family.angular}.z"]
    velocities = np.stack([table.floats(path) for path in columns], axis=1)
    usable = transforms.finite_rows(velocities, _MAX_SPEED)
    tally.add("velocity not finite or above 1e4 m/s", int((~usable).sum()))
    header = read_stamps(table, family.stamp)
    clock: Literal["header", "log"] = "header" if (header[usable] != 0).any() else "log"
    stamps = table.log_times_ns
    if clock == "header":
        stamps = np.where(header != 0, header, stamps)
        tally.add("velocity without stamp (log time used)", int((usable & (header == 0)).sum()))
    rows = np.flatnonzero(usable)
    rows = rows[_sorted_once(stamps[rows], tally)]
    stamps = stamps[rows]
    tally.add("gaps over which a velocity was held", int((np.diff(stamps) > max_gap_ns).sum()))
    poses = np.zeros((0, 3))
    if len(rows):
        poses = geometry.integrate_twists(stamps, velocities[rows])
    child = ""
    if family.frame:
        child, _ = _one_name(clean_frames(table.values(family.frame[0])), usable)
    return Track(
        PoseTrack("odom", child, stamps, poses), np.tile(UPRIGHT, (len(rows), 1)), tally, clock
    )


def transform_track(tree: TransformTree, parent: str, child: str, max_gap_ns: int) -> Track:
    """Poses of one frame in another, at every stamp of the links between them."""
    nothing = PoseTrack(parent, child, np.zeros(0, np.int64), np.zeros((0, 3)))
    path = tree.path(parent, child)
    if path is None:
        return Track(nothing, np.zeros((0, 4)))
    # A robot that stands still has links that do not move, but are repeated.
    moving = [link.stamps_ns for link, _ in path if not link.static]
    moving = moving or [link.stamps_ns for link, _ in path if len(link.stamps_ns) > 1]
    stamps = np.unique(np.concatenate(moving)) if moving else np.zeros(1, np.int64)
    found = tree.lookup(parent, child, stamps, max_gap_ns)
    if found is None or not len(stamps):
        return Track(nothing, np.zeros((0, 4)))
    chain, valid = found
    chain, stamps = chain.take(valid), stamps[valid]
    headings = transforms.headings(chain.rotations_xyzw)
    poses = np.column_stack([chain.translations[:, :2], headings])
    tilts = _tilts(chain.rotations_xyzw, headings)
    return Track(PoseTrack(parent, child, stamps, poses), tilts, still=not moving)


def planar_covariances(column: Column) -> Column:
    """Covariances of x, y and heading out of those of all six degrees of freedom.

    Args:
        column: Fixed arrays of 36 numbers, (n, 36), or lists of them.

    Returns:
        The 3 by 3 matrices, (n, 9); `ABSENT` where a list is empty or no field holds such
        matrices, infinite where a list has another size.
    """
    if column.offsets:
        spans = column.offsets[0]
        counts = np.diff(spans)
        result = np.where(counts == 0, ABSENT, np.inf)[:, None].repeat(9, axis=1)
        full = counts == 36
        result[full] = column.values[spans[:-1][full, None] + _PLANAR]
        return Column(result)
    if column.values.ndim != 2 or column.values.shape[1] != 36:
        return Column(np.full((len(column.values), 9), ABSENT))
    return Column(column.values[:, _PLANAR].astype(np.float64))


def is_positive_semidefinite(matrices: FloatArray) -> BoolArray:
    """Which of (n, k, k) matrices are covariances: finite, symmetric, no negative direction."""
    (sound,) = blockwise(_positive_semidefinite, matrices)
    return np.asarray(sound)


def _positive_semidefinite(matrices: FloatArray) -> tuple[BoolArray]:
    limit = transforms.MAX_DISTANCE**2
    finite = np.asarray((np.isfinite(matrices) & (np.abs(matrices) <= limit)).all(axis=(1, 2)))
    safe = np.where(finite[:, None, None], matrices, 0.0)
    scale = np.abs(safe).max(axis=(1, 2), initial=0.0)
    skew = np.abs(safe - np.swapaxes(safe, 1, 2)).max(axis=(1, 2), initial=0.0)
    lowest = np.linalg.eigvalsh(0.5 * (safe + np.swapaxes(safe, 1, 2)))[:, 0]
    return (np.asarray(finite & (skew <= 1e-6 * scale) & (lowest >= -1e-9 * scale)),)


def _orientations(table: Table, fields: PoseFields) -> tuple[FloatArray, BoolArray]:
    """Unit quaternions of all messages and which of them are rotations."""
    if len(fields.orientation) == 4:
        values = np.stack([table.floats(path) for path in fields.orientation], axis=1)
        return transforms.normalize_quaternions(values)
    if len(fields.orientation) == 1:
        headings = table.floats(fields.orientation[0])
        finite = np.isfinite(headings) & (np.abs(headings) <= _MAX_HEADING)
        return transforms.from_heading(np.where(finite, headings, 0.0)), finite
    return np.tile(UPRIGHT, (len(table), 1)), np.ones(len(table), bool)


def _tilts(turns: FloatArray, headings: FloatArray) -> FloatArray:
    """What is left of rotations when their heading is taken away."""
    return transforms.multiply(transforms.from_heading(-headings), turns)


def _one_name(names: TextArray, usable: BoolArray) -> tuple[str, BoolArray]:
    """The first name in use, and which rows bear it or none."""
    named = np.flatnonzero(usable & (names != ""))
    if not len(named):
        return "", np.ones(len(names), bool)
    first = str(names[named[0]])
    return first, np.asarray((names == first) | (names == ""), dtype=bool)


def _sorted_once(stamps: IntArray, tally: Tally) -> IntArray:
    """Rows by increasing stamp; of rows with one stamp the last."""
    tally.add("pose out of order (sorted)", int((np.diff(stamps) < 0).sum()))
    order = np.argsort(stamps, kind="stable")
    last = np.append(np.diff(stamps[order]) > 0, True)[: len(order)]
    tally.add("pose with a stamp met before (last kept)", int((~last).sum()))
    return np.asarray(order[last])


def _covariances(
    table: Table, fields: PoseFields, rows: IntArray, tally: Tally
) -> FloatArray | None:
    """Covariances of (x, y, heading), (n, 3, 3), or None if the log gives none.

    Those that are not told, or cannot be, are replaced by the latest one before, else the first.
    """
    if fields.covariance is None or not len(rows):
        return None
    planar = table.floats(fields.covariance)[rows].reshape(-1, 3, 3)
    # Publishers that do not know their covariance leave it zero, or set its first entry to -1.
    untold = np.asarray((is_absent(planar) | (planar == 0.0)).all(axis=(1, 2)))
    untold |= (planar == np.diag([-1.0, 0.0, 0.0])).all(axis=(1, 2))
    finite = np.isfinite(planar).all(axis=(1, 2))
    sound = ~untold & is_positive_semidefinite(planar)
    tally.add("covariance not finite (left out)", int((~untold & ~finite).sum()))
    tally.add(
        "covariance not positive semi-definite (left out)", int((~untold & finite & ~sound).sum())
    )
    known = np.flatnonzero(sound)
    if not len(known):
        return None
    source = known[np.maximum(np.searchsorted(known, np.arange(len(rows)), side="right") - 1, 0)]
    result = planar[source]
    return np.asarray(0.5 * (result + np.swapaxes(result, 1, 2)))
