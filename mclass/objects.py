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
from scipy.special import logsumexp

from mclass.belief import log_orientation_density
from mclass.evidence import Engine, Evidence, Pairs
from mclass.footprint import Grid, Sight, sight, tiles
from mclass.orientation import log_mean_exp
from mclass.records import BoolArray, FloatArray, IntArray
from mclass.results import BeliefBlock, ObjectEstimate
from mclass.summary import NEGLIGIBLE, Readout

_SHORTEST_BLOCK = 4
_LONGEST_BLOCK = 64
_ROWS_AT_ONCE = 256


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


def pointed_cells(grid: Grid, engine: Engine, rows: IntArray) -> Candidates | None:
    """All cells that at least one of the measurements points at; None if there is none."""
    pointing = engine.pointing.select(rows)
    touched = []
    for tile in tiles(grid, pointing):
        seen = sight(grid.centers(tile.cells), grid.cell_size, pointing.select(tile.rows))
        touched.append(tile.cells[seen.inside.any(axis=1)])
    cells = np.sort(np.concatenate(touched)) if touched else np.zeros(0, dtype=np.int64)
    return Candidates(grid, cells, known=False) if len(cells) else None


@dataclass(frozen=True)
class Step:
    """The belief after measurement ``row``; ``count`` measurements so far."""

    row: int
    count: int
    readout: Readout


class ObjectFilter:
    """Follows one object through its measurements."""

    def __init__(
        self,
        engine: Engine,
        candidates: Candidates,
        log_priors: FloatArray,
        outside_probability: float,
    ) -> None:
        self.engine = engine
        self.candidates = candidates
        self.log_priors = log_priors
        self.log_outside = float(np.log(outside_probability))
        count = len(candidates.cells)
        shape = (count, engine.n_classes, engine.bins)
        self._total = Evidence(np.zeros(shape), np.zeros(count), np.zeros(count, dtype=np.int64))
        self._hits = np.zeros(count, dtype=np.int64)
        self._misses = np.zeros(count, dtype=np.int64)

    def steps(self, rows: IntArray) -> Iterator[Step]:
        """Apply measurements in the given order and yield the belief after each.

        Cells are let go after the last measurement at which they are candidates.
        """
        last_candidate = self._last_candidate(rows)
        start = 0
        while start < len(rows):
            kept = last_candidate >= start
            if not kept.all():
                self._keep(np.flatnonzero(kept))
                last_candidate = last_candidate[kept]
            # The belief narrows fast at first: short blocks let cells go early.
            part = rows[start : start + int(np.clip(start, _SHORTEST_BLOCK, _LONGEST_BLOCK))]
            for offset, readout in enumerate(self._block(part)):
                yield Step(int(part[offset]), start + offset + 1, readout)
            start += len(part)

    def _last_candidate(self, rows: IntArray) -> IntArray:
        """Position in ``rows`` of the last measurement at which each cell is a candidate, (k,)."""
        last = np.full(len(self.candidates.cells), -1, dtype=np.int64)
        hits = self._hits
        for start in range(0, len(rows), _ROWS_AT_ONCE):
            part = rows[start : start + _ROWS_AT_ONCE]
            inside, located = self._inside(self._sight(part), part)
            totals = hits[:, None] + np.cumsum(inside & located, axis=1)
            candidate = _is_candidate(totals)
            latest = len(part) - 1 - np.argmax(candidate[:, ::-1], axis=1)
            last = np.where(candidate.any(axis=1), start + latest, last)
            hits = totals[:, -1]
        return last

    def _keep(self, cells: IntArray) -> None:
        """Go on with some of the cells only."""
        self.candidates = replace(self.candidates, cells=self.candidates.cells[cells])
        self._total = self._total.select(cells)
        self._hits, self._misses = self._hits[cells], self._misses[cells]

    def _sight(self, rows: IntArray) -> Sight:
        pointing = self.engine.pointing.select(rows)
        return sight(self.candidates.centers, self.candidates.grid.cell_size, pointing)

    def _inside(self, seen: Sight, rows: IntArray) -> tuple[BoolArray, BoolArray]:
        """Footprint test of every cell (k, m); which measurements have a footprint at all (m,)."""
        located = np.isfinite(self.engine.pointing.directions[rows]).all(axis=1)
        return seen.inside, np.asarray(located & (not self.candidates.known))

    def _block(self, rows: IntArray) -> Iterator[Readout]:
        seen = self._sight(rows)
        inside, located = self._inside(seen, rows)
        hits = self._hits[:, None] + np.cumsum(inside & located, axis=1)
        misses = self._misses[:, None] + np.cumsum(~inside & located, axis=1)
        candidate = _is_candidate(hits)
        before, before_mass = self._total, self._mass(self._total, self._misses)
        after = before + self._evidence(_all_pairs(seen, rows))
        after_mass = self._mass(after, misses[:, -1])
        # What matters neither before the block nor after it does not matter within.
        active = np.flatnonzero(
            candidate.any(axis=1)
            & (
                (before_mass > before_mass[candidate[:, 0]].max(initial=-np.inf) - NEGLIGIBLE)
                | (after_mass > after_mass[candidate[:, -1]].max(initial=-np.inf) - NEGLIGIBLE)
            )
        )
        each = self._evidence(_single_pairs(seen.select(active), rows))
        shape = (len(active), len(rows))
        classes = each.classes.reshape(*shape, self.engine.n_classes, self.engine.bins)
        classes = before.classes[active, None] + np.cumsum(classes, axis=1)
        background = before.background[active, None] + np.cumsum(
            each.background.reshape(shape), axis=1
        )
        penalty = np.where(candidate[active], misses[active] * self.log_outside, -np.inf)
        log_outer = self.log_priors + penalty[..., None]
        log_joint = np.concatenate([background[..., None], log_mean_exp(classes)], axis=-1)
        log_joint += log_outer
        centers = self.candidates.centers[active]
        self._total, self._hits, self._misses = after, hits[:, -1], misses[:, -1]
        for t in range(len(rows)):
            yield Readout(classes[:, t], log_outer[:, t, 1:], log_joint[:, t], centers)

    def _evidence(self, pairs: Pairs) -> Evidence:
        exact = self.candidates.known
        return self.engine.exact_evidence(pairs) if exact else self.engine.evidence(pairs)

    def _mass(self, total: Evidence, misses: IntArray) -> FloatArray:
        """Rough log belief of each cell, for leaving out those that do not matter, (k,)."""
        peak = total.classes.max(axis=-1) + self.log_priors[1:]
        best = np.maximum(peak.max(axis=-1), total.background + self.log_priors[0])
        return np.asarray(best + misses * self.log_outside)

    def belief(self, last: ObjectEstimate) -> BeliefBlock:
        """The full belief after the last measurement, cells of negligible mass left out."""
        mass = np.where(_is_candidate(self._hits), self._mass(self._total, self._misses), -np.inf)
        kept = np.flatnonzero(mass >= mass.max() - NEGLIGIBLE)
        classes = self._total.classes[kept]
        log_joint = np.concatenate(
            [self._total.background[kept, None], log_mean_exp(classes)], axis=1
        )
        log_joint += self.log_priors + (self._misses[kept] * self.log_outside)[:, None]
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
            log_density=log_orientation_density(classes).astype(np.float32),
            measurements=np.full(len(kept), last.measurements, dtype=np.int64),
        )


def _is_candidate(hits: IntArray) -> BoolArray:
    """Cells that at least half as many measurements point at as at the best, same shape."""
    return np.asarray(2 * hits >= hits.max(axis=0))


def _all_pairs(seen: Sight, rows: IntArray) -> Pairs:
    """Every cell with every measurement: one row a cell."""
    cells, count = seen.ranges.shape
    return _pairs(seen, rows, starts=np.arange(cells + 1) * count)


def _single_pairs(seen: Sight, rows: IntArray) -> Pairs:
    """Every cell with every measurement: one row a pair."""
    return _pairs(seen, rows, starts=np.arange(seen.ranges.size + 1))


def _pairs(seen: Sight, rows: IntArray, starts: IntArray) -> Pairs:
    measurements = np.tile(rows, len(seen.ranges))
    return Pairs(starts, measurements, seen.ranges.ravel(), seen.directions.ravel())
