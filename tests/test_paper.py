"""The paper's worked example and experiment, from log to printed numbers."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from sample_runs import CONFIGS, SAMPLES, estimated, mclass, objects_of

# Our numbers must match the exact integrals to 1e-5; these are given to five digits.
TOY_TOLERANCE = 1e-5

TOY = (
    # P(background), P(c1), P(c2), modes of the orientation given c1
    (0.42313, 0.42443, 0.15244, (56.3, 236.3)),
    (0.30207, 0.57330, 0.12463, (45.0, 225.0)),
    (0.150597, 0.849385, 1.80773e-5, (45.0,)),
)
PUBLISHED = ((0.4231, 0.4244, 0.1524), (0.3019, 0.5735, 0.1247), (0.1502, 0.8498, 1.8e-5))
"""The paper's own numbers, which differ from the exact ones by up to 4.2e-4."""


def probabilities(entry: dict[str, Any]) -> list[float]:
    """Background first."""
    return list(entry["class_probabilities"].values())


def angles(entry: dict[str, Any]) -> list[float]:
    """Modes with a mass worth the name, by angle."""
    return sorted(mode["orientation_deg"] for mode in entry["modes"] if mode["mass"] > 1e-3)


def toy_history(output: Path) -> list[dict[str, Any]]:
    history: list[dict[str, Any]] = objects_of(output, "--history")["o1"]["history"]
    return history


def test_worked_example(tmp_path: Path) -> None:
    history = toy_history(estimated("paper_toy", tmp_path))
    assert len(history) == len(TOY)
    for entry, (*expected, modes), published in zip(history, TOY, PUBLISHED, strict=True):
        assert probabilities(entry) == pytest.approx(expected, abs=TOY_TOLERANCE)
        assert probabilities(entry) == pytest.approx(published, abs=4.2e-4)
        assert angles(entry) == pytest.approx(modes, abs=0.05)
        assert entry["class"] == "c1"
        assert "tie" not in entry
    assert probabilities(history[2])[2] == pytest.approx(1.80773e-5, rel=1e-4)
    assert [entry["labels"] for entry in history] == [["c1"], ["c1"], ["c1", "c2"]]


def test_worked_example_by_cell(tmp_path: Path) -> None:
    """`inspect cell --object --history` evaluates the belief anew, from the measurements."""
    output = estimated("paper_toy", tmp_path)
    arguments = ("inspect", "cell", output, "0.5", "0.5", "--object", "o1", "--format", "json")
    document = mclass(*arguments, "--history").document
    for entry, (*expected, _) in zip(document["history"], TOY, strict=True):
        assert probabilities(entry) == pytest.approx(expected, abs=TOY_TOLERANCE)
    assert probabilities(document) == pytest.approx(TOY[-1][:3], abs=TOY_TOLERANCE)


def test_printed_variance(tmp_path: Path) -> None:
    """As printed, with the bearing term of (25) and (26): not the published numbers."""
    model = CONFIGS / "paper_as_printed.yaml"
    first = toy_history(estimated("paper_toy", tmp_path, "-c", model))[0]
    assert probabilities(first) == pytest.approx((0.5962, 0.2692, 0.1346), abs=1e-4)


def test_printed_variance_without_bearing(tmp_path: Path) -> None:
    model = tmp_path / "model.yaml"
    text = (CONFIGS / "paper_toy.yaml").read_text(encoding="utf-8")
    model.write_text(text.replace(", covariance: 20", ""), encoding="utf-8")
    first = toy_history(estimated("paper_toy", tmp_path, "-c", model))[0]
    assert probabilities(first) == pytest.approx((0.39926, 0.40049, 0.20025), abs=TOY_TOLERANCE)


@pytest.mark.parametrize("name", ["cas_lab", "cas_lab_protobuf", "cas_lab_json"])
def test_experiment(name: str, tmp_path: Path) -> None:
    """Section V: classes and orientations of three boxes from five places."""
    objects = objects_of(estimated(name, tmp_path), "--history")
    history = {key: entry["history"] for key, entry in objects.items()}
    assert {key: len(steps) for key, steps in history.items()} == {"o1": 2, "o2": 2, "o3": 1}

    logo, label = history["o2"]
    assert logo["tie"] == ["physics_books", "robot_parts"]
    assert probabilities(logo)[1:] == pytest.approx((0.2626, 0.2626), abs=1e-4)
    assert angles(logo) == pytest.approx([317.0], abs=0.2)
    assert label["class"] == "robot_parts"
    assert label["class_probabilities"]["robot_parts"] == pytest.approx(0.6154, abs=1e-4)
    assert angles(label) == pytest.approx([315.1], abs=0.2)

    assert history["o3"][0]["class"] == "robot_parts"
    assert angles(history["o3"][0]) == pytest.approx([3.0, 183.0], abs=0.2)

    label, logo = history["o1"]
    assert angles(label) == pytest.approx([57.0, 237.0], abs=0.2)
    assert logo["class"] == "physics_books"
    assert angles(logo) == pytest.approx([257.7], abs=0.2)


def test_encodings_give_the_same_numbers(tmp_path: Path) -> None:
    names = ("cas_lab", "cas_lab_protobuf", "cas_lab_json")
    outputs = [estimated(name, tmp_path) for name in names]
    objects = [objects_of(output, "--history") for output in outputs]
    assert objects[0] == objects[1] == objects[2]
    cells = [
        mclass("inspect", "cell", output, "2.1", "-1.5", "--format", "json").document
        for output in outputs
    ]
    assert cells[0]["measurements"] == 2
    assert cells[0] == cells[1] == cells[2]


def in_metres(model: str) -> str:
    """A model in decimetres with every length, variance and density rewritten by hand."""
    model = model.replace("length_unit: dm", "length_unit: m")
    model = re.sub(r"(position: )\[([-\d.]+), ([-\d.]+)\]", _tenth, model)
    model = re.sub(r"(covariance: )([\d.]+)", lambda m: f"{m[1]}{float(m[2]) / 100}", model)
    model = re.sub(r"(likelihood: )([\d.]+)", lambda m: f"{m[1]}{float(m[2]) * 100}", model)
    model = re.sub(r"(cell_size: )([\d.]+)", lambda m: f"{m[1]}{float(m[2]) / 10}", model)
    return re.sub(r"(range: )\[([\d.]+), ([\d.]+)\]", _tenth, model)


def _tenth(found: re.Match[str]) -> str:
    return f"{found[1]}[{float(found[2]) / 10}, {float(found[3]) / 10}]"


@pytest.mark.parametrize("preset", ["paper", "robust"])
@pytest.mark.parametrize(
    ("log", "cell"), [("paper_toy", ("0.5", "0.4")), ("cas_lab", ("2.1", "-1.5"))]
)
def test_metres_and_decimetres_agree(
    log: str, cell: tuple[str, str], preset: str, tmp_path: Path
) -> None:
    text = (CONFIGS / f"{log}.yaml").read_text(encoding="utf-8").replace("paper}", f"{preset}}}")
    found = []
    for unit, model_text in (("dm", text), ("m", in_metres(text))):
        model, output = tmp_path / f"{unit}.yaml", tmp_path / f"{unit}.mcap"
        model.write_text(model_text, encoding="utf-8")
        mclass("estimate", SAMPLES / f"{log}.mcap", "-c", model, "-o", output)
        inside = mclass("inspect", "cell", output, *cell, "--format", "json").document
        assert inside["measurements"] > 0
        objects = objects_of(output, "--history")
        steps = [step for key in sorted(objects) for step in objects[key]["history"]]
        found.append([inside, *steps])
    for decimetres, metres in zip(*found, strict=True):
        assert probabilities(metres) == pytest.approx(probabilities(decimetres), abs=1e-6)


def test_grid_cell_at_the_object(tmp_path: Path) -> None:
    """A cell centred where the object stands agrees with the known position's belief."""
    text = (CONFIGS / "paper_toy.yaml").read_text(encoding="utf-8")
    assert "footprint: ray, range: [1, 30]}" in text
    model = tmp_path / "model.yaml"
    text = text.replace("range: [1, 30]}", "range: [1, 30], origin: [-0.5, -0.5], size: [20, 20]}")
    model.write_text(text, encoding="utf-8")
    output = estimated("paper_toy", tmp_path, "-c", model)
    cell = mclass("inspect", "cell", output, "0.5", "0.5", "--format", "json").document
    assert cell["cell"]["center"] == pytest.approx((0.5, 0.5))
    assert cell["measurements"] == 3
    assert probabilities(cell) == pytest.approx(TOY[-1][:3], abs=1e-4)
