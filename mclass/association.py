"""Which detections without ids belong to which objects.

Objects are born one at a time, where the detections left over speak loudest for anything
rather than nothing; then every detection is shared among the objects that its box points at,
by how well its labels fit what each is believed to be, and clutter (probabilistic data
association: at most one detection of a frame belongs to an object). Objects that stand where
poses may have drifted from one to the other, and are never seen together, become one. What
still belongs to none gives birth to more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mclass.evidence import Engine
from mclass.footprint import Grid, sight, tiles
from mclass.logarithms import logsumexp
from mclass.looks import Looks, grid_pairs, object_looks, off_axis
from mclass.objects import ObjectFilter, pointed_cells
from mclass.orientation import log_mean_exp
from mclass.records import FloatArray, IntArray

_MIN_LOG_ODDS = 1.0
"""How much likelier something must be than nothing for an object to be born, by one look's worth
of detections; less by more, as a stray label comes once."""

_MIN_DETECTIONS = 3
_MAX_OBJECTS = 200
_BIRTH_BINS = 36
_ASTRAY = 1e-9
_ROUNDS = 3
_MIN_SHARE = 0.05
"""Smaller shares of a detection are not worth their cost."""

_SIGHTS_AT_ONCE = 2**19
"""Cells times detections; a dozen numbers are known of each."""

_DRIFT = 0.1
"""Standard deviation of the drift between two times that a thing is seen, in greatest ranges."""

_PARTED = 2.5
"""How many standard deviations apart two places may be of what is one thing."""

_RARELY = 0.1
"""What share of the detections of one object may be in frames with what is the same object."""


@dataclass(frozen=True)
class Group:
    """The detections of one object in the order of time, and how much of each is its own."""

    rows: IntArray
    shares: FloatArray

    @property
    def mostly_own(self) -> IntArray:
        """Detections that are more probably its own than not."""
        return self.rows[self.shares > 0.5]


@dataclass(frozen=True)
class _Place:
    """What an object is believed to be: cells with their mass, the best class and orientation."""

    centers: FloatArray
    mass: FloatArray
    class_index: int
    orientation: float

    @property
    def middle(self) -> FloatArray:
        """Mean position [m], (2,)."""
        return np.asarray(self.mass @ self.centers)

    @property
    def covariance(self) -> FloatArray:
        """Of the position [m²], (2, 2)."""
        away = self.centers - self.middle
        return np.asarray((self.mass * away.T) @ away)


def associate(
    engine: Engine, looks: Looks, grid: Grid, log_priors: FloatArray, rows: IntArray
) -> list[Group]:
    """Group detections into objects.

    Args:
        engine: Sums evidence.
        looks: All looks; labels must have probabilities.
        grid: Where objects may be.
        log_priors: Background first, (1 + n,).
        rows: The detections to group, increasing.

    Returns:
        One group an object, in the order of their first detections.
    """
    search = _Search(engine, looks, grid, log_priors, rows)
    groups: list[Group] = []
    left = rows
    for _ in range(_ROUNDS):
        born = search.births(left)
        if not born:
            break
        groups = search.settled([*groups, *born])
        left = np.setdiff1d(rows, np.concatenate([group.mostly_own for group in groups]))
    return sorted(groups, key=lambda group: int(group.rows[0]))


@dataclass(frozen=True)
class _Search:
    """What `associate` is given, and its steps."""

    engine: Engine
    looks: Looks
    grid: Grid
    log_priors: FloatArray
    rows: IntArray

    def births(self, left: IntArray) -> list[Group]:
        """Take the place with the greatest odds, give it the detections that point there, go on."""
        # Where something stands is a rougher question than what it is and which way it faces.
        engine = replace(self.engine, bins=min(self.engine.bins, _BIRTH_BINS), _tables={})
        grid = Grid(
            self.grid.origin,
            2.0 * self.grid.cell_size,
            -(-self.grid.rows // 2),
            -(-self.grid.columns // 2),
        )
        groups: list[Group] = []
        while len(left) >= _MIN_DETECTIONS and len(groups) < _MAX_OBJECTS:
            center = _likeliest_place(engine, _only(self.looks, left), grid, self.log_priors)
            if center is None:
                break
            # A cell of slack: the place is not yet known better than that.
            pointing = self.looks.pointing.select(left)
            seen = sight(center[None], grid.cell_size, pointing)
            slack = np.arcsin(np.minimum(grid.cell_size / np.maximum(seen.ranges[0], 1e-9), 1.0))
            near = off_axis(seen.directions[0], pointing.axes) <= pointing.widths / 2.0 + slack
            near &= seen.ranges[0] <= pointing.max_range
            group = _group(self.looks, left[near], np.ones(int(near.sum())))
            if len(group.rows) >= _MIN_DETECTIONS:
                groups.append(group)
            left = left[~near]
        return groups

    def settled(self, groups: list[Group]) -> list[Group]:
        """Place objects and share detections among them by turns."""
        rounds = 0
        while rounds < _ROUNDS:
            placed = [(group, place) for group in groups if (place := self._place(group))]
            groups, places = [group for group, _ in placed], [place for _, place in placed]
            whole = self._joined(groups, places)
            if len(whole) < len(groups):
                groups = whole
                continue
            shared = self._shared(places)
            if _same_rows(groups, shared):
                return shared
            groups = shared
            rounds += 1
        return groups

    def _place(self, group: Group) -> _Place | None:
        """An object's belief from the detections it has so far, in short."""
        candidates = pointed_cells(self.grid, self.looks.pointing, group.rows)
        if candidates is None:
            return None
        followed = object_looks(self.looks, group.rows, group.shares)
        readout = ObjectFilter(self.engine, followed, candidates, self.log_priors).finish()
        log_mass = logsumexp(readout.log_joint[:, 1:], axis=1)
        mass = np.exp(log_mass - log_mass.max())
        class_index = int(np.argmax(logsumexp(readout.log_joint[:, 1:], axis=0)))
        marginal = logsumexp(
            readout.log_likelihood[:, class_index] + readout.log_outer[:, class_index, None], axis=0
        )
        orientation = 2.0 * np.pi * int(np.argmax(marginal)) / len(marginal)
        return _Place(readout.centers, mass / mass.sum(), class_index, orientation)

    def _joined(self, groups: list[Group], places: Sequence[_Place]) -> list[Group]:
        """Make one of each two objects that drift may have parted, the nearest first."""
        middles = np.array([place.middle for place in places]).reshape(-1, 2)
        covariances = np.array([place.covariance for place in places]).reshape(-1, 2, 2)
        drift = _DRIFT * self.looks.pointing.max_range
        ones, others = np.triu_indices(len(places), k=1)
        spread = covariances[ones] + covariances[others] + drift**2 * np.eye(2)
        offsets = (middles[others] - middles[ones])[:, :, None]
        apart = np.sqrt((offsets * np.linalg.solve(spread, offsets)).sum(axis=(1, 2)))
        taken: set[int] = set()
        joined = []
        for pair in np.argsort(apart, kind="stable"):
            one, other = int(ones[pair]), int(others[pair])
            if apart[pair] > _PARTED:
                break
            if taken & {one, other} or self._seen_together(groups[one], groups[other]):
                continue
            taken |= {one, other}
            joined.append(_union(self.looks, groups[one], groups[other]))
        return [*(group for i, group in enumerate(groups) if i not in taken), *joined]

    def _seen_together(self, one: Group, other: Group) -> bool:
        """Whether one frame shows both of two objects, and not just by accident."""
        of_one, of_other = (self.looks.frames[group.mostly_own] for group in (one, other))
        both = np.intersect1d(of_one, of_other)
        return len(both) > _RARELY * min(len(of_one), len(of_other))

    def _shared(self, places: Sequence[_Place]) -> list[Group]:
        """Share every detection among objects and clutter by how well each explains it."""
        # A box that points elsewhere is another thing's, not this one's gone astray.
        strict = replace(
            self.looks, settings=replace(self.looks.settings, outside_probability=_ASTRAY)
        )
        clutter = np.full(len(self.rows), self.looks.settings.log_outside)
        fit = np.stack([clutter, *(self._log_fit(strict, place) for place in places)])
        groups = []
        for share in np.exp(fit - logsumexp(fit, axis=0))[1:]:
            chosen = np.flatnonzero(share > _MIN_SHARE)
            group = _group(self.looks, self.rows[chosen], share[chosen])
            if len(group.rows) >= _MIN_DETECTIONS:
                groups.append(group)
        return groups

    def _log_fit(self, looks: Looks, place: _Place) -> FloatArray:
        """Log likelihood of detections, clutter's taken out, if they came from an object, (k,)."""
        followed = object_looks(looks, self.rows, np.ones(len(self.rows)), silence=False)
        at_once = max(1, _SIGHTS_AT_ONCE // len(place.centers))
        fits = []
        for start in range(0, len(self.rows), at_once):
            part = slice(start, start + at_once)
            concern = followed.concern(place.centers, self.grid.cell_size, part)
            at = int(np.argmax(place.mass))
            odds = self._log_odds(
                self.rows[part], concern.seen.ranges[at], concern.seen.directions[at], place
            )
            away = logsumexp(concern.log_factor, weights=place.mass[:, None], axis=0)
            fits.append(odds + away)
        return np.concatenate(fits)

    def _log_odds(
        self, rows: IntArray, ranges: FloatArray, directions: FloatArray, place: _Place
    ) -> FloatArray:
        """Log odds of detections' labels from some ranges and directions [m], [rad], (k,)."""
        aspects = directions - place.orientation
        views = ranges[:, None] * np.stack([np.cos(aspects), np.sin(aspects)], -1)
        odds = np.zeros(len(rows))
        for term in self.engine.terms[: self.engine.term_weights.shape[1]]:
            weights = self.engine.term_weights[rows, term.index]
            value = np.full(len(rows), term.elsewhere)
            if place.class_index in term.classes:
                value = term.log_likelihood(views)[list(term.classes).index(place.class_index)]
            odds += np.where(weights > 0.0, weights * (value - term.background), 0.0)
        return odds


def _only(looks: Looks, rows: IntArray) -> Looks:
    """The looks with all detections but some taken for unseen: they point nowhere."""
    directions = looks.pointing.directions.copy()
    gone = np.setdiff1d(np.arange(looks.n_detections), rows)
    directions[gone] = np.nan
    # Where another object was detected, silence about this one means nothing.
    return replace(looks, pointing=replace(looks.pointing, directions=directions))


def _likeliest_place(
    engine: Engine, looks: Looks, grid: Grid, log_priors: FloatArray
) -> FloatArray | None:
    """Centre of the cell with the greatest log odds of something over nothing, if enough."""
    best, place = 0.0, None
    for tile in tiles(grid, looks.pointing.select(np.arange(looks.n_detections))):
        centers = grid.centers(tile.cells)
        every = np.union1d(tile.rows, looks.frame_looks(np.arange(looks.n_frames)))
        pairs = grid_pairs(looks, centers, grid.cell_size, every)
        is_detection = pairs.looks < looks.n_detections
        owners = np.repeat(np.arange(len(centers)), pairs.counts)[is_detection]
        pointed = np.bincount(owners, minlength=len(centers))
        scale = None if pairs.scale is None else pairs.scale[is_detection]
        worth = np.bincount(owners, scale, minlength=len(centers))
        evidence = engine.evidence(pairs)
        something = logsumexp(log_mean_exp(evidence.classes) + log_priors[1:], axis=1)
        odds = something - evidence.background - log_priors[0]
        odds[(pointed < _MIN_DETECTIONS) | (odds * worth < _MIN_LOG_ODDS)] = -np.inf
        at = int(np.argmax(odds))
        if odds[at] > best:
            best, place = float(odds[at]), centers[at]
    return place


def _group(looks: Looks, rows: IntArray, shares: FloatArray) -> Group:
    """Of the detections of each frame the one with the greatest share, by frame."""
    order = np.lexsort((-shares, looks.frames[rows]))
    _, first = np.unique(looks.frames[rows][order], return_index=True)
    return Group(rows[order][first], shares[order][first])


def _union(looks: Looks, one: Group, other: Group) -> Group:
    """What belongs to either of two objects, when they are one."""
    rows = np.union1d(one.rows, other.rows)
    shares = np.zeros(len(rows))
    for group in (one, other):
        shares[np.searchsorted(rows, group.rows)] += group.shares
    return _group(looks, rows, np.minimum(shares, 1.0))


def _same_rows(groups: Sequence[Group], others: Sequence[Group]) -> bool:
    return [group.rows.tolist() for group in groups] == [group.rows.tolist() for group in others]
