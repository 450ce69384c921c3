"""Which fields of a channel are used, going by the model file."""

from __future__ import annotations

from collections.abc import Mapping

from mclass.errors import LogError
from mclass.logs.fields import BoxFields, DetectionFields, PoseFields, element_level, present
from mclass.logs.guesses import FRAMES, children_box, guess_pose, guess_stamp
from mclass.model import FieldMapping


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
        element=element_level(given["label"], box, given.get("id")),
        label=given["label"],
        stamps=(given["stamp"],) if "stamp" in given else guess_stamp(paths),
        frames=(given["frame"],) if "frame" in given else present(FRAMES, paths),
        score=given.get("score"),
        id=given.get("id"),
        box=box,
    )


def mapped_pose_fields(mapping: FieldMapping, paths: Mapping[str, str]) -> PoseFields:
    """Poses where the model file says they are, or by their names when it names a topic alone.

    Raises:
        LogError: If a path is not in the messages or nothing looks like a position.
    """
    fields = mapping.fields or guess_pose(paths)
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
    stamps = (given["stamp"],) if "stamp" in given else guess_stamp(paths)
    frames = (given["frame"],) if "frame" in given else present(FRAMES, paths)
    return PoseFields(
        (given["x"], given["y"]),
        orientation,
        stamps[0] if stamps else None,
        frames[0] if frames else None,
    )


def _resolve_box(mapping: FieldMapping, given: str, paths: Mapping[str, str]) -> BoxFields:
    """A box that the model file points to: an object with four numbers, or a list of them."""
    box = None
    for holder in (given, given + "[]"):
        box = box or children_box(holder, paths)
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
