from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle import Reach, Sighting, footprint_holds
from strategies import angles, floats, grids

from mclass.footprint import Grid, Pointing, covering_grid, sight, tiles, touching
from mclass.records import FloatArray


def pointing_of(
    sensors: list[list[float]],
    directions: list[list[float]],
    min_range: float,
    max_range: float,
    *,
    rays: bool = False,
) -> Pointing:
    return Pointing(
        positions=np.array(sensors, dtype=float).reshape(-1, 2),
        headings=np.zeros(len(sensors)),
        directions=np.array(directions, dtype=float).reshape(-1, 2),
        min_range=min_range,
        max_range=max_range,
        rays=rays,
    )


def held_cells(grid: Grid, pointing: Pointing) -> list[set[int]]:
    """For every detection the cells in its footprint, found through the tiles."""
    held: list[set[int]] = [set() for _ in pointing.positions]
    for tile in tiles(grid, pointing):
        seen = sight(grid.centers(tile.cells), grid.cell_size, pointing.select(tile.rows))
        for cell, column in zip(*np.nonzero(seen.inside), strict=True):
            held[int(tile.rows[column])].add(int(tile.cells[cell]))
    return held


# --- Grid --------------------------------------------------------------------------------------


def test_centers_by_hand() -> None:
    grid = Grid((-1.0, 2.0), 0.5, rows=3, columns=4)
    np.testing.assert_allclose(
        grid.centers(np.array([0, 3, 4, 11])),
        [[-0.75, 2.25], [0.75, 2.25], [-0.75, 2.75], [0.75, 3.25]],
    )


@pytest.mark.parametrize(
    ("x", "y", "cell"),
    [
        (-1.0, 2.0, 0),
        (-0.51, 2.1, 0),
        (-0.49, 2.1, 1),
        (-0.9, 2.6, 4),
        (0.99, 3.49, 11),
        (1.01, 2.1, None),
        (-1.01, 2.1, None),
        (0.0, 1.99, None),
        (0.0, 3.51, None),
    ],
)
def test_cell_at_by_hand(x: float, y: float, cell: int | None) -> None:
    assert Grid((-1.0, 2.0), 0.5, rows=3, columns=4).cell_at(x, y) == cell


@given(grids())
def test_cell_at_a_center_is_that_cell(grid: Grid) -> None:
    cells = np.arange(grid.rows * grid.columns)
    assert [grid.cell_at(x, y) for x, y in grid.centers(cells)] == cells.tolist()


# --- Which cells -------------------------------------------------------------------------------


def test_cone_by_hand() -> None:
    # From (0.5, 0.5) between -20° and +50°, 0.9 to 2.3 m, centres on whole and half metres:
    # (1.5, 0.5), (2.5, 0.5), (1.5, 1.5) at 45° and 1.41 m, (2.5, 1.5) at 26.6° and 2.24 m.
    grid = Grid((0.0, -1.0), 1.0, rows=4, columns=4)
    edges = [math.radians(-20.0), math.radians(50.0)]
    pointing = pointing_of([[0.5, 0.5]], [edges], 0.9, 2.3)
    assert held_cells(grid, pointing) == [{5, 6, 9, 10}]


def test_cone_across_the_wrap() -> None:
    grid = Grid((-3.0, -1.5), 1.0, rows=3, columns=3)
    edges = [math.radians(160.0), math.radians(-175.0)]
    # Due west at y = 0: centres at 180°; (-1.5, 1) is at 146°, (-2.5, 1) at 158.2°.
    assert held_cells(grid, pointing_of([[0.0, 0.0]], [edges], 0.2, 3.0)) == [{3, 4, 5}]


def test_cone_wider_than_half_a_turn() -> None:
    grid = Grid((-1.5, -1.5), 1.0, rows=3, columns=3)
    edges = [math.radians(10.0), math.radians(-10.0)]
    # All eight neighbours but the one due east; the sensor's own cell is too near.
    held = held_cells(grid, pointing_of([[0.0, 0.0]], [edges], 0.5, 2.0))
    assert held == [{0, 1, 2, 3, 6, 7, 8}]


def test_range_borders_belong_to_the_footprint() -> None:
    grid = Grid((0.0, -0.5), 1.0, rows=1, columns=6)
    pointing = pointing_of([[0.5, 0.0]], [[-0.1, 0.1]], 1.0, 4.0)
    assert held_cells(grid, pointing) == [{1, 2, 3, 4}]


def test_ray_by_hand() -> None:
    # From (0.5, 0.4) with slope 1/3 the ray enters row 1 at x = 2.3 and ends 4 m on, at x = 4.29.
    grid = Grid((0.0, 0.0), 1.0, rows=3, columns=6)
    slope = math.atan2(1.0, 3.0)
    box = [slope - 0.1, slope + 0.1]
    assert held_cells(grid, pointing_of([[0.5, 0.4]], [box], 0.0, 4.0, rays=True)) == [
        {0, 1, 2, 8, 9, 10}
    ]
    without_width = pointing_of([[0.5, 0.4]], [[slope, slope]], 0.0, 4.0)
    assert held_cells(grid, without_width) == [{0, 1, 2, 8, 9, 10}]


def test_ray_starts_at_min_range() -> None:
    grid = Grid((0.0, 0.0), 1.0, rows=1, columns=6)
    pointing = pointing_of([[0.5, 0.5]], [[0.0, 0.0]], 1.6, 3.1)
    assert held_cells(grid, pointing) == [{2, 3}]


@pytest.mark.parametrize("first_row", [-16, -15, -8, -32])
def test_ray_along_a_border_of_cells(first_row: int) -> None:
    grid = Grid((0.0, 0.1 * first_row), 0.1, rows=40, columns=20)
    held = held_cells(grid, pointing_of([[0.0, 0.0]], [[0.0, 0.0]], 0.25, 0.95))[0]
    # The cells above and below, as the segment meets the closed squares of both.
    assert held == {
        row * 20 + column for row in (-first_row - 1, -first_row) for column in range(2, 10)
    }


def test_no_direction_points_nowhere() -> None:
    grid = Grid((-2.0, -2.0), 0.5, rows=8, columns=8)
    pointing = pointing_of([[0, 0], [0, 0]], [[math.nan, math.nan], [0.0, 1.0]], 0.2, 3.0)
    held = held_cells(grid, pointing)
    assert held[0] == set()
    assert held[1]


def test_footprints_beside_the_grid() -> None:
    grid = Grid((0.0, 1.0), 0.25, rows=2, columns=2)
    assert held_cells(grid, pointing_of([[0.0, 0.0]], [[0.0, 0.0]], 0.0, 1.0)) == [set()]


def test_sight_by_hand() -> None:
    # The sensor at (1, 2) seen from a cell at (4, -2): 5 m away, up and to the left.
    seen = sight(np.array([[4.0, -2.0]]), 0.1, pointing_of([[1.0, 2.0]], [[-1.0, 0.0]], 0.2, 9.0))
    assert seen.ranges[0, 0] == pytest.approx(5.0)
    assert seen.directions[0, 0] == pytest.approx(math.atan2(4.0, -3.0))
    assert seen.inside[0, 0]


@given(
    grids(most=20),
    st.lists(
        st.tuples(
            floats(-4.0, 6.0),
            floats(-4.0, 6.0),
            angles(),
            st.one_of(st.just(0.0), floats(0.01, 6.2)),
        ),
        min_size=1,
        max_size=4,
    ),
    floats(0.0, 1.0),
    floats(0.5, 5.0),
    st.booleans(),
)
@settings(deadline=None, max_examples=60)
def test_cells_match_oracle(
    grid: Grid,
    boxes: list[tuple[float, float, float, float]],
    min_range: float,
    depth: float,
    rays: bool,
) -> None:
    max_range = min_range + depth
    boxes = [*boxes, (grid.origin[0] - min_range, grid.origin[1], 0.5, 0.4)]
    pointing = pointing_of(
        [[x, y] for x, y, _, _ in boxes],
        [[middle - width / 2, middle + width / 2] for _, _, middle, width in boxes],
        min_range,
        max_range,
        rays=rays,
    )
    kind = "ray" if rays else "cone"
    cells_held = held_cells(grid, pointing)
    assert touching(grid, pointing).tolist() == [bool(held) for held in cells_held]
    for box, held in zip(boxes, cells_held, strict=True):
        x, y, middle, width = box
        view = Sighting((), np.array([x, y]), 0.0, middle - width / 2, middle + width / 2)
        cells = range(grid.rows * grid.columns)
        # A cell whose border is met to rounding may count either way.
        surely, possibly = (
            {c for c in cells if footprint_holds(grid, c, view, reach)}
            for reach in (
                Reach(min_range, max_range, kind, -1e-9),
                Reach(min_range, max_range, kind, 1e-9),
            )
        )
        assert surely <= held <= possibly


# --- Extent ------------------------------------------------------------------------------------


def test_covering_grid_by_hand() -> None:
    # From (0.3, 0.3), 90° wide around north-east, up to 1 m: the footprint's corners are
    # (0.3, 1.3) and (1.3, 0.3), its nearest points at 0.2 m.
    pointing = pointing_of([[0.3, 0.3]], [[0.0, math.pi / 2]], 0.2, 1.0)
    grid = covering_grid(pointing, 0.25)
    assert grid == Grid((0.25, 0.25), 0.25, rows=5, columns=5)


def test_covering_grid_reaches_the_arc() -> None:
    # Around north, the arc's top is farther up than the footprint's corners.
    pointing = pointing_of([[0.0, 0.0]], [[math.radians(60), math.radians(120)]], 0.5, 2.05)
    grid = covering_grid(pointing, 0.5)
    # Corners at x = ±1.025 and y = 0.433 to 2.05.
    assert grid == Grid((-1.5, 0.0), 0.5, rows=5, columns=6)


def test_nothing_points_anywhere() -> None:
    assert covering_grid(pointing_of([[0, 0]], [[math.nan, math.nan]], 0.2, 3.0), 0.1) is None
    grid = Grid((0.0, 0.0), 0.1, 4, 4)
    assert not list(tiles(grid, pointing_of([[0, 0]], [[math.nan, math.nan]], 0.2, 3.0)))


@given(floats(-50.0, 50.0), floats(-50.0, 50.0), angles(), floats(0.0, 6.0), floats(0.05, 0.7))
@settings(deadline=None)
def test_covering_grid_holds_the_whole_footprint(
    x: float, y: float, middle: float, width: float, cell_size: float
) -> None:
    pointing = pointing_of([[x, y]], [[middle - width / 2, middle + width / 2]], 0.3, 2.0)
    grid = covering_grid(pointing, cell_size)
    assert grid is not None
    across = np.linspace(middle - width / 2, middle + width / 2, 97)
    low = np.array(grid.origin)
    high = low + np.array([grid.columns, grid.rows]) * grid.cell_size
    for distance in (0.3, 1.1, 2.0):
        points: FloatArray = np.array([x, y]) + distance * np.stack(
            [np.cos(across), np.sin(across)], axis=-1
        )
        assert np.all(points >= low - 1e-9)
        assert np.all(points <= high + 1e-9)
    # No wider than needed: a margin of less than one cell on each side of the reachable disc.
    assert np.all(high - low <= 4.0 + 2.0 * cell_size + 1e-9)


def test_far_tiles_are_left_out() -> None:
    # A narrow cone into one corner of a large grid touches few of its many tiles.
    grid = Grid((0.0, 0.0), 0.1, rows=400, columns=400)
    pointing = pointing_of([[1.0, 1.0]], [[0.0, 0.2]], 0.2, 4.0)
    visited = list(tiles(grid, pointing))
    assert 0 < len(visited) <= 8
    assert all(len(tile.cells) <= 16 * 16 for tile in visited)


@pytest.mark.parametrize("place", [math.nan, math.inf, -math.inf, 1e308, -1e308])
def test_no_cell_holds_what_is_no_place(place: float, small_grid: Grid) -> None:
    assert small_grid.cell_at(place, 0.0) is None
    assert small_grid.cell_at(0.0, place) is None
