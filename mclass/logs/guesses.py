"""Which fields of a channel are used, going by their names."""

from __future__ import annotations

import re
from collections.abc import Mapping

from mclass.logs.families import Alternatives, BoxFormat
from mclass.logs.fields import BoxFields, DetectionFields, box_level, element_level, present
from mclass.logs.tables import level_of

FRAMES = ("header.frame_id", "frame_id", "frame")
"""Fields that may name a frame, the likelier first."""

_LABELS = ("label", "class_name", "class", "category", "class_id", "label_id", "name")
_SCORES = ("score", "confidence", "probability", "conf", "prob")
_IDS = ("object_id", "track_id", "tracking_id", "instance_id", "id")
_STAMPS = ("header.stamp", "timestamp", "stamp", "time", "stamp_ns", "timestamp_ns", "time_ns")
_BOX_NAMES = ("bbox", "box", "bounding_box", "rect", "roi", "xyxy", "xywh")
_PLURALS = {
    **{f"{name}s": name for name in (*_LABELS, *_SCORES, *_IDS, "bbox")},
    **{"classes": "class", "categories": "category", "boxes": "box", "bboxes": "bbox"},
    **{"confidences": "confidence", "probabilities": "probability", "bounding_boxes": "bbox"},
}
_HEADINGS = ("heading", "yaw", "theta")

_BOX_PATTERNS: tuple[tuple[BoxFormat, tuple[str, str, str, str]], ...] = (
    ("corners", ("xmin", "ymin", "xmax", "ymax")),
    ("corners", ("x_min", "y_min", "x_max", "y_max")),
    ("corners", ("min.x", "min.y", "max.x", "max.y")),
    ("corners", ("x1", "y1", "x2", "y2")),
    ("corners", ("left", "top", "right", "bottom")),
    ("center", ("center_x", "center_y", "width", "height")),
    ("center", ("center_x", "center_y", "size_x", "size_y")),
    ("center", ("center.position.x", "center.position.y", "size_x", "size_y")),
    ("center", ("center.position.x", "center.position.y", "size.x", "size.y")),
    ("center", ("center.x", "center.y", "size_x", "size_y")),
    ("center", ("center.x", "center.y", "size.x", "size.y")),
    ("center", ("center.x", "center.y", "width", "height")),
    ("center", ("cx", "cy", "w", "h")),
    ("center", ("cx", "cy", "width", "height")),
    ("corner", ("x_offset", "y_offset", "width", "height")),
    ("corner", ("left", "top", "width", "height")),
    ("corner", ("x", "y", "width", "height")),
    ("corner", ("x", "y", "w", "h")),
)


def guess_detection_fields(paths: Mapping[str, str]) -> DetectionFields | None:
    """Detections by field names alone; None unless a label has a box, a score or an id with it."""
    for label in _guess_labels(paths):
        level = level_of(label)
        box = _guess_box(paths, level)
        score = _guess_near(paths, _SCORES, level, ("float", "int"))
        identity = _guess_id(paths, level, box)
        weak = _leaf_name(label) == "name"
        if box or score or (identity and not weak):
            return DetectionFields(
                element=element_level(label, box, identity),
                label=label,
                stamps=guess_stamp(paths),
                frames=present(FRAMES, paths),
                score=score,
                id=identity,
                box=box,
            )
    return None


def guess_stamp(paths: Mapping[str, str]) -> Alternatives:
    """A stamp by its name, else the first time outside of lists; at most one."""
    named = present(_STAMPS, paths)
    if named:
        return named[:1]
    times = [path for path, kind in paths.items() if kind == "time" and "[]" not in path]
    return tuple(times[:1])


def guess_pose(paths: Mapping[str, str]) -> dict[str, str]:
    """Position and direction by field names, in the outermost place that has them."""
    for x in sorted((p for p in paths if _leaf_name(p) == "x"), key=lambda p: p.count(".")):
        dot = x[: -len("x")]
        if "[]" in x or f"{dot}y" not in paths:
            continue
        found = {"x": x, "y": f"{dot}y"}
        for name in _HEADINGS:
            if f"{dot}{name}" in paths:
                return {**found, "heading": f"{dot}{name}"}
        parent = dot.rstrip(".").rpartition(".")[0]
        for name in ("orientation", "rotation", "quaternion"):
            turn = f"{parent}.{name}" if parent else name
            if f"{turn}.w" in paths:
                return {**found, "quaternion": turn}
    return {}


def children_box(holder: str, paths: Mapping[str, str]) -> BoxFields | None:
    """The four numbers of a box among the fields of a holder."""
    dot = f"{holder}." if holder else ""
    for box_format, names in _BOX_PATTERNS:
        four = tuple(dot + name for name in names)
        if all(paths.get(path) in ("float", "int") for path in four):
            return BoxFields(box_format, four)
    return None


def _leaf_name(path: str) -> str:
    """Last name of a path in small letters, words joined by underscores, lists in the singular."""
    name = path.rstrip("[]").rpartition(".")[2]
    name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower()
    return _PLURALS.get(name, name) if path.endswith("[]") else name


def _guess_labels(paths: Mapping[str, str]) -> list[str]:
    """Paths that may hold a label, best first: by name, then the outermost."""
    found = [
        path
        for path, kind in paths.items()
        if kind in ("string", "int") and _leaf_name(path) in _LABELS
    ]
    return sorted(found, key=lambda path: (_LABELS.index(_leaf_name(path)), path.count("[]")))


def _guess_near(
    paths: Mapping[str, str], names: tuple[str, ...], level: str, kinds: tuple[str, ...]
) -> str | None:
    """A field of one of these names at a level or above it, the nearest first."""
    found = [
        path
        for path, kind in paths.items()
        if kind in kinds
        and _leaf_name(path) in names
        and (level.startswith(level_of(path)) or _run_beside(level_of(path), level))
    ]
    found.sort(key=lambda path: (-path.count("[]"), names.index(_leaf_name(path))))
    return found[0] if found else None


def _run_beside(level: str, other: str) -> bool:
    """Whether two levels are lists in the same place: ``boxes[]``, ``labels[]``."""
    beside = level.rpartition(".")[0] == other.rpartition(".")[0]
    return beside and level.count("[]") == other.count("[]") == 1


def _guess_id(paths: Mapping[str, str], level: str, box: BoxFields | None) -> str | None:
    """An object id: at the box's level, else at the label's or above, but within the list."""
    within = box_level(box) if box else level
    found = [
        path
        for path, kind in paths.items()
        if kind in ("string", "int")
        and _leaf_name(path) in _IDS
        and (within.startswith(level_of(path)) or _run_beside(level_of(path), within))
        and (not within or level_of(path))
    ]
    found.sort(key=lambda path: (-path.count("[]"), _IDS.index(_leaf_name(path)), path))
    return found[0] if found else None


def _guess_box(paths: Mapping[str, str], level: str) -> BoxFields | None:
    """A box at the label's level, above it, or below it in a list of its own."""
    holders = {""}
    for path in paths:
        pieces = path.split(".")
        holders.update(".".join(pieces[:end]) for end in range(1, len(pieces)))
    found: list[tuple[int, str, BoxFields]] = []
    for holder in holders:
        box = children_box(holder, paths)
        if box and (level.startswith(_level(holder)) or _level(holder).startswith(level)):
            found.append((-_level(holder).count("[]"), holder, box))
    for path, kind in paths.items():
        if kind in ("float", "int") and _leaf_name(path) in _BOX_NAMES:
            own = level_of(path.removesuffix("[]"))
            if level.startswith(own) or _run_beside(own, level):
                corners: BoxFormat = "corners" if _leaf_name(path) == "xyxy" else "corner"
                found.append((-own.count("[]"), path, BoxFields(corners, (path,))))
    return min(found, key=lambda entry: entry[:2])[2] if found else None


def _level(holder: str) -> str:
    """Level of the fields inside a holder."""
    return level_of(holder + ".x") if holder else ""
