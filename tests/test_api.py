"""Use from Python: arrays in, arrays out, the same numbers as the command line."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

import mclass
from mclass.commands.cli import main

ROOT = Path(__file__).parent.parent
LOG = ROOT / "sample_logs" / "cas_lab.mcap"
MODEL = ROOT / "configs" / "cas_lab.yaml"
TOY_MODEL = ROOT / "configs" / "paper_toy.yaml"


@pytest.fixture(scope="module")
def found() -> mclass.Estimate:
    return mclass.estimate(LOG)


def test_import_alone_loads_nothing_heavy() -> None:
    heavy = ("numpy", "scipy", "mcap", "yaml", "click", "google")
    code = f"import sys, mclass; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_every_public_name_is_there() -> None:
    for name in mclass.__all__:
        assert getattr(mclass, name) is not None
    assert set(mclass.__all__) <= set(dir(mclass))
    with pytest.raises(AttributeError, match="no attribute 'estimates'"):
        mclass.estimates  # noqa: B018 (the access is what is tested)


def test_the_function_stays_a_function() -> None:
    # A submodule of the same name would take its place once it is imported.
    code = "import mclass, mclass.commands.cli, mclass.commands.estimate; print(mclass.estimate)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("<function estimate")


def test_same_numbers_as_the_command(found: mclass.Estimate, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    result = CliRunner().invoke(main, ["estimate", str(LOG), "-o", str(out), "--format", "json"])
    assert result.exit_code == 0, result.output
    objects = json.loads(result.stdout)["objects"]
    assert found.object_ids == tuple(entry["id"] for entry in objects)
    names = ("background", *found.class_names)
    expected = [[entry["class_probabilities"][name] for name in names] for entry in objects]
    np.testing.assert_array_equal(found.class_probabilities, expected)
    np.testing.assert_array_equal(found.positions, [entry["position"] for entry in objects])
    np.testing.assert_allclose(
        np.degrees(found.orientations), [entry["orientation_deg"] for entry in objects], rtol=1e-12
    )
    assert [len(steps) for steps in found.history.values()] == [
        entry["measurements"] for entry in objects
    ]
    with mclass.OutputLog.open(out) as output:
        stored = output.belief_at(4.05, 2.05)
        np.testing.assert_allclose(
            np.log(found.cell(4.05, 2.05).class_probabilities),
            stored.log_class_probability[0],
            atol=1e-4,
        )
        assert len(output.measurements()) == len(found.measurements)


def test_nothing_is_written_unless_asked(tmp_path: Path) -> None:
    log = tmp_path / "drive.mcap"
    log.write_bytes(LOG.read_bytes())
    assert mclass.estimate(log).output is None
    assert list(tmp_path.iterdir()) == [log]
    found = mclass.estimate(str(log), output=tmp_path / "out.mcap")
    assert found.output == tmp_path / "out.mcap"
    assert found.input_hash.startswith("sha256:")
    with pytest.raises(mclass.LogError, match="exists already"):
        mclass.estimate(log, output=tmp_path / "out.mcap")


@pytest.mark.parametrize("kind", ["path", "str", "text", "model"])
def test_a_model_comes_in_any_form(kind: str, found: mclass.Estimate) -> None:
    sources: dict[str, Any] = {
        "path": MODEL,
        "str": str(MODEL),
        "text": MODEL.read_text(),
        "model": mclass.load_model(MODEL),
    }
    again = mclass.estimate(LOG, sources[kind])
    np.testing.assert_array_equal(again.class_probabilities, found.class_probabilities)


def test_wrong_models_are_refused() -> None:
    with pytest.raises(mclass.ConfigError):
        mclass.estimate(LOG, "no_such_file.yaml")
    with pytest.raises(mclass.ConfigError):
        mclass.estimate(LOG, "viewpoints: {}\nclasses: {}\n")


def test_measurements_of_a_log_give_its_estimate(found: mclass.Estimate) -> None:
    again = mclass.infer(found.measurements, found.model)
    assert again.object_ids == found.object_ids
    np.testing.assert_array_equal(again.class_probabilities, found.class_probabilities)
    np.testing.assert_array_equal(again.positions, found.positions)
    blocks = list(again.grid_belief())
    assert sum(len(block.cells) for block in blocks) == len(again.maps.cells if again.maps else ())


def toy(**changes: Any) -> mclass.LabelMeasurements:
    """The paper's three measurements of an object at (5, 5) dm, in metres."""
    model = mclass.load_model(TOY_MODEL)
    arguments: dict[str, Any] = {
        "poses": [[1.2, 1.2, -3 * np.pi / 4], [0.5, 1.5, -np.pi / 2], [-0.2, -0.2, np.pi / 4]],
        "labels": [["c1", "c2"], ["c1"], ["c1"]],
        "label_names": model.classes.label_names,
        "object_ids": ["o1"] * 3,
    }
    return mclass.measurements_from_arrays(**{**arguments, **changes})


def test_arrays_become_measurements() -> None:
    stamps = [5, 5, 8, 8, 9]
    poses = [[0, 0, 0], [0, 0, 0], [0, 0, 0], [1, 0, 0], [2, 0, 0]]
    made = mclass.measurements_from_arrays(
        poses,
        [["b", "a"], ["a"], ["a", "a"], [], ["b"]],
        ("a", "b"),
        directions=[[0.1, 0.2], [np.nan, np.nan], [0.3, 0.3], [np.nan, np.nan], [0.5, 0.6]],
        object_ids=["z", None, "z", None, "k"],
        stamps_ns=stamps,
    )
    assert len(made) == 4
    np.testing.assert_array_equal(made.frames.stamps_ns, [5, 8, 8, 9])
    np.testing.assert_array_equal(made.frames.poses_world_sensor[:, 0], [0, 0, 1, 2])
    np.testing.assert_array_equal(made.frame_index, [0, 0, 1, 3])
    np.testing.assert_array_equal(made.label_offsets, [0, 2, 3, 4, 5])
    np.testing.assert_array_equal(made.labels, [0, 1, 0, 0, 1])
    assert made.object_ids == ("k", "z")
    np.testing.assert_array_equal(made.object_index, [1, -1, 1, 0])
    np.testing.assert_array_equal(made.directions[:, 0], [0.1, np.nan, 0.3, 0.5])


def test_no_measurements_are_an_empty_estimate() -> None:
    empty = toy(poses=np.zeros((0, 3)), labels=[], object_ids=[])
    found = mclass.infer(empty, TOY_MODEL)
    assert found.object_ids == ()
    assert found.class_probabilities.shape == (0, 3)
    assert found.positions.shape == (0, 2)
    assert found.maps is None


def test_labels_that_no_class_explains() -> None:
    """Each class returns its own label alone: c1, then c2, is neither."""
    text = TOY_MODEL.read_text(encoding="utf-8")
    model = mclass.load_model(TOY_MODEL)
    for confusion in re.findall(r"^ +c\d: .*covariance: 20}\n", text, re.MULTILINE):
        text = text.replace(confusion, "")
    stray = toy(labels=[["c1"], ["c1"], ["c2"]])
    *before, last = mclass.infer(stray, text).history["o1"]
    assert last.unexplained
    assert last.class_probabilities.tolist() == [1.0, 0.0, 0.0]
    assert not any(step.unexplained for step in before)
    assert not mclass.infer(stray, model).objects[0].unexplained


def test_what_points_beside_the_grid_is_counted() -> None:
    """With an id or without: of four detections, two look away from the map's only cells."""
    text = TOY_MODEL.read_text(encoding="utf-8")
    text = text.replace("range: [1, 30]", "range: [1, 30], origin: [0, 0], size: [10, 10]")
    away, towards = [0.0, 0.1], [np.pi - 0.1, np.pi + 0.1]
    looks = toy(
        poses=[[2.0, 0.5, 0.0]] * 4,
        labels=[["c1"]] * 4,
        object_ids=[None, None, "far", "near"],
        directions=[away, towards, away, towards],
        stamps_ns=[1, 2, 3, 4],
    )
    found = mclass.infer(looks, text.replace("objects:\n  o1: {position: [5, 5]}\n", ""))
    (reason,) = found.skipped
    assert "points at no cell (larger grid.size" in reason
    assert (found.skipped[reason], found.used, found.object_ids) == (2, 2, ("near",))


def test_estimate_from_arrays_is_kept_in_a_log(tmp_path: Path) -> None:
    out = tmp_path / "toy.mcap"
    model = mclass.load_model(TOY_MODEL)
    found = mclass.infer(toy(), model, output=out, frame="lab", encoding="protobuf")
    with mclass.OutputLog.open(out) as output:
        (stored,) = output.objects()
        assert output.frame == "lab"
        np.testing.assert_array_equal(stored.class_probabilities, found.class_probabilities[0])
        assert {channel.topic.split("/")[1] for channel in output.reader.channels} == {"mclass"}
    result = CliRunner().invoke(main, ["inspect", "objects", str(out)])
    assert result.exit_code == 0, result.output


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"poses": [[0, 0]] * 3}, r"poses has the shape \(3, 2\), not \(3, 3\)"),
        ({"poses": [[0, 0, np.nan]] * 3}, "not finite"),
        ({"poses": "here"}, "no array of numbers"),
        ({"labels": [["c1"], ["c9"], ["c1"]]}, "labels c9 are not among c1, c2"),
        ({"object_ids": ["o1"]}, "object_ids has 1 entries for 3 rows"),
        ({"stamps_ns": [1.0, 2.0, 3.0]}, "integers"),
        ({"stamps_ns": [3, 2, 1]}, "not decrease"),
        ({"directions": [[np.inf, 0.0]] * 3}, "not finite"),
        ({"poses": [[0, 0, 0]] * 3, "stamps_ns": [1, 1, 1]}, "'o1' has two rows in one frame"),
    ],
)
def test_contradicting_arrays_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(mclass.UsageError, match=message):
        toy(**changes)


def test_measurements_with_other_labels_are_refused() -> None:
    with pytest.raises(mclass.UsageError, match="labels"):
        mclass.infer(toy(), MODEL)


def test_questions_about_nothing_are_refused(found: mclass.Estimate) -> None:
    with pytest.raises(mclass.UsageError, match="no object 'x'; objects: o1, o2, o3"):
        found.cell(0.0, 0.0, "x")
    with pytest.raises(mclass.UsageError, match="not on the grid"):
        found.cell(1e6, 0.0)
