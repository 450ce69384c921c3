"""The sample logs: complete, readable by others, and estimated rightly."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from sample_runs import CONFIGS, SAMPLE_NAMES, SAMPLES, estimated, mclass, objects_of

ENCODINGS = {"cas_lab": "cdr", "cas_lab_protobuf": "protobuf", "cas_lab_json": "json"}


def attachments(name: str) -> dict[str, bytes]:
    with (SAMPLES / f"{name}.mcap").open("rb") as stream:
        return {found.name: found.data for found in make_reader(stream).iter_attachments()}


def truth_of(name: str) -> dict[str, dict[str, Any]]:
    document = json.loads(attachments(name)["truth.json"])
    return {entry["id"]: entry for entry in document["objects"]}


def turn(a: float, b: float) -> float:
    """Angle between two directions in degrees."""
    return abs((a - b + 180.0) % 360.0 - 180.0)


def test_there_are_no_others() -> None:
    logs = {path.stem for path in SAMPLES.glob("*.mcap") if not path.stem.endswith(".mclass")}
    assert logs == set(SAMPLE_NAMES)
    assert all((SAMPLES / f"{name}.mcap").stat().st_size < 1_000_000 for name in logs)


@pytest.mark.parametrize("name", SAMPLE_NAMES)
def test_carries_its_model_and_truth(name: str) -> None:
    found = attachments(name)
    assert set(found) == {"mclass.yaml", "truth.json"}
    config = name.removesuffix("_protobuf").removesuffix("_json")
    assert found["mclass.yaml"] == (CONFIGS / f"{config}.yaml").read_bytes()


@pytest.mark.parametrize("name", SAMPLE_NAMES)
def test_nothing_of_it_is_damaged_or_skipped(name: str, tmp_path: Path) -> None:
    log = SAMPLES / f"{name}.mcap"
    survey = mclass("inspect", "log", log, "--verify", "--format", "json").document
    assert survey["damage"] == []
    out = tmp_path / "out.mcap"
    document = mclass("estimate", log, "-o", out, "--format", "json").document
    assert document["measurements"]["skipped"] == {}
    assert document["model"] == f"{name}.mcap#mclass.yaml"


@pytest.mark.parametrize("name", SAMPLE_NAMES)
def test_truth_is_found(name: str, tmp_path: Path) -> None:
    """Every object's class, and its orientation among the modes; at most 6 degrees off."""
    objects, truth = objects_of(estimated(name, tmp_path)), truth_of(name)
    assert set(objects) == set(truth)
    for object_id, true in truth.items():
        found = objects[object_id]
        assert found["class"] == true["class"]
        assert found["position"] == pytest.approx((true["x"], true["y"]))
        errors = [turn(mode["orientation_deg"], true["phi"]) for mode in found["modes"]]
        assert min(errors) < 6.0


@pytest.mark.parametrize(("name", "encoding"), ENCODINGS.items())
def test_encoding(name: str, encoding: str) -> None:
    with (SAMPLES / f"{name}.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count > 1000
    assert {channel.message_encoding for channel in summary.channels.values()} == {encoding}
