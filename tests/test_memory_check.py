"""An estimate that would not fit is refused before it starts, with numbers and advice."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from models import measurements_of, toy_model

from mclass import memory
from mclass.errors import ModelError
from mclass.inference import Problem, prepare
from mclass.memory import available_bytes, memory_needed, require_memory
from mclass.model import PAPER, ROBUST, GridSettings, InferenceSettings, Model

GIGABYTE = 10**9


def problem_of(
    cell_size: float = 0.1,
    bins: int = 72,
    size: float = 20.0,
    inference: InferenceSettings = PAPER,
    ids: bool = False,
) -> Problem:
    model = Model(
        name="hall.yaml",
        source="",
        length_unit="m",
        classes=toy_model(unit=0.1),
        grid=GridSettings(
            cell_size=cell_size, orientation_bins=bins, origin=(0.0, 0.0), size=(size, size)
        ),
        inference=inference,
    )
    measurements = measurements_of(
        [[5.0, 5.0, 0.0], [15.0, 12.0, 2.0]],
        [[0], [1]],
        [[-0.3, 0.3], [1.8, 2.2]],
        label_names=("c1", "c2"),
    )
    if ids:
        measurements = replace(measurements, object_index=np.array([0, 1]), object_ids=("a", "b"))
    return prepare(model, measurements)


def test_counts_what_footprints_touch() -> None:
    need = memory_needed(problem_of(), 1, 1)
    assert need.cells == 200 * 200
    assert 0 < need.touched < need.cells
    assert memory_needed(problem_of(), 1, 1, touched=need.cells).n_bytes > need.n_bytes


@pytest.mark.parametrize(
    "more", [problem_of(cell_size=0.05), problem_of(bins=576), problem_of(size=40.0)]
)
def test_needs_more_for_more(more: Problem) -> None:
    assert memory_needed(more, 1, 1).n_bytes > memory_needed(problem_of(), 1, 1).n_bytes


def test_needs_more_for_more_maps_and_threads() -> None:
    once = memory_needed(problem_of(), 1, 1).n_bytes
    assert memory_needed(problem_of(), 50, 1).n_bytes > once
    assert memory_needed(problem_of(), 1, 8).n_bytes > once


def test_needs_more_to_follow_objects() -> None:
    alone = replace(ROBUST, association=False)
    grid = memory_needed(problem_of(inference=alone), 1, 1).n_bytes
    by_id = memory_needed(problem_of(inference=alone, ids=True), 1, 1).n_bytes
    # Without ids all detections may turn out to be of one object.
    by_group = memory_needed(problem_of(inference=ROBUST), 1, 1).n_bytes
    assert grid < by_id < by_group
    assert memory_needed(problem_of(inference=ROBUST, ids=True), 1, 1).n_bytes == by_id
    drifting = replace(alone, trajectory_samples=8)
    assert memory_needed(problem_of(inference=drifting, ids=True), 1, 1).n_bytes > by_id


def test_refuses_groups_that_would_not_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = problem_of(inference=ROBUST)
    found = memory_needed(problem, 1, 1, candidates=0).n_bytes
    monkeypatch.setattr(memory, "available_bytes", lambda: found)
    with pytest.raises(ModelError, match="does not fit"):
        require_memory(problem, 1, 1)
    require_memory(problem_of(inference=replace(ROBUST, association=False)), 1, 1)


def test_refuses_with_numbers_and_advice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available_bytes", lambda: GIGABYTE // 10)
    with pytest.raises(ModelError) as caught:
        require_memory(problem_of(), 1, 1)
    text = str(caught.value)
    for part in ("hall.yaml", "200 x 200", "0.1 GB are free", "grid.cell_size (0.1 m now)"):
        assert part in text
    assert "--every" not in text
    with pytest.raises(ModelError, match="--every"):
        require_memory(problem_of(), 7, 1)


def test_what_fits_may_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available_bytes", lambda: GIGABYTE)
    require_memory(problem_of(), 1, 1)
    require_memory(replace(problem_of(), grid=None), 1, 1)
    monkeypatch.setattr(memory, "available_bytes", lambda: None)
    require_memory(problem_of(size=1000.0), 1, 1)


def test_takes_the_smallest_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    information = tmp_path / "meminfo"
    information.write_text("MemTotal:  8000000 kB\nMemAvailable:    2000 kB\n")
    monkeypatch.setattr(memory, "_MEMORY_FILE", information)
    monkeypatch.setattr(memory, "_GROUPS", (tmp_path / "group",))
    assert available_bytes() == 2000 * 1024
    group = tmp_path / "group"
    group.mkdir()
    (group / "memory.max").write_text("max\n")
    (group / "memory.current").write_text("5\n")
    assert available_bytes() == 2000 * 1024
    (group / "memory.max").write_text("1000000\n")
    (group / "memory.current").write_text("900000\n")
    (group / "memory.stat").write_text("anon 5\ninactive_file 300\n")
    assert available_bytes() == 100_300
    information.unlink()
    assert available_bytes() == 100_300
    (group / "memory.max").unlink()
    assert available_bytes() is None
