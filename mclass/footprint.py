"""The grid, and which of its cells a detection points at (paper section IV)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from mclass.blockwise import blocks
from mclass.geometry import NO_WIDTH, opening_angles, wrap_angle
from mclass.records import BoolArray, FloatArray, IntArray

_BORDER = 1e-9
"""A ray this close to a cell [m] meets it: along a border it meets the cells on both sides."""

_TILE = 16
"""Cells along the edge of a tile."""

_PAIRS_AT_ONCE = 2**16
"""Cells times detections that are looked at together."""

_TOUCHING_AT_ONCE = 2**16
"""Detections that are looked for in all tiles together: a dozen numbers are known of each tile."""

TILE_CELLS = _TILE**2


@dataclass(frozen=True)
class Grid:
    """Square cells on the ground plane; cell (row 0, column 0) is the lower-left one.

    Attributes:
        origin: Lower-left corner of cell (0, 0) in the world frame [m].
        cell_size: Edge length [m].
        rows: Number of rows, growing with y.
        columns: Number of columns, growing with x.
    """

    origin: tuple[float, float]
    cell_size: float
    rows: int
    columns: int

    def centers(self, cells: IntArray) -> FloatArray:
        """Centres [m] of flat cell indices (row * columns + column), (..., 2)."""
        row, column = np.divmod(cells, self.columns)
        x = self.origin[0] + (column + 0.5) * self.cell_size
        y = self.origin[1] + (row + 0.5) * self.cell_size
        return np.stack([x, y], axis=-1)

    def cell_at(self, x: float, y: float) -> int | None:
        """Flat index of the cell that holds a point [m], None outside the grid."""
        column = (x - self.origin[0]) / self.cell_size
        row = (y - self.origin[1]) / self.cell_size
        # Compared before they become integers, which infinities and NaN cannot.
        inside = 0 <= row < self.rows and 0 <= column < self.columns
        return int(row) * self.columns + int(column) if inside else None


@dataclass(frozen=True)
class Pointing:
    """Where detections point from, one row each.

    Attributes:
        positions: Sensor positions in the world [m], (n, 2).
        headings: Sensor headings in the world [rad], (n,).
        directions: World azimuths of the box's right and left edge [rad], (n, 2); NaN for none.
        min_range: Nearest distance that is updated [m].
        max_range: Farthest [m].
        rays: Treat every box as a ray through its middle.
    """

    positions: FloatArray
    headings: FloatArray
    directions: FloatArray
    min_range: float
    max_range: float
    rays: bool = False

    @cached_property
    def widths(self) -> FloatArray:
        """Opening angles of the boxes [rad], (n,), 0 for a ray."""
        if self.rays:
            return np.where(np.isfinite(self.directions[:, 0]), 0.0, np.nan)
        return self._openings

    @cached_property
    def axes(self) -> FloatArray:
        """Middle directions of the boxes [rad], (n,)."""
        return np.asarray(self.directions[:, 0] + self._openings / 2.0)

    @cached_property
    def backs(self) -> FloatArray:
        """Directions from the boxes' right edges to the sensor [rad], wrapped, (n,)."""
        return wrap_angle(self.directions[:, 0] + np.pi)

    @cached_property
    def coordinates(self) -> FloatArray:
        """Sensor positions, all x before all y: so they are taken faster, (2, n)."""
        return np.ascontiguousarray(self.positions.T)

    @property
    def _openings(self) -> FloatArray:
        return opening_angles(self.directions)

    def select(self, rows: IntArray) -> Pointing:
        """Only the given rows."""
        return replace(
            self,
            positions=self.positions[rows],
            headings=self.headings[rows],
            directions=self.directions[rows],
        )


def covering_grid(pointing: Pointing, cell_size: float) -> Grid | None:
    """The smallest grid on multiples of the cell size that holds every footprint.

    Returns:
        The grid, or None when no detection points anywhere.
    """
    used = np.isfinite(pointing.directions).all(axis=1)
    if not used.any():
        return None
    rows = np.flatnonzero(used)
    corners = [_bounding_boxes(pointing.select(rows[part])) for part in blocks(len(rows))]
    low = np.min([low.min(axis=0) for low, _ in corners], axis=0)
    high = np.max([high.max(axis=0) for _, high in corners], axis=0)
    first = np.floor(low / cell_size).astype(int)
    last = np.ceil(high / cell_size).astype(int)
    columns, rows = np.maximum(last - first, 1)
    origin = (float(first[0] * cell_size), float(first[1] * cell_size))
    return Grid(origin, cell_size, int(rows), int(columns))


def _bounding_boxes(pointing: Pointing) -> tuple[FloatArray, FloatArray]:
    """Lower-left and upper-right corners of the footprints, (n, 2) each."""
    axes, half = pointing.axes, pointing.widths / 2.0
    # The extreme points of a sector are its corners and where its arc crosses an axis direction.
    angles = np.concatenate(
        [axes + half, axes - half, *(np.full(len(axes), k * np.pi / 2.0) for k in range(4))]
    ).reshape(6, -1)
    reached: BoolArray = np.abs(wrap_angle(angles - axes)) <= half + 1e-12
    arc = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    near, far = arc * pointing.min_range, arc * pointing.max_range
    points = np.concatenate([near, far])
    valid: BoolArray = np.concatenate([reached, reached])[:, :, None]
    low = np.where(valid, points, np.inf).min(axis=0) + pointing.positions
    high = np.where(valid, points, -np.inf).max(axis=0) + pointing.positions
    return low, high


@dataclass(frozen=True)
class Tile:
    """A square of cells and the detections that may point at it.

    Attributes:
        cells: Flat cell indices, (m,).
        numbers: Detections, increasing, (k,); in 32 bits, since a grid's tiles name each often.
    """

    cells: IntArray
    numbers: npt.NDArray[np.int32]

    @property
    def rows(self) -> IntArray:
        """Detections, increasing, (k,)."""
        return self.numbers.astype(np.int64)

    def parts(self, most_pairs: int) -> Iterator[Tile]:
        """The tile cut into runs of cells so that each has few pairs of cells and detections."""
        step = max(1, most_pairs // max(1, len(self.numbers)))
        for start in range(0, len(self.cells), step):
            yield Tile(self.cells[start : start + step], self.numbers)


def tiles(grid: Grid, pointing: Pointing) -> Iterator[Tile]:
    """The grid's touched tiles, each with its candidate detections.

    Work in a tile is dense, its evidence fits the cache, and what no footprint comes near
    is never visited.
    """
    usable = np.flatnonzero(np.isfinite(pointing.directions).all(axis=1))
    if len(usable) == 0:
        return
    parts = (_tiles_near(grid, pointing, usable[part]) for part in blocks(len(usable)))
    across = -(-grid.columns // _TILE)
    # Tile and detection in one number: both are sorted at once, and nothing is moved besides.
    count = len(pointing.positions)
    found = np.concatenate([keys * count + rows for keys, rows in parts])
    found.sort()
    start = 0
    while start < len(found):
        key = int(found[start]) // count
        stop = int(np.searchsorted(found, (key + 1) * count))
        upper, left = divmod(key, across)
        row = np.arange(upper * _TILE, min((upper + 1) * _TILE, grid.rows))
        column = np.arange(left * _TILE, min((left + 1) * _TILE, grid.columns))
        cells = (row[:, None] * grid.columns + column[None, :]).ravel()
        yield Tile(cells, (found[start:stop] - key * count).astype(np.int32))
        start = stop


def _tiles_near(grid: Grid, pointing: Pointing, usable: IntArray) -> tuple[IntArray, IntArray]:
    """Numbers of tiles that detections may point at, and the detections, (p,) each."""
    low, high = _bounding_boxes(pointing.select(usable))
    low, high = low - _BORDER, high + _BORDER
    size = grid.cell_size * _TILE
    across = -(-grid.columns // _TILE)
    upward = -(-grid.rows // _TILE)
    limits = np.array([across, upward]) - 1
    first = np.floor((low - grid.origin) / size).astype(np.int64)
    last = np.floor((high - grid.origin) / size).astype(np.int64)
    outside = np.any((last < 0) | (first > limits), axis=1)
    first, last = np.clip(first, 0, limits), np.clip(last, 0, limits)
    spans = np.where(outside.reshape(-1, 1), 0, last - first + 1)
    counts = spans[:, 0] * spans[:, 1]
    owner = np.repeat(np.arange(len(usable)), counts)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    tile_x = first[owner, 0] + within % np.maximum(spans[owner, 0], 1)
    tile_y = first[owner, 1] + within // np.maximum(spans[owner, 0], 1)
    centers = np.asarray(grid.origin) + (np.stack([tile_x, tile_y], axis=-1) + 0.5) * size
    rows = usable[owner]
    near = _near_sector(pointing, rows, centers, size * np.sqrt(0.5))
    return (tile_y * across + tile_x)[near], rows[near]


def touching(grid: Grid, pointing: Pointing) -> BoolArray:
    """Which detections point at some cell of the grid, (k,)."""
    return np.concatenate(
        [
            _touching(grid, pointing.select(np.arange(part.start, part.stop)))
            for part in blocks(len(pointing.positions), _TOUCHING_AT_ONCE)
        ]
    )


def _touching(grid: Grid, pointing: Pointing) -> BoolArray:
    touches = np.zeros(len(pointing.positions), dtype=bool)
    for tile in tiles(grid, pointing):
        # Most are found in their first tile, and are not looked for again.
        unseen = Tile(tile.cells, tile.numbers[~touches[tile.numbers]])
        rows = unseen.rows
        for part in unseen.parts(_PAIRS_AT_ONCE) if len(rows) else ():
            seen = sight(grid.centers(part.cells), grid.cell_size, pointing.select(rows))
            touches[rows] |= seen.inside.any(axis=0)
    return touches


def _near_sector(
    pointing: Pointing, rows: IntArray, centers: FloatArray, radius: float
) -> BoolArray:
    """Whether a disc around each centre may meet the sector of its detection; never misses one."""
    offset = centers - pointing.positions[rows]
    distance = np.hypot(offset[:, 0], offset[:, 1])
    angle = np.abs(wrap_angle(np.arctan2(offset[:, 1], offset[:, 0]) - pointing.axes[rows]))
    slack = np.arcsin(np.minimum(radius / np.maximum(distance, radius), 1.0))
    in_angle = (angle <= pointing.widths[rows] / 2.0 + slack + 1e-9) | (distance <= radius)
    in_range = (distance >= pointing.min_range - radius) & (distance <= pointing.max_range + radius)
    return np.asarray(in_angle & in_range)


@dataclass(frozen=True)
class Sight:
    """Cells seen from sensors, (m, k) each: cell i, detection j.

    Attributes:
        ranges: Distance [m].
        directions: World direction of the sensor seen from the cell [rad].
        inside: Whether the footprint holds the cell.
    """

    ranges: FloatArray
    directions: FloatArray
    inside: BoolArray

    def select(self, cells: IntArray) -> Sight:
        """Only the given cells."""
        return Sight(self.ranges[cells], self.directions[cells], self.inside[cells])

    def select_looks(self, columns: IntArray) -> Sight:
        """Only the given detections."""
        return Sight(self.ranges[:, columns], self.directions[:, columns], self.inside[:, columns])


def sight(
    centers: FloatArray, cell_size: float, pointing: Pointing, rows: IntArray | None = None
) -> Sight:
    """Range, direction and footprint test of every cell for every detection.

    A cone holds a cell whose centre lies between its edges and within the range, both ends
    included; a ray holds the cells that its segment meets.

    Args:
        centers: Cell centres [m], (m, 2).
        cell_size: Edge length [m].
        pointing: The detections.
        rows: Those that are looked at, (k,); all when None.
    """
    rows = np.arange(len(pointing.positions)) if rows is None else rows
    x, y = pointing.coordinates
    offset_x = x.take(rows) - centers[:, None, 0]
    offset_y = y.take(rows) - centers[:, None, 1]
    # Not np.hypot: what it guards against cannot happen here, and it takes seven times as long.
    ranges = np.sqrt(offset_x * offset_x + offset_y * offset_y)
    directions = np.arctan2(offset_y, offset_x)
    # How far to the left of the right edge, perhaps less a turn: both angles are within one.
    from_right = directions - pointing.backs.take(rows)
    widths = pointing.widths.take(rows)
    inside = (from_right >= 0.0) & (from_right <= widths)
    inside |= from_right <= widths - 2.0 * np.pi
    inside &= (ranges >= pointing.min_range) & (ranges <= pointing.max_range)
    is_ray = np.flatnonzero(widths < NO_WIDTH)
    if len(is_ray):
        axes = pointing.axes[rows[is_ray]]
        inside[:, is_ray] = _segment_meets_square(
            -offset_x[:, is_ray], -offset_y[:, is_ray], axes, cell_size / 2.0 + _BORDER, pointing
        )
    return Sight(ranges, directions, inside)


def _segment_meets_square(
    offset_x: FloatArray, offset_y: FloatArray, axes: FloatArray, half: float, pointing: Pointing
) -> BoolArray:
    """Whether the segment from min to max range meets the square, its border included."""
    enter = np.full(offset_x.shape, pointing.min_range)
    leave = np.full(offset_x.shape, pointing.max_range)
    for offset, slope in ((offset_x, np.cos(axes)), (offset_y, np.sin(axes))):
        # A slope of 0 gives entry and exit at plus or minus infinity, as it should.
        safe = np.where(np.abs(slope) < 1e-300, 1e-300, slope)
        one, other = (offset - half) / safe, (offset + half) / safe
        np.maximum(enter, np.minimum(one, other), out=enter)
        np.minimum(leave, np.maximum(one, other), out=leave)
    return np.asarray(enter <= leave)
