"""Measurements of several logs as those of one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mclass.errors import UsageError
from mclass.geometry import wrap_angle
from mclass.records import FloatArray, Frames, IntArray, LabelMeasurements


@dataclass(frozen=True)
class Part:
    """The measurements of one log.

    Attributes:
        measurements: In the log's own world.
        pose_world_log: The log's world in the common one: x [m], y [m], heading [rad], (3,).
        name: Put before object ids, with a slash; empty when equal ids mean the same object.
    """

    measurements: LabelMeasurements
    pose_world_log: FloatArray
    name: str = ""


def join(
    parts: Sequence[Part], label_names: Sequence[str], drift: float = 0.0
) -> LabelMeasurements:
    """All measurements in the common world, by increasing stamp.

    Beliefs over all of them are then those of one log that holds them all: priors count once,
    and what couples measurements (shared votes, silence) couples those of different logs too.

    Args:
        parts: At least one.
        label_names: The model's; labels are matched by name.
        drift: Rate at which poses become uncertain since the beginning of their own log
            [m/sqrt(s)]; added to their covariance.

    Raises:
        UsageError: If a label that was returned is not among ``label_names``.
    """
    ids = [_ids(part) for part in parts]
    object_ids = tuple(sorted({name for names in ids for name in names}))
    number = {name: index for index, name in enumerate(object_ids)}
    moved = [_moved(part, drift) for part in parts]
    stamps = np.concatenate([frames.stamps_ns for frames in moved])
    order = np.argsort(stamps, kind="stable")
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    starts = np.cumsum([0, *(len(frames) for frames in moved)])

    found = [part.measurements for part in parts]
    frame_index = np.concatenate(
        [
            place[measurements.frame_index + start]
            for measurements, start in zip(found, starts[:-1], strict=True)
        ]
    )
    rows = np.argsort(frame_index, kind="stable")
    counts = np.concatenate([np.diff(measurements.label_offsets) for measurements in found])
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    taken = _spans(offsets[rows], counts[rows])
    labels = np.concatenate([_renamed(measurements, label_names) for measurements in found])
    joined = LabelMeasurements(
        frames=_concatenated(moved, order),
        frame_index=frame_index[rows],
        directions=np.concatenate(
            [
                measurements.directions + part.pose_world_log[2]
                for measurements, part in zip(found, parts, strict=True)
            ]
        )[rows],
        object_index=np.concatenate(
            [
                np.array([*(number[name] for name in names), -1])[measurements.object_index]
                for measurements, names in zip(found, ids, strict=True)
            ]
        )[rows],
        object_ids=object_ids,
        label_offsets=np.concatenate([[0], np.cumsum(counts[rows])]).astype(np.int64),
        labels=labels[taken],
        scores=np.concatenate([measurements.scores for measurements in found])[taken],
        label_names=tuple(label_names),
    )
    return _with_labels_in_order(joined)


def _ids(part: Part) -> list[str]:
    prefix = f"{part.name}/" if part.name else ""
    return [f"{prefix}{name}" for name in part.measurements.object_ids]


def _moved(part: Part, drift: float) -> Frames:
    """Frames as seen in the common world."""
    frames, (x, y, turn) = part.measurements.frames, part.pose_world_log
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    poses = frames.poses_world_sensor
    covariances = frames.covariances
    if drift > 0.0 and len(frames):
        seconds = (frames.stamps_ns - frames.stamps_ns[0]) * 1e-9
        grown = (drift**2 * seconds)[:, None, None] * np.diag([1.0, 1.0, 0.0])
        covariances = grown if covariances is None else covariances + grown
    if covariances is not None:
        spin = np.eye(3)
        spin[:2, :2] = rotation
        covariances = spin @ covariances @ spin.T
    return replace(
        frames,
        poses_world_sensor=np.column_stack(
            [poses[:, :2] @ rotation.T + [x, y], wrap_angle(poses[:, 2] + turn)]
        ),
        covariances=covariances,
        view_directions=frames.view_directions + turn,
    )


def _concatenated(moved: Sequence[Frames], order: IntArray) -> Frames:
    covariances = None
    if any(frames.covariances is not None for frames in moved):
        every = [
            np.zeros((len(frames), 3, 3)) if frames.covariances is None else frames.covariances
            for frames in moved
        ]
        covariances = np.concatenate(every)[order]
    return Frames(
        stamps_ns=np.concatenate([frames.stamps_ns for frames in moved])[order],
        log_times_ns=np.concatenate([frames.log_times_ns for frames in moved])[order],
        poses_world_sensor=np.concatenate([f.poses_world_sensor for f in moved])[order],
        covariances=covariances,
        view_directions=np.concatenate([frames.view_directions for frames in moved])[order],
    )


def _renamed(measurements: LabelMeasurements, label_names: Sequence[str]) -> IntArray:
    """Labels as indices into other names."""
    number = {name: index for index, name in enumerate(label_names)}
    returned = [measurements.label_names[index] for index in np.unique(measurements.labels)]
    unknown = [name for name in returned if name not in number]
    if unknown:
        raise UsageError(
            f"the measurements hold labels that the model lacks: {', '.join(unknown)}. "
            f"It knows {', '.join(label_names)}"
        )
    table = [number.get(name, -1) for name in measurements.label_names]
    return np.array([*table, -1], dtype=np.int64)[measurements.labels]


def _spans(starts: IntArray, counts: IntArray) -> IntArray:
    """Indices of spans one after the other."""
    before = np.cumsum(counts) - counts
    return np.repeat(starts - before, counts) + np.arange(counts.sum())


def _with_labels_in_order(measurements: LabelMeasurements) -> LabelMeasurements:
    """Labels of each row increasing, as another model may number them differently."""
    owners = np.repeat(np.arange(len(measurements)), np.diff(measurements.label_offsets))
    order = np.lexsort([measurements.labels, owners])
    return replace(
        measurements, labels=measurements.labels[order], scores=measurements.scores[order]
    )
