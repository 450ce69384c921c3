"""Rows worked on a block at a time, so that what is held in between does not grow with them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

ROWS = 2**14
"""Of a block."""

Columns = tuple[npt.NDArray[Any], ...]


def blocks(count: int, rows: int = ROWS) -> Iterator[slice]:
    """Slices of so many rows each that make up all of them; one if there are none."""
    for start in range(0, max(count, 1), rows):
        yield slice(start, min(start + rows, count))


def blockwise(function: Callable[..., Columns], *columns: npt.NDArray[Any]) -> Columns:
    """What a function makes of columns, (n, ...) each, row by row: other columns."""
    parts = [function(*(c[rows] for c in columns)) for rows in blocks(len(columns[0]))]
    if len(parts) == 1:
        return parts[0]
    return tuple(np.concatenate(column) for column in zip(*parts, strict=True))
