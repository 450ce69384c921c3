"""Numbers over whole estimates: sums, order, place, and what a hundred thousand additions cost."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from models import lopsided_model, measurements_of

from mclass.findings import Estimate
from mclass.geometry import wrap_angle
from mclass.inference import prepare
from mclass.model import PAPER, ROBUST, GridSettings, InferenceSettings, Model
from mclass.pairs import Pairs
from mclass.pipeline import infer
from mclass.records import Frames, IntArray, LabelMeasurements
from mclass.text.documents import objects_json

PRESETS = {"paper": PAPER, "robust": ROBUST}
EACH = ["paper", pytest.param("robust", marks=pytest.mark.slow)]


def model_of(inference: InferenceSettings) -> Model:
    grid = GridSettings(cell_size=0.25, orientation_bins=24, min_range=0.2, max_range=2.5)
    return Model("test.yaml", "", "m", lopsided_model(), grid=grid, inference=inference)


def drive(count: int, seed: int) -> LabelMeasurements:
    """Detections from around a place, two a frame on average, two frames at each instant."""
    rng = np.random.default_rng(seed)
    frames = max(1, count // 2)
    turns = rng.uniform(-math.pi, math.pi, frames)
    places = rng.uniform(1.0, 2.0, frames)[:, None] * np.stack([np.cos(turns), np.sin(turns)], 1)
    places += rng.normal(0.0, 0.05, places.shape)
    headings = np.arctan2(-places[:, 1], -places[:, 0])
    stamps = 1_700_000_000_000_000_000 + 50_000_000 * (np.arange(frames, dtype=np.int64) // 2)
    owner = np.sort(rng.integers(0, frames, count))
    axis = headings[owner] + rng.normal(0.0, 0.1, count)
    width = rng.uniform(0.1, 0.5, count)
    labels = [sorted(rng.permutation(2)[: rng.integers(1, 3)].tolist()) for _ in range(count)]
    return LabelMeasurements(
        frames=Frames(
            stamps_ns=stamps,
            log_times_ns=stamps + 70_000_000,
            poses_world_sensor=np.column_stack([places, headings]),
            covariances=None,
            view_directions=np.stack([headings - 0.5, headings + 0.5], axis=1),
        ),
        frame_index=owner,
        directions=np.stack([axis - width / 2, axis + width / 2], axis=1),
        object_index=_ids(owner),
        object_ids=("b", "a", "c/1"),
        label_offsets=np.cumsum([0, *map(len, labels)]),
        labels=np.concatenate([np.array(found, dtype=np.int64) for found in labels]),
        scores=rng.uniform(0.5, 1.0, sum(map(len, labels))),
        label_names=("a", "b"),
    )


def _ids(owner: IntArray) -> IntArray:
    """Three ids, none twice in a frame; further detections of a frame have none."""
    place = np.arange(len(owner)) - np.searchsorted(owner, owner)
    return np.where(place < 3, (place + owner) % 3, -1)


def shuffled(found: LabelMeasurements, seed: int) -> LabelMeasurements:
    """The same measurements, listed in another order: frames, rows and ids."""
    rng = np.random.default_rng(seed)
    frame_order = rng.permutation(len(found.frames))
    row_order = rng.permutation(len(found))
    id_order = rng.permutation(len(found.object_ids))
    frames = found.frames
    spans = [np.arange(found.label_offsets[row], found.label_offsets[row + 1]) for row in row_order]
    return LabelMeasurements(
        frames=Frames(
            frames.stamps_ns[frame_order],
            frames.log_times_ns[frame_order],
            frames.poses_world_sensor[frame_order],
            None,
            frames.view_directions[frame_order],
        ),
        frame_index=np.argsort(frame_order)[found.frame_index[row_order]],
        directions=found.directions[row_order],
        object_index=np.append(np.argsort(id_order), -1)[found.object_index[row_order]],
        object_ids=tuple(found.object_ids[i] for i in id_order),
        label_offsets=np.cumsum([0, *map(len, spans)]),
        labels=found.labels[np.concatenate(spans)],
        scores=found.scores[np.concatenate(spans)],
        label_names=found.label_names,
    )


def moved(found: LabelMeasurements, turn: float, x: float, y: float) -> LabelMeasurements:
    """The same measurements in a world turned about its origin, then shifted."""
    frames = found.frames
    cosine, sine = math.cos(turn), math.sin(turn)
    rotation = np.array([[cosine, -sine], [sine, cosine]])
    places = frames.poses_world_sensor[:, :2] @ rotation.T + [x, y]
    headings = wrap_angle(frames.poses_world_sensor[:, 2] + turn)
    return dataclasses.replace(
        found,
        frames=dataclasses.replace(
            frames,
            poses_world_sensor=np.column_stack([places, headings]),
            view_directions=frames.view_directions + turn,
        ),
        directions=found.directions + turn,
    )


def everything(estimate: Estimate) -> list[bytes]:
    """All numbers of an estimate, bit for bit."""
    found = [json.dumps(objects_json(estimate.objects, estimate.class_names, "w")).encode()]
    for _, belief in sorted(estimate.object_beliefs.items()):
        found += [belief.cells.tobytes(), belief.log_density.tobytes()]
        found += [belief.log_class_probability.tobytes(), belief.log_cell_mass.tobytes()]
    assert estimate.maps is not None
    return [*found, estimate.maps.cells.tobytes(), estimate.maps.class_probabilities.tobytes()]


@pytest.mark.parametrize("preset", EACH)
@settings(max_examples=4, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 16))
def test_probabilities_sum_to_one_as_reported(preset: str, seed: int, count: int) -> None:
    estimate = infer(drive(count, seed), model_of(PRESETS[preset]))
    document = json.loads(
        json.dumps(
            objects_json(estimate.objects, estimate.class_names, "w", estimate.history),
            allow_nan=False,
        )
    )
    for entry in document["objects"]:
        for step in (entry, *entry["history"]):
            assert math.fsum(step["class_probabilities"].values()) == pytest.approx(1, abs=1e-9)
            assert math.fsum(mode["mass"] for mode in step["modes"]) == pytest.approx(1, abs=1e-9)
    if estimate.maps is not None:
        sums = estimate.maps.class_probabilities.sum(axis=1)
        np.testing.assert_allclose(sums, 1.0, rtol=0, atol=1e-9)


@pytest.mark.parametrize("preset", EACH)
@settings(max_examples=3, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_order_of_measurements_matters_to_no_bit(preset: str, seed: int) -> None:
    found, model = drive(12, seed), model_of(PRESETS[preset])
    expected = everything(infer(found, model))
    assert everything(infer(shuffled(found, seed + 1), model)) == expected


def test_canonical_order_keeps_what_is_said() -> None:
    found = drive(40, 3)
    ordered = shuffled(found, 4).in_canonical_order()
    assert (np.diff(ordered.frames.stamps_ns) >= 0).all()
    assert (np.diff(ordered.frame_index) >= 0).all()
    assert list(ordered.object_ids) == sorted(found.object_ids)
    assert sorted(map(_row, [ordered] * 40, range(40))) == sorted(
        map(_row, [found] * 40, range(40))
    )
    again = ordered.in_canonical_order()
    assert again.directions.tobytes() == ordered.directions.tobytes()
    assert again.labels.tobytes() == ordered.labels.tobytes()


def _row(found: LabelMeasurements, row: int) -> tuple[object, ...]:
    """Everything that one row says."""
    index = int(found.object_index[row])
    span = slice(int(found.label_offsets[row]), int(found.label_offsets[row + 1]))
    return (
        int(found.stamps_ns[row]),
        found.frames.poses_world_sensor[found.frame_index[row]].tolist(),
        found.directions[row].tolist(),
        found.object_ids[index] if index >= 0 else "",
        found.labels[span].tolist(),
        found.scores[span].tolist(),
    )


@pytest.mark.parametrize("preset", EACH)
@pytest.mark.parametrize(
    ("quarters", "x", "y"),
    [(0, 500_000.0, 5_500_000.0), (1, 0.0, 0.0), (3, -1_000_000.0, 9_000_000.0)],
)
def test_moving_and_turning_the_world_changes_nothing_but_the_world(
    preset: str, quarters: int, x: float, y: float
) -> None:
    """At the coordinates of maps too; turned by quarters, so that cells lie upon cells."""
    allowed = 1e-6
    found, model = drive(16, 11), model_of(PRESETS[preset])
    turn = quarters * math.pi / 2
    here, there = infer(found, model), infer(moved(found, turn, x, y), model)
    cosine, sine = round(math.cos(turn)), round(math.sin(turn))
    rotation = np.array([[cosine, -sine], [sine, cosine]])
    assert len(here.objects) == len(there.objects) == 3
    for before, after in zip(here.objects, there.objects, strict=True):
        np.testing.assert_allclose(
            after.class_probabilities, before.class_probabilities, rtol=0, atol=allowed
        )
        np.testing.assert_allclose(
            after.position, rotation @ before.position + [x, y], rtol=0, atol=allowed
        )
        best = before.class_index
        assert after.class_index == best
        apart = after.class_poses[best, 2] - before.class_poses[best, 2] - turn
        assert abs(math.remainder(apart, 2.0 * math.pi)) < 10 * allowed
    assert here.maps is not None
    assert there.maps is not None
    assert len(here.maps.cells) == len(there.maps.cells)
    np.testing.assert_allclose(
        np.sort(there.maps.class_probabilities, axis=0),
        np.sort(here.maps.class_probabilities, axis=0),
        rtol=0,
        atol=2 * allowed,
    )


@pytest.mark.parametrize("preset", PRESETS)
@settings(max_examples=6, deadline=None)
@given(turn=st.floats(-math.pi, math.pi), x=st.floats(-1e6, 1e6), y=st.floats(-1e7, 1e7))
def test_objects_of_known_position_turn_with_the_world(
    preset: str, turn: float, x: float, y: float
) -> None:
    """By any angle: nothing of these depends on cells.

    The robust filter counts looks on a lattice over world directions, which shows a little.
    """
    allowed = {"paper": 1e-6, "robust": 1e-4}[preset]
    model = model_of(PRESETS[preset])
    found = dataclasses.replace(drive(12, 2), object_ids=("here", "there", "yonder"))
    places = {"here": (0.1, 0.05), "there": (-0.2, 0.0), "yonder": (0.0, 0.0)}
    cosine, sine = math.cos(turn), math.sin(turn)
    turned = {
        name: (cosine * a - sine * b + x, sine * a + cosine * b + y)
        for name, (a, b) in places.items()
    }
    before = infer(found, dataclasses.replace(model, objects=places))
    after = infer(moved(found, turn, x, y), dataclasses.replace(model, objects=turned))
    assert len(before.objects) == len(after.objects) == 3
    for first, second in zip(before.objects, after.objects, strict=True):
        np.testing.assert_allclose(
            second.class_probabilities, first.class_probabilities, rtol=0, atol=allowed
        )
        apart = second.modes[0].orientation - first.modes[0].orientation - turn
        assert abs(math.remainder(apart, 2.0 * math.pi)) < 1e-3


@pytest.mark.parametrize("count", [1_000, pytest.param(100_000, marks=pytest.mark.slow)])
def test_many_measurements_lose_no_precision_that_matters(count: int) -> None:
    """Sums by the tables, and direct ones, against exact sums of exact terms in float64.

    The accumulator is float64; what it loses is far below what the tables' interpolation does,
    and that (at most 4e-6 a measurement, of either sign) stays below a thousandth altogether.
    """
    rng = np.random.default_rng(8)
    turns = rng.uniform(-math.pi, math.pi, count)
    ranges = rng.uniform(0.3, 2.5, count)
    poses = np.column_stack([ranges * np.cos(turns), ranges * np.sin(turns), turns + math.pi])
    labels = [[int(label)] for label in rng.integers(0, 2, count)]
    found = measurements_of(poses, labels, np.stack([turns + 3.0, turns + 3.3], axis=1))
    engine = prepare(model_of(PAPER), found).engine
    cells = np.array([[0.1, -0.05], [0.0, 0.0], [-0.3, 0.2]])
    offsets = poses[None, :, :2] - cells[:, None]
    distances = np.hypot(offsets[..., 0], offsets[..., 1])
    directions = np.arctan2(offsets[..., 1], offsets[..., 0])
    rows = np.arange(count)
    pairs = Pairs(np.arange(4) * count, np.tile(rows, 3), distances.ravel(), directions.ravel())
    direct, summed = engine.exact_evidence(pairs), engine.evidence(pairs)
    for cell in range(3):
        alone = Pairs(np.arange(count + 1), rows, distances[cell], directions[cell])
        each = engine.exact_evidence(alone).classes
        for class_index, angle in ((0, 0), (0, 16), (1, 7)):
            exact = math.fsum(each[:, class_index, angle].tolist())
            assert abs(direct.classes[cell, class_index, angle] - exact) <= 1e-13 * abs(exact)
            assert abs(summed.classes[cell, class_index, angle] - exact) <= 1e-3
