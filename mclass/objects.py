"""One object's belief over class, orientation and position, after each of its measurements.

Joint over cells (paper eqs. 20 to 24, assuming one object): every measurement of the object
is evaluated in every candidate cell. A cell that a measurement does not point at pays the
outside probability instead of being ruled out, and stays a candidate as long as at least
half as many measurements point at it as at the cell most pointed at.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from mclass.belief import log_orientation_density
from mclass.correlation import shared_votes
from mclass.evidence import Engine, Evidence
from mclass.footprint import Grid, Pointing, sight, tiles
from mclass.logarithms import logsumexp
from mclass.looks import Concern, ObjectLooks
from mclass.orientation import log_mean_exp, peaks
from mclass.pairs import Pairs
from mclass.records import BoolArray, FloatArray, IntArray
from mclass.results import BeliefBlock, ObjectEstimate
from mclass.summary import NEGLIGIBLE, Readout

_STEPS_AT_ONCE = 64
_SIGHTS_AT_ONCE = 2**18
"""Cells times looks; a dozen numbers are known of each."""

_WEIGHTS_AT_ONCE = 2**22
"""Cells times looks whose weights are remembered: what lies beyond takes another count."""

_NUMBERS_AT_ONCE = 2**20
"""Of the beliefs after each step of a block, unless one step has more."""

FILTER_BYTES = 4 * _WEIGHTS_AT_ONCE + 8 * 4 * _NUMBERS_AT_ONCE
"""What an `ObjectFilter` holds, about, besides a few copies of its belief."""


@dataclass(frozen=True)
class Candidates:
    """Cells where an object may be.

    Attributes:
        grid: Their geometry.
        cells: Flat indices, (k,).
        known: Whether there is but one cell, at the known position.
    """

    grid: Grid
    cells: IntArray
    known: bool

    def select(self, rows: IntArray) -> Candidates:
        """Only some of the cells."""
        return replace(self, cells=self.cells[rows])

    @property
    def centers(self) -> FloatArray:
        """Cell centres [m], (k, 2)."""
        return self.grid.centers(self.cells)


def known_position(position: tuple[float, float], cell_size: float) -> Candidates:
    """The single cell centred on a known position [m]."""
    corner = (position[0] - cell_size / 2.0, position[1] - cell_size / 2.0)
    return Candidates(Grid(corner, cell_size, 1, 1), np.zeros(1, dtype=np.int64), known=True)


def pointed_cells(grid: Grid, pointing: Pointing, rows: IntArray) -> Candidates | None:
    """All cells that at least one of the detections points at; None if there is none."""
    pointing = pointing.select(rows)
    touched = []
    for tile in tiles(grid, pointing):
        for part in tile.parts(_SIGHTS_AT_ONCE):
            seen = sight(grid.centers(part.cells), grid.cell_size, pointing.select(part.rows))
            touched.append(part.cells[seen.inside.any(axis=1)])
    cells = np.sort(np.concatenate(touched)) if touched else np.zeros(0, dtype=np.int64)
    return Candidates(grid, cells, known=False) if len(cells) else None


class ObjectFilter:
    """Follows one object through its detections.

    Args:
        engine: Sums evidence.
        looks: The looks at the object.
        candidates: Where it may be.
        log_priors: Background first, (1 + n,).
    """

    def __init__(
        self, engine: Engine, looks: ObjectLooks, candidates: Candidates, log_priors: FloatArray
    ) -> None:
        self.engine = engine
        self.log_priors = log_priors
        last_step = _last_steps(looks, candidates)
        kept = np.flatnonzero(last_step >= 0)
        self.candidates, self._last_step = candidates.select(kept), last_step[kept]
        self.looks = looks.near(self.candidates.centers)
        shape = (len(kept), engine.n_classes, engine.bins)
        self._total = Evidence(np.zeros(shape), np.zeros(len(kept)), np.zeros(len(kept), np.int64))
        self._hits = np.zeros(len(kept), dtype=np.int64)
        self._log_outer = np.zeros(len(kept))
        self._weights = np.empty((len(kept), 0), dtype=np.float32)
        self._weighed = slice(0, 0)

    def steps(self) -> Iterator[Readout]:
        """The belief after each detection.

        Cells are let go after the last detection at which they are candidates.
        """
        start = 0
        while start < len(self.looks.rows):
            first = int(self.looks.steps[start])
            self._keep(self._last_step >= first)
            numbers = len(self.candidates.cells) * self.engine.n_classes * self.engine.bins
            most = np.clip(_NUMBERS_AT_ONCE // numbers, 1, _STEPS_AT_ONCE)
            stop = self._stop(start, int(np.searchsorted(self.looks.steps, first + most)))
            yield from self._block(slice(start, stop))
            start = stop

    def finish(self) -> Readout:
        """The belief after the last detection: what `steps` ends with, in a fraction of the time.

        Only cells that are candidates in the end are looked at.
        """
        self._keep(self._last_step == self.looks.n_steps - 1)
        every = np.arange(len(self.candidates.cells))
        start = 0
        while start < len(self.looks.rows):
            stop = self._stop(start, len(self.looks.rows))
            part = slice(start, stop)
            concern = self._concern(part)
            scale = self._scale(concern, part)
            whole = np.zeros(stop - start, dtype=np.int64)
            self._add(every, self._evidence(concern, scale, every, whole, part))
            self._hits += self._pointed_at(concern).sum(axis=1)
            self._log_outer += self._log_factor(concern, scale).sum(axis=1)
            start = stop
        outer = self.log_priors + self._log_outer[:, None]
        log_joint = np.concatenate(
            [self._total.background[:, None], log_mean_exp(self._total.classes)], axis=1
        )
        return Readout(
            self._total.classes, outer[:, 1:], log_joint + outer, self.candidates.centers
        )

    def _stop(self, start: int, most: int) -> int:
        """Where a block ends that begins with a look, before another one at the latest."""
        looks = self.looks
        stop = min(most, start + max(2, _SIGHTS_AT_ONCE // len(self.candidates.cells)))
        if stop < len(looks.rows):
            # A detection and its frame, which is the next look, stay together.
            before, after = looks.looks.frames[looks.rows[stop - 1 : stop + 1]]
            stop += int(before == after)
        return stop

    def _keep(self, mask: BoolArray) -> None:
        """Go on with some of the cells only."""
        if mask.all():
            return
        cells = np.flatnonzero(mask)
        self.candidates, self._total = self.candidates.select(cells), self._total.select(cells)
        self._hits, self._log_outer = self._hits[cells], self._log_outer[cells]
        self._last_step, self._weights = self._last_step[cells], self._weights[cells]

    def _concern(self, part: slice) -> Concern:
        return self.looks.concern(self.candidates.centers, self.candidates.grid.cell_size, part)

    def _pointed_at(self, concern: Concern) -> BoolArray:
        """Whether each look is a detection that points at each cell, (k, l)."""
        if self.candidates.known:
            return np.broadcast_to(concern.is_detection, concern.speaks.shape)
        return concern.seen.inside & concern.located

    def _log_factor(self, concern: Concern, scale: FloatArray | None) -> FloatArray:
        """What it costs each cell that looks point elsewhere, (k, l)."""
        if self.candidates.known:
            return np.zeros(concern.log_factor.shape)
        return concern.log_factor if scale is None else concern.log_factor * scale

    def _scale(self, concern: Concern, part: slice) -> FloatArray | None:
        """Weight of every look at every cell, (k, l); None for one each."""
        settings, shares = self.looks.looks.settings, self.looks.shares[part]
        if settings.correlation is None or not settings.probabilities:
            whole = bool((shares == 1.0).all() and (concern.belongs == 1.0).all())
            return None if whole else np.broadcast_to(shares, concern.speaks.shape)
        if part.stop > self._weighed.stop:
            self._weigh(part)
        first = self._weighed.start
        return np.asarray(self._weights[:, part.start - first : part.stop - first] * shares)

    def _weigh(self, part: slice) -> None:
        """Find the weights of looks from those of a block on, as many as there is room for."""
        looks, count = self.looks, len(self.candidates.cells)
        widths = looks.looks.settings.correlation
        assert widths is not None
        stop = min(max(part.stop, part.start + _WEIGHTS_AT_ONCE // count), len(looks.rows))
        self._weighed = slice(part.start, stop)
        self._weights = np.empty((count, stop - part.start), dtype=np.float32)
        most = max(1, _SIGHTS_AT_ONCE // len(looks.rows))
        for first in range(0, count, most):
            some = slice(first, first + most)
            centers = self.candidates.centers[some]
            concern = looks.concern(
                centers, self.candidates.grid.cell_size, slice(0, len(looks.rows))
            )
            weights = shared_votes(
                concern.speaks & ~concern.is_detection,
                concern.seen.ranges,
                concern.seen.directions,
                *widths,
            )
            # A detection has the weight of its frame, which is the next look.
            detections = np.flatnonzero(concern.is_detection)
            weights[:, detections] = weights[:, detections + 1]
            self._weights[some] = weights[:, self._weighed]

    def _block(self, part: slice) -> Iterator[Readout]:
        """Take in some looks; the belief after each step that ends with them."""
        concern = self._concern(part)
        scale = self._scale(concern, part)
        number = self.looks.steps[part]
        steps = number - number[0]
        first = np.flatnonzero(np.diff(steps, prepend=-1))
        # The last step may go on in the next block.
        n_ended = len(first) - int(
            (self.looks.steps[part.stop : part.stop + 1] == number[-1]).sum()
        )
        pointed = np.add.reduceat(self._pointed_at(concern), first, axis=1, dtype=np.int64)
        hits = self._hits[:, None] + np.cumsum(pointed, axis=1)
        factor = np.add.reduceat(self._log_factor(concern, scale), first, axis=1)
        log_outer = self._log_outer[:, None] + np.cumsum(factor, axis=1)
        self._hits, self._log_outer = hits[:, -1], log_outer[:, -1]
        candidate = _is_candidate(hits)[:, :n_ended]
        now = candidate.any(axis=1)
        active, waiting = np.flatnonzero(now), np.flatnonzero(~now)
        self._add(waiting, self._evidence(concern, scale, waiting, np.zeros_like(steps), part))
        if not n_ended:
            return
        each = self._evidence(concern, scale, active, steps, part)
        classes, background = self._running(active, each)
        log_outer = np.where(candidate, log_outer[:, :n_ended], -np.inf)[active]
        matters = self._matters(classes[:, :n_ended], background[:, :n_ended], log_outer)
        step, cell = np.nonzero(matters.T)
        kept = classes[cell, step]
        outer = self.log_priors + log_outer[cell, step, None]
        log_joint = np.concatenate([background[cell, step, None], log_mean_exp(kept)], axis=1)
        log_joint += outer
        centers = self.candidates.centers[active[cell]]
        for begin, end in pairwise(np.searchsorted(step, np.arange(n_ended + 1)).tolist()):
            own = slice(begin, end)
            yield Readout(kept[own], outer[own, 1:], log_joint[own], centers[own])

    def _running(self, cells: IntArray, each: Evidence) -> tuple[FloatArray, FloatArray]:
        """Add evidence of some cells' steps; their totals after each step, (k, steps, ...)."""
        total = self._total
        shape = (len(cells), -1)
        classes = each.classes.reshape(*shape, *each.classes.shape[1:])
        background = each.background.reshape(shape)
        classes[:, 0] += total.classes[cells]
        background[:, 0] += total.background[cells]
        # In place: a cumulative sum along this axis takes many times as long.
        for step in range(1, classes.shape[1]):
            classes[:, step] += classes[:, step - 1]
            background[:, step] += background[:, step - 1]
        total.classes[cells], total.background[cells] = classes[:, -1], background[:, -1]
        return classes, background

    def _add(self, cells: IntArray, evidence: Evidence) -> None:
        """Add evidence of some cells."""
        self._total.classes[cells] += evidence.classes
        self._total.background[cells] += evidence.background

    def _evidence(
        self,
        concern: Concern,
        scale: FloatArray | None,
        cells: IntArray,
        steps: IntArray,
        part: slice,
    ) -> Evidence:
        """Evidence of some cells, a row for each cell and each of the (consecutive) steps."""
        n_steps = int(steps[-1]) + 1
        cell, column = np.nonzero((concern.speaks & (concern.belongs > 0.0))[cells])
        owner = cell * n_steps + steps[column]
        at = cells[cell]
        pairs = Pairs(
            starts=np.searchsorted(owner, np.arange(len(cells) * n_steps + 1)),
            looks=self.looks.rows[part][column],
            ranges=concern.seen.ranges[at, column],
            directions=concern.seen.directions[at, column],
            scale=None if scale is None else scale[at, column] * concern.belongs[at, column],
        )
        exact = self.candidates.known
        return self.engine.exact_evidence(pairs) if exact else self.engine.evidence(pairs)

    def _matters(
        self, classes: FloatArray, background: FloatArray, log_outer: FloatArray
    ) -> BoolArray:
        """Cells not negligible for what they say of some class or of none, (k, ...)."""
        highest, _ = peaks(classes)
        mass = np.concatenate([background[..., None], highest], axis=-1)
        mass += self.log_priors + log_outer[..., None]
        best = mass.max(axis=-1)
        # The best one matters even if nothing explains what was measured.
        matters = (mass > mass.max(axis=0) - NEGLIGIBLE).any(axis=-1) | (best == best.max(axis=0))
        return np.asarray(matters)

    @property
    def log_evidence(self) -> float:
        """Log probability of all measurements so far, up to a constant of the looks alone."""
        _, _, log_joint = self._joint()
        return float(logsumexp(log_joint))

    def _joint(self) -> tuple[IntArray, FloatArray, FloatArray]:
        """Cells that matter, their log likelihoods and log joint, background first."""
        log_outer = np.where(_is_candidate(self._hits), self._log_outer, -np.inf)
        kept = np.flatnonzero(self._matters(self._total.classes, self._total.background, log_outer))
        classes = self._total.classes[kept]
        log_joint = np.concatenate(
            [self._total.background[kept, None], log_mean_exp(classes)], axis=1
        )
        return kept, classes, log_joint + self.log_priors + self._log_outer[kept, None]

    def belief(self, last: ObjectEstimate) -> BeliefBlock:
        """The full belief after the last measurement, cells of negligible mass left out."""
        kept, classes, log_joint = self._joint()
        log_cell = logsumexp(log_joint, axis=1)
        return BeliefBlock(
            object_id=last.object_id,
            grid=self.candidates.grid,
            stamp_ns=last.stamp_ns,
            log_time_ns=last.log_time_ns,
            block=0,
            blocks=1,
            cells=self.candidates.cells[kept],
            log_cell_mass=log_cell - logsumexp(log_cell),
            log_class_probability=log_joint - log_cell[:, None],
            log_density=log_orientation_density(classes, self.engine.shown_bins).astype(np.float32),
            measurements=np.full(len(kept), last.measurements, dtype=np.int64),
        )


def _last_steps(looks: ObjectLooks, candidates: Candidates) -> IntArray:
    """The last step, that is detection, at which each cell is a candidate, -1 for none, (k,)."""
    count = len(candidates.cells)
    if candidates.known:
        return np.full(count, looks.n_steps - 1)
    detections = looks.rows[looks.rows < looks.looks.n_detections]
    last, hits = np.full(count, -1, dtype=np.int64), np.zeros(count, dtype=np.int64)
    most = max(1, _SIGHTS_AT_ONCE // count)
    for start in range(0, len(detections), most):
        pointing = looks.looks.pointing.select(detections[start : start + most])
        seen = sight(candidates.centers, candidates.grid.cell_size, pointing)
        totals = hits[:, None] + np.cumsum(seen.inside, axis=1)
        candidate = _is_candidate(totals)
        latest = start + candidate.shape[1] - 1 - np.argmax(candidate[:, ::-1], axis=1)
        last = np.where(candidate.any(axis=1), latest, last)
        hits = totals[:, -1]
    return last


def _is_candidate(hits: IntArray) -> BoolArray:
    """Cells that at least half as many measurements point at as at the best, same shape."""
    return np.asarray(2 * hits >= hits.max(axis=0))
