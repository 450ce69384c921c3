"""Looks to evidence: sums of log likelihoods for many cells at once.

A look is one instant at which a cell was measured: a detection, or a frame that returned
nothing. Cells are rows; each row owns a run of (cell, look) pairs. Two ways lead from pairs to
sums: tables (S @ D, fast, for grids) and direct evaluation (exact, for known positions and
for models whose viewpoints have a bearing term). Both add the same terms. The product S @ D is
taken pair by pair where rows have few of them, as a convolution where they have many.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from threading import Lock

import numpy as np
from numpy.fft import irfft

from mclass.blockwise import blocks
from mclass.convolution import ConvolutionTable, at_bins, take_apart
from mclass.footprint import Pointing
from mclass.observation import Term, has_bearing
from mclass.pairs import Pairs
from mclass.parallel import ordered_map
from mclass.records import BoolArray, FloatArray, IntArray
from mclass.spectra import SpectralTable, spectral_table
from mclass.table import build_table

_SPREADS = (0.0, 0.08, 0.15, 0.22, 0.3, 0.4, 0.5, 0.65, 0.8, 1.0)
"""Standard deviations of the sensor's position [m] for which terms are tabulated."""

_PAIRS_AT_ONCE = 2**13
"""Pairs that are evaluated together: all there is to know of them fits the processor's cache."""

_CONVOLVED_AT_ONCE = 2**17
_TRANSFORMED_AT_ONCE = 2**20
_SPECTRA_AT_ONCE = 2**17
"""Pairs, numbers to be transformed, and numbers added for each pair: fewer at once take longer,
more hold more memory."""


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


@dataclass(frozen=True)
class _Part:
    """Pairs that add a term, over all rows, with its tables.

    Attributes:
        classes: Those that the term tells of.
        few: For rows of few pairs.
        many: For rows of many.
        pairs: Those that add the term.
    """

    classes: IntArray | slice
    few: SpectralTable
    many: ConvolutionTable
    pairs: Pairs

    @property
    def is_many(self) -> bool:
        """Whether to convolve; rows without pairs do not count."""
        rows = int(np.count_nonzero(self.pairs.counts))
        return _many(self.few, self.many, rows, len(self.pairs.looks))


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
        tabulated: list[_Part] = []
        for index in self._present(pairs.looks):
            term = self.terms[index]
            chosen = self._adding(index, pairs)
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
                tabulated += self._tabulated(term, chosen)
        self._add_tabulated(tabulated, classes, pairs)
        return Evidence(classes, background, pairs.counts)

    def _present(self, looks: IntArray | BoolArray) -> IntArray:
        """Terms that some of the looks, numbers or a mask, add."""
        seen = np.zeros(len(self.term_weights), dtype=bool)
        seen[looks] = True
        different = np.flatnonzero(seen)
        return np.flatnonzero([adds.take(different).any() for adds in self._adds])

    def _adding(self, index: int, pairs: Pairs) -> Pairs:
        """Pairs whose looks add a term, their scale multiplied by how much."""
        chosen = pairs.select(self._adds[index].take(pairs.looks))
        if self._in_full[index]:
            return chosen
        weights = self.term_weights[chosen.looks, index]
        return replace(chosen, scale=weights if chosen.scale is None else chosen.scale * weights)

    @cached_property
    def _adds(self) -> BoolArray:
        """Whether looks add terms, (terms, looks)."""
        return np.ascontiguousarray(self.term_weights.T > 0.0)

    @cached_property
    def _in_full(self) -> BoolArray:
        """Terms that looks add in full or not at all, (terms,)."""
        return np.asarray(((self.term_weights == 0.0) | (self.term_weights == 1.0)).all(axis=0))

    def _direct(self, term: Term, pairs: Pairs) -> FloatArray:
        """Evaluate a term for every pair and bin and sum over rows, (rows, k, bins)."""
        rows = len(pairs.starts) - 1
        total = np.zeros((rows, len(term.classes), self.bins))
        orientations = 2.0 * np.pi * np.arange(self.bins) / self.bins
        owners = np.repeat(np.arange(rows), pairs.counts)
        for part in blocks(len(owners), _PAIRS_AT_ONCE):
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

    def _tabulated(self, term: Term, pairs: Pairs) -> Iterator[_Part]:
        """Pairs of a term with the tables that hold them."""
        classes = slice(None) if len(term.classes) == self.n_classes else term.classes
        for level, part in self._by_spread(pairs):
            yield _Part(classes, *self._table(term, float(part.ranges.max()), level), part)

    def _add_tabulated(self, parts: Sequence[_Part], classes: FloatArray, pairs: Pairs) -> None:
        """Add terms to rows, (rows, n, bins), given all of their pairs."""
        read = [part for part in parts if not part.is_many]
        most = _SPECTRA_AT_ONCE // max((part.few.size for part in read), default=1)
        for rows in pairs.blocks(most, most) if read else ():
            shape = (rows.stop - rows.start, self.n_classes, self.bins // 2 + 1)
            spectra = np.zeros(shape, dtype=complex)
            for part in read:
                own = part.pairs.within(rows)
                if len(own.looks):
                    found = part.few.spectra_of(*own.columns)
                    spectra[:, part.classes, : found.shape[-1]] += found
            classes[rows] += irfft(spectra, n=self.bins)
        convolved = [part for part in parts if part.is_many]
        if not convolved:
            return
        size = max(part.many.size for part in convolved)
        for rows in pairs.blocks(_CONVOLVED_AT_ONCE, max(1, _TRANSFORMED_AT_ONCE // size)):
            shape = (self.bins // 2 + 1, rows.stop - rows.start, self.n_classes)
            spectra = np.zeros(shape, dtype=complex)
            for part in convolved:
                own = part.pairs.within(rows)
                spectra[..., part.classes] += part.many.spectra(*own.columns)
            classes[rows] += at_bins(spectra, self.bins)

    def build_tables(self, threads: int) -> None:
        """Build the tables that looks from within the maximal range need, several at a time."""
        points = np.isfinite(self.pointing.widths)
        levels = np.zeros(len(points)) if self._levels is None else self._levels
        keys = [
            (index, 0, level)
            for level in range(len(_SPREADS))
            for index in self._present(points & (np.abs(levels - level) < 1.0)).tolist()
            if self._is_tabulated(self.terms[index]) and (index, 0, level) not in self._tables
        ]
        built = ordered_map(lambda key: self._built(*key), keys, threads)
        self._tables.update(zip(keys, built, strict=True))

    def _is_tabulated(self, term: Term) -> bool:
        return len(term.classes) > 0 and not self.direct and not has_bearing(term)

    def _table(
        self, term: Term, farthest: float, spread: int
    ) -> tuple[SpectralTable, ConvolutionTable]:
        """Tables that reach the maximal range, doubled as often as a pair lies beyond."""
        doublings = max(0, int(np.ceil(np.log2(max(farthest / self.pointing.max_range, 1.0)))))
        key = (term.index, doublings, spread)
        with self._lock:
            if key not in self._tables:
                self._tables[key] = self._built(*key)
        return self._tables[key]

    def _built(
        self, index: int, doublings: int, spread: int
    ) -> tuple[SpectralTable, ConvolutionTable]:
        table = build_table(
            self.terms[index],
            self.bins,
            self.pointing.min_range,
            self.pointing.max_range * 2.0**doublings,
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
        """Pairs by tabulated spread, shared between the two next to that of their looks."""
        if self._levels is None:
            if len(pairs.looks):
                yield 0, pairs
            return
        levels = self._levels[pairs.looks]
        for level in range(len(_SPREADS)):
            shares = np.maximum(1.0 - np.abs(levels - level), 0.0)
            if shares.any():
                yield level, pairs.weighed(shares)

    @cached_property
    def _levels(self) -> FloatArray | None:
        """Where among the tabulated spreads each look's is, (looks,); None for exact poses.

        Log likelihoods between two are taken as linear in the variance.
        """
        if self.position_covariances is None:
            return None
        variances = np.trace(self.position_covariances, axis1=1, axis2=2) / 2.0
        places = np.arange(len(_SPREADS))
        return np.asarray(np.interp(variances, np.square(_SPREADS), places))


def _row_weights(pairs: Pairs) -> FloatArray:
    """Sum of the weights of the pairs in each row, (rows,)."""
    if pairs.scale is None:
        return pairs.counts.astype(float)
    sums = np.concatenate([[0.0], np.cumsum(pairs.scale)])
    return np.asarray(sums[pairs.starts[1:]] - sums[pairs.starts[:-1]])


def _many(few: SpectralTable, many: ConvolutionTable, rows: int, pairs: int) -> bool:
    """Whether rows have so many pairs that a convolution is faster than a spectrum for each.

    Nothing but the tables and the numbers of rows and pairs decides, so the same pairs are always
    summed in the same way. The two ways differ by rounding and by the tolerance of the tables.
    """
    return pairs * few.size > rows * many.size
