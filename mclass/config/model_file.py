"""A model file to a checked `mclass.model.Model`, or every fault in it at once.

To add a setting: give its dataclass in `mclass.model` a field, its section here a line
in the mapping of key to reader, and `schemas/model.schema.json` a property.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

from mclass.classes import ClassModel
from mclass.config import yaml_source
from mclass.config.checks import (
    MAX_COORDINATE,
    Reader,
    Rejected,
    Value,
    attempt,
    children,
    choice,
    entries,
    fields,
    integer,
    number,
    several,
    switch,
    vector,
)
from mclass.config.likelihood_sections import position, read_class_model, read_label_names
from mclass.config.log_section import read_log
from mclass.config.yaml_source import Problems
from mclass.model import (
    LENGTH_UNITS,
    PAPER,
    ROBUST,
    GridSettings,
    InferenceSettings,
    LogSettings,
    Model,
)

MAX_BELIEF_BYTES = 64e9
"""Most that the belief of a whole grid may take, at 4 bytes a number."""
_MIN_CELL = 1e-4

_SECTIONS = (
    "length_unit",
    "background",
    "viewpoints",
    "classes",
    "log",
    "grid",
    "inference",
    "objects",
)

_PRESETS = {"paper": PAPER, "robust": ROBUST}
DEFAULT_PRESET = "robust"
"""What a file that names no preset starts from."""


def load_model(path: Path | str) -> Model:
    """The model in a file.

    Raises:
        ConfigError: If the file cannot be read or is wrong; holds every fault.
    """
    path = Path(path)
    return _parse(yaml_source.read_bytes(path), path.name, str(path))


def parse_model(text: str | bytes, name: str) -> Model:
    """The model in a text, named ``name`` in messages and outputs.

    Raises:
        ConfigError: If it is wrong; holds every fault.
    """
    return _parse(text, name, name)


def _parse(source: str | bytes, name: str, shown_path: str) -> Model:
    text = yaml_source.decode(source, shown_path) if isinstance(source, bytes) else source
    problems = Problems(shown_path)
    root = yaml_source.compose(text, problems)
    try:
        return _model(Value(root, "", root.start_mark, problems), name, text)
    except Rejected:
        problems.raise_any()
        raise


def _model(root: Value, name: str, text: str) -> Model:
    top = children(root, _SECTIONS, required=("viewpoints", "classes"))
    length_unit = attempt(choice(*LENGTH_UNITS), top.get("length_unit"), "m")
    unit = LENGTH_UNITS[length_unit]
    labels = read_label_names(top.get("classes"))
    classes: ClassModel | None = None
    with contextlib.suppress(Rejected):  # the other sections may hold faults too
        classes = read_class_model(top, labels, unit)
    n_classes = max(len(list(top["classes"].pairs())), 1) if "classes" in top else 1
    log = attempt(lambda value: read_log(value, unit, labels), top.get("log"), LogSettings())
    grid = attempt(lambda value: _grid(value, unit, n_classes), top.get("grid"), GridSettings())
    preset = _PRESETS[DEFAULT_PRESET]
    inference = attempt(lambda value: _inference(value, unit), top.get("inference"), preset)
    no_objects: dict[str, tuple[float, float]] = {}
    objects = attempt(lambda value: _objects(value, unit), top.get("objects"), no_objects)
    root.problems.raise_any()
    assert classes is not None
    return Model(name, text, length_unit, classes, log, grid, inference, objects)


def _objects(value: Value, unit: float) -> dict[str, tuple[float, float]]:
    """Known positions [m] by object id."""

    def known_position(child: Value) -> tuple[float, float]:
        x, y = fields(child, {"position": position(unit)}, required=("position",))["position"]
        return x, y

    nowhere = (math.nan, math.nan)
    return {name: attempt(known_position, child, nowhere) for name, child in entries(value).items()}


def _inference(value: Value, unit: float) -> InferenceSettings:
    """A preset with the given keys changed."""
    distance = number(minimum=0.0, maximum=MAX_COORDINATE, scale=unit)
    width = number(above=0.0, maximum=MAX_COORDINATE, scale=unit)
    degree = math.radians(1.0)
    direction = number(above=0.0, maximum=math.pi, scale=degree)

    def correlation(child: Value) -> tuple[float, float] | None:
        if child.scalar == "false":
            return None
        readers: dict[str, Reader[Any]] = {"range": width, "direction_deg": direction}
        found = fields(child, readers, required=readers)
        return found["range"], found["direction_deg"]

    readers: dict[str, Reader[Any]] = {
        "preset": choice(*_PRESETS),
        "probabilities": switch,
        "detection_probability": number(above=0.0, maximum=1.0),
        "false_alarm": number(above=0.0, maximum=0.5),
        "silence": switch,
        "view_margin": distance,
        "correlation": correlation,
        "outside_probability": number(above=0.0, maximum=1.0),
        "pointing_std_deg": number(minimum=0.0, maximum=math.pi / 4.0, scale=degree),
        "pose_uncertainty": switch,
        "drift": distance,
        "score_weights": _score_weights,
        "association": switch,
        "one_cause": switch,
        "trajectory_samples": integer(0, 1000),
    }
    found = fields(value, readers)
    if "pointing_std_deg" in found:
        found["pointing_std"] = found.pop("pointing_std_deg")
    inference = replace(_PRESETS[found.get("preset", DEFAULT_PRESET)], **found)
    if inference.silence and not inference.probabilities:
        value.fail("silence can only count where labels have probabilities: set both or neither")
    if inference.association and not inference.probabilities:
        value.fail("association needs labels with probabilities: set both or neither")
    return inference


def _score_weights(value: Value) -> tuple[tuple[float, float], ...]:
    """Points (score, weight), scores increasing."""
    point = vector(number(minimum=0.0, maximum=1.0), "score", "weight")
    points = tuple((score, weight) for score, weight in several(point, value.elements()))
    if any(after[0] <= before[0] for before, after in itertools.pairwise(points)):
        value.fail("scores must increase from point to point")
    return points


def _grid(value: Value, unit: float, n_classes: int) -> GridSettings:
    length = number(above=0.0, minimum=_MIN_CELL, maximum=MAX_COORDINATE, scale=unit)
    from_sensor = number(minimum=0.0, maximum=MAX_COORDINATE, scale=unit)

    def reach(child: Value) -> tuple[float, ...]:
        low, high = vector(from_sensor, "min", "max")(child)
        if low >= high:
            child.fail(f"the minimum {low / unit:g} must be less than the maximum {high / unit:g}")
        return low, high

    readers: dict[str, Reader[Any]] = {
        "cell_size": length,
        "orientation_bins": integer(8, 7200),
        "footprint": choice("cone", "ray"),
        "range": reach,
        "origin": position(unit),
        "size": vector(length, "width", "height"),
    }
    found = fields(value, readers, together=(("origin", "size"),))
    if "range" in found:
        found["min_range"], found["max_range"] = found.pop("range")
    grid = GridSettings(**found)
    _check_memory(value, grid, n_classes)
    return grid


def _check_memory(value: Value, grid: GridSettings, n_classes: int) -> None:
    """Refuse a grid whose belief no machine can hold, before anything is allocated.

    Without a size the extent follows the data; what can be seen from one place counts then.
    """
    if grid.size is not None:
        where, area, what = "size", grid.size[0] * grid.size[1], "this size"
    else:
        where, area, what = "range", math.pi * grid.max_range**2, "what is in range of one place"
    cells = area / grid.cell_size**2
    needed = cells * n_classes * grid.orientation_bins * 4.0
    if needed > MAX_BELIEF_BYTES:
        numbers = (
            f"{cells:.3g} cells x {n_classes} classes x {grid.orientation_bins} bins x 4 bytes "
            f"= {needed / 1e9:,.0f} GB"
        )
        culprit = value.at(where)
        culprit = culprit if culprit is not value else value.at("cell_size")
        culprit.fail(
            f"too many cells: {what} needs {numbers}, more than {MAX_BELIEF_BYTES / 1e9:.0f} GB. "
            "Give larger cells, fewer bins or a smaller area"
        )
