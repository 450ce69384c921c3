"""Which looks concern which cells: pairs of both, in columns."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from mclass.records import BoolArray, FloatArray, IntArray


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
            looks=self.looks.take(kept),
            ranges=self.ranges.take(kept),
            directions=self.directions.take(kept),
            scale=None if self.scale is None else self.scale.take(kept),
        )

    def within(self, rows: slice) -> Pairs:
        """Only the pairs of some of the rows, and these rows alone."""
        starts = self.starts[rows.start : rows.stop + 1]
        own = slice(starts[0], starts[-1])
        return Pairs(
            starts=starts - starts[0],
            looks=self.looks[own],
            ranges=self.ranges[own],
            directions=self.directions[own],
            scale=None if self.scale is None else self.scale[own],
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

    @property
    def columns(self) -> tuple[IntArray, FloatArray, FloatArray, FloatArray | None]:
        """What tables are read with: starts, ranges, directions, scale."""
        return self.starts, self.ranges, self.directions, self.scale

    def blocks(self, most_pairs: int, most_rows: int | None = None) -> Iterator[slice]:
        """Cut the rows into blocks.

        Args:
            most_pairs: Of a block of more than one row.
            most_rows: Of a block.
        """
        first, rows = 0, len(self.starts) - 1
        while first < rows:
            end = self.starts[first] + most_pairs
            fitting = int(np.searchsorted(self.starts, end, side="right")) - 1
            last = min(max(fitting, first + 1), first + (most_rows or rows), rows)
            yield slice(first, last)
            first = last
