"""A detection's evidence shared among the cells that it points at."""

from __future__ import annotations

import numpy as np
import pytest
from models import measurements_of

from mclass.cells import grid_history
from mclass.config.model_file import parse_model
from mclass.inference import GridEstimate, Problem, cuts_every, prepare
from mclass.results import ClassMaps

MODEL = """
viewpoints:
  front: {position: [1.9, 0], covariance: 0.4}
  back: {position: [-1.9, 0], covariance: 0.4}
  left: {position: [0, 1.9], covariance: 0.4}
  right: {position: [0, -1.9], covariance: 0.4}
classes:
  cup: {labels: {cup: {probability: 0.9, views: [front, back, left, right]}}}
grid: {cell_size: 0.25, orientation_bins: 36, range: [0.5, 3], origin: [-1, -1], size: [4, 4]}
inference: {preset: robust, silence: false, one_cause: SWITCH}
"""


def problem(switch: str) -> Problem:
    # Two sensors, 90 degrees apart, that both see a cup about (1.1, 0.1), and one more that
    # sees it along a ray on which nothing else was ever seen.
    sensors = [[-0.9, 0.1, 0.0], [1.1, 1.9, -np.pi / 2], [-0.3, -0.9, 0.6]]
    directions = [[pose[2] - 0.12, pose[2] + 0.12] for pose in sensors]
    measurements = measurements_of(sensors, [(0,)] * 3, directions, label_names=("cup",))
    return prepare(parse_model(MODEL.replace("SWITCH", switch), "m"), measurements)


def maps(found: Problem) -> ClassMaps:
    grid = GridEstimate(found, cuts_every(found.measurements, None))
    for _ in grid.blocks():
        pass
    return grid.maps()[-1]


def test_a_detection_is_not_worth_more_than_one_object() -> None:
    alone, shared = maps(problem("false")), maps(problem("true"))
    assert alone.cells.tolist() == shared.cells.tolist()
    # Each cell of a ray alone believes in a cup: many cups for three detections.
    assert alone.class_probabilities[:, 1].sum() > 8.0
    odds = shared.class_probabilities[:, 1] / shared.class_probabilities[:, 0]
    assert odds.max() < (alone.class_probabilities[:, 1] / alone.class_probabilities[:, 0]).max()
    assert shared.class_probabilities[:, 1].sum() < alone.class_probabilities[:, 1].sum()


def test_the_crossing_keeps_what_the_rays_lose() -> None:
    shared = maps(problem("true"))
    best = shared.grid.centers(shared.cells[[np.argmax(shared.class_probabilities[:, 1])]])[0]
    assert np.hypot(*(best - [1.1, 0.1])) < 0.5


def test_history_ends_where_the_map_does() -> None:
    found = problem("true")
    shared = maps(found)
    row = int(np.argmax(shared.class_probabilities[:, 1]))
    last = grid_history(found, int(shared.cells[row]))[-1]
    assert last.class_probabilities == pytest.approx(shared.class_probabilities[row], abs=1e-6)
