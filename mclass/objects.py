"""One object's belief over class, orientation and position, after each of its measurements.

Joint over cells (paper eqs. 20 to 24, assuming one object): every measurement of the object
is evaluated in every candidate cell. A cell that a measurement does not point at pays the
outside probability instead of being ruled out, and stays a candidate as long as at least
half as many measurements point at it as at the cell most pointed at.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from mclass.belief import log_orientation_density
from mclass.correlation import LookLattice
from mclass.evidence import Engine, Evidence, Pairs
from mclass.footprint import Grid, Pointing, sight, tiles
from mclass.logarithms import logsumexp
from mclass.looks import Concern, ObjectLooks
from mclass.orientation import log_mean_exp
from mclass.records import BoolArray, FloatArray, IntArray
from mclass.results import BeliefBlock, ObjectEstimate
from mclass.summary import NEGLIGIBLE, Readout

_SHORTEST_BLOCK = 4
_LONGEST_BLOCK = 64
_STEPS_AT_ONCE = 64
_SIGHTS_AT_ONCE = 2**19
"""Cells times looks; a dozen numbers are known of each."""

_NUMBERS_AT_ONCE = 2**21
"""Of the beliefs after each step of a block, unless it would be too short to be fast."""


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
        seen = sight(grid.centers(tile.cells), grid.cell_size, pointing.select(tile.rows))
        touched.append(tile.cells[seen.inside.any(axis=1)])
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
        self.looks = looks.near(candidates.centers)
        self.candidates = candidates
        self.log_priors = log_priors
        count = len(candidates.cells)
        shape = (count, engine.n_classes, engine.bins)
        self._total = Evidence(np.zeros(shape), np.zeros(count), np.zeros(count, dtype=np.int64))
        self._hits = np.zeros(count, dtype=np.int64)
        self._log_outer = np.zeros(count)
        self._lattice_cells = np.arange(count)
        self._lattice: LookLattice | None = None

    def steps(self) -> Iterator[Readout]:
        """The belief after each detection.

        Cells are let go after the last detection at which they are candidates.
        """
        last_candidate = self._survey()
        width = self.engine.n_classes * self.engine.bins
        start = 0
        while start < self.looks.n_steps:
            kept = last_candidate >= start
            if not kept.all():
                self._keep(np.flatnonzero(kept))
                last_candidate = last_candidate[kept]
            # The belief narrows fast at first: short blocks let cells go early.
            longest = np.clip(
                _NUMBERS_AT_ONCE // kept.sum() // width, _SHORTEST_BLOCK, _LONGEST_BLOCK
            )
            stop = self._stop(start, int(np.clip(start, _SHORTEST_BLOCK, longest)))
            yield from self._block(start, stop)
            start = stop

    def _stop(self, start: int, most: int) -> int:
        """The step before which a block ends that begins with a step, of so many steps at most."""
        most_rows = _SIGHTS_AT_ONCE // len(self.candidates.cells)
        return min(start + most, self.looks.n_steps, self.looks.stop_after(start, most_rows))

    def finish(self) -> Readout:
        """The belief after the last detection: what `steps` ends with, in a fraction of the time.

        Only cells that are candidates in the end are looked at.
        """
        looks, known = self.looks, self.candidates.known
        if not known:
            detections = looks.rows[looks.rows < looks.looks.n_detections]
            pointing = looks.looks.pointing.select(detections)
            seen = sight(self.candidates.centers, self.candidates.grid.cell_size, pointing)
            self._keep(np.flatnonzero(_is_candidate(seen.inside.sum(axis=1))))
        self._survey()
        part = slice(0, len(looks.rows))
        concern = self._concern(part)
        scale = self._scale(concern, looks.shares)
        every = np.arange(len(self.candidates.cells))
        whole = np.zeros(len(looks.rows), dtype=np.int64)
        self._total = self._evidence(concern, scale, every, whole, part)
        self._hits = self._new_hits(concern).sum(axis=1)
        if not known:
            factor = concern.log_factor if scale is None else concern.log_factor * scale
            self._log_outer = factor.sum(axis=1)
        outer = self.log_priors + self._log_outer[:, None]
        log_joint = np.concatenate(
            [self._total.background[:, None], log_mean_exp(self._total.classes)], axis=1
        )
        return Readout(
            self._total.classes, outer[:, 1:], log_joint + outer, self.candidates.centers
        )

    def _survey(self) -> IntArray:
        """Count the looks around each viewpoint; return each cell's last step as a candidate."""
        settings = self.looks.looks.settings
        if settings.correlation is not None:
            centers = self.candidates.centers
            pointing = self.looks.looks.pointing
            # A frame without a detection speaks of what is in view alone.
            positions = pointing.positions[self.looks.rows[~self.looks.silent]]
            farthest = np.hypot(
                *np.maximum(
                    np.abs(positions.max(axis=0) - centers.min(axis=0)),
                    np.abs(centers.max(axis=0) - positions.min(axis=0)),
                )
            )
            reach = max(float(farthest), pointing.max_range)
            self._lattice = LookLattice(len(centers), reach, *settings.correlation)
            self._lattice_cells = np.arange(len(centers))
        last = np.full(len(self.candidates.cells), -1, dtype=np.int64)
        hits = self._hits
        start = 0
        while start < self.looks.n_steps:
            stop = self._stop(start, _STEPS_AT_ONCE)
            part = self.looks.within(start, stop)
            concern = self._concern(part)
            totals = hits[:, None] + np.cumsum(self._new_hits(concern), axis=1)
            candidate = _is_candidate(totals)
            latest = stop - start - 1 - np.argmax(candidate[:, ::-1], axis=1)
            last = np.where(candidate.any(axis=1), start + latest, last)
            hits = totals[:, -1]
            if self._lattice is not None:
                cell, column = np.nonzero(concern.speaks & ~concern.is_detection)
                self._lattice.deposit(
                    cell, concern.seen.ranges[cell, column], concern.seen.directions[cell, column]
                )
            start = stop
        return last

    def _keep(self, cells: IntArray) -> None:
        """Go on with some of the cells only."""
        self.candidates = replace(self.candidates, cells=self.candidates.cells[cells])
        self._total = self._total.select(cells)
        self._hits, self._log_outer = self._hits[cells], self._log_outer[cells]
        self._lattice_cells = self._lattice_cells[cells]

    def _concern(self, part: slice) -> Concern:
        return self.looks.concern(self.candidates.centers, self.candidates.grid.cell_size, part)

    def _new_hits(self, concern: Concern) -> IntArray:
        """Whether each detection points at each cell; all do at a known position, (k, steps)."""
        columns = np.flatnonzero(concern.is_detection)
        if self.candidates.known:
            return np.ones((len(concern.speaks), len(columns)), dtype=np.int64)
        located = concern.seen.inside[:, columns] & concern.located[columns]
        return located.astype(np.int64)

    def _scale(self, concern: Concern, shares: FloatArray) -> FloatArray | None:
        """Weight of every look at every cell, (k, l); None for one each."""
        if self._lattice is None:
            whole = bool((shares == 1.0).all() and (concern.belongs == 1.0).all())
            return None if whole else np.broadcast_to(shares, concern.speaks.shape)
        # Looks that neither speak of a cell nor point away from it need no weight.
        needed = (concern.speaks & (concern.belongs > 0.0)) | (concern.log_factor < 0.0)
        cell, _ = np.nonzero(needed)
        weights = np.zeros(needed.shape)
        weights[needed] = self._lattice.weights(
            self._lattice_cells[cell], concern.seen.ranges[needed], concern.seen.directions[needed]
        )
        return np.asarray(weights * shares)

    def _block(self, start: int, stop: int) -> Iterator[Readout]:
        part = self.looks.within(start, stop)
        concern = self._concern(part)
        scale = self._scale(concern, self.looks.shares[part])
        steps = self.looks.steps[part] - start
        hits = self._hits[:, None] + np.cumsum(self._new_hits(concern), axis=1)
        factor = np.zeros(concern.log_factor.shape)
        if not self.candidates.known:
            factor = concern.log_factor if scale is None else concern.log_factor * scale
        first = np.searchsorted(steps, np.arange(stop - start))
        log_outer = self._log_outer[:, None] + np.cumsum(
            np.add.reduceat(factor, first, axis=1), axis=1
        )
        candidate = _is_candidate(hits)
        before, before_mass = self._total, self._mass(self._total, self._log_outer)
        every = np.arange(len(self.candidates.cells))
        whole = np.zeros(len(steps), dtype=np.int64)
        after = before + self._evidence(concern, scale, every, whole, part)
        after_mass = self._mass(after, log_outer[:, -1])
        # What matters neither before the block nor after it does not matter within.
        active = np.flatnonzero(
            candidate.any(axis=1)
            & (
                (before_mass > before_mass[candidate[:, 0]].max(initial=-np.inf) - NEGLIGIBLE)
                | (after_mass > after_mass[candidate[:, -1]].max(initial=-np.inf) - NEGLIGIBLE)
            )
        )
        each = self._evidence(concern, scale, active, steps, part)
        shape = (len(active), stop - start)
        classes = each.classes.reshape(*shape, self.engine.n_classes, self.engine.bins)
        classes = before.classes[active, None] + np.cumsum(classes, axis=1)
        background = before.background[active, None] + np.cumsum(
            each.background.reshape(shape), axis=1
        )
        outer = np.where(candidate[active], log_outer[active], -np.inf)
        outer = self.log_priors + outer[..., None]
        log_joint = np.concatenate([background[..., None], log_mean_exp(classes)], axis=-1)
        log_joint += outer
        centers = self.candidates.centers[active]
        self._total, self._hits, self._log_outer = after, hits[:, -1], log_outer[:, -1]
        for t in range(stop - start):
            yield Readout(classes[:, t], outer[:, t, 1:], log_joint[:, t], centers)

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

    def _mass(self, total: Evidence, log_outer: FloatArray) -> FloatArray:
        """Rough log belief of each cell, for leaving out those that do not matter, (k,)."""
        peak = total.classes.max(axis=-1) + self.log_priors[1:]
        best = np.maximum(peak.max(axis=-1), total.background + self.log_priors[0])
        return np.asarray(best + log_outer)

    @property
    def log_evidence(self) -> float:
        """Log probability of all measurements so far, up to a constant of the looks alone."""
        _, _, log_joint = self._joint()
        return float(logsumexp(log_joint))

    def _joint(self) -> tuple[IntArray, FloatArray, FloatArray]:
        """Cells that matter, their log likelihoods and log joint, background first."""
        mass = self._mass(self._total, self._log_outer)
        mass = np.where(_is_candidate(self._hits), mass, -np.inf)
        kept = np.flatnonzero(mass >= mass.max() - NEGLIGIBLE)
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


def _is_candidate(hits: IntArray) -> BoolArray:
    """Cells that at least half as many measurements point at as at the best, same shape."""
    return np.asarray(2 * hits >= hits.max(axis=0))
