"""The section ``log``: which channels to read, and how."""

from __future__ import annotations

import math
import re
from collections.abc import Collection
from typing import Any

import yaml

from mclass.config.checks import (
    Reader,
    Value,
    angle,
    choice,
    coordinate,
    entries,
    fields,
    integer,
    number,
    several,
    switch,
    text,
    unknown_name,
    vector,
)
from mclass.model import CameraSettings, FieldMapping, LogSettings, TransformSource

# Coefficients that each distortion model can have.
_DISTORTION_SIZES = {
    "none": 0,
    "plumb_bob": 5,
    "rational_polynomial": 12,
    "equidistant": 4,
    "fisheye": 4,
    "kannala_brandt": 4,
}
_FIELD_PATH = re.compile(r"[^.\[\]\s]+(\[[0-9]*\])*(\.[^.\[\]\s]+(\[[0-9]*\])*)*")
_INTRINSICS = ("fx", "fy", "cx", "cy")
_IMAGE_SIZE = ("width", "height")


def read_log(value: Value, unit: float, labels: Collection[str]) -> LogSettings:
    """LogSettings of the section.

    Args:
        value: The section.
        unit: Metres in one ``length_unit``.
        labels: The model's label names.
    """
    readers: dict[str, Reader[Any]] = {
        "odometry": _odometry,
        "tf": _transforms,
        "detections": _detections,
        "camera_info": text,
        "camera": lambda child: _camera(child, unit),
        "min_score": number(),
        "labels": lambda child: _label_names(child, labels),
        "max_gap": number(above=0.0, maximum=1e9),
    }
    found = fields(value, readers, apart=(("odometry", "tf"),))
    if "tf" in found:
        found["odometry"] = found.pop("tf")
    if "max_gap" in found:
        found["max_gap_ns"] = round(found.pop("max_gap") * 1e9)
    return LogSettings(**found)


def _transforms(value: Value) -> TransformSource:
    keys = ("parent", "child")
    return TransformSource(**fields(value, dict.fromkeys(keys, text), required=keys))


def _odometry(value: Value) -> FieldMapping | TransformSource:
    """A topic, a topic with field paths, or ``{tf: {parent, child}}``."""
    keys = ("x", "y", "heading", "quaternion", "stamp", "frame")
    if isinstance(value.node, yaml.MappingNode) and value.at("tf") is not value:
        transforms: TransformSource = fields(value, {"tf": _transforms})["tf"]
        return transforms
    return _topic_or_mapping(value, keys, needed=("x", "y"), apart=(("heading", "quaternion"),))


def _detections(value: Value) -> tuple[FieldMapping, ...]:
    """One source of detections, or a list of them."""

    def source(child: Value) -> FieldMapping:
        keys = ("label", "score", "id", "box", "stamp", "frame")
        return _topic_or_mapping(child, keys, needed=("label",), box_format=True)

    if isinstance(value.node, yaml.SequenceNode):
        return several(source, value.elements())
    return (source(value),)


def _topic_or_mapping(
    value: Value,
    keys: Collection[str],
    *,
    needed: Collection[str],
    apart: Collection[tuple[str, str]] = (),
    box_format: bool = False,
) -> FieldMapping:
    """A bare topic, whose schema is known, or a topic and where its fields are."""
    if isinstance(value.node, yaml.ScalarNode):
        return FieldMapping(text(value))
    readers: dict[str, Reader[Any]] = {"topic": text, **dict.fromkeys(keys, _field_path)}
    if box_format:
        readers["box_format"] = choice("center", "corner", "corners")
    found = fields(value, readers, required=("topic",), apart=apart)
    topic, layout = found.pop("topic"), found.pop("box_format", None)
    missing = [key for key in needed if key not in found]
    if found and missing:
        value.fail(f"field paths are given, but not for {' and '.join(missing)}; add it")
    return FieldMapping(topic, found, layout)


def _field_path(value: Value) -> str:
    path = text(value)
    if not _FIELD_PATH.fullmatch(path):
        value.fail("must be a path such as pose.position.x or boxes[].label")
    return path


def _label_names(value: Value, labels: Collection[str]) -> dict[str, str]:
    """The detector's names to the model's."""

    def label(child: Value) -> str:
        name = text(child)
        if name not in labels:
            child.fail(unknown_name(name, "label", labels))
        return name

    given = entries(value)
    return dict(zip(given, several(label, given.values()), strict=True))


def _camera(value: Value, unit: float) -> CameraSettings:
    coefficient = number(minimum=-1e6, maximum=1e6)
    focal, center = number(above=0.0, maximum=1e6), number(minimum=-1e6, maximum=1e6)
    readers: dict[str, Reader[Any]] = {
        "fx": focal,
        "fy": focal,
        "cx": center,
        "cy": center,
        "width": integer(1, 100_000),
        "height": integer(1, 100_000),
        "distortion_model": choice(*_DISTORTION_SIZES),
        "distortion": lambda child: several(coefficient, child.elements()),
        "rectified": switch,
        "mount": lambda child: _mount(child, unit),
    }
    found = fields(value, readers, together=(_INTRINSICS, _IMAGE_SIZE))
    camera = CameraSettings(
        intrinsics=_take(found, _INTRINSICS),
        image_size=_take(found, _IMAGE_SIZE),
        **found.pop("mount", {}),
        **found,
    )
    if camera.rectified and camera.distortion:
        value.at("distortion").fail(
            "rectified images have no distortion left: leave out this or rectified"
        )
    allowed = _DISTORTION_SIZES[camera.distortion_model]
    if len(camera.distortion) > allowed:
        value.at("distortion").fail(
            f"{camera.distortion_model} has at most {allowed} coefficients, "
            f"not {len(camera.distortion)}"
        )
    return camera


def _take(found: dict[str, Any], keys: tuple[str, ...]) -> Any:
    """The values of keys that only mean something together, taken out of ``found``."""
    return tuple(found.pop(key) for key in keys) if keys[0] in found else None


def _mount(value: Value, unit: float) -> dict[str, tuple[float, ...]]:
    readers: dict[str, Reader[Any]] = {
        "position": vector(coordinate(unit), "x", "y", "z"),
        "rpy_deg": vector(angle(math.radians(1.0)), "roll", "pitch", "yaw"),
    }
    found = fields(value, readers, required=("position",))
    return {
        "mount_" + {"position": "xyz", "rpy_deg": "rpy"}[key]: read for key, read in found.items()
    }
