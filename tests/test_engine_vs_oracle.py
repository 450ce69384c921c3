"""The filter as a whole against the brute-force oracle, and what must hold for any input."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from models import lopsided_model, measurements_of, mixture_of, permuted, scaled_model, toy_model
from oracle import (
    TURN,
    Belief,
    ObjectBelief,
    Reach,
    belief_at,
    cell_belief,
    center_of,
    footprint_holds,
    object_belief,
    rotation,
    sightings,
)
from scipy.special import logsumexp
from strategies import class_models, grids, label_measurements, poses

from mclass.classes import ClassModel, LabelLikelihood
from mclass.footprint import Grid
from mclass.inference import GridEstimate, Problem, cuts_every, estimate_objects, prepare
from mclass.model import GridSettings, InferenceSettings, Model
from mclass.records import FloatArray, LabelMeasurements
from mclass.results import BeliefBlock, ObjectEstimate

BINS = 72
FINER = 20
"""Bins of the oracle for each of the filter's."""

PROBABILITY = 1e-4
LOG_BELIEF = 1e-3
DEPTH = 20.0
"""Log beliefs are compared down to this far below the peak."""

NEAR, FAR = 0.2, 3.0
OUTSIDE = 1e-3

few = settings(
    max_examples=12,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)


@pytest.fixture(autouse=True, scope="module")
def _tables() -> Iterator[None]:
    """Little is summed here, which would be done without tables."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mclass.inference._LITTLE_WORK", 0.0)
        yield


def model_of(
    classes: ClassModel,
    grid: Grid | None = None,
    *,
    kind: str = "cone",
    bins: int = BINS,
    objects: dict[str, tuple[float, float]] | None = None,
    reach: tuple[float, float] = (NEAR, FAR),
) -> Model:
    cell_size = 0.1 if grid is None else grid.cell_size
    size = None if grid is None else (grid.columns * cell_size, grid.rows * cell_size)
    return Model(
        name="test.yaml",
        source="",
        length_unit="m",
        classes=classes,
        grid=GridSettings(
            cell_size=cell_size,
            orientation_bins=bins,
            footprint="ray" if kind == "ray" else "cone",
            min_range=reach[0],
            max_range=reach[1],
            origin=None if grid is None else grid.origin,
            size=size,
        ),
        inference=InferenceSettings(preset="paper", outside_probability=OUTSIDE),
        objects=objects or {},
    )


def grid_block(problem: Problem) -> BeliefBlock:
    """The final belief of all touched cells, tiles joined."""
    blocks = list(GridEstimate(problem, cuts_every(problem.measurements, None)).blocks())
    assert blocks
    cells = np.concatenate([block.cells for block in blocks])
    order = np.argsort(cells)

    return replace(
        blocks[0],
        cells=cells[order],
        log_class_probability=np.concatenate([b.log_class_probability for b in blocks])[order],
        log_density=np.concatenate([b.log_density for b in blocks])[order],
        measurements=np.concatenate([b.measurements for b in blocks])[order],
    )


def assert_same_belief(block: BeliefBlock, row: int, expected: Belief) -> None:
    """One cell's class probabilities and, where it matters, its log density at the bins.

    The density is normalised over its bins, which are too coarse for the sharpest beliefs.
    """
    log_class = block.log_class_probability[row]
    probabilities = expected.class_probabilities
    np.testing.assert_allclose(np.exp(log_class), probabilities, rtol=0, atol=PROBABILITY)
    possible = probabilities[1:] > 0.0
    log_possible = np.log(probabilities[1:][possible, None])
    wanted = expected.log_classes[possible, ::FINER]
    wanted = wanted - logsumexp(wanted, axis=1, keepdims=True)
    wanted += math.log(wanted.shape[1] / TURN) + log_possible
    joint = log_possible + block.log_density[row][possible]
    peak = max(expected.log_background, float(expected.log_classes.max()))
    matters = wanted > peak - DEPTH
    np.testing.assert_allclose(joint[matters], wanted[matters], rtol=0, atol=LOG_BELIEF)


def assert_same_angle(actual: float, expected: float, tolerance: float) -> None:
    assert abs(math.remainder(actual - expected, TURN)) <= tolerance


# --- Grid --------------------------------------------------------------------------------------


@given(st.data(), class_models(), grids(), st.sampled_from(["cone", "ray"]))
@few
def test_grid_cells(data: st.DataObject, classes: ClassModel, grid: Grid, kind: str) -> None:
    measurements = data.draw(label_measurements(classes, grid))
    block = grid_block(prepare(model_of(classes, grid, kind=kind), measurements))
    seen = sightings(measurements)
    held = dict(zip(block.cells.tolist(), range(len(block.cells)), strict=True))
    compared = 0
    for cell in range(grid.rows * grid.columns):
        inner, outer = (
            sum(footprint_holds(grid, cell, s, Reach(NEAR, FAR, kind, slack)) for s in seen)
            for slack in (-1e-9, 1e-9)
        )
        if inner != outer:
            continue
        assert (cell in held) == (inner > 0)
        if cell in held and compared < 6:
            row = held[cell]
            assert block.measurements[row] == inner
            expected = cell_belief(
                classes, seen, grid, cell, Reach(NEAR, FAR, kind), bins=BINS * FINER
            )
            assert_same_belief(block, row, expected)
            compared += 1


@given(st.data(), class_models(bearing=True), grids(most=4))
@few
def test_grid_cells_with_bearing_terms(
    data: st.DataObject, classes: ClassModel, grid: Grid
) -> None:
    measurements = data.draw(label_measurements(classes, grid, most=3))
    block = grid_block(prepare(model_of(classes, grid), measurements))
    seen = sightings(measurements)
    for row in range(0, len(block.cells), 4):
        cell = int(block.cells[row])
        reach = Reach(NEAR, FAR)
        expected = cell_belief(classes, seen, grid, cell, reach, bins=BINS * FINER)
        if sum(footprint_holds(grid, cell, s, reach) for s in seen) == block.measurements[row]:
            assert_same_belief(block, row, expected)


def test_cells_nearer_than_the_range() -> None:
    # A ray's first cell may have its centre nearer to the sensor than the ray begins.
    grid = Grid((0.0, 0.0), 0.5, 4, 4)
    measurements = measurements_of([[0.6, 0.6, 0.3]], [(0,)], [[0.0, 0.0]])
    block = grid_block(prepare(model_of(lopsided_model(), grid, reach=(0.35, 3.0)), measurements))
    assert 5 in block.cells
    for row, cell in enumerate(block.cells):
        expected = belief_at(
            lopsided_model(), sightings(measurements), center_of(grid, int(cell)), BINS * FINER
        )
        assert_same_belief(block, row, expected)


def contradicting() -> tuple[ClassModel, Grid, LabelMeasurements]:
    """Label c1 from all around, without clutter: tails upon tails decide, not the background."""
    rng = np.random.default_rng(6)
    target = np.array([0.4, 0.4])
    sensors, directions = [], []
    for _ in range(100):
        azimuth, distance = rng.uniform(-math.pi, math.pi), rng.uniform(0.8, 1.8)
        step = distance * np.array([math.cos(azimuth), math.sin(azimuth)])
        sensors.append([*(target - step), azimuth])
        directions.append([azimuth - 0.2, azimuth + 0.2])
    classes = replace(toy_model(unit=0.1), background_log_likelihood=np.full(2, -1000.0))
    measurements = measurements_of(sensors, [(0,)] * 100, directions, label_names=("c1", "c2"))
    return classes, Grid((0.0, 0.0), 0.1, 8, 8), measurements


def test_contradicting_measurements() -> None:
    classes, grid, measurements = contradicting()
    assert_same_beliefs(classes, grid, measurements)


def assert_same_beliefs(
    classes: ClassModel, grid: Grid, measurements: LabelMeasurements, bins: int = BINS
) -> None:
    """Every few cells of a grid."""
    reach = (NEAR, 10.0)
    block = grid_block(prepare(model_of(classes, grid, bins=bins, reach=reach), measurements))
    seen = sightings(measurements)
    for row in range(0, len(block.cells), 5):
        cell = int(block.cells[row])
        expected = cell_belief(classes, seen, grid, cell, Reach(*reach), bins=bins * FINER)
        assert_same_belief(block, row, expected)


def test_contradicting_measurements_from_narrow_views() -> None:
    _, grid, measurements = contradicting()
    assert_same_beliefs(narrow_model(0.03, clutter=0.0), grid, permuted(measurements, range(60)))


def narrow_model(variance: float, clutter: float) -> ClassModel:
    """Two classes that give the same label from other sides; the background is out of the game."""
    round_view, skewed = np.eye(2) * variance, np.array([[1.0, 0.3], [0.3, 2.0]]) * variance
    return ClassModel(
        class_names=("one", "two"),
        label_names=("c1", "c2"),
        log_priors=np.log([0.4, 0.3, 0.3]),
        background_log_likelihood=np.full(2, -1000.0),
        likelihoods={
            (0, 0): LabelLikelihood(0.9, mixture_of([1.0], [[0.0, -1.0]], [round_view]), clutter),
            (1, 0): LabelLikelihood(
                0.9,
                mixture_of([0.5, 0.5], [[-1.0, 0.0], [0.7, 0.6]], [round_view, skewed]),
                clutter,
            ),
        },
    )


def test_fine_bins_and_long_range() -> None:
    _, grid, measurements = contradicting()
    rows = permuted(measurements, range(8))
    assert_same_beliefs(narrow_model(0.1, clutter=1e-3), grid, rows, bins=360)


# --- Known positions ---------------------------------------------------------------------------


@given(st.data(), class_models(bearing=True), grids(most=3))
@few
def test_known_position(data: st.DataObject, classes: ClassModel, grid: Grid) -> None:
    measurements = data.draw(label_measurements(classes, grid, most=6))
    measurements = replace(
        measurements, object_index=np.zeros(len(measurements), dtype=np.int64), object_ids=("o",)
    )
    position = center_of(grid, 0) + np.array([0.03, -0.05])
    model = model_of(classes, grid, objects={"o": (float(position[0]), float(position[1]))})
    estimates, _ = estimate_objects(prepare(model, measurements))
    assert [estimate.measurements for estimate in estimates] == [*range(1, len(measurements) + 1)]
    for estimate in estimates:
        seen = sightings(measurements, range(estimate.measurements))
        expected = belief_at(classes, seen, position, bins=BINS * FINER)
        np.testing.assert_allclose(
            estimate.class_probabilities, expected.class_probabilities, rtol=0, atol=PROBABILITY
        )
        assert_same_modes(estimate, expected)
        np.testing.assert_allclose(estimate.position, position, rtol=1e-12)


def assert_same_modes(estimate: ObjectEstimate, expected: Belief) -> None:
    """Every clear mode of the oracle is reported: angle, mass and standard deviation."""
    assert sum(mode.mass for mode in estimate.modes) == pytest.approx(1.0, abs=1e-9)
    if not np.isfinite(expected.log_classes[estimate.class_index]).any():
        return
    density = expected.density(estimate.class_index)
    # Slight ripples may count as modes or not, and in a flat valley the cut may be anywhere.
    highest = np.sort(density)[-BINS:].mean()
    if density.min() > 1e-3 * highest:
        return
    wanted = expected.modes(estimate.class_index)
    saddles = density[(density < np.roll(density, 1)) & (density <= np.roll(density, -1))]
    if saddles.max() > 1e-3 * highest or len(wanted) != len(estimate.modes):
        return
    for mode in wanted:
        found = min(
            estimate.modes, key=lambda m: abs(math.remainder(m.orientation - mode.angle, TURN))
        )
        assert_same_angle(found.orientation, mode.angle, 2e-3)
        assert found.mass == pytest.approx(mode.mass, abs=0.02)
        assert found.std == pytest.approx(mode.std, rel=0.05, abs=1e-3)


TOY_VIEWS = [[2.0, -10.0], [-2.0, -10.0], [0.0, 10.0]]
TOY_LABELS = [(0,), (0,), (0, 1)]


def toy_measurements(unit: float) -> LabelMeasurements:
    center = np.array([5.0, 5.0]) * unit
    sensors = [rotation(math.pi / 4) @ np.array(view) * unit + center for view in TOY_VIEWS]
    headings = [math.atan2(*(center - sensor)[::-1]) for sensor in sensors]
    return measurements_of(
        [[*sensor, heading] for sensor, heading in zip(sensors, headings, strict=True)],
        TOY_LABELS,
        objects=[0, 0, 0],
        label_names=("c1", "c2"),
    )


def test_toy_example_in_metres() -> None:
    model = model_of(toy_model(unit=0.1), objects={"o0": (0.5, 0.5)})
    estimates, beliefs = estimate_objects(prepare(model, toy_measurements(0.1)))
    printed = [
        [0.42313, 0.42443, 0.15244],
        [0.30207, 0.57330, 0.12463],
        [0.150597, 0.849385, 1.80773e-5],
    ]
    for estimate, expected in zip(estimates, printed, strict=True):
        np.testing.assert_allclose(estimate.class_probabilities, expected, rtol=0, atol=1e-5)
        assert estimate.class_index == 0
    angles = [[56.3, 236.3], [45.0, 225.0], [45.0]]
    for estimate, expected in zip(estimates, angles, strict=True):
        found = [math.degrees(mode.orientation) for mode in estimate.modes if mode.mass > 1e-2]
        assert sorted(found) == pytest.approx(expected, abs=0.05)
    assert len(beliefs) == 1
    assert estimates[2].class_probabilities[2] == pytest.approx(1.80773e-5, rel=1e-4)


def test_toy_example_as_printed() -> None:
    classes = toy_model(confusion_variance=10.0, bearing_variance=math.pi / 4, unit=0.1)
    estimates, _ = estimate_objects(
        prepare(model_of(classes, objects={"o0": (0.5, 0.5)}), toy_measurements(0.1))
    )
    np.testing.assert_allclose(
        estimates[0].class_probabilities, [0.5962, 0.2692, 0.1346], atol=6e-5
    )


# --- Objects somewhere on the grid -------------------------------------------------------------


def crossing_sightings(rng: np.random.Generator, count: int) -> LabelMeasurements:
    """Boxes around one point of the small grid, from all around; labels at random."""
    target = np.array([0.6, -0.7])
    sensors, directions = [], []
    for _ in range(count):
        azimuth, distance = rng.uniform(-math.pi, math.pi), rng.uniform(0.8, 1.8)
        place = target - distance * np.array([math.cos(azimuth), math.sin(azimuth)])
        sensors.append([*place, azimuth + rng.uniform(-0.3, 0.3)])
        middle, width = azimuth + rng.normal(0.0, 0.1), rng.uniform(0.15, 0.5)
        directions.append([middle - width / 2, middle + width / 2])
    label_sets = [[(0,), (1,), (0, 1)][rng.integers(3)] for _ in range(count)]
    return measurements_of(sensors, label_sets, directions, objects=[0] * count)


def assert_same_object(estimate: ObjectEstimate, expected: ObjectBelief, grid: Grid) -> None:
    np.testing.assert_allclose(
        estimate.class_probabilities, expected.class_probabilities, rtol=0, atol=PROBABILITY
    )
    k = estimate.class_index
    masses = expected.cell_masses_given(k)
    centers = np.array([center_of(grid, cell) for cell in expected.cells])
    best = centers[int(np.argmax(masses))]
    assert np.all(np.abs(estimate.position - best) <= 1.5 * grid.cell_size)
    mean = masses @ centers
    spread = np.sqrt(masses @ (centers - mean) ** 2 + grid.cell_size**2 / 12.0)
    np.testing.assert_allclose(estimate.position_std, spread, rtol=1e-3)
    density = expected.density(k)
    top = TURN * int(np.argmax(density)) / len(density)
    assert_same_angle(estimate.class_poses[k, 2], top, 1.5 * TURN / len(density))


@pytest.mark.parametrize(("kind", "seed"), [("cone", 1), ("cone", 2), ("ray", 3)])
def test_object_somewhere(small_grid: Grid, kind: str, seed: int) -> None:
    classes = lopsided_model()
    classes = replace(
        classes,
        likelihoods={
            pair: replace(
                entry,
                mixture=replace(
                    entry.mixture, bearing_variances=np.full(len(entry.mixture.weights), math.inf)
                ),
            )
            for pair, entry in classes.likelihoods.items()
        },
    )
    measurements = crossing_sightings(np.random.default_rng(seed), 5)
    estimates, beliefs = estimate_objects(
        prepare(model_of(classes, small_grid, kind=kind), measurements)
    )
    assert len(estimates) == 5
    for count in (1, 3, 5):
        expected = object_belief(
            classes,
            sightings(measurements, range(count)),
            small_grid,
            Reach(NEAR, FAR, kind),
            outside_probability=OUTSIDE,
            bins=BINS * 5,
        )
        assert_same_object(estimates[count - 1], expected, small_grid)
    k, cell, angle = expected.joint_map()
    assert estimates[-1].joint_map[0] == k
    np.testing.assert_allclose(estimates[-1].joint_map[1:3], center_of(small_grid, cell))
    assert_same_angle(estimates[-1].joint_map[3], angle, TURN / (BINS * 5))
    block = beliefs[0]
    masses = dict(zip(expected.cells, expected.cell_masses, strict=True))
    assert set(block.cells.tolist()) <= set(masses)
    np.testing.assert_allclose(
        np.exp(block.log_cell_mass), [masses[c] for c in block.cells], rtol=0, atol=PROBABILITY
    )
    assert sum(masses[int(c)] for c in block.cells) == pytest.approx(1.0, abs=1e-6)
    for row, cell in enumerate(block.cells):
        place = expected.cells.index(int(cell))
        joint = block.log_cell_mass[row] + block.log_class_probability[row, 1:, None]
        joint = joint + block.log_density[row]
        wanted = expected.log_classes[place][:, ::5]
        matters = wanted > expected.log_classes.max() - DEPTH
        np.testing.assert_allclose(joint[matters], wanted[matters], rtol=0, atol=LOG_BELIEF)


def test_object_with_bearing_terms(small_grid: Grid) -> None:
    classes = lopsided_model()
    measurements = crossing_sightings(np.random.default_rng(4), 3)
    estimates, _ = estimate_objects(prepare(model_of(classes, small_grid), measurements))
    expected = object_belief(
        classes,
        sightings(measurements),
        small_grid,
        Reach(NEAR, FAR),
        outside_probability=OUTSIDE,
        bins=BINS * 5,
    )
    assert_same_object(estimates[-1], expected, small_grid)


# --- What must hold for any input --------------------------------------------------------------


@given(st.data(), class_models(), grids())
@few
def test_probabilities_sum_to_one(data: st.DataObject, classes: ClassModel, grid: Grid) -> None:
    measurements = data.draw(label_measurements(classes, grid, most=8))
    problem = prepare(model_of(classes, grid), measurements)
    block = grid_block(problem)
    np.testing.assert_allclose(
        np.exp(block.log_class_probability).sum(axis=1), 1.0, rtol=0, atol=1e-9
    )
    # Stored as float32, so no closer than that.
    np.testing.assert_allclose(
        np.exp(block.log_density.astype(float)).sum(axis=2) * TURN / BINS, 1.0, atol=1e-5
    )
    estimate = GridEstimate(problem, cuts_every(measurements, None))
    list(estimate.blocks())
    for maps in estimate.maps():
        np.testing.assert_allclose(maps.class_probabilities.sum(axis=1), 1.0, rtol=0, atol=1e-9)
    estimates, beliefs = estimate_objects(problem)
    for each in estimates:
        assert each.class_probabilities.sum() == pytest.approx(1.0, abs=1e-9)
        assert sum(mode.mass for mode in each.modes) == pytest.approx(1.0, abs=1e-9)
    for belief in beliefs:
        assert np.exp(belief.log_cell_mass).sum() == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize(
    ("way", "tolerance"),
    [("pair by pair", 1e-12), ("convolved", 1e-10), ("whichever is faster", 1e-6)],
)
def test_order_does_not_matter(way: str, tolerance: float) -> None:
    """What was seen first may be seen last: only the way of summing shows, no closer than tables.

    That messages may come in any order, times kept, to the last bit is tested elsewhere.
    """

    @given(st.data(), class_models(), grids())
    @few
    def holds(data: st.DataObject, classes: ClassModel, grid: Grid) -> None:
        measurements = data.draw(label_measurements(classes, grid, most=6))
        order = data.draw(st.permutations(range(len(measurements))))
        model = model_of(classes, grid)
        once = grid_block(prepare(model, measurements))
        again = grid_block(prepare(model, permuted(measurements, order)))
        np.testing.assert_array_equal(once.cells, again.cells)
        np.testing.assert_allclose(
            np.exp(once.log_class_probability),
            np.exp(again.log_class_probability),
            rtol=0,
            atol=tolerance,
        )
        np.testing.assert_allclose(once.log_density, again.log_density, atol=1e-4)
        first, _ = estimate_objects(prepare(model, measurements))
        second, _ = estimate_objects(prepare(model, permuted(measurements, order)))
        for one, other in zip(first[-1:], second[-1:], strict=True):
            np.testing.assert_allclose(
                one.class_probabilities, other.class_probabilities, rtol=0, atol=tolerance
            )
            # A deviation is the root of a small difference.
            np.testing.assert_allclose(
                one.position_std, other.position_std, rtol=1e-5, atol=np.sqrt(tolerance)
            )

    with pytest.MonkeyPatch.context() as patch:
        if way != "whichever is faster":
            patch.setattr("mclass.evidence._many", lambda *_: way == "convolved")
        holds()


@given(st.data(), class_models(), grids(), st.integers(1, 5))
@few
def test_evidence_adds_up(
    data: st.DataObject, classes: ClassModel, grid: Grid, middle: int
) -> None:
    measurements = data.draw(label_measurements(classes, grid, most=6))
    problem = prepare(model_of(classes, grid), measurements)
    whole = cuts_every(measurements, None)
    rows = range(min(middle, len(measurements)))
    early_cut = replace(whole[0], stamp_ns=int(measurements.stamps_ns[rows[-1]]))
    stepwise = GridEstimate(problem, [early_cut, *whole])
    at_once = GridEstimate(problem, whole)
    list(stepwise.blocks())
    list(at_once.blocks())
    np.testing.assert_array_equal(stepwise.maps()[-1].cells, at_once.maps()[-1].cells)
    np.testing.assert_allclose(
        stepwise.maps()[-1].class_probabilities,
        at_once.maps()[-1].class_probabilities,
        rtol=0,
        atol=1e-5,
    )
    # Before the cut nothing of what follows is known.
    alone = GridEstimate(prepare(model_of(classes, grid), permuted(measurements, rows)), whole)
    list(alone.blocks())
    if alone.maps():
        early = stepwise.maps()[0]
        np.testing.assert_array_equal(early.cells, alone.maps()[0].cells)
        np.testing.assert_allclose(
            early.class_probabilities, alone.maps()[0].class_probabilities, rtol=0, atol=1e-5
        )


def moved(measurements: LabelMeasurements, world: FloatArray) -> LabelMeasurements:
    """The same seen in a world frame that is moved and turned."""
    frames = measurements.frames
    local = frames.poses_world_sensor
    position = local[:, :2] @ rotation(float(world[2])).T + world[:2]
    return replace(
        measurements,
        frames=replace(
            frames,
            poses_world_sensor=np.concatenate([position, local[:, 2:] + world[2]], axis=1),
        ),
        directions=measurements.directions + world[2],
    )


@given(st.data(), class_models(bearing=True), grids(most=3), poses(1e6))
@few
def test_moving_the_world_turns_an_object_with_it(
    data: st.DataObject, classes: ClassModel, grid: Grid, world: FloatArray
) -> None:
    measurements = data.draw(label_measurements(classes, grid, most=4))
    measurements = replace(
        measurements, object_index=np.zeros(len(measurements), dtype=np.int64), object_ids=("o",)
    )
    here = center_of(grid, 0)
    there = rotation(float(world[2])) @ here + world[:2]
    first, _ = estimate_objects(
        prepare(model_of(classes, objects={"o": (here[0], here[1])}), measurements)
    )
    second, _ = estimate_objects(
        prepare(model_of(classes, objects={"o": (there[0], there[1])}), moved(measurements, world))
    )
    for one, other in zip(first, second, strict=True):
        np.testing.assert_allclose(
            one.class_probabilities, other.class_probabilities, rtol=0, atol=2e-6
        )
        clear = [mode for mode in one.modes if mode.mass > 0.3 and mode.std < 0.3]
        for mode in clear:
            nearest = min(
                abs(math.remainder(m.orientation - mode.orientation - world[2], TURN))
                for m in other.modes
            )
            assert nearest < 5e-3


@pytest.mark.parametrize("quarter", [0, 1, 2, 3])
def test_moving_the_world_moves_the_grid_with_it(small_grid: Grid, quarter: int) -> None:
    classes = lopsided_model()
    measurements = crossing_sightings(np.random.default_rng(5), 4)
    once = grid_block(prepare(model_of(classes, small_grid), measurements))
    # A million metres away and turned by a quarter, so that the cells fall on cells again.
    world = np.array([1e6, -1e6, quarter * math.pi / 2])
    turn = np.round(rotation(float(world[2])))
    rows, columns = (
        (small_grid.columns, small_grid.rows)
        if quarter % 2
        else (small_grid.rows, small_grid.columns)
    )
    size = np.array([small_grid.columns, small_grid.rows]) * small_grid.cell_size
    corners = [turn @ (np.array(small_grid.origin) + size * at) for at in ([0, 0], [1, 1])]
    low = np.minimum(*corners) + world[:2]
    far_grid = Grid((float(low[0]), float(low[1])), small_grid.cell_size, rows, columns)
    again = grid_block(prepare(model_of(classes, far_grid), moved(measurements, world)))
    assert len(again.cells) == len(once.cells) > 20
    place = {int(cell): row for row, cell in enumerate(again.cells)}
    for row, cell in enumerate(once.cells):
        x, y = turn @ center_of(small_grid, int(cell)) + world[:2]
        there = far_grid.cell_at(float(x), float(y))
        assert there is not None
        other = place[there]
        np.testing.assert_allclose(
            np.exp(again.log_class_probability[other]),
            np.exp(once.log_class_probability[row]),
            rtol=0,
            atol=1e-6,
        )
        np.testing.assert_allclose(
            np.roll(once.log_density[row], quarter * BINS // 4, axis=-1),
            again.log_density[other],
            atol=1e-4,
        )


@given(st.data(), class_models(bearing=True), grids(most=5))
@few
def test_length_unit_does_not_matter(data: st.DataObject, classes: ClassModel, grid: Grid) -> None:
    measurements = data.draw(label_measurements(classes, grid, most=4))
    larger_poses = measurements.frames.poses_world_sensor * [10.0, 10.0, 1.0]
    larger = replace(
        measurements, frames=replace(measurements.frames, poses_world_sensor=larger_poses)
    )
    larger_grid = Grid(
        (10 * grid.origin[0], 10 * grid.origin[1]), 10 * grid.cell_size, grid.rows, grid.columns
    )
    once = grid_block(prepare(model_of(classes, grid), measurements))
    again = grid_block(
        prepare(
            model_of(scaled_model(classes, 10.0), larger_grid, reach=(10 * NEAR, 10 * FAR)), larger
        )
    )
    shared, one, other = np.intersect1d(once.cells, again.cells, return_indices=True)
    # Cells whose border is met to rounding may fall either way.
    assert len(shared) >= 0.9 * max(len(once.cells), len(again.cells))
    same = once.measurements[one] == again.measurements[other]
    np.testing.assert_allclose(
        np.exp(once.log_class_probability[one][same]),
        np.exp(again.log_class_probability[other][same]),
        rtol=0,
        atol=1e-6,
    )


# --- Single facts ------------------------------------------------------------------------------


def test_a_repeated_label_counts_once() -> None:
    model = model_of(lopsided_model(), objects={"o0": (1.0, 0.2)})
    once, _ = estimate_objects(prepare(model, measurements_of([[0, 0, 0]], [(1,)], objects=[0])))
    twice, _ = estimate_objects(prepare(model, measurements_of([[0, 0, 0]], [(1, 1)], objects=[0])))
    np.testing.assert_array_equal(once[0].class_probabilities, twice[0].class_probabilities)


def test_labels_that_no_class_returns_together_take_part_in_nothing() -> None:
    classes = lopsided_model()
    exclusive = replace(
        classes,
        likelihoods={
            pair: entry
            for pair, entry in classes.likelihoods.items()
            if pair in {(0, 0), (1, 0), (2, 1)}
        },
    )
    model = model_of(exclusive, objects={"o0": (1.0, 0.2)})
    measurements = measurements_of([[0, 0, 0]] * 3, [(0,), (0, 1), (0,)], objects=[0, 0, 0])
    problem = prepare(model, measurements)
    assert problem.used.tolist() == [0, 2]
    estimates, _ = estimate_objects(problem)
    assert len(estimates) == 2
    expected = belief_at(exclusive, sightings(measurements, [0, 2]), np.array([1.0, 0.2]))
    np.testing.assert_allclose(
        estimates[-1].class_probabilities, expected.class_probabilities, atol=1e-6
    )
    assert estimates[-1].class_probabilities[3] == 0.0
    pointing = replace(measurements, directions=np.array([[0.0, 0.5], [-0.3, 0.3], [0.1, 0.6]]))
    grid = Grid((0.0, -1.0), 0.25, rows=8, columns=8)
    block = grid_block(prepare(model_of(exclusive, grid), pointing))
    touched = grid.centers(block.cells)
    assert np.all(np.arctan2(touched[:, 1], touched[:, 0]) >= 0.0)
    assert block.measurements.max() == 2


def test_classes_that_exclude_each_other_leave_the_background() -> None:
    classes = lopsided_model()
    exclusive = replace(
        classes,
        likelihoods={
            pair: entry for pair, entry in classes.likelihoods.items() if pair in {(0, 0), (2, 1)}
        },
    )
    model = model_of(exclusive, objects={"o0": (1.0, 0.2)})
    measurements = measurements_of([[0, 0, 0]] * 2, [(0,), (1,)], objects=[0, 0])
    estimates, _ = estimate_objects(prepare(model, measurements))
    np.testing.assert_array_equal(estimates[-1].class_probabilities, [1.0, 0.0, 0.0, 0.0])
    assert np.isfinite(estimates[-1].class_poses).all()


def test_hundreds_of_measurements_stay_finite() -> None:
    # Narrower than a bin in the end, and without clutter tails of e^-1000 and beyond.
    count = 200
    rng = np.random.default_rng(8)
    angles = rng.uniform(-2.5, -0.6, count)
    sensors = np.stack([np.cos(angles), np.sin(angles), angles + math.pi], axis=-1)
    classes = toy_model(unit=0.1)
    measurements = measurements_of(
        sensors, [(0,)] * count, objects=[0] * count, label_names=("c1", "c2")
    )
    estimates, _ = estimate_objects(
        prepare(model_of(classes, objects={"o0": (0.0, 0.0)}), measurements)
    )
    seen = sightings(measurements)
    expected = belief_at(classes, seen, np.zeros(2), bins=BINS * FINER)
    np.testing.assert_allclose(
        estimates[-1].class_probabilities, expected.class_probabilities, atol=1e-6
    )
    wanted, found = expected.modes(0)[:2], estimates[-1].modes[:2]
    assert wanted[0].std < TURN / BINS
    assert sorted(mode.orientation for mode in found) == pytest.approx(
        sorted(mode.angle for mode in wanted), abs=1e-4
    )
    assert found[0].std == pytest.approx(wanted[0].std, rel=1e-2)


@pytest.mark.parametrize(("count", "turn"), [(5, 0.0), (150, 0.0), (150, 0.025), (150, 0.05)])
def test_sharp_beliefs_in_the_balance(count: int, turn: float) -> None:
    # Beliefs of different widths, far narrower than a bin in the end, with the priors set so
    # that both classes and the background come out alike: integrals that are off show at once.
    rng = np.random.default_rng(9)
    angles = turn + rng.uniform(-1.7, -1.2, count)
    sensors = np.stack([np.cos(angles), np.sin(angles), angles + math.pi], axis=-1)
    measurements = measurements_of(
        sensors, [(0,)] * count, objects=[0] * count, label_names=("c1", "c2")
    )
    model = narrow_model(0.1, clutter=1e-3)
    seen = sightings(measurements)
    even = belief_at(replace(model, log_priors=np.zeros(3)), seen, np.zeros(2), bins=BINS * FINER)
    log_classes = logsumexp(even.log_classes, axis=1) + math.log(TURN / (BINS * FINER))
    log_priors = -np.concatenate([[even.log_background], log_classes])
    balanced = replace(model, log_priors=log_priors - logsumexp(log_priors))
    estimates, _ = estimate_objects(
        prepare(model_of(balanced, objects={"o0": (0.0, 0.0)}), measurements)
    )
    np.testing.assert_allclose(estimates[-1].class_probabilities, 1.0 / 3.0, rtol=0, atol=1e-4)
