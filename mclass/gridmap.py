"""Beliefs of the grid's cells, independent of each other (paper section IV), tile by tile."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mclass.belief import Posterior, posterior
from mclass.evidence import Engine, Evidence
from mclass.footprint import Grid, Tile, tiles
from mclass.looks import Looks, grid_pairs
from mclass.records import FloatArray, IntArray


@dataclass(frozen=True)
class TileBelief:
    """The touched cells of one tile after some of the looks.

    Attributes:
        tile: Number of the tile, from 0.
        tiles: How many tiles the grid's belief has.
        cells: Flat indices of touched cells, (m,).
        looks: How many looks touched each, (m,).
        posterior: Their belief.
    """

    tile: int
    tiles: int
    cells: IntArray
    looks: IntArray
    posterior: Posterior


def grid_beliefs(
    engine: Engine, looks: Looks, grid: Grid, log_priors: FloatArray, cuts_ns: Sequence[int]
) -> Iterator[tuple[TileBelief, ...]]:
    """Beliefs of every touched tile, each from the looks up to each of the cuts.

    Args:
        engine: Sums evidence.
        looks: All looks.
        grid: The cells.
        log_priors: Background first, (1 + n,).
        cuts_ns: Increasing stamps.

    Yields:
        For each tile one belief a cut; a tile that nothing has touched yet has no cells.
    """
    touched = list(tiles(grid, looks.pointing))
    for number, tile in enumerate(touched):
        yield tuple(
            TileBelief(
                number,
                len(touched),
                cells,
                evidence.looks,
                posterior(evidence, log_priors, engine.shown_bins),
            )
            for cells, evidence in _cumulative(engine, looks, grid, tile, cuts_ns)
        )


def _cumulative(
    engine: Engine, looks: Looks, grid: Grid, tile: Tile, cuts_ns: Sequence[int]
) -> Iterator[tuple[IntArray, Evidence]]:
    """A tile's touched cells and their evidence up to each cut."""
    pairs = grid_pairs(looks, grid.centers(tile.cells), grid.cell_size, tile.rows)
    stamps = looks.stamps_ns[pairs.looks]
    total: Evidence | None = None
    before = np.iinfo(np.int64).min
    for cut in cuts_ns:
        part = engine.evidence(pairs.select((stamps > before) & (stamps <= cut)))
        total = part if total is None else total + part
        kept = np.flatnonzero(total.looks)
        yield tile.cells[kept], total.select(kept)
        before = cut
