"""Beliefs averaged over trajectories that err together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from models import measurements_of
from scipy.special import logsumexp

from mclass.config.model_file import parse_model
from mclass.drift import sample_offsets, shifted
from mclass.inference import estimate_objects, prepare
from mclass.records import FloatArray, LabelMeasurements
from mclass.results import BeliefBlock

MODEL = """
viewpoints: {front: {position: [1.5, 0], covariance: 0.4}}
classes:
  cup: {labels: {cup: {probability: 0.9, views: {front: 1}}}}
grid: {cell_size: 0.2, orientation_bins: 36, range: [0.5, 3]}
inference: {preset: robust, silence: false, trajectory_samples: COUNT, drift: RATE}
"""


def growing(count: int) -> FloatArray:
    steps = np.arange(1, count + 1)[:, None, None]
    return np.asarray(steps * np.array([[4e-3, 1e-3, 0.0], [1e-3, 2e-3, 0.0], [0.0, 0.0, 1e-3]]))


def cup() -> LabelMeasurements:
    angles = np.linspace(-0.4, 0.4, 9)
    sensors = [[1.5 * np.cos(a), 1.5 * np.sin(a), a + np.pi] for a in angles]
    directions = [[pose[2] - 0.1, pose[2] + 0.1] for pose in sensors]
    found = measurements_of(sensors, [(0,)] * 9, directions, label_names=("cup",))
    return replace(found, object_index=np.zeros(9, dtype=np.int64), object_ids=("o",))


def last_belief(count: int, rate: float, measurements: LabelMeasurements) -> BeliefBlock:
    text = MODEL.replace("COUNT", str(count)).replace("RATE", str(rate))
    _, beliefs = estimate_objects(prepare(parse_model(text, "m"), measurements))
    return beliefs[0]


def test_samples_have_the_covariance_of_every_frame() -> None:
    covariances = growing(6)
    offsets = sample_offsets(covariances, 20_000)
    for frame in (0, 2, 5):
        found = np.cov(offsets[:, frame].T)
        assert found == pytest.approx(covariances[frame], abs=0.03 * covariances[frame, 0, 0] * 2)


def test_neighbouring_frames_err_together() -> None:
    offsets = sample_offsets(growing(50), 2000)
    assert np.corrcoef(offsets[:, 48, 0], offsets[:, 49, 0])[0, 1] > 0.98


def test_a_shifted_world_is_the_same_world_elsewhere() -> None:
    found = cup()
    offset = np.tile([0.3, -0.7, 0.25], (len(found.frames), 1))
    moved = shifted(found, offset)
    assert moved.directions == pytest.approx(found.directions + 0.25)
    assert moved.frames.poses_world_sensor == pytest.approx(
        found.frames.poses_world_sensor + offset
    )


def test_drift_spreads_the_place_and_keeps_the_sum() -> None:
    sure, unsure = last_belief(0, 0.0, cup()), last_belief(24, 0.3, cup())
    for block in (sure, unsure):
        assert logsumexp(block.log_cell_mass) == pytest.approx(0.0, abs=1e-9)
        np.testing.assert_allclose(logsumexp(block.log_class_probability, axis=1), 0.0, atol=1e-9)
        width = 2.0 * np.pi / block.log_density.shape[-1]
        np.testing.assert_allclose(
            np.exp(block.log_density).sum(axis=-1) * width, 1.0, rtol=0, atol=1e-5
        )

    def spread(block: BeliefBlock) -> float:
        centers, mass = block.grid.centers(block.cells), np.exp(block.log_cell_mass)
        return float(mass @ ((centers - mass @ centers) ** 2).sum(axis=1))

    assert spread(unsure) > 1.2 * spread(sure)


def test_the_same_log_gives_the_same_belief() -> None:
    one, other = last_belief(5, 0.1, cup()), last_belief(5, 0.1, cup())
    np.testing.assert_array_equal(one.log_density, other.log_density)
