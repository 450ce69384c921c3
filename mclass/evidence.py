"""Looks to evidence: sums of log likelihoods for many cells at once.

A look is one instant at which a cell was measured: a detection, or a frame that returned
nothing. Cells are rows; each row owns a run of (cell, look) pairs. Two ways lead from pairs to
sums: tables (S @ D, fast, for grids) and direct evaluation (exact, for known positions and
for models whose viewpoints have a bearing term). Both add the same terms. The product S @ D is
taken pair by pair where rows have few of them, as a convolution where they have many.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from threading import Lock

import numpy as np

from mclass.convolution import ConvolutionTable, take_apart
from mclass.footprint import Pointing
from mclass.observation import Term, has_bearing
from mclass.records import BoolArray, FloatArray, IntArray
from mclass.spectra import SpectralTable, spectral_table
from mclass.table import build_table

_SPREADS = (0.0, 0.15, 0.3, 0.6, 1.0)
"""Standard deviations of the sensor's position [m] for which terms are tabulated."""

_PAIRS_AT_ONCE = 2**13
_TABULATED_AT_ONCE = 2**14
_ROWS_AT_ONCE = 16
"""Pairs and rows of which all there is to know fits the processor's cache."""

_NUMBERS_AT_ONCE = 2**16
"""Rows of few pairs are taken together up to so many numbers, to do more work a call."""


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
        if mask.all():
            return self
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
        positive = weights > 0.0
        chosen = self.select(positive)
        weights = weights[positive]
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
        direct: Build no tables: there is too little to sum.
    """

    terms: tuple[Term, ...]
    n_classes: int
    bins: int
    pointing: Pointing
    term_weights: FloatArray
    position_covariances: FloatArray | None = None
    reported_bins: int = 0
    direct: bool = False
    _tables: dict[tuple[int, int, int], tuple[SpectralTable, ConvolutionTable]] = field(
        default_factory=dict
    )
    _lock: Lock = field(default_factory=Lock)

    @property
    def shown_bins(self) -> int:
        """Orientation bins of reported beliefs."""
        return self.reported_bins or self.bins

    def evidence(self, pairs: Pairs) -> Evidence:
        """Sum the log likelihoods of all pairs, from tables where the model allows it."""
        return self._sum(pairs, exact=self.direct)

    def exact_evidence(self, pairs: Pairs) -> Evidence:
        """Sum the log likelihoods of all pairs, each evaluated directly in float64."""
        return self._sum(pairs, exact=True)

    def _sum(self, pairs: Pairs, *, exact: bool) -> Evidence:
        rows = len(pairs.starts) - 1
        classes = np.zeros((rows, self.n_classes, self.bins))
        background = np.zeros(rows)
        for index in self._present(pairs.looks):
            term = self.terms[index]
            chosen = pairs.weighed(self.term_weights[:, index].take(pairs.looks))
            weights = _row_weights(chosen)
            background += weights * term.background
            others = np.ones(self.n_classes, dtype=bool)
            others[term.classes] = False
            if others.any():
                # No weight times minus infinity is nothing, not NaN.
                touched = np.flatnonzero(weights)
                value = weights[touched] * term.elsewhere
                classes[np.ix_(touched, others)] += value[:, None, None]
            if not len(term.classes):
                continue
            if exact or has_bearing(term):
                classes[:, term.classes] += self._direct(term, chosen)
            else:
                self._add_tabulated(term, chosen, classes)
        return Evidence(classes, background, pairs.counts)

    def _present(self, looks: IntArray) -> IntArray:
        """Terms that some of the looks add."""
        if not len(looks):
            return np.zeros(0, dtype=np.int64)
        first = looks.min()
        different = first + np.flatnonzero(np.bincount(looks - first))
        return np.flatnonzero(self.term_weights[different].any(axis=0))

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

    def _add_tabulated(self, term: Term, pairs: Pairs, classes: FloatArray) -> None:
        """Add a term to rows, (rows, n, bins), as S @ D."""
        for level, part in self._by_spread(pairs):
            few, many = self._table(term, float(part.ranges.max()), level)
            for rows, own, starts in _blocks(part.starts, self.bins * len(term.classes)):
                scale = None if part.scale is None else part.scale[own]
                chosen = (starts, part.ranges[own], part.directions[own], scale)
                table = many if _many(few, many, len(starts) - 1, len(chosen[1])) else few
                sums = table.sums(*chosen)
                if len(term.classes) == self.n_classes:
                    classes[rows] += sums
                else:
                    classes[rows, term.classes] += sums

    def _table(
        self, term: Term, farthest: float, spread: int
    ) -> tuple[SpectralTable, ConvolutionTable]:
        """Tables that reach the maximal range, doubled as often as a pair lies beyond."""
        doublings = max(0, int(np.ceil(np.log2(max(farthest / self.pointing.max_range, 1.0)))))
        key = (term.index, doublings, spread)
        with self._lock:
            if key not in self._tables:
                self._tables[key] = self._built(term, spread, 2.0**doublings)
        return self._tables[key]

    def _built(
        self, term: Term, spread: int, farther: float
    ) -> tuple[SpectralTable, ConvolutionTable]:
        table = build_table(
            term,
            self.bins,
            self.pointing.min_range,
            self.pointing.max_range * farther,
            _SPREADS[spread] ** 2,
        )
        return spectral_table(table), take_apart(table)

    def _spread(self, looks: IntArray, orientations: FloatArray) -> FloatArray | None:
        """Position covariances turned into the frame of each orientation, (p, bins, 2, 2)."""
        if self.position_covariances is None:
            return None
        cosine, sine = np.cos(orientations), np.sin(orientations)
        to_world = np.stack([np.stack([cosine, -sine], -1), np.stack([sine, cosine], -1)], -2)
        covariances = self.position_covariances[looks][:, None]
        return np.asarray(to_world.swapaxes(-1, -2) @ covariances @ to_world)

    def _by_spread(self, pairs: Pairs) -> Iterator[tuple[int, Pairs]]:
        """Pairs by the tabulated spread nearest to the position uncertainty of their looks."""
        if self._levels is None:
            if len(pairs.looks):
                yield 0, pairs
            return
        levels = self._levels[pairs.looks]
        for level in np.flatnonzero(np.bincount(levels)):
            yield int(level), pairs.select(levels == level)

    @cached_property
    def _levels(self) -> IntArray | None:
        """Number of the tabulated spread of each look, (looks,); None for exact poses."""
        if self.position_covariances is None:
            return None
        trace = np.trace(self.position_covariances, axis1=1, axis2=2)
        middles = (np.array(_SPREADS[1:]) + np.array(_SPREADS[:-1])) / 2.0
        return np.asarray(np.searchsorted(middles, np.sqrt(trace / 2.0)))


def _row_weights(pairs: Pairs) -> FloatArray:
    """Sum of the weights of the pairs in each row, (rows,)."""
    if pairs.scale is None:
        return pairs.counts.astype(float)
    sums = np.concatenate([[0.0], np.cumsum(pairs.scale)])
    return np.asarray(sums[pairs.starts[1:]] - sums[pairs.starts[:-1]])


def _blocks(starts: IntArray, width: int) -> Iterator[tuple[slice, slice, IntArray]]:
    """Cut rows and their pairs into blocks; a row with too many pairs is in several.

    Args:
        starts: Row ``i`` owns pairs ``starts[i]:starts[i + 1]``, (rows + 1,).
        width: Numbers that a pair adds to a row.

    Yields:
        The rows, the pairs, and where among the pairs those of each row start.
    """
    first_pair = 0
    while first_pair < starts[-1]:
        first = int(np.searchsorted(starts, first_pair, side="right")) - 1
        few = int(np.searchsorted(starts, first_pair + _NUMBERS_AT_ONCE // width))
        after = min(max(first + _ROWS_AT_ONCE, few), len(starts) - 1)
        last_pair = int(min(starts[after], first_pair + _TABULATED_AT_ONCE))
        last = int(np.searchsorted(starts, last_pair))
        own = np.clip(starts[first : last + 1], first_pair, last_pair) - first_pair
        yield slice(first, last), slice(first_pair, last_pair), own
        first_pair = last_pair


def _many(few: SpectralTable, many: ConvolutionTable, rows: int, pairs: int) -> bool:
    """Whether rows have so many pairs that a convolution is faster than a spectrum for each.

    Nothing but the tables and the numbers of rows and pairs decides, so the same pairs are always
    summed in the same way. The two ways differ by rounding and by the tolerance of the tables.
    """
    return pairs * few.size > rows * many.size
