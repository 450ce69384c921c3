"""The robust filter as a whole against brute force: weights, silence, hiding, pointing, blur."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import numpy as np
import pytest
from models import lopsided_model
from oracle import TURN, ObjectBelief, center_of, normalised
from oracle_looks import Robust, frames_of, looks_at_cell, looks_at_object, peak_density, weighed
from scipy.special import logsumexp

from mclass.classes import ClassModel
from mclass.footprint import Grid
from mclass.inference import GridEstimate, cuts_every, estimate_objects, prepare
from mclass.model import ROBUST, GridSettings, InferenceSettings, Model
from mclass.pairs import Pairs
from mclass.records import FloatArray, Frames, LabelMeasurements
from mclass.results import BeliefBlock

BINS, FINER = 72, 4
PROBABILITY, LOG_BELIEF, DEPTH = 1e-4, 1e-3, 10.0
GRID = Grid((0.0, -1.2), 0.2, rows=5, columns=6)
TARGET = np.array([0.6, -0.7])
NEAR, FAR = 0.2, 3.0
ORACLE = Robust(NEAR, FAR, (0.3, 0.12), margin=0.2, outside=1e-3, pointing_std=0.05)


@pytest.fixture(autouse=True, scope="module")
def _tables() -> Iterator[None]:
    """Little is summed here, which would be done without tables."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mclass.inference._LITTLE_WORK", 0.0)
        yield


def classes_of(seed: int) -> tuple[ClassModel, list[float]]:
    """Lopsided at random, but for bearings: with them nothing is tabulated; and the peaks."""
    model, rng = lopsided_model(), np.random.default_rng(seed)
    flat = {
        pair: dataclasses.replace(
            entry,
            mixture=dataclasses.replace(
                entry.mixture,
                means=entry.mixture.means + rng.normal(0.0, 0.3, entry.mixture.means.shape),
                bearing_variances=np.full(len(entry.mixture.weights), math.inf),
            ),
        )
        for pair, entry in model.likelihoods.items()
    }
    model = dataclasses.replace(model, likelihoods=flat)
    return model, [peak_density(model, k) for k in range(len(model.class_names))]


def model_of(classes: ClassModel, inference: InferenceSettings, *, known: bool = False) -> Model:
    grid = GridSettings(
        cell_size=GRID.cell_size,
        orientation_bins=BINS,
        min_range=NEAR,
        max_range=FAR,
        origin=GRID.origin,
        size=(GRID.columns * GRID.cell_size, GRID.rows * GRID.cell_size),
    )
    objects = {"o0": (float(TARGET[0]), float(TARGET[1]))} if known else {}
    return Model("t", "", "m", classes, grid=grid, inference=inference, objects=objects)


def drive(seed: int, count: int = 16) -> LabelMeasurements:
    """Frames that crowd together, look past the target or return nothing; boxes that go astray.

    Every third frame has a box of something else, which sometimes hides the target.
    """
    rng = np.random.default_rng(seed)
    turns = np.sort(rng.uniform(-math.pi, math.pi, count // 2)).repeat(2)
    turns += rng.normal(0.0, 0.08, count)
    distance = rng.uniform(0.8, 1.9, count)
    sensors = TARGET + distance[:, None] * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    headings = turns + math.pi + rng.uniform(-0.5, 0.5, count)
    rows: list[tuple[int, int, float, float]] = []
    for f in range(count):
        at_target = turns[f] + math.pi + rng.normal(0.0, 0.08)
        if rng.random() < 0.75:
            astray = rng.uniform(-1.0, 1.0) if rng.random() < 0.2 else 0.0
            rows.append((f, 0, at_target + astray, rng.uniform(0.15, 0.5)))
        if f % 3 == 0:
            rows.append((f, 1, at_target + rng.uniform(-0.6, 0.6), 0.3))
    labels = [[(0,), (1,), (0, 1)][rng.integers(3)] for _ in rows]
    stamps = 1_700_000_000_000_000_000 + 100_000_000 * np.arange(count, dtype=np.int64)
    blur = np.zeros((count, 3, 3))
    roots = rng.normal(0.0, 0.15, (count, 2, 2))
    blur[:, :2, :2] = roots @ roots.transpose(0, 2, 1) + 0.01 * np.eye(2)
    return LabelMeasurements(
        frames=Frames(
            stamps_ns=stamps,
            log_times_ns=stamps,
            poses_world_sensor=np.column_stack([sensors, headings]),
            covariances=blur,
            view_directions=np.stack([headings - 0.6, headings + 0.6], axis=1),
        ),
        frame_index=np.array([row[0] for row in rows]),
        directions=np.array([[m - w / 2.0, m + w / 2.0] for _, _, m, w in rows]),
        object_index=np.array([row[1] for row in rows]),
        object_ids=("o0", "o1"),
        label_offsets=np.cumsum([0, *map(len, labels)]),
        labels=np.concatenate([np.array(found) for found in labels]),
        scores=np.ones(sum(map(len, labels))),
        label_names=("a", "b"),
    )


def exact(found: LabelMeasurements) -> LabelMeasurements:
    """The same without a covariance of poses."""
    return dataclasses.replace(found, frames=dataclasses.replace(found.frames, covariances=None))


def same(actual: FloatArray, wanted: FloatArray) -> None:
    """Log beliefs where they matter."""
    matters = wanted > wanted.max() - DEPTH
    np.testing.assert_allclose(actual[matters], wanted[matters], rtol=0, atol=LOG_BELIEF)


def joint(block: BeliefBlock, row: int) -> FloatArray:
    """Log density over class and orientation in one cell, (n, bins)."""
    return np.asarray(block.log_class_probability[row, 1:, None] + block.log_density[row])


@pytest.mark.parametrize("seed", [1, 2])
def test_cells_of_the_grid(seed: int) -> None:
    classes, peaks = classes_of(seed)
    found = exact(drive(seed))
    estimate = GridEstimate(prepare(model_of(classes, ROBUST), found), cuts_every(found, None))
    frames = frames_of(found)
    compared = 0
    for block in estimate.blocks():
        for row in range(seed, len(block.cells), 5):
            point = center_of(GRID, int(block.cells[row]))
            looks = looks_at_cell(frames, point, ORACLE)
            expected = normalised(*weighed(classes, peaks, looks, point, BINS * FINER))
            np.testing.assert_allclose(
                np.exp(block.log_class_probability[row]),
                expected.class_probabilities,
                rtol=0,
                atol=PROBABILITY,
            )
            same(joint(block, row), expected.log_classes[:, ::FINER])
            compared += 1
    assert compared >= 5


@pytest.mark.parametrize("blurred", [False, True])
def test_object_of_known_position(blurred: bool) -> None:
    classes, peaks = classes_of(3)
    found = drive(3) if blurred else exact(drive(3))
    settings = dataclasses.replace(ROBUST, pose_uncertainty=blurred)
    problem = prepare(model_of(classes, settings, known=True), found)
    estimates, blocks = estimate_objects(problem, history=False)
    looks, _, _ = looks_at_object(frames_of(found), 0, TARGET, ORACLE, known=True)
    expected = normalised(*weighed(classes, peaks, looks, TARGET, BINS * FINER))
    np.testing.assert_allclose(
        next(e for e in estimates if e.object_id == "o0").class_probabilities,
        expected.class_probabilities,
        rtol=0,
        atol=PROBABILITY,
    )
    block = next(block for block in blocks if block.object_id == "o0")
    same(joint(block, 0), expected.log_classes[:, ::FINER])


@pytest.mark.parametrize("std", [0.04, 0.11, 0.34, 0.58, 0.95])
def test_tables_widen_with_the_poses(std: float) -> None:
    """Spreads between those tabulated; exact evidence is compared with the oracle above."""
    classes, _ = classes_of(3)
    found, rng = drive(3), np.random.default_rng(7)
    assert found.frames.covariances is not None
    found.frames.covariances[:] = np.diag([std**2, std**2, 0.0])
    blurred = dataclasses.replace(ROBUST, pose_uncertainty=True)
    engine = prepare(model_of(classes, blurred), found).engine
    count = len(engine.term_weights)
    looks = Pairs(
        starts=np.arange(count + 1),
        looks=np.arange(count),
        ranges=rng.uniform(0.5, FAR, count),
        directions=rng.uniform(-math.pi, math.pi, count),
    )
    tabulated, direct = engine.evidence(looks).classes, engine.exact_evidence(looks).classes
    np.testing.assert_allclose(tabulated, direct, rtol=0, atol=0.1)
    sharp = dataclasses.replace(engine, position_covariances=None).exact_evidence(looks).classes
    assert np.abs(sharp - direct).max() > 0.1


@pytest.mark.parametrize(("seed", "history"), [(4, True), (4, False), (5, False)])
def test_object_somewhere(seed: int, history: bool) -> None:
    classes, peaks = classes_of(seed)
    found = exact(drive(seed))
    estimates, blocks = estimate_objects(prepare(model_of(classes, ROBUST), found), history=history)
    frames = frames_of(found)
    cells = list(range(GRID.rows * GRID.columns))
    seen = [
        looks_at_object(frames, 0, center_of(GRID, cell), ORACLE, known=False) for cell in cells
    ]
    most = max(hits for _, _, hits in seen)
    cells = [cell for cell in cells if 2 * seen[cell][2] >= most]
    backgrounds, beliefs = [], []
    for cell in cells:
        looks, log_outer, _ = seen[cell]
        background, belief = weighed(classes, peaks, looks, center_of(GRID, cell), BINS * FINER)
        backgrounds.append(background + log_outer)
        beliefs.append(belief + log_outer)
    log_background, log_classes = np.array(backgrounds), np.array(beliefs)
    total = np.logaddexp(
        logsumexp(log_background), logsumexp(log_classes) + math.log(TURN / (BINS * FINER))
    )
    expected = ObjectBelief(cells, log_background - total, log_classes - total)
    last = [estimate for estimate in estimates if estimate.object_id == "o0"][-1]
    np.testing.assert_allclose(
        last.class_probabilities, expected.class_probabilities, rtol=0, atol=PROBABILITY
    )
    block = next(block for block in blocks if block.object_id == "o0")
    place = [expected.cells.index(int(cell)) for cell in block.cells]
    np.testing.assert_allclose(
        np.exp(block.log_cell_mass), expected.cell_masses[place], rtol=0, atol=PROBABILITY
    )
    assert expected.cell_masses[place].sum() == pytest.approx(1.0, abs=1e-6)
    actual = np.array([joint(block, row) for row in range(len(place))])
    actual += block.log_cell_mass[:, None, None]
    same(actual, expected.log_classes[place][..., ::FINER])
