"""Threads change how long an estimate takes, and nothing else, to the last bit."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from models import lopsided_model, measurements_of

import mclass
from mclass.inference import GridEstimate, Problem, cuts_every, prepare
from mclass.model import ROBUST, GridSettings, InferenceSettings, Model
from mclass.parallel import ordered_map
from mclass.results import BeliefBlock

SAMPLE = Path(__file__).parents[1] / "sample_logs" / "cas_lab.mcap"


def problem_of(inference: InferenceSettings) -> Problem:
    model = Model(
        name="test.yaml",
        source="",
        length_unit="m",
        classes=lopsided_model(),
        grid=GridSettings(cell_size=0.1, orientation_bins=36, max_range=3.0),
        inference=inference,
    )
    rng = np.random.default_rng(3)
    count = 24
    poses = np.column_stack([rng.uniform(-3.0, 3.0, (count, 2)), rng.uniform(-3.0, 3.0, count)])
    middle = rng.uniform(-np.pi, np.pi, count)
    directions = np.stack([middle - 0.4, middle + 0.4], axis=-1)
    labels = [[int(label)] for label in rng.integers(0, 2, count)]
    return prepare(model, measurements_of(poses, labels, directions))


@pytest.mark.parametrize("inference", [InferenceSettings(), ROBUST], ids=["paper", "robust"])
def test_blocks_are_identical(inference: InferenceSettings) -> None:
    problem = problem_of(inference)
    cuts = cuts_every(problem.measurements, 2_000_000_000)

    def blocks(threads: int) -> list[BeliefBlock]:
        return list(GridEstimate(problem, cuts, threads).blocks())

    wanted = blocks(1)
    assert len(wanted) > 4
    for threads in (2, 4):
        for one, other in zip(wanted, blocks(threads), strict=True):
            assert one.block == other.block
            for name in ("cells", "log_class_probability", "log_density", "measurements"):
                np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize("inference", [InferenceSettings(), ROBUST], ids=["paper", "robust"])
def test_tables_are_built_beforehand(inference: InferenceSettings) -> None:
    engine = problem_of(inference).engine
    engine.build_tables(2)
    built = dict(engine._tables)
    assert built
    problem = replace(problem_of(inference), engine=engine)
    assert list(GridEstimate(problem, cuts_every(problem.measurements, None), 2).blocks())
    assert engine._tables == built


def test_outputs_are_identical(tmp_path: Path) -> None:
    written = []
    for threads in (1, 2, 4):
        output = tmp_path / f"{threads}.mcap"
        mclass.estimate(SAMPLE, output=output, threads=threads)
        written.append(output.read_bytes())
    assert written[0] == written[1] == written[2]


def test_results_come_in_order() -> None:
    def late(number: int) -> int:
        time.sleep(0.01 * (number % 3))
        return number

    assert list(ordered_map(late, range(20), 4)) == list(range(20))


def test_works_on_few_items_ahead() -> None:
    started = 0
    lock = threading.Lock()

    def count(number: int) -> int:
        nonlocal started
        with lock:
            started += 1
        return number

    results = ordered_map(count, range(100), 2)
    assert next(results) == 0
    time.sleep(0.05)
    assert started <= 5
    results.close()  # type: ignore[attr-defined]
    assert started <= 5


def test_an_error_arrives_where_it_belongs() -> None:
    def fail(number: int) -> int:
        if number == 3:
            raise ValueError("three")
        return number

    results = ordered_map(fail, range(9), 2)
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(ValueError, match="three"):
        next(results)
