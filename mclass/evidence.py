"""Looks to evidence: sums of log likelihoods for many cells at once.

A look is one instant at which a cell was measured: a detection, or a frame that returned
nothing. Cells are rows; each row owns a run of (cell, look) pairs. Two ways lead from pairs to
sums: tables (S @ D, fast, for grids) and direct evaluation (exact, for known positions and
for models whose viewpoints have a bearing term). Both add the same terms.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse import csr_array

from mclass.footprint import Pointing
from mclass.observation import Term, has_bearing
from mclass.records import BoolArray, FloatArray, IntArray
from mclass.table import LikelihoodTable, build_table

_DENSE_SHARE = 0.1
"""Above this filling a matrix product is faster dense than sparse."""

_DENSE_BYTES = 2**22
_SPREADS = (0.0, 0.15, 0.3, 0.6, 1.0)
"""Standard deviations of the sensor's position [m] for which terms are tabulated."""

_PAIRS_AT_ONCE = 2**13


@dataclass(frozen=True)
class Pairs:
    """Cells with the looks that concern them.

    Attributes:
        starts: Row ``i`` owns pairs ``starts[i]:starts[i + 1]``, (rows + 1,).
        looks: Index of the look of each pair, (p,).
        ranges: Distance of sensor and cell [m], (p,).
        directions: World direction of the sensor seen from the cell [rad], (p,).
        scale: Weight of each pair's log likelihood, (p,), or None for one each.
    """

    starts: IntArray
    looks: IntArray
    ranges: FloatArray
    directions: FloatArray
    scale: FloatArray | None = None

    def select(self, mask: BoolArray) -> Pairs:
        """Only the pairs in the mask, over the same rows."""
        kept = np.flatnonzero(mask)
        return Pairs(
            starts=np.searchsorted(kept, self.starts),
            looks=self.looks[kept],
            ranges=self.ranges[kept],
            directions=self.directions[kept],
            scale=None if self.scale is None else self.scale[kept],
        )

    def weighed(self, weights: FloatArray) -> Pairs:
        """Pairs of positive weight, (p,), their scale multiplied by it."""
        chosen = self.select(weights > 0.0)
        weights = weights[weights > 0.0]
        if (weights == 1.0).all():
            return chosen
        return replace(chosen, scale=weights if chosen.scale is None else chosen.scale * weights)

    @property
    def counts(self) -> IntArray:
        """Pairs in each row, (rows,)."""
        return np.diff(self.starts)


@dataclass(frozen=True)
class Evidence:
    """Summed log likelihoods of cells, prior not included.

    Attributes:
        classes: Given class and orientation; orientation bin b is centred at
            2 pi b / bins, (rows, n, bins).
        background: Given the background, (rows,).
        looks: How many looks were summed, (rows,).
    """

    classes: FloatArray
    background: FloatArray
    looks: IntArray

    def __add__(self, other: Evidence) -> Evidence:
        """Evidence of both sets of looks, row by row."""
        return Evidence(
            self.classes + other.classes,
            self.background + other.background,
            self.looks + other.looks,
        )

    def select(self, rows: IntArray) -> Evidence:
        """Only the given rows."""
        return Evidence(self.classes[rows], self.background[rows], self.looks[rows])


@dataclass
class Engine:
    """Sums evidence for one model and one set of looks.

    Attributes:
        terms: The observation model.
        n_classes: Without the background.
        bins: Orientation bins in which evidence is summed.
        pointing: Where the looks were taken from.
        term_weights: How much of each term a look adds, 0 for nothing, (looks, terms).
        position_covariances: Of the sensor in the world [m²], (looks, 2, 2), widening every
            viewpoint; None for exact poses.
        reported_bins: Bins that beliefs are reported in, a divisor of ``bins``; 0 for all.
    """

    terms: tuple[Term, ...]
    n_classes: int
    bins: int
    pointing: Pointing
    term_weights: FloatArray
    position_covariances: FloatArray | None = None
    reported_bins: int = 0
    _tables: dict[tuple[int, int, int], LikelihoodTable] = field(default_factory=dict)

    @property
    def shown_bins(self) -> int:
        """Orientation bins of reported beliefs."""
        return self.reported_bins or self.bins

    def evidence(self, pairs: Pairs) -> Evidence:
        """Sum the log likelihoods of all pairs, from tables where the model allows it."""
        return self._sum(pairs, exact=False)

    def exact_evidence(self, pairs: Pairs) -> Evidence:
        """Sum the log likelihoods of all pairs, each evaluated directly in float64."""
        return self._sum(pairs, exact=True)

    def _sum(self, pairs: Pairs, *, exact: bool) -> Evidence:
        rows = len(pairs.starts) - 1
        classes = np.zeros((rows, self.n_classes, self.bins))
        background = np.zeros(rows)
        present = np.flatnonzero(self.term_weights[np.unique(pairs.looks)].any(axis=0))
        for index in present:
            term = self.terms[index]
            chosen = pairs.weighed(self.term_weights[pairs.looks, index])
            weights = _row_weights(chosen)
            background += weights * term.background
            others = np.ones(self.n_classes, dtype=bool)
            others[term.classes] = False
            # No weight times minus infinity is nothing, not NaN.
            touched = np.flatnonzero(weights)
            value = weights[touched] * term.elsewhere
            classes[np.ix_(touched, others)] += value[:, None, None]
            if len(term.classes):
                direct = exact or has_bearing(term)
                part = self._direct(term, chosen) if direct else self._tabulated(term, chosen)
                classes[:, term.classes] += part
        return Evidence(classes, background, pairs.counts)

    def _direct(self, term: Term, pairs: Pairs) -> FloatArray:
        """Evaluate a term for every pair and bin and sum over rows, (rows, k, bins)."""
        rows = len(pairs.starts) - 1
        total = np.zeros((rows, len(term.classes), self.bins))
        orientations = 2.0 * np.pi * np.arange(self.bins) / self.bins
        owners = np.repeat(np.arange(rows), pairs.counts)
        for start in range(0, len(owners), _PAIRS_AT_ONCE):
            part = slice(start, start + _PAIRS_AT_ONCE)
            aspects = pairs.directions[part, None] - orientations
            views = np.stack([np.cos(aspects), np.sin(aspects)], axis=-1)
            views *= pairs.ranges[part, None, None]
            headings = self.pointing.headings[pairs.looks[part]]
            bearings = np.broadcast_to(
                (pairs.directions[part] + np.pi - headings)[:, None], aspects.shape
            )
            spread = self._spread(pairs.looks[part], orientations)
            values = term.log_likelihood(views, bearings, spread).transpose(1, 0, 2)
            if pairs.scale is not None:
                values = values * pairs.scale[part, None, None]
            first = np.flatnonzero(np.diff(owners[part], prepend=-1))
            if len(first):
                total[owners[part][first]] += np.add.reduceat(values, first, axis=0)
        return total

    def _tabulated(self, term: Term, pairs: Pairs) -> FloatArray:
        """Sum a term over rows as S @ D, (rows, k, bins)."""
        rows = len(pairs.starts) - 1
        shape = (rows, len(term.classes), self.bins)
        if len(pairs.ranges) == 0:
            return np.zeros(shape)
        total = np.zeros(shape)
        levels = self._spread_levels(pairs.looks)
        for level in np.unique(levels):
            part = pairs.select(levels == level)
            table = self._table(term, float(part.ranges.max()), int(level))
            weights = table.weights(part.starts, part.ranges, part.directions, part.scale)
            total += _product(weights, table).reshape(shape)
        return total

    def _table(self, term: Term, farthest: float, spread: int) -> LikelihoodTable:
        """A table that reaches the maximal range, doubled as often as a pair lies beyond."""
        doublings = max(0, int(np.ceil(np.log2(max(farthest / self.pointing.max_range, 1.0)))))
        key = (term.index, doublings, spread)
        if key not in self._tables:
            reach = self.pointing.max_range * 2.0**doublings
            variance = _SPREADS[spread] ** 2
            self._tables[key] = build_table(
                term, self.bins, self.pointing.min_range, reach, variance
            )
        return self._tables[key]

    def _spread(self, looks: IntArray, orientations: FloatArray) -> FloatArray | None:
        """Position covariances turned into the frame of each orientation, (p, bins, 2, 2)."""
        if self.position_covariances is None:
            return None
        cosine, sine = np.cos(orientations), np.sin(orientations)
        to_world = np.stack([np.stack([cosine, -sine], -1), np.stack([sine, cosine], -1)], -2)
        covariances = self.position_covariances[looks][:, None]
        return np.asarray(to_world.swapaxes(-1, -2) @ covariances @ to_world)

    def _spread_levels(self, looks: IntArray) -> IntArray:
        """The tabulated spread nearest to the position uncertainty of each look, (p,)."""
        if self.position_covariances is None:
            return np.zeros(len(looks), dtype=np.int64)
        trace = np.trace(self.position_covariances, axis1=1, axis2=2)
        deviations = np.sqrt(trace / 2.0)
        middles = (np.array(_SPREADS[1:]) + np.array(_SPREADS[:-1])) / 2.0
        return np.asarray(np.searchsorted(middles, deviations)[looks])


def _row_weights(pairs: Pairs) -> FloatArray:
    """Sum of the weights of the pairs in each row, (rows,)."""
    if pairs.scale is None:
        return pairs.counts.astype(float)
    sums = np.concatenate([[0.0], np.cumsum(pairs.scale)])
    return np.asarray(sums[pairs.starts[1:]] - sums[pairs.starts[:-1]])


def _product(weights: csr_array, table: LikelihoodTable) -> FloatArray:
    """S @ D over the nodes in use, dense where that is faster."""
    used = np.flatnonzero(np.bincount(weights.indices, minlength=weights.shape[1]))
    position = np.zeros(weights.shape[1], dtype=np.int32)
    position[used] = np.arange(len(used), dtype=np.int32)
    values = table.rows(used)
    compact = csr_array(
        (weights.data, position[weights.indices], weights.indptr),
        shape=(weights.shape[0], len(used)),
    )
    if weights.nnz < _DENSE_SHARE * weights.shape[0] * len(used):
        return np.asarray(compact @ values)
    result = np.empty((weights.shape[0], values.shape[1]))
    step = max(1, _DENSE_BYTES // (8 * len(used)))
    for start in range(0, len(result), step):
        rows = slice(start, start + step)
        np.matmul(compact[rows].toarray(), values, out=result[rows])
    return result
