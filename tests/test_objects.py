"""An object's belief after its last measurement alone, and after each."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mclass.config.model_file import load_model
from mclass.inference import estimate_objects, prepare
from mclass.model import PAPER, ROBUST, InferenceSettings, Model
from mclass.records import LabelMeasurements
from mclass.simulation.scenario_file import load_scenario
from mclass.simulation.world import simulate_measurements

CONFIGS = Path(__file__).parent.parent / "configs"


def office(settings: InferenceSettings, known: bool) -> tuple[Model, LabelMeasurements]:
    """Three stops of the drive around the office, on a coarse grid."""
    scenario = load_scenario(CONFIGS / "scenarios" / "office.yaml")
    scenario = replace(
        scenario,
        trajectory=replace(scenario.trajectory, stops=scenario.trajectory.stops[:3]),
        camera=replace(scenario.camera, rate=1.0),
    )
    model = load_model(CONFIGS / "office.yaml")
    grid = replace(model.grid, orientation_bins=24, cell_size=0.2)
    objects = {item.object_id: item.position for item in scenario.objects} if known else {}
    measurements, _ = simulate_measurements(scenario)
    return replace(model, inference=settings, objects=objects, grid=grid), measurements


@pytest.mark.parametrize("settings", [ROBUST, replace(ROBUST, correlation=None)])
@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("history", [False, True])
def test_blocks_do_not_show(
    settings: InferenceSettings, known: bool, history: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, measurements = office(settings, known)
    problem = prepare(model, measurements)
    whole, beliefs = estimate_objects(problem, history=history)
    # A few looks at a time, fewer than between two detections; weights of a few more.
    monkeypatch.setattr("mclass.objects._NUMBERS_AT_ONCE", 1)
    monkeypatch.setattr("mclass.objects._SIGHTS_AT_ONCE", 600)
    monkeypatch.setattr("mclass.objects._WEIGHTS_AT_ONCE", 2_000)
    parted, parted_beliefs = estimate_objects(problem, history=history)
    for one, other in zip(whole, parted, strict=True):
        assert one.measurements == other.measurements
        assert one.class_probabilities == pytest.approx(other.class_probabilities, abs=1e-6)
        assert one.class_poses == pytest.approx(other.class_poses, abs=1e-4)
    for belief, other_belief in zip(beliefs, parted_beliefs, strict=True):
        np.testing.assert_array_equal(belief.cells, other_belief.cells)
        np.testing.assert_allclose(
            np.exp(belief.log_cell_mass), np.exp(other_belief.log_cell_mass), rtol=0, atol=1e-5
        )


@pytest.mark.parametrize("settings", [PAPER, ROBUST, replace(ROBUST, correlation=None)])
@pytest.mark.parametrize("known", [False, True])
def test_last_belief_needs_no_history(settings: InferenceSettings, known: bool) -> None:
    model, measurements = office(settings, known)
    followed, beliefs = estimate_objects(prepare(model, measurements))
    ends, end_beliefs = estimate_objects(prepare(model, measurements), history=False)
    last = {estimate.object_id: estimate for estimate in followed}
    assert {estimate.object_id for estimate in ends} == last.keys()
    assert len(followed) > 5 * len(ends)
    for end in ends:
        one = last[end.object_id]
        assert end.class_probabilities == pytest.approx(one.class_probabilities, abs=1e-4)
        assert end.class_poses == pytest.approx(one.class_poses, abs=1e-4)
        assert (end.measurements, end.stamp_ns, end.labels) == (
            one.measurements,
            one.stamp_ns,
            one.labels,
        )
    # Sums of tables, in blocks by one and at once by the other: as exact as the tables are.
    for belief, end_belief in zip(beliefs, end_beliefs, strict=True):
        # What has no mass may be left out by one and not by the other.
        shared, there, here = np.intersect1d(belief.cells, end_belief.cells, return_indices=True)
        assert np.exp(belief.log_cell_mass[there]).sum() == pytest.approx(1.0, abs=1e-6)
        masses = np.exp(belief.log_cell_mass[there]), np.exp(end_belief.log_cell_mass[here])
        assert len(shared) >= 1
        assert masses[1] == pytest.approx(masses[0], abs=1e-4)
