"""Class maps as rasters, row by row with x fastest, from sparse cells and back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mclass.errors import LogError
from mclass.footprint import Grid
from mclass.outputs.colors import palette
from mclass.records import FloatArray
from mclass.results import ClassMaps

UNTOUCHED = -1
"""Occupancy of a cell that no footprint touched."""

_UINT8, _FLOAT32 = 1, 7
_COLORS = ("red", "green", "blue", "alpha")
_PREFIX = "p_"
_FAINTEST = 40.0


@dataclass(frozen=True)
class PackedCells:
    """Cells as Foxglove's grids hold them.

    Attributes:
        fields: Name, byte offset and numeric type of each field.
        cell_stride: Bytes of a cell.
        data: (rows * columns, cell_stride).
    """

    fields: tuple[tuple[str, int, int], ...]
    cell_stride: int
    data: npt.NDArray[np.uint8]


def occupancy(maps: ClassMaps) -> npt.NDArray[np.int8]:
    """Percentages of the background and each class, (1 + n, rows * columns)."""
    shape = (len(maps.untouched), maps.grid.rows * maps.grid.columns)
    percent = np.full(shape, UNTOUCHED, dtype=np.int8)
    percent[:, maps.cells] = np.rint(100.0 * maps.class_probabilities.T)
    return percent


def pack_cells(maps: ClassMaps, names: tuple[str, ...]) -> PackedCells:
    """Probabilities in float32 and a colour for every cell.

    The colour is that of the classes mixed by their probabilities, and as opaque as a cell
    is not background; cells that no footprint touched hold the prior and are transparent.

    Args:
        maps: The maps.
        names: Of the background and the classes, (1 + n).
    """
    n_fields = len(names)
    cells = maps.grid.rows * maps.grid.columns
    values = np.empty((cells, n_fields), dtype="<f4")
    values[:] = maps.untouched
    values[maps.cells] = maps.class_probabilities
    colors = np.zeros((cells, len(_COLORS)), dtype=np.uint8)
    presence = 1.0 - maps.class_probabilities[:, 0]
    colors[maps.cells, :3] = np.rint(maps.class_probabilities @ palette(n_fields - 1))
    colors[maps.cells, 3] = np.rint(_FAINTEST + (255.0 - _FAINTEST) * presence)
    offset = 4 * n_fields
    fields = [(f"{_PREFIX}{name}", 4 * index, _FLOAT32) for index, name in enumerate(names)]
    fields += [(name, offset + index, _UINT8) for index, name in enumerate(_COLORS)]
    data = np.concatenate([values.view(np.uint8), colors], axis=1)
    return PackedCells(tuple(fields), offset + len(_COLORS), data)


def unpack_cells(
    packed: PackedCells, names: tuple[str, ...], grid: Grid, stamp_ns: int, log_time_ns: int
) -> ClassMaps:
    """The maps that `pack_cells` packed, as precise as float32; rows sum to 1 again.

    Raises:
        LogError: If the fields are not those of these classes.
    """
    expected = [(f"{_PREFIX}{name}", 4 * index, _FLOAT32) for index, name in enumerate(names)]
    if list(packed.fields[: len(names)]) != expected:
        raise LogError("the grid has other classes than the log's model")
    values = np.ascontiguousarray(packed.data[:, : 4 * len(names)]).view("<f4").astype(np.float64)
    touched = packed.data[:, -1] > 0
    cells = np.flatnonzero(touched).astype(np.int64)
    rest = np.flatnonzero(~touched)
    # With every cell touched nothing asks for what the others hold.
    untouched = values[rest[0]] if rest.size else np.full(len(names), 1.0 / len(names))
    return ClassMaps(
        grid, stamp_ns, log_time_ns, cells, _normalised(values[cells]), _normalised(untouched)
    )


def _normalised(probabilities: FloatArray) -> FloatArray:
    return np.asarray(probabilities / probabilities.sum(axis=-1, keepdims=True))
