"""Where the worlds of several logs lie in a common one, from a YAML file."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from mclass.config import yaml_source
from mclass.config.checks import Rejected, Value, angle, coordinate, entries, fields, unknown_name
from mclass.config.yaml_source import Problems
from mclass.records import FloatArray


def load_frames(path: Path, names: Sequence[Sequence[str]]) -> list[FloatArray]:
    """Poses of logs' worlds in the common world.

    The file has one entry a log::

        kitchen: {x: 0, y: 0, heading_deg: 0}
        hall: {x: 12.5, y: -3.0, heading_deg: 90}

    Args:
        path: The file; lengths in metres.
        names: For each log, the names under which it may stand in the file.

    Returns:
        x [m], y [m], heading [rad] of each log's world, (3,) each.

    Raises:
        ConfigError: If the file is wrong, a log is missing from it, or a name in it is no log;
            holds every fault.
    """
    problems = Problems(str(path))
    root = yaml_source.compose(
        yaml_source.decode(yaml_source.read_bytes(path), str(path)), problems
    )
    with contextlib.suppress(Rejected):
        found = entries(Value(root, "", root.start_mark, problems))
        logs = _matched(found, names, problems)
        poses = [_pose(found[name]) if name else np.zeros(3) for name in logs]
        problems.raise_any()
        return poses
    problems.raise_any()
    raise AssertionError("unreachable: what is rejected has been recorded")


def _matched(
    found: Mapping[str, Value], names: Sequence[Sequence[str]], problems: Problems
) -> list[str]:
    """The key of each log, empty if it has none."""
    known = [name for aliases in names for name in aliases]
    for key, value in found.items():
        if known.count(key) != 1:
            message = (
                f"stands for {known.count(key)} logs; name them by path"
                if key in known
                else unknown_name(key, "log", [aliases[-1] for aliases in names])
            )
            problems.add(value.mark, key, message)
    keys = []
    for aliases in names:
        present = [key for key in found if key in aliases]
        if not present:
            message = "missing; add {x: 0, y: 0, heading_deg: 0} if it is in the common frame"
            problems.add(None, aliases[-1], message)
        elif len(present) > 1:
            problems.add(found[present[1]].mark, present[1], f"is {present[0]} again; remove one")
        keys.append(present[0] if present else "")
    return keys


def _pose(value: Value) -> FloatArray:
    readers = {"x": coordinate(1.0), "y": coordinate(1.0), "heading_deg": angle(math.radians(1.0))}
    try:
        given = fields(value, readers, required=readers)
    except Rejected:
        return np.zeros(3)
    return np.array([given["x"], given["y"], given["heading_deg"]])
