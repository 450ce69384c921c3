"""Which fields of a channel are used: from its family, the model file, or its field names."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from mclass.errors import LogError
from mclass.logs import families
from mclass.logs.families import Alternatives, BoxFormat, DetectionFamily, PoseFamily
from mclass.logs.tables import level_of
from mclass.model import FieldMapping

_LABELS = ("label", "class_name", "class", "category", "class_id", "label_id", "name")
_SCORES = ("score", "confidence", "probability", "conf", "prob")
_IDS = ("object_id", "track_id", "tracking_id", "instance_id", "id")
_STAMPS = ("header.stamp", "timestamp", "stamp", "time", "stamp_ns", "timestamp_ns", "time_ns")
_FRAMES = ("header.frame_id", "frame_id", "frame")
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


@dataclass(frozen=True)
class BoxFields:
    """Four paths, or the one path of a list or array of four numbers; maybe a turn [rad]."""

    format: BoxFormat
    paths: tuple[str, ...]
    angle: str | None = None


@dataclass(frozen=True)
class DetectionFields:
    """Paths of one channel's detections; ``element`` is the level of one detection.

    ``label`` is None where messages name their own fields and none ever holds a label.
    """

    element: str
    label: str | None
    stamps: Alternatives = ()
    frames: Alternatives = ()
    score: str | None = None
    id: str | None = None
    box: BoxFields | None = None
    bearing: tuple[str, str] | None = None
    volume: tuple[str, ...] = ()

    @property
    def paths(self) -> tuple[str, ...]:
        """All of them."""
        single = [path for path in (self.label, self.score, self.id) if path is not None]
        box = self.box.paths if self.box else ()
        if self.box and self.box.angle:
            box = (*box, self.box.angle)
        return (*single, *self.stamps, *self.frames, *box, *(self.bearing or ()), *self.volume)


@dataclass(frozen=True)
class PoseFields:
    """Paths of one channel's poses: ``position`` has two or three, ``orientation`` one or four."""

    position: tuple[str, ...]
    orientation: tuple[str, ...] = ()
    stamp: str | None = None
    frame: str | None = None
    child: str | None = None
    covariance: str | None = None

    @property
    def paths(self) -> tuple[str, ...]:
        """All of them."""
        optional = (self.stamp, self.frame, self.child, self.covariance)
        return (*self.position, *self.orientation, *(p for p in optional if p is not None))


def family_detection_fields(
    family: DetectionFamily, paths: Mapping[str, str], *, silent: bool = False
) -> DetectionFields | None:
    """A known type's fields in the layout that the schema has.

    Without a field for labels there are None, or, if ``silent``, detections that have none.
    """
    label = families.first_present(family.label, paths)
    if label is None and not silent:
        return None
    angle = families.first_present(family.box_angle, paths)
    boxes = [BoxFields(kind, four, angle) for kind, four in family.boxes if _has(four, paths)]
    volume = _volume_paths(family.volume, paths) if family.volume else ()
    bearing = family.bearing if family.bearing and _has(family.bearing, paths) else None
    return DetectionFields(
        element=family.element,
        label=label,
        stamps=tuple(p for p in family.stamp if p in paths),
        frames=tuple(p for p in family.frame if p in paths),
        score=families.first_present(family.score, paths),
        id=families.first_present(family.id, paths),
        box=boxes[0] if boxes else None,
        bearing=bearing,
        volume=volume,
    )


def family_pose_fields(family: PoseFamily, paths: Mapping[str, str]) -> PoseFields | None:
    """A known pose type's fields; None if the schema lacks a position."""
    for position, orientation in zip(family.position, family.orientation, strict=True):
        places = tuple(f"{position}.{axis}" for axis in "xyz")
        turns = tuple(f"{orientation}.{axis}" for axis in "xyzw")
        if _has(places + turns, paths):
            return PoseFields(
                places,
                turns,
                families.first_present(family.stamp, paths),
                families.first_present(family.frame, paths),
                families.first_present(family.child, paths),
                families.first_present(family.covariance, paths),
            )
    return None


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
                element=_element_level(label, box, identity),
                label=label,
                stamps=_guess_stamp(paths),
                frames=_present(_FRAMES, paths),
                score=score,
                id=identity,
                box=box,
            )
    return None


def mapped_detection_fields(mapping: FieldMapping, paths: Mapping[str, str]) -> DetectionFields:
    """Detections where the model file says they are.

    Raises:
        LogError: If a path is not in the messages, or a box has no four numbers.
    """
    given = {
        key: _resolve(mapping.topic, key, path, paths)
        for key, path in mapping.fields.items()
        if key != "box"
    }
    box = None
    if "box" in mapping.fields:
        box = _resolve_box(mapping, mapping.fields["box"], paths)
    return DetectionFields(
        element=_element_level(given["label"], box, given.get("id")),
        label=given["label"],
        stamps=(given["stamp"],) if "stamp" in given else _guess_stamp(paths),
        frames=(given["frame"],) if "frame" in given else _present(_FRAMES, paths),
        score=given.get("score"),
        id=given.get("id"),
        box=box,
    )


def mapped_pose_fields(mapping: FieldMapping, paths: Mapping[str, str]) -> PoseFields:
    """Poses where the model file says they are, or by their names when it names a topic alone.

    Raises:
        LogError: If a path is not in the messages or nothing looks like a position.
    """
    fields = mapping.fields or _guess_pose(paths)
    if not {"x", "y"} <= fields.keys():
        raise LogError(
            "no position was recognised in its messages. Give log.odometry x and y as field paths. "
            + _fields_present(paths),
            topic=mapping.topic,
        )
    given = {
        key: _resolve(mapping.topic, key, path, paths)
        for key, path in fields.items()
        if key != "quaternion"
    }
    orientation: tuple[str, ...] = ()
    if "heading" in given:
        orientation = (given["heading"],)
    elif "quaternion" in fields:
        orientation = tuple(
            _resolve(mapping.topic, "quaternion", f"{fields['quaternion']}.{axis}", paths)
            for axis in "xyzw"
        )
    stamps = (given["stamp"],) if "stamp" in given else _guess_stamp(paths)
    frames = (given["frame"],) if "frame" in given else _present(_FRAMES, paths)
    return PoseFields(
        (given["x"], given["y"]),
        orientation,
        stamps[0] if stamps else None,
        frames[0] if frames else None,
    )


def _has(wanted: Iterable[str], paths: Mapping[str, str]) -> bool:
    return all(path in paths for path in wanted)


def _present(wanted: Iterable[str], paths: Mapping[str, str]) -> tuple[str, ...]:
    return tuple(path for path in wanted if path in paths)


def _volume_paths(volume: tuple[str, str], paths: Mapping[str, str]) -> tuple[str, ...]:
    """Position, orientation and size of a 3-D box: ten paths, or none."""
    pose, size = volume
    wanted = (
        *(f"{pose}.position.{axis}" for axis in "xyz"),
        *(f"{pose}.orientation.{axis}" for axis in "xyzw"),
        *(f"{size}.{axis}" for axis in "xyz"),
    )
    return wanted if _has(wanted, paths) else ()


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
    within = _box_level(box) if box else level
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
        box = _children_box(holder, paths)
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


def _children_box(holder: str, paths: Mapping[str, str]) -> BoxFields | None:
    """The four numbers of a box among the fields of a holder."""
    dot = f"{holder}." if holder else ""
    for box_format, names in _BOX_PATTERNS:
        four = tuple(dot + name for name in names)
        if all(paths.get(path) in ("float", "int") for path in four):
            return BoxFields(box_format, four)
    return None


def _resolve_box(mapping: FieldMapping, given: str, paths: Mapping[str, str]) -> BoxFields:
    """A box that the model file points to: an object with four numbers, or a list of them."""
    box = None
    for holder in (given, given + "[]"):
        box = box or _children_box(holder, paths)
        if box is None and paths.get(holder) in ("float", "int"):
            box = BoxFields("corner", (holder,))
    if box is None:
        raise LogError(
            f"log.detections.box: {given!r} holds no box. Wanted are x, y, width, height; "
            "center_x, center_y, width, height; xmin, ymin, xmax, ymax; or a list of four numbers. "
            + _fields_present(paths),
            topic=mapping.topic,
        )
    return BoxFields(mapping.box_format or box.format, box.paths)


def _element_level(label: str, box: BoxFields | None, identity: str | None) -> str:
    """What one detection is: what has a box, else an id, else a label (or a list of labels)."""
    if box is not None:
        return _box_level(box)
    if identity is not None:
        return level_of(identity)
    return level_of(label.removesuffix("[]"))


def _box_level(box: BoxFields) -> str:
    first = box.paths[0]
    return level_of(first.removesuffix("[]") if len(box.paths) == 1 else first)


def _guess_stamp(paths: Mapping[str, str]) -> Alternatives:
    named = _present(_STAMPS, paths)
    if named:
        return named[:1]
    times = [path for path, kind in paths.items() if kind == "time" and "[]" not in path]
    return tuple(times[:1])


def _guess_pose(paths: Mapping[str, str]) -> dict[str, str]:
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


def _resolve(topic: str, key: str, given: str, paths: Mapping[str, str]) -> str:
    """A path as the decoder spells it; ``[]`` may have been left out.

    Raises:
        LogError: If the messages have no such field.
    """
    if given in paths:
        return given
    bare = given.replace("[]", "")
    matches = [path for path in paths if path.replace("[]", "") == bare]
    if not matches:
        raise LogError(
            f"its messages have no field {given!r} (for {key}). " + _fields_present(paths),
            topic=topic,
        )
    return matches[0]


def _fields_present(paths: Mapping[str, str]) -> str:
    shown = list(paths)[:30]
    more = f" and {len(paths) - len(shown)} more" if len(paths) > len(shown) else ""
    return f"Fields present: {', '.join(shown) or 'none'}{more}."
