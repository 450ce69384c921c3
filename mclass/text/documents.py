"""Results as JSON documents: what ``--format json`` prints.

Names and meanings are the documented interface of the commands. Angles become degrees in
[0, 360), stamps become strings (a double cannot hold their nanoseconds), and a number that
JSON cannot say (an unbounded deviation) becomes null. Nothing is rounded.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeAlias

from mclass.classes import BACKGROUND
from mclass.results import CellReport, ObjectEstimate, OrientationMode
from mclass.text.values import degrees, natural

JsonObject: TypeAlias = dict[str, Any]


def objects_json(
    objects: Iterable[ObjectEstimate],
    class_names: Sequence[str],
    frame: str,
    history: Mapping[str, Sequence[ObjectEstimate]] | None = None,
) -> JsonObject:
    """The document of ``inspect objects``.

    Args:
        objects: Latest estimate of each object; they come out in the natural order of ids.
        class_names: Without the background.
        frame: World frame of the positions.
        history: Every estimate by object id, oldest first; each object then gets its own.
    """
    entries = []
    for estimate in sorted(objects, key=lambda estimate: natural(estimate.object_id)):
        entry = object_json(estimate, class_names)
        if history is not None:
            past = history.get(estimate.object_id, ())
            entry["history"] = [object_json(step, class_names) for step in past]
        entries.append(entry)
    return {"frame": frame, "objects": entries}


def object_json(estimate: ObjectEstimate, class_names: Sequence[str]) -> JsonObject:
    """One object after one measurement."""
    best_class, best_x, best_y, best_orientation = estimate.joint_map
    document: JsonObject = {
        "id": estimate.object_id,
        "class": class_names[estimate.class_index],
        "class_probabilities": _probabilities_json(estimate.class_probabilities, class_names),
        "position": _numbers(estimate.position),
        "position_std": _numbers(estimate.position_std),
        "orientation_deg": _degrees(estimate.class_poses[estimate.class_index, 2]),
        "modes": [_mode_json(mode) for mode in estimate.modes],
        "measurements": int(estimate.measurements),
        "stamp_ns": str(int(estimate.stamp_ns)),
        "labels": list(estimate.labels),
        "class_poses": {
            name: {"position": _numbers(pose[:2]), "orientation_deg": _degrees(pose[2])}
            for name, pose in zip(class_names, estimate.class_poses, strict=True)
        },
        "joint_map": {
            "class": class_names[best_class],
            "orientation_deg": _degrees(best_orientation),
            "position": _numbers((best_x, best_y)),
        },
    }
    if estimate.tie:
        document["tie"] = [class_names[index] for index in estimate.tie]
    if estimate.unexplained:
        document["unexplained"] = True
    return document


def cell_json(
    report: CellReport,
    class_names: Sequence[str],
    history: Sequence[CellReport] | None = None,
) -> JsonObject:
    """The document of ``inspect cell``.

    Args:
        report: The cell, or an object's belief at its place.
        class_names: Without the background.
        history: The same cell after each measurement, oldest first.
    """
    document = _cell_figures(report, class_names)
    if history is not None:
        document["history"] = [_cell_figures(step, class_names) for step in history]
    return document


def _cell_figures(report: CellReport, class_names: Sequence[str]) -> JsonObject:
    """One cell after one measurement."""
    bins = report.density.shape[1]
    bins_deg = [360.0 * b / bins for b in range(bins)]
    return {
        "cell": {
            "row": int(report.row),
            "column": int(report.column),
            "center": _numbers(report.center),
            "size": finite(report.grid.cell_size),
        },
        "class_probabilities": _probabilities_json(report.class_probabilities, class_names),
        "orientation": {
            name: {
                "bins_deg": bins_deg,
                "density": _numbers(density),
                "modes": [_mode_json(mode) for mode in modes],
            }
            for name, density, modes in zip(class_names, report.density, report.modes, strict=True)
        },
        "measurements": int(report.measurements),
        "stamp_ns": str(int(report.stamp_ns)),
        "labels": list(report.labels),
    }


def estimate_json(
    *,
    input_path: str,
    output_path: str,
    model_name: str,
    used: int,
    skipped: Mapping[str, int],
    objects: Iterable[ObjectEstimate],
    class_names: Sequence[str],
    frame: str,
    damage: Sequence[str] = (),
    notes: Sequence[str] = (),
) -> JsonObject:
    """The document of ``estimate``.

    Args:
        input_path: Log that was read.
        output_path: Log that was written.
        model_name: The effective model.
        used: Number of measurements used.
        skipped: Number of measurements left out, by reason.
        objects: Latest estimate of each object.
        class_names: Without the background.
        frame: World frame of the positions.
        damage: What of the input was lost, in sentences.
        notes: Choices made while reading, in sentences.
    """
    return {
        "input": input_path,
        "output": output_path,
        "model": model_name,
        "measurements": {
            "used": int(used),
            "skipped": {reason: int(count) for reason, count in skipped.items()},
        },
        **objects_json(objects, class_names, frame),
        "damage": list(damage),
        "notes": list(notes),
    }


def _probabilities_json(probabilities: Iterable[float], class_names: Sequence[str]) -> JsonObject:
    """P by name, background first."""
    names = (BACKGROUND, *class_names)
    return {name: finite(p) for name, p in zip(names, probabilities, strict=True)}


def _mode_json(mode: OrientationMode) -> JsonObject:
    """One peak of an orientation density."""
    return {
        "orientation_deg": _degrees(mode.orientation),
        "mass": finite(mode.mass),
        "std_deg": finite(math.degrees(mode.std)),
    }


def finite(value: float) -> float | None:
    """A float of Python's own; None for what JSON has no number for."""
    number = float(value)
    return number if math.isfinite(number) else None


def _numbers(values: Iterable[float]) -> list[float | None]:
    """Several of them."""
    return [finite(value) for value in values]


def _degrees(angle: float) -> float | None:
    """Radians to degrees in [0, 360)."""
    number = finite(angle)
    return None if number is None else degrees(number)
