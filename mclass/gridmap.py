"""Beliefs of the grid's cells, independent of each other (paper section IV), tile by tile."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mclass.allocation import keep_freed_memory
from mclass.belief import Posterior, posterior
from mclass.evidence import Engine, Evidence
from mclass.footprint import Grid, Tile, tiles
from mclass.looks import Looks, grid_pairs
from mclass.pairs import Pairs
from mclass.parallel import ordered_map
from mclass.records import FloatArray, IntArray

_PAIRS_AT_ONCE = 2**17
"""Cells times looks that are worked on at once."""

_ROUNDS = 4
_MOST_LOG_ODDS = 30.0


@dataclass(frozen=True)
class TileBelief:
    """The touched cells of one tile after some of the looks.

    Attributes:
        tile: Number of the tile, from 0.
        tiles: How many tiles the grid's belief has.
        cells: Flat indices of touched cells, (m,).
        measurements: How many detections pointed at each, (m,).
        posterior: Their belief.
    """

    tile: int
    tiles: int
    cells: IntArray
    measurements: IntArray
    posterior: Posterior


def grid_beliefs(
    engine: Engine,
    looks: Looks,
    grid: Grid,
    log_priors: FloatArray,
    cuts_ns: Sequence[int],
    threads: int = 1,
) -> Iterator[tuple[TileBelief, ...]]:
    """Beliefs of every touched tile, each from the looks up to each of the cuts.

    Args:
        engine: Sums evidence.
        looks: All looks.
        grid: The cells.
        log_priors: Background first, (1 + n,).
        cuts_ns: Increasing stamps.
        threads: Tiles worked on at once; the beliefs are the same for any number.

    Yields:
        For each tile one belief a cut; a tile that nothing has touched yet has no cells.
    """
    keep_freed_memory()
    touched = list(tiles(grid, looks.pointing))
    if touched:
        engine.build_tables(threads)
    causes = Causes.found(engine, looks, grid, log_priors, touched)
    cut_of_look = np.searchsorted(cuts_ns, looks.stamps_ns)

    def beliefs(number: int) -> tuple[TileBelief, ...]:
        parts = [
            [
                TileBelief(
                    number,
                    len(touched),
                    cells,
                    measurements,
                    posterior(evidence, log_priors, engine.shown_bins),
                )
                for cells, measurements, evidence in _cumulative(
                    engine,
                    looks,
                    part,
                    tile_pairs(looks, grid, part, causes),
                    cut_of_look,
                    len(cuts_ns),
                )
            ]
            for part in touched[number].parts(_PAIRS_AT_ONCE)
        ]
        return tuple(_joined(beliefs) for beliefs in zip(*parts, strict=True))

    yield from ordered_map(beliefs, range(len(touched)), threads)


def _joined(parts: Sequence[TileBelief]) -> TileBelief:
    """One belief of the cells of all parts."""
    posteriors = [part.posterior for part in parts]
    return replace(
        parts[0],
        cells=np.concatenate([part.cells for part in parts]),
        measurements=np.concatenate([part.measurements for part in parts]),
        posterior=Posterior(
            np.concatenate([part.log_class_probability for part in posteriors]),
            np.concatenate([part.log_density for part in posteriors]),
            np.concatenate([part.log_evidence for part in posteriors]),
        ),
    )


@dataclass(frozen=True)
class Causes:
    """How cells share the evidence of detections, each of which has but one cause.

    A detection comes from one of the cells that it points at, or from none of them. A cell's
    share is its odds of holding something over the sum of all those odds and one, for clutter;
    the shares make the odds, so both are found in turn.

    Attributes:
        odds: Of something over nothing, by flat cell index; one where nothing is known.
        totals: Sum over the cells that each detection points at, (n detections,).
    """

    odds: Mapping[int, float]
    totals: FloatArray

    @classmethod
    def found(
        cls,
        engine: Engine,
        looks: Looks,
        grid: Grid,
        log_priors: FloatArray,
        touched: Sequence[Tile],
    ) -> Causes | None:
        """The shares after a few rounds; None where every cell takes all of the evidence."""
        if not looks.settings.one_cause:
            return None
        causes: Causes | None = None
        for _ in range(_ROUNDS):
            odds: dict[int, float] = {}
            for tile in touched:
                pairs = tile_pairs(looks, grid, tile, causes)
                log_class = posterior(engine.evidence(pairs), log_priors).log_class_probability
                something = np.log1p(-np.minimum(np.exp(log_class[:, 0]), 1.0 - 1e-15))
                log_odds = np.clip(something - log_class[:, 0], -_MOST_LOG_ODDS, _MOST_LOG_ODDS)
                odds.update(zip(tile.cells.tolist(), np.exp(log_odds).tolist(), strict=True))
            totals = np.zeros(looks.n_detections)
            for tile in touched:
                pairs = tile_pairs(looks, grid, tile, None)
                is_detection = pairs.looks < looks.n_detections
                values = np.array([odds[cell] for cell in tile.cells.tolist()])
                owners = np.repeat(np.arange(len(tile.cells)), pairs.counts)[is_detection]
                np.add.at(totals, pairs.looks[is_detection], values[owners])
            causes = cls(odds, totals)
        return causes

    def shares(self, looks: Looks, cells: IntArray, pairs: Pairs) -> FloatArray:
        """Share of each pair's evidence that is its cell's; frames are shared by none, (p,)."""
        values = np.array([self.odds.get(int(cell), 1.0) for cell in cells])
        owners = np.repeat(np.arange(len(cells)), pairs.counts)
        shares = np.ones(len(owners))
        is_detection = pairs.looks < looks.n_detections
        totals = self.totals[pairs.looks[is_detection]]
        shares[is_detection] = values[owners[is_detection]] / (totals + 1.0)
        return shares


def tile_pairs(looks: Looks, grid: Grid, tile: Tile, causes: Causes | None) -> Pairs:
    """The looks at a tile's cells, weighed."""
    pairs = grid_pairs(looks, grid.centers(tile.cells), grid.cell_size, tile.rows)
    return pairs if causes is None else pairs.weighed(causes.shares(looks, tile.cells, pairs))


def _cumulative(
    engine: Engine, looks: Looks, tile: Tile, pairs: Pairs, cut_of_look: IntArray, n_cuts: int
) -> Iterator[tuple[IntArray, IntArray, Evidence]]:
    """A tile's touched cells, how many detections pointed at each, and their evidence by cut."""
    pointed = np.zeros(len(tile.cells), dtype=np.int64)
    total: Evidence | None = None
    for number in range(n_cuts):
        part = pairs.select(cut_of_look.take(pairs.looks) == number)
        evidence = engine.evidence(part)
        total = evidence if total is None else total + evidence
        pointed = pointed + part.select(part.looks < looks.n_detections).counts
        kept = np.flatnonzero(total.looks)
        yield tile.cells[kept], pointed[kept], total.select(kept)
