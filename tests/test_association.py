"""Detections without ids are grouped into the objects that caused them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mclass.cells import object_history, stored_report
from mclass.config.model_file import parse_model
from mclass.inference import Problem, estimate_objects, prepare
from mclass.records import FloatArray, Frames, LabelMeasurements
from mclass.results import BeliefBlock, ObjectEstimate

MODEL = """
length_unit: m
viewpoints:
  front: {position: [0, 1.5], covariance: 0.8}
  back: {position: [0, -1.5], covariance: 0.8}
classes:
  crate: {labels: {crate: {probability: 0.9, views: {front: 0.5, back: 0.5}},
                   drum: {probability: 0.9, views: {front: 0.5}}}}
  drum: {labels: {drum: {probability: 0.9, views: {front: 0.5, back: 0.5}},
                  crate: {probability: 0.9, views: {front: 0.5}}}}
grid: {cell_size: 0.2, orientation_bins: 36, range: [0.3, 4]}
inference: {preset: robust}
"""
PLACES = np.array([[0.0, 0.0], [3.1, 0.6], [1.2, 4.3]])
CLASSES = ("crate", "drum", "crate")
FACING = np.deg2rad([20.0, 140.0, 250.0])


def drive(rng: np.random.Generator) -> tuple[LabelMeasurements, list[int]]:
    """A look every ten degrees around each object; returns the true object of each row too."""
    poses: list[list[float]] = []
    rows: list[tuple[int, tuple[float, float], tuple[int, ...], int]] = []
    for number, place in enumerate(PLACES):
        for angle in np.deg2rad(np.arange(0, 360, 10)):
            sensor = place + 1.6 * np.array([np.cos(angle), np.sin(angle)])
            heading = float(angle + np.pi)
            frame = len(poses)
            poses.append([*sensor, heading])
            for other, target in enumerate(PLACES):
                labels = seen_labels(other, sensor, target)
                offset = target - sensor
                distance = float(np.hypot(*offset))
                azimuth = float(np.arctan2(offset[1], offset[0]))
                ahead = abs((azimuth - heading + np.pi) % (2 * np.pi) - np.pi) < 0.4
                if labels and ahead and distance < 3.0 and rng.random() < 0.95:
                    half = 0.2 / distance
                    rows.append((frame, (azimuth - half, azimuth + half), labels, other))
            if number == 1 and frame % 9 == 0:  # clutter: a label where nothing is
                rows.append((frame, (heading + 0.3, heading + 0.35), (0,), -1))
    count = len(poses)
    pose_array: FloatArray = np.array(poses)
    stamps = np.arange(count) * 200_000_000
    views = pose_array[:, 2:] + np.array([-0.6, 0.6])
    frames = Frames(stamps, stamps, pose_array, None, views)
    returned = [row[2] for row in rows]
    measurements = LabelMeasurements(
        frames=frames,
        frame_index=np.array([row[0] for row in rows]),
        directions=np.array([row[1] for row in rows]),
        object_index=np.full(len(rows), -1),
        object_ids=(),
        label_offsets=np.cumsum([0, *(len(found) for found in returned)]),
        labels=np.concatenate([np.array(found) for found in returned]),
        scores=np.ones(sum(len(found) for found in returned)),
        label_names=("crate", "drum"),
    )
    return measurements, [row[3] for row in rows]


def seen_labels(number: int, sensor: FloatArray, place: FloatArray) -> tuple[int, ...]:
    """Both labels from within 50 degrees of the front, one's own from behind, else nothing."""
    offset = sensor - place
    aspect = np.arctan2(offset[1], offset[0]) - FACING[number]
    own = ("crate", "drum").index(CLASSES[number])
    if np.sin(aspect) > 0.64:
        return (0, 1)
    return (own,) if np.sin(aspect) < -0.64 else ()


def last(estimates: list[ObjectEstimate]) -> dict[str, ObjectEstimate]:
    return {estimate.object_id: estimate for estimate in estimates}


@pytest.fixture(scope="module")
def problem() -> Problem:
    measurements, _ = drive(np.random.default_rng(5))
    return prepare(parse_model(MODEL, "m"), measurements)


@pytest.fixture(scope="module")
def found(problem: Problem) -> tuple[list[ObjectEstimate], list[BeliefBlock]]:
    return estimate_objects(problem)


@pytest.fixture(scope="module")
def without_ids(
    found: tuple[list[ObjectEstimate], list[BeliefBlock]],
) -> dict[str, ObjectEstimate]:
    estimates, beliefs = found
    assert {belief.object_id for belief in beliefs} == set(last(estimates))
    return last(estimates)


def test_the_history_of_a_cell_ends_with_the_belief(
    problem: Problem, found: tuple[list[ObjectEstimate], list[BeliefBlock]]
) -> None:
    block = found[1][1]
    cell = int(block.cells[block.log_cell_mass.argmax()])
    history = object_history(problem, block.grid, cell, block.object_id)
    stored = stored_report(block, cell)
    np.testing.assert_allclose(
        history[-1].class_probabilities, stored.class_probabilities, rtol=0, atol=1e-4
    )
    np.testing.assert_allclose(history[-1].density, stored.density, rtol=2e-3, atol=1e-4)
    assert np.abs(history[0].class_probabilities - stored.class_probabilities).max() > 0.1


def test_every_object_is_found_and_no_other(without_ids: dict[str, ObjectEstimate]) -> None:
    assert list(without_ids) == ["object-1", "object-2", "object-3"]
    found = np.array([estimate.position for estimate in without_ids.values()])
    gaps = np.linalg.norm(found[:, None] - PLACES[None], axis=2)
    assert sorted(gaps.argmin(axis=1)) == [0, 1, 2]
    assert gaps.min(axis=1).max() < 0.4


def test_classes_and_orientations_are_right(without_ids: dict[str, ObjectEstimate]) -> None:
    for estimate in without_ids.values():
        true = int(np.linalg.norm(PLACES - estimate.position, axis=1).argmin())
        assert ("crate", "drum")[estimate.class_index] == CLASSES[true]
        error = estimate.modes[0].orientation - FACING[true]
        assert abs((error + np.pi) % (2 * np.pi) - np.pi) < np.deg2rad(20.0)


def test_clutter_belongs_to_nothing(without_ids: dict[str, ObjectEstimate]) -> None:
    _, truth = drive(np.random.default_rng(5))
    assert truth.count(-1) == 4
    assert sum(e.measurements for e in without_ids.values()) <= len(truth) - truth.count(-1)


def test_ids_agree_with_none(without_ids: dict[str, ObjectEstimate]) -> None:
    measurements, truth = drive(np.random.default_rng(5))
    with_ids = replace(measurements, object_index=np.array(truth), object_ids=("a", "b", "c"))
    estimates, _ = estimate_objects(prepare(parse_model(MODEL, "m"), with_ids))
    for estimate in last(estimates).values():
        twin = min(
            without_ids.values(),
            key=lambda other: float(np.linalg.norm(other.position - estimate.position)),
        )
        assert twin.class_index == estimate.class_index
        assert np.abs(twin.class_probabilities - estimate.class_probabilities).max() < 0.05


def test_association_can_be_switched_off() -> None:
    measurements, _ = drive(np.random.default_rng(5))
    model = parse_model(MODEL.replace("preset: robust", "preset: robust, association: false"), "m")
    assert estimate_objects(prepare(model, measurements)) == ([], [])


def boxes_at(
    sides: list[tuple[FloatArray, FloatArray]], also: FloatArray | None = None
) -> LabelMeasurements:
    """A crate seen over 50 degrees on both of two sides, drawn where the poses put it.

    Args:
        sides: Direction of the sensor from the crate, and where the crate seems to stand.
        also: A second crate that seems to stand there, in every frame.
    """
    poses: list[list[float]] = []
    rows: list[tuple[int, tuple[float, float]]] = []
    for away, place in sides:
        for turn in np.deg2rad(np.arange(-25, 26, 5)):
            cosine, sine = np.cos(turn), np.sin(turn)
            sensor = place + 1.6 * np.array([[cosine, -sine], [sine, cosine]]) @ away
            heading = np.arctan2(*(place - sensor)[::-1])
            for target in [place] if also is None else [place, also]:
                azimuth = np.arctan2(*(target - sensor)[::-1])
                half = 0.15 / float(np.hypot(*(target - sensor)))
                rows.append((len(poses), (azimuth - half, azimuth + half)))
            poses.append([*sensor, heading])
    stamps = np.arange(len(poses)) * 200_000_000
    pose_array: FloatArray = np.array(poses)
    views = pose_array[:, 2:] + np.array([-0.6, 0.6])
    return LabelMeasurements(
        frames=Frames(stamps, stamps, pose_array, None, views),
        frame_index=np.array([frame for frame, _ in rows]),
        directions=np.array([direction for _, direction in rows]),
        object_index=np.full(len(rows), -1),
        object_ids=(),
        label_offsets=np.arange(len(rows) + 1),
        labels=np.zeros(len(rows), dtype=np.int64),
        scores=np.ones(len(rows)),
        label_names=("crate", "drum"),
    )


NORTH, SOUTH = np.array([0.0, 1.0]), np.array([0.0, -1.0])


def test_what_drift_has_parted_is_one() -> None:
    parted = [(NORTH, np.array([-0.25, 0.0])), (SOUTH, np.array([0.35, 0.1]))]
    estimates, _ = estimate_objects(prepare(parse_model(MODEL, "m"), boxes_at(parted)))
    (only,) = last(estimates).values()
    assert only.measurements == 22
    assert only.position == pytest.approx([0.05, 0.05], abs=0.4)


def test_neighbours_seen_together_are_two() -> None:
    left, right = np.array([-0.3, 0.0]), np.array([0.4, 0.1])
    sides = [(NORTH, left), (SOUTH, left)]
    estimates, _ = estimate_objects(prepare(parse_model(MODEL, "m"), boxes_at(sides, also=right)))
    found = sorted(tuple(estimate.position) for estimate in last(estimates).values())
    np.testing.assert_allclose(found, [left, right], rtol=0, atol=0.2)
