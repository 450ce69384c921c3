"""Which looks concern which cells, and how much each counts.

A look is a detection, or the frame it was taken in. In the paper's filter only detections
speak, each in full. Where labels are probabilities, every frame in which a cell was in view
speaks as well (it adds the silence term), detections add the odds of their labels, and looks
from one place share one vote.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mclass.correlation import shared_votes
from mclass.footprint import Pointing, Sight, sight
from mclass.geometry import wrap_angle
from mclass.model import InferenceSettings
from mclass.pairs import Pairs
from mclass.records import BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class Looks:
    """All looks of a log: its n detections, then its f frames.

    Attributes:
        pointing: Where each was taken from; a frame's directions are its field of view,
            NaN where silence is no evidence, (n + f,).
        frames: Number of the frame of each look, (n + f,).
        stamps_ns: (n + f,).
        n_detections: n.
        settings: How evidence is weighed.
        covariances: Of the sensor's pose in the world, (n + f, 3, 3), or None.
    """

    pointing: Pointing
    frames: IntArray
    stamps_ns: IntArray
    n_detections: int
    settings: InferenceSettings
    covariances: FloatArray | None = None

    @property
    def n_frames(self) -> int:
        """F."""
        return len(self.frames) - self.n_detections

    def frame_looks(self, frames: IntArray) -> IntArray:
        """The looks that are these frames."""
        return frames + self.n_detections

    def in_view(self, seen: Sight, looks: IntArray) -> BoolArray:
        """Whether frames had cells in view, a margin inside their border, (m, k)."""
        pointing = self.pointing.select(looks)
        cell, look = np.nonzero(seen.inside)
        ratio = self.settings.view_margin / np.maximum(seen.ranges[cell, look], 1e-9)
        angles = off_axis(seen.directions[cell, look], pointing.axes[look])
        clear = angles <= pointing.widths[look] / 2.0 - np.arcsin(np.minimum(ratio, 1.0))
        shown = np.zeros(seen.inside.shape, dtype=bool)
        shown[cell[clear], look[clear]] = True
        return shown


def off_axis(directions: FloatArray, axes: FloatArray) -> FloatArray:
    """Angle between the direction to a cell and an axis, given the direction back [rad]."""
    return np.abs(wrap_angle(directions + np.pi - axes))


def grid_pairs(looks: Looks, centers: FloatArray, cell_size: float, candidates: IntArray) -> Pairs:
    """Looks at cells of the grid, those of one cell in a fixed order.

    Args:
        looks: All looks.
        centers: Cell centres [m], (m, 2).
        cell_size: Edge length [m].
        candidates: Looks that may concern these cells, increasing.
    """
    detections = candidates[candidates < looks.n_detections]
    seen = sight(centers, cell_size, looks.pointing, detections)
    if not looks.settings.probabilities:
        return joined_pairs([seen], [detections], [seen.inside], None)
    frames, column = np.unique(looks.frames[candidates], return_inverse=True)
    frame_looks = looks.frame_looks(frames)
    frame_seen = sight(centers, cell_size, looks.pointing, frame_looks)
    looked = (
        looks.in_view(frame_seen, frame_looks)
        if looks.settings.silence
        else (np.zeros(frame_seen.inside.shape, dtype=bool))
    )
    looked |= _any_by_column(seen.inside, column[: len(detections)], len(frames))
    weights = _weights(looks.settings, frame_seen, looked)
    scale = [weights[:, column[: len(detections)]], weights]
    return joined_pairs([seen, frame_seen], [detections, frame_looks], [seen.inside, looked], scale)


def _any_by_column(mask: BoolArray, columns: IntArray, count: int) -> BoolArray:
    """Whether any entry of a row falls into each column, (m, k) to (m, count)."""
    totals = np.zeros((len(mask), count), dtype=np.int64)
    np.add.at(totals.T, columns, mask.T.astype(np.int64))
    return totals > 0


def _weights(settings: InferenceSettings, seen: Sight, looked: BoolArray) -> FloatArray:
    """Weight of every frame at every cell, 0 where the cell was not looked at, (m, k)."""
    if settings.correlation is None:
        return looked.astype(float)
    return shared_votes(looked, seen.ranges, seen.directions, *settings.correlation)


def joined_pairs(
    seen: list[Sight],
    looks: list[IntArray],
    masks: list[BoolArray],
    scales: list[FloatArray] | None,
) -> Pairs:
    """Pairs of cells and looks where the masks hold, cell by cell."""
    mask = np.concatenate(masks, axis=1)
    # Found and taken as if in one row: several times faster than in two dimensions.
    flat = np.flatnonzero(mask)
    before = np.arange(len(mask) + 1) * mask.shape[1]
    starts = np.searchsorted(flat, before)

    def taken(parts: list[FloatArray]) -> FloatArray:
        joined = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
        return joined.ravel().take(flat)

    return Pairs(
        starts=starts,
        looks=np.concatenate(looks).take(flat - np.repeat(before[:-1], np.diff(starts))),
        ranges=taken([part.ranges for part in seen]),
        directions=taken([part.directions for part in seen]),
        scale=None if scales is None else taken(scales),
    )


@dataclass(frozen=True)
class ObjectLooks:
    """The looks at one object in the order of time, grouped into steps.

    A step is one detection of the object, together with the frames since the detection before;
    frames after the last detection belong to the last step. Where silence is no evidence
    there are no frames.

    Attributes:
        looks: All looks of the log.
        rows: Those that concern the object, by frame, a detection before its frame, (l,).
        steps: Step of each, not decreasing, (l,).
        silent: Frames in which the object was not detected, (l,).
        rivals: Detections of anything else, by frame: where they point the object may be
            hidden, or be what was detected, (r,).
        shares: How much of each look belongs to the object, (l,).
        known: The object's position is known: its detections are of it wherever they point.
    """

    looks: Looks
    rows: IntArray
    steps: IntArray
    silent: BoolArray
    rivals: IntArray
    shares: FloatArray
    known: bool = False

    @property
    def n_steps(self) -> int:
        """Number of detections of the object."""
        return int(self.steps[-1]) + 1

    def near(self, centers: FloatArray) -> ObjectLooks:
        """Without frames from which none of the cells could be seen; (m, 2) centres [m]."""
        pointing = self.looks.pointing.select(self.rows)
        low, high = centers.min(axis=0), centers.max(axis=0)
        beside = np.maximum(np.maximum(low - pointing.positions, pointing.positions - high), 0.0)
        kept = ~self.silent | (np.hypot(*beside.T) <= pointing.max_range)
        return replace(
            self,
            rows=self.rows[kept],
            steps=self.steps[kept],
            silent=self.silent[kept],
            shares=self.shares[kept],
        )

    def concern(self, centers: FloatArray, cell_size: float, part: slice) -> Concern:
        """How some of the looks concern some cells.

        Args:
            centers: Cell centres [m], (m, 2).
            cell_size: Edge length [m].
            part: Positions in ``rows``.
        """
        rows = self.rows[part]
        pointing = self.looks.pointing.select(rows)
        seen = sight(centers, cell_size, pointing)
        is_detection = rows < self.looks.n_detections
        located = is_detection & np.isfinite(pointing.directions).all(axis=1)
        speaks = np.ones(seen.inside.shape, dtype=bool)
        silent = np.flatnonzero(self.silent[part])
        if len(silent):
            speaks[:, silent] = self._could_show(seen.select_looks(silent), rows[silent])
        log_factor = np.zeros(seen.inside.shape)
        pointed = np.flatnonzero(located)
        log_factor[:, pointed] = self._log_factor(seen.select_looks(pointed), rows[pointed])
        belongs = np.ones(seen.inside.shape)
        if self.looks.settings.probabilities and not self.known and len(pointed):
            floor = self.looks.settings.log_outside
            own = np.expm1(floor - log_factor[:, pointed]) / np.expm1(floor)
            belongs[:, pointed] = own
            if not is_detection.all():
                # Its frame, which is the next look, may have shown the object without a label.
                told = pointed + 1
                shown = self._could_show(seen.select_looks(told), rows[told])
                belongs[:, told] = np.where(shown, 1.0, own)
        return Concern(seen, speaks, is_detection, located, log_factor, belongs)

    def pairs(self, centers: FloatArray, cell_size: float) -> Pairs:
        """All looks at cells where the object is taken to be, weighed; (m, 2) centres [m]."""
        concern = self.concern(centers, cell_size, slice(0, len(self.rows)))
        frames = ~concern.is_detection
        scale = None
        if self.looks.settings.probabilities:
            weights = _weights(
                self.looks.settings,
                concern.seen.select_looks(np.flatnonzero(frames)),
                concern.speaks[:, frames],
            )
            column = np.searchsorted(
                self.looks.frames[self.rows[frames]], self.looks.frames[self.rows]
            )
            scale = [weights[:, column] * self.shares * concern.belongs]
        masks = [concern.speaks & (concern.belongs > 0.0)]
        return joined_pairs([concern.seen], [self.rows], masks, scale)

    def _log_factor(self, seen: Sight, rows: IntArray) -> FloatArray:
        """What it costs cells that detections point elsewhere, (m, k)."""
        settings, pointing = self.looks.settings, self.looks.pointing.select(rows)
        log_factor = np.where(seen.inside, 0.0, settings.log_outside)
        variance = self._direction_variance(seen, rows)
        if np.any(variance > 0.0):
            excess = off_axis(seen.directions, pointing.axes) - pointing.widths / 2.0
            soft = np.maximum(-0.5 * excess**2 / variance, settings.log_outside)
            in_range = (seen.ranges >= pointing.min_range) & (seen.ranges <= pointing.max_range)
            log_factor = np.where(~seen.inside & in_range, soft, log_factor)
        return log_factor

    def _direction_variance(self, seen: Sight, rows: IntArray) -> FloatArray:
        """Variance of the direction to each cell [rad²], (m, k): box edges, heading, position."""
        variance = np.full(seen.ranges.shape, self.looks.settings.pointing_std**2)
        if self.looks.covariances is not None:
            covariances = self.looks.covariances[rows]
            sine, cosine = np.sin(seen.directions), np.cos(seen.directions)
            across = (
                sine**2 * covariances[:, 0, 0]
                - 2.0 * sine * cosine * covariances[:, 0, 1]
                + cosine**2 * covariances[:, 1, 1]
            )
            variance += covariances[:, 2, 2] + across / np.maximum(seen.ranges, 1e-9) ** 2
        return variance

    def _could_show(self, seen: Sight, rows: IntArray) -> BoolArray:
        """Cells in view of frames and not where something else was detected, (m, k)."""
        shown = self.looks.in_view(seen, rows)
        frames = self.looks.frames[rows]
        rivals = self.rivals[np.isin(self.looks.frames[self.rivals], frames)]
        if len(rivals):
            rival = self.looks.pointing.select(rivals)
            column = np.searchsorted(frames, self.looks.frames[rivals])
            covered = off_axis(seen.directions[:, column], rival.axes) <= rival.widths / 2.0
            shown &= ~_any_by_column(np.asarray(covered), column, len(frames))
        return shown


@dataclass(frozen=True)
class Concern:
    """How looks concern cells, (m, l); ``is_detection`` and ``located`` are (l,).

    Attributes:
        seen: Ranges, directions and footprints.
        speaks: Whether the look says anything about the cell.
        is_detection: Detections, not frames.
        located: Detections that point somewhere.
        log_factor: What it costs a cell that a detection points elsewhere.
        belongs: How likely each look is of what stands in the cell: a detection that points
            elsewhere is of something else, and its labels say nothing about this cell.
    """

    seen: Sight
    speaks: BoolArray
    is_detection: BoolArray
    located: BoolArray
    log_factor: FloatArray
    belongs: FloatArray


def object_looks(
    looks: Looks,
    detections: IntArray,
    shares: FloatArray | None = None,
    *,
    silence: bool = True,
    known: bool = False,
) -> ObjectLooks:
    """The looks at an object.

    Args:
        looks: All looks.
        detections: Those of the object by frame, at most one a frame.
        shares: How much of each belongs to it, (k,); all when None.
        silence: Take in the frames too, where silence is evidence.
        known: The object's position is known.
    """
    shares = np.ones(len(detections)) if shares is None else shares
    frames = np.zeros(0, dtype=np.int64)
    own = looks.frames[detections]
    if looks.settings.probabilities and silence:
        frames = np.arange(looks.n_frames) if looks.settings.silence else np.unique(own)
    rows = np.concatenate([detections, looks.frame_looks(frames)])
    order = np.argsort(looks.frames[rows], kind="stable")
    rows = rows[order]
    steps = np.searchsorted(own, looks.frames[rows])
    return ObjectLooks(
        looks=looks,
        rows=rows,
        steps=np.minimum(steps, len(detections) - 1),
        silent=(rows >= looks.n_detections) & ~np.isin(looks.frames[rows], own),
        rivals=np.setdiff1d(np.arange(looks.n_detections), detections),
        shares=np.concatenate([shares, np.ones(len(frames))])[order],
        known=known,
    )
