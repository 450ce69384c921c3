"""Which detections without ids belong to which objects.

Objects are born one at a time, where the detections left over speak loudest for anything
rather than nothing; then every detection is shared among the objects that its box points at,
by how well its labels fit what each is believed to be, and clutter (probabilistic data
association: at most one detection of a frame belongs to an object).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mclass.evidence import Engine
from mclass.footprint import Grid, sight, tiles
from mclass.logarithms import logsumexp
from mclass.looks import Looks, grid_pairs, object_looks, off_axis
from mclass.objects import ObjectFilter, pointed_cells
from mclass.orientation import log_mean_exp
from mclass.records import FloatArray, IntArray

_MIN_LOG_ODDS = 2.0
"""An object is born where something is at least this much likelier than nothing."""

_MIN_DETECTIONS = 3
_MAX_OBJECTS = 200
_BIRTH_BINS = 36
_ASTRAY = 1e-9
_ROUNDS = 3
_MIN_SHARE = 0.05
"""Smaller shares of a detection are not worth their cost."""


@dataclass(frozen=True)
class Group:
    """The detections of one object in the order of time, and how much of each is its own."""

    rows: IntArray
    shares: FloatArray


@dataclass(frozen=True)
class _Place:
    """What an object is believed to be: cells with their mass, the best class and orientation."""

    centers: FloatArray
    mass: FloatArray
    class_index: int
    orientation: float


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
    groups = _births(engine, looks, grid, log_priors, rows)
    for _ in range(_ROUNDS):
        before = groups
        places = [_place(engine, looks, grid, log_priors, group) for group in before]
        groups = _shared(engine, looks, grid, rows, places)
        if [group.rows.tolist() for group in before] == [group.rows.tolist() for group in groups]:
            break
    return sorted(groups, key=lambda group: int(group.rows[0]))


def _births(
    engine: Engine, looks: Looks, grid: Grid, log_priors: FloatArray, rows: IntArray
) -> list[Group]:
    """Take the place with the greatest odds, give it the detections that point there, go on."""
    # Where something stands is a rougher question than what it is and which way it faces.
    engine = replace(engine, bins=min(engine.bins, _BIRTH_BINS), _tables={})
    grid = Grid(grid.origin, 2.0 * grid.cell_size, -(-grid.rows // 2), -(-grid.columns // 2))
    groups: list[Group] = []
    left = rows
    while len(left) >= _MIN_DETECTIONS and len(groups) < _MAX_OBJECTS:
        center, odds = _likeliest_place(engine, _only(looks, left), grid, log_priors)
        if center is None or odds < _MIN_LOG_ODDS:
            break
        # A cell of slack: the place is not yet known better than that.
        pointing = looks.pointing.select(left)
        seen = sight(center[None], grid.cell_size, pointing)
        slack = np.arcsin(np.minimum(grid.cell_size / np.maximum(seen.ranges[0], 1e-9), 1.0))
        near = off_axis(seen.directions[0], pointing.axes) <= pointing.widths / 2.0 + slack
        near &= seen.ranges[0] <= pointing.max_range
        mine = _one_a_frame(looks, left[near], np.ones(int(near.sum())))
        if len(mine) >= _MIN_DETECTIONS:
            groups.append(Group(mine, np.ones(len(mine))))
        left = left[~near]
    return groups


def _only(looks: Looks, rows: IntArray) -> Looks:
    """The looks with all detections but some taken for unseen: they point nowhere."""
    directions = looks.pointing.directions.copy()
    gone = np.setdiff1d(np.arange(looks.n_detections), rows)
    directions[gone] = np.nan
    # Where another object was detected, silence about this one means nothing.
    return replace(looks, pointing=replace(looks.pointing, directions=directions))


def _likeliest_place(
    engine: Engine, looks: Looks, grid: Grid, log_priors: FloatArray
) -> tuple[FloatArray | None, float]:
    """Centre of the cell with the greatest log odds of something over nothing."""
    best, place = -np.inf, None
    for tile in tiles(grid, looks.pointing.select(np.arange(looks.n_detections))):
        centers = grid.centers(tile.cells)
        every = np.union1d(tile.rows, looks.frame_looks(np.arange(looks.n_frames)))
        pairs = grid_pairs(looks, centers, grid.cell_size, every)
        pointed = np.bincount(
            np.repeat(np.arange(len(centers)), pairs.counts)[pairs.looks < looks.n_detections],
            minlength=len(centers),
        )
        evidence = engine.evidence(pairs)
        something = logsumexp(log_mean_exp(evidence.classes) + log_priors[1:], axis=1)
        odds = something - evidence.background - log_priors[0]
        odds[pointed < _MIN_DETECTIONS] = -np.inf
        at = int(np.argmax(odds))
        if odds[at] > best:
            best, place = float(odds[at]), centers[at]
    return place, best


def _place(
    engine: Engine, looks: Looks, grid: Grid, log_priors: FloatArray, group: Group
) -> _Place | None:
    """An object's belief from the detections it has so far, in short."""
    candidates = pointed_cells(grid, looks.pointing, group.rows)
    if candidates is None:
        return None
    followed = object_looks(looks, group.rows, group.shares)
    readout = ObjectFilter(engine, followed, candidates, log_priors).finish()
    log_mass = logsumexp(readout.log_joint[:, 1:], axis=1)
    mass = np.exp(log_mass - log_mass.max())
    class_index = int(np.argmax(logsumexp(readout.log_joint[:, 1:], axis=0)))
    marginal = logsumexp(
        readout.log_likelihood[:, class_index] + readout.log_outer[:, class_index, None], axis=0
    )
    orientation = 2.0 * np.pi * int(np.argmax(marginal)) / len(marginal)
    return _Place(readout.centers, mass / mass.sum(), class_index, orientation)


def _shared(
    engine: Engine, looks: Looks, grid: Grid, rows: IntArray, places: list[_Place | None]
) -> list[Group]:
    """Share every detection among objects and clutter by how well each explains it."""
    # A box that points elsewhere is another thing's, not this one's gone astray.
    strict = replace(looks, settings=replace(looks.settings, outside_probability=_ASTRAY))
    known = [place for place in places if place is not None]
    fit = np.stack(
        [np.zeros(len(rows)), *(_log_fit(engine, strict, grid, rows, place) for place in known)]
    )
    fit[0] = looks.settings.log_outside
    shares = np.exp(fit - logsumexp(fit, axis=0))
    groups = []
    for share in shares[1:]:
        chosen = np.flatnonzero(share > _MIN_SHARE)
        mine = _one_a_frame(looks, rows[chosen], share[chosen])
        if len(mine) >= _MIN_DETECTIONS:
            groups.append(Group(mine, share[np.searchsorted(rows, mine)]))
    return groups


def _log_fit(engine: Engine, looks: Looks, grid: Grid, rows: IntArray, place: _Place) -> FloatArray:
    """Log likelihood of detections, clutter's taken out, if they came from an object, (k,)."""
    followed = object_looks(looks, rows, np.ones(len(rows)), silence=False)
    concern = followed.concern(place.centers, grid.cell_size, slice(0, len(rows)))
    at = int(np.argmax(place.mass))
    aspects = concern.seen.directions[at] - place.orientation
    views = concern.seen.ranges[at][:, None] * np.stack([np.cos(aspects), np.sin(aspects)], -1)
    odds = np.zeros(len(rows))
    for term in engine.terms[: engine.term_weights.shape[1]]:
        weights = engine.term_weights[rows, term.index]
        value = np.full(len(rows), term.elsewhere)
        if place.class_index in term.classes:
            value = term.log_likelihood(views)[list(term.classes).index(place.class_index)]
        odds += np.where(weights > 0.0, weights * (value - term.background), 0.0)
    return odds + logsumexp(concern.log_factor, weights=place.mass[:, None], axis=0)


def _one_a_frame(looks: Looks, rows: IntArray, shares: FloatArray) -> IntArray:
    """Of the detections of each frame the one with the greatest share, by frame."""
    order = np.lexsort((-shares, looks.frames[rows]))
    _, first = np.unique(looks.frames[rows][order], return_index=True)
    return np.asarray(rows[order][first])
