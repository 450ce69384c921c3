"""Beliefs of the grid's cells, independent of each other (paper section IV), tile by tile."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mclass.belief import Posterior, posterior
from mclass.evidence import Engine, Evidence, Pairs
from mclass.footprint import Grid, Tile, sight, tiles
from mclass.records import FloatArray, IntArray


@dataclass(frozen=True)
class TileBelief:
    """The touched cells of one tile after some of the measurements.

    Attributes:
        tile: Number of the tile, from 0.
        tiles: How many tiles the grid's belief has.
        cells: Flat indices of touched cells, (m,).
        measurements: How many measurements touched each, (m,).
        posterior: Their belief.
    """

    tile: int
    tiles: int
    cells: IntArray
    measurements: IntArray
    posterior: Posterior


def grid_beliefs(
    engine: Engine, grid: Grid, log_priors: FloatArray, cuts: Sequence[int]
) -> Iterator[tuple[TileBelief, ...]]:
    """Beliefs of every touched tile, each after the first ``cuts[0]``, ``cuts[1]``... measurements.

    Args:
        engine: Holds the measurements, in time order.
        grid: The cells.
        log_priors: Background first, (1 + n,).
        cuts: Increasing counts of measurements; the last is normally all of them.

    Yields:
        For each tile one belief a cut; a tile that nothing has touched yet has no cells.
    """
    touched = list(tiles(grid, engine.pointing))
    for number, tile in enumerate(touched):
        yield tuple(
            TileBelief(
                number, len(touched), cells, evidence.looks, posterior(evidence, log_priors)
            )
            for cells, evidence in _cumulative(engine, grid, tile, cuts)
        )


def _cumulative(
    engine: Engine, grid: Grid, tile: Tile, cuts: Sequence[int]
) -> Iterator[tuple[IntArray, Evidence]]:
    """A tile's touched cells and their evidence up to each cut."""
    pointing = engine.pointing.select(tile.rows)
    seen = sight(grid.centers(tile.cells), grid.cell_size, pointing)
    total: Evidence | None = None
    before = 0
    for cut in cuts:
        window = (tile.rows >= before) & (tile.rows < cut)
        cell, column = np.nonzero(seen.inside & window)
        pairs = Pairs(
            starts=np.searchsorted(cell, np.arange(len(tile.cells) + 1)),
            looks=tile.rows[column],
            ranges=seen.ranges[cell, column],
            directions=seen.directions[cell, column],
        )
        part = engine.evidence(pairs)
        total = part if total is None else total + part
        kept = np.flatnonzero(total.looks)
        yield tile.cells[kept], total.select(kept)
        before = cut
