"""A detector that says everything ten times says no more than once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_association import MODEL, drive

from mclass.config.model_file import parse_model
from mclass.inference import GridEstimate, cuts_every, estimate_objects, prepare
from mclass.model import Model
from mclass.records import FloatArray, Frames, LabelMeasurements
from mclass.results import BeliefBlock

TIMES = 10


def repeated(found: LabelMeasurements) -> LabelMeasurements:
    """Every frame ten times over, a millisecond apart."""
    frames = found.frames
    again = np.arange(len(frames)).repeat(TIMES)
    late = np.tile(np.arange(TIMES) * 1_000_000, len(frames))
    rows = np.arange(len(found)).repeat(TIMES)
    spans = [
        np.arange(found.label_offsets[row], found.label_offsets[row + 1]) for row in rows.tolist()
    ]
    taken = np.concatenate(spans)
    return replace(
        found,
        frames=Frames(
            frames.stamps_ns[again] + late,
            frames.log_times_ns[again] + late,
            frames.poses_world_sensor[again],
            None,
            frames.view_directions[again],
        ),
        frame_index=found.frame_index[rows] * TIMES + np.tile(np.arange(TIMES), len(found)),
        directions=found.directions[rows],
        object_index=found.object_index[rows],
        label_offsets=np.cumsum([0, *map(len, spans)]),
        labels=found.labels[taken],
        scores=found.scores[taken],
    )


def measurements(ids: bool) -> LabelMeasurements:
    found, owners = drive(np.random.default_rng(7))
    if not ids:
        return found
    return replace(found, object_index=np.array(owners), object_ids=("a", "b", "c"))


def belief_of(blocks: list[BeliefBlock]) -> FloatArray:
    """P(class, orientation bin), place summed out, background first, (1 + n * bins,)."""
    total: FloatArray = np.zeros(1)
    for block in blocks:
        mass = np.exp(block.log_cell_mass[:, None] + block.log_class_probability)
        density = np.exp(block.log_density.astype(float))
        density /= density.sum(axis=-1, keepdims=True)
        joint = (mass[:, 1:, None] * density).sum(axis=0)
        total = total + np.concatenate([[mass[:, 0].sum()], joint.ravel()])
    return np.asarray(total / total.sum())


def total_variation(one: FloatArray, other: FloatArray) -> float:
    return 0.5 * float(np.abs(one - other).sum())


@pytest.fixture(scope="module")
def model() -> Model:
    return parse_model(MODEL, "m")


@pytest.mark.parametrize("ids", [True, False])
def test_objects_hardly_change_when_every_frame_comes_ten_times(model: Model, ids: bool) -> None:
    found = measurements(ids)
    beliefs = []
    for given in (found, repeated(found)):
        _, blocks = estimate_objects(prepare(model, given), history=False)
        beliefs.append({block.object_id: belief_of([block]) for block in blocks})
    once, often = beliefs
    assert len(once) == 3
    assert once.keys() == often.keys()
    for key, belief in once.items():
        # Not because nothing was learned.
        assert belief.max() > 0.1
        assert total_variation(belief, often[key]) < 0.02


def test_cells_hardly_change_when_every_frame_comes_ten_times(model: Model) -> None:
    found = measurements(ids=False)
    once, often = (
        list(GridEstimate(prepare(model, given), cuts_every(given, None)).blocks())
        for given in (found, repeated(found))
    )
    worst, learned = 0.0, 0
    for one, other in zip(once, often, strict=True):
        assert one.cells.tolist() == other.cells.tolist()
        for row in range(len(one.cells)):
            pair = [
                belief_of(
                    [
                        replace(
                            block,
                            log_cell_mass=np.zeros(1),
                            log_class_probability=block.log_class_probability[[row]],
                            log_density=block.log_density[[row]],
                        )
                    ]
                )
                for block in (one, other)
            ]
            worst = max(worst, total_variation(*pair))
            learned += bool(pair[0].max() > 0.1)
    assert learned > 10
    assert worst < 0.02
