"""What really stood where: truth files, and the truth that a simulated log carries."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

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
    text,
)
from mclass.config.yaml_source import Problems
from mclass.model import LENGTH_UNITS
from mclass.records import FloatArray, IntArray

_ANGLE_UNITS: Mapping[str, float] = {"deg": math.pi / 180.0, "rad": 1.0}
_MAX_TURNS = 100.0
_IGNORED = ("layout", "name", "frame", "classes", "camera_mount")
"""What truth files say beside objects."""


@dataclass(frozen=True)
class Truth:
    """True objects.

    Attributes:
        object_ids: (o).
        class_names: Of each object, (o).
        poses: x [m], y [m], orientation [rad], (o, 3).
        symmetry: How many orientations of each object look alike, 1 if all differ, (o,).
    """

    object_ids: tuple[str, ...]
    class_names: tuple[str, ...]
    poses: FloatArray
    symmetry: IntArray

    def __len__(self) -> int:
        return len(self.object_ids)


def load_truth(path: Path) -> Truth:
    """The truth in a JSON or YAML file.

    Raises:
        ConfigError: If the file cannot be read or is wrong; holds every fault.
    """
    return parse_truth(yaml_source.read_bytes(path), str(path))


def parse_truth(source: bytes, name: str) -> Truth:
    """The truth in a text, JSON or YAML, named ``name`` in messages.

    ``units`` gives those of x, y (``m`` when left out) and phi (``deg``); ``symmetry`` says
    for a class how many of its orientations look alike.

    Raises:
        ConfigError: If it is wrong; holds every fault.
    """
    problems = Problems(name)
    root = yaml_source.compose(yaml_source.decode(source, name), problems)
    with contextlib.suppress(Rejected):
        truth = _truth(Value(root, "", root.start_mark, problems))
        problems.raise_any()
        return truth
    problems.raise_any()
    raise AssertionError("unreachable: what was rejected has been recorded")


def _truth(root: Value) -> Truth:
    known = ("units", "symmetry", "objects", *_IGNORED)
    top = children(root, known, required=("objects",))
    no_units: dict[str, float] = {}
    no_symmetry: dict[str, int] = {}
    units = attempt(_units, top.get("units"), no_units)
    symmetry = attempt(_symmetry, top.get("symmetry"), no_symmetry)
    x, y = units.get("x", 1.0), units.get("y", 1.0)
    phi = units.get("phi", _ANGLE_UNITS["deg"])
    readers: dict[str, Reader[Any]] = {
        "id": text,
        "class": text,
        "x": number(minimum=-MAX_COORDINATE, maximum=MAX_COORDINATE, scale=x),
        "y": number(minimum=-MAX_COORDINATE, maximum=MAX_COORDINATE, scale=y),
        "phi": number(minimum=-_MAX_TURNS, maximum=_MAX_TURNS, scale=phi),
        "against_wall": lambda value: value.node.value,
    }

    def read(value: Value) -> dict[str, Any]:
        return fields(value, readers, required=("id", "class", "x", "y", "phi"))

    if "objects" not in top:
        raise Rejected
    listed = several(read, top["objects"].elements())
    ids = [item["id"] for item in listed]
    for index, object_id in enumerate(ids):
        if object_id in ids[:index]:
            top["objects"].note(f"the id {object_id[:80]!r} is given twice")
    return Truth(
        object_ids=tuple(ids),
        class_names=tuple(item["class"] for item in listed),
        poses=np.array([[item[key] for key in ("x", "y", "phi")] for item in listed]).reshape(
            -1, 3
        ),
        symmetry=np.array([symmetry.get(item["class"], 1) for item in listed], dtype=np.int64),
    )


def _units(value: Value) -> dict[str, float]:
    """Metres or radians in one unit, by coordinate."""
    lengths, angles = choice(*LENGTH_UNITS), choice(*_ANGLE_UNITS)
    found = fields(value, {"x": lengths, "y": lengths, "phi": angles})
    return {
        key: (_ANGLE_UNITS if key == "phi" else LENGTH_UNITS)[unit] for key, unit in found.items()
    }


def _symmetry(value: Value) -> dict[str, int]:
    return {name: attempt(integer(1, 360), child, 1) for name, child in entries(value).items()}
