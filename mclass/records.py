"""What crosses the log's border: columns of arrays, metres, radians, integer nanoseconds.

Everything above this line of the package (adapters, outputs) turns messages into
these columns or these columns into messages; everything below computes with them.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class PoseTrack:
    """Planar poses of one moving frame over time, in strictly increasing stamp order.

    Attributes:
        frame: Name of the world frame (``odom``, ``map``).
        child_frame: Name of the moving frame (``base_link``); empty if the log does not say.
        stamps_ns: Header stamps [ns], (n,).
        poses_world_child: x [m], y [m], heading [rad], (n, 3).
        covariances: Covariance of (x, y, heading) in the world frame, (n, 3, 3), or None.
    """

    frame: str
    child_frame: str
    stamps_ns: IntArray
    poses_world_child: FloatArray
    covariances: FloatArray | None = None


@dataclass(frozen=True)
class Frames:
    """Detector frames (one image, one instant), empty ones included, by increasing stamp.

    Attributes:
        stamps_ns: Header stamps [ns], (f,).
        log_times_ns: Log times of the messages that carried them [ns], (f,).
        poses_world_sensor: Ground-plane sensor position [m] and heading of its optical
            axis [rad], (f, 3).
        covariances: Covariance of those poses in the world frame, (f, 3, 3), or None.
        view_directions: World azimuths [rad] of the right and the left border of the
            field of view, counter-clockwise from right to left, (f, 2); NaN if unknown.
    """

    stamps_ns: IntArray
    log_times_ns: IntArray
    poses_world_sensor: FloatArray
    covariances: FloatArray | None
    view_directions: FloatArray

    def __len__(self) -> int:
        return len(self.stamps_ns)


@dataclass(frozen=True)
class LabelMeasurements:
    """Label sets, one row a detection: what was returned at one instant for one object.

    Rows are ordered by frame, then as in the message. Detections of one frame that share
    an object id are one row. Labels of row ``m`` are
    ``labels[label_offsets[m]:label_offsets[m + 1]]``, distinct and increasing.

    Attributes:
        frames: The frames that rows point into.
        frame_index: Row of ``frames``, (n,).
        directions: World azimuths [rad] of the right and left edge of the box, (n, 2),
            counter-clockwise from right to left; equal for a ray; NaN when the detection
            has no direction (it then says nothing about the grid).
        object_index: Index into ``object_ids``, -1 for a detection without id, (n,).
        object_ids: Ids as the detector gave them.
        label_offsets: (n + 1,).
        labels: Indices into ``label_names``, (k,).
        scores: Detector scores, 1 when it gives none, (k,).
        label_names: The model's label names.
    """

    frames: Frames
    frame_index: IntArray
    directions: FloatArray
    object_index: IntArray
    object_ids: tuple[str, ...]
    label_offsets: IntArray
    labels: IntArray
    scores: FloatArray
    label_names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.frame_index)

    @property
    def stamps_ns(self) -> IntArray:
        """Header stamp of every row [ns], (n,)."""
        return self.frames.stamps_ns[self.frame_index]

    @property
    def log_times_ns(self) -> IntArray:
        """Log time of every row [ns], (n,)."""
        return self.frames.log_times_ns[self.frame_index]

    def in_canonical_order(self) -> LabelMeasurements:
        """The same, in an order that depends on nothing but what the measurements say.

        Frames go by stamp, then by what else they hold; rows by frame, id, direction, labels and
        scores; ids by their text. Sums over rows then come out the same to the last bit however
        messages were ordered in a log, and detections in a message.
        """
        frames = self.frames
        values = [frames.poses_world_sensor, frames.view_directions, frames.log_times_ns[:, None]]
        if frames.covariances is not None:
            values.append(frames.covariances.reshape(len(frames), 9))
        columns = np.concatenate(values, axis=1).T
        frame_order = np.lexsort((*columns[::-1], frames.stamps_ns))
        ids = sorted(range(len(self.object_ids)), key=self.object_ids.__getitem__)
        frame_index = _ranks(frame_order)[self.frame_index]
        # One more for the rows without id, whose index is -1.
        object_index = np.append(_ranks(np.array(ids, dtype=np.int64)), -1)[self.object_index]
        keys = (self._label_ranks(), *self.directions.T, object_index, frame_index)
        order = np.lexsort(keys)
        if all(np.array_equal(o, np.arange(len(o))) for o in (frame_order, order, ids)):
            return self
        counts = np.diff(self.label_offsets)[order]
        offsets = np.concatenate([[0], np.cumsum(counts)])
        # The place of each label: its row's old start, and how far it stands behind it.
        taken = np.repeat(self.label_offsets[:-1][order] - offsets[:-1], counts)
        taken = taken + np.arange(len(taken))
        covariances = frames.covariances
        return LabelMeasurements(
            frames=Frames(
                frames.stamps_ns[frame_order],
                frames.log_times_ns[frame_order],
                frames.poses_world_sensor[frame_order],
                None if covariances is None else covariances[frame_order],
                frames.view_directions[frame_order],
            ),
            frame_index=frame_index[order],
            directions=self.directions[order],
            object_index=object_index[order],
            object_ids=tuple(self.object_ids[i] for i in ids),
            label_offsets=offsets,
            labels=self.labels[taken],
            scores=self.scores[taken],
            label_names=self.label_names,
        )

    def _label_ranks(self) -> IntArray:
        """A number for each row's labels and scores, equal ones alike, (n,)."""
        counts = np.diff(self.label_offsets)
        ranks = np.empty(len(counts), dtype=np.int64)
        before = 0
        for count in np.unique(counts).tolist():
            rows = np.flatnonzero(counts == count)
            places = self.label_offsets[:-1][rows, None] + np.arange(count)
            values = np.concatenate([self.labels[places], self.scores[places]], axis=1)
            order = np.lexsort(values.T) if count else np.arange(len(rows))
            is_new = np.append(False, (np.diff(values[order], axis=0) != 0).any(axis=1))
            ranks[rows[order]] = before + np.cumsum(is_new)
            before += 1 + int(is_new.sum())
        return ranks

    def label_names_of(self, row: int) -> tuple[str, ...]:
        """Names of the labels in one row."""
        span = self.labels[self.label_offsets[row] : self.label_offsets[row + 1]]
        return tuple(self.label_names[i] for i in span)


def _ranks(order: IntArray) -> IntArray:
    """Where each element stands in an order of all."""
    ranks = np.empty(len(order), dtype=np.int64)
    ranks[order] = np.arange(len(order))
    return ranks


@dataclass
class Tally:
    """Counts of what was left out, by reason. ``add`` ignores zero counts."""

    counts: dict[str, int] = field(default_factory=dict)

    def add(self, reason: str, count: int = 1) -> None:
        """Count ``count`` more under ``reason``."""
        if count:
            self.counts[reason] = self.counts.get(reason, 0) + int(count)

    @property
    def total(self) -> int:
        """Sum over all reasons."""
        return sum(self.counts.values())
