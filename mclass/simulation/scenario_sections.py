"""What a scenario file says about odometry, camera and detector; and readers of its values."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from mclass.config.checks import (
    Reader,
    Value,
    choice,
    entries,
    fields,
    integer,
    number,
    several,
    text,
    vector,
)
from mclass.simulation.scenario import (
    Camera,
    Correlation,
    Detector,
    Errors,
    ModelDetector,
    Odometry,
    Recogniser,
    Response,
    Script,
)

MAX_COORDINATE = 1e7
MAX_SECONDS = 86_400.0
DEGREE = math.radians(1.0)
_MAX_RATE = 10_000.0

_CAMERA_GROUPS = {"intrinsics": ("fx", "fy", "cx", "cy"), "image_size": ("width", "height")}
"""Fields of `Camera` that the file gives one by one, as the model file does."""


def read_odometry(value: Value, unit: float) -> Odometry:
    """The section ``odometry``; ``unit`` is metres in one ``length_unit``, here and below."""
    error = {"minimum": 0.0, "maximum": 1e6}
    readers: dict[str, Reader[Any]] = {
        "rate": number(above=0.0, maximum=_MAX_RATE),
        # Errors grow with the root of the distance, so its unit enters with its root.
        "position_by_distance": number(scale=math.sqrt(unit), **error),
        "heading_by_distance_deg": number(scale=DEGREE / math.sqrt(unit), **error),
        "heading_by_turn_deg": number(scale=DEGREE, **error),
        "position_drift": number(scale=unit, **error),
        "heading_drift_deg": number(scale=DEGREE, **error),
        "covariance_factor": number(**error),
    }
    return Odometry(**renamed(fields(value, readers), {}))


def read_camera(value: Value, unit: float) -> Camera:
    """The section ``camera``, with the keys that it has in a model file."""
    focal, center = number(above=0.0, maximum=1e6), number(minimum=-1e6, maximum=1e6)
    pixels = integer(1, 100_000)
    rate = number(above=0.0, maximum=_MAX_RATE)
    from_sensor = number(minimum=0.0, maximum=MAX_COORDINATE, scale=unit)
    tilt = number(minimum=-2.0 * math.pi, maximum=2.0 * math.pi, scale=DEGREE)
    mount: dict[str, Reader[Any]] = {
        "position": point(unit, "x", "y", "z"),
        "rpy_deg": vector(tilt, "roll", "pitch", "yaw"),
    }
    readers: dict[str, Reader[Any]] = {
        "rate": rate,
        "info_rate": rate,
        **dict.fromkeys(("fx", "fy"), focal),
        **dict.fromkeys(("cx", "cy"), center),
        **dict.fromkeys(("width", "height"), pixels),
        "mount": lambda child: fields(child, mount),
        "range": _increasing(vector(from_sensor, "min", "max")),
        "latency": _increasing(
            vector(number(minimum=0.0, maximum=MAX_SECONDS), "min", "max"), equal=True
        ),
        "box_noise": number(minimum=0.0, maximum=1e5),
    }
    found = fields(value, readers)
    default = Camera()
    for key, axes in (
        ("intrinsics", ("fx", "fy", "cx", "cy")),
        ("image_size", ("width", "height")),
    ):
        values = zip(axes, getattr(default, key), strict=True)
        found[key] = tuple(found.pop(axis, usual) for axis, usual in values)
    if "range" in found:
        found["min_range"], found["max_range"] = found.pop("range")
    placed = renamed(found.pop("mount", {}), {"position": "mount_xyz", "rpy_deg": "mount_rpy"})
    return replace(default, **found, **placed)


def _increasing(reader: Reader[tuple[float, ...]], *, equal: bool = False) -> Reader[Any]:
    def read(value: Value) -> tuple[float, ...]:
        low, high = reader(value)
        if high < low or (high == low and not equal):
            value.fail("the minimum must be less than the maximum")
        return low, high

    return read


def read_detector(value: Value, unit: float) -> Detector:
    """One of three detectors; ``kind`` says which."""
    probability = number(minimum=0.0, maximum=1.0)
    length = number(above=0.0, maximum=MAX_COORDINATE, scale=unit)
    correlation: dict[str, Reader[Any]] = {
        "direction_deg": number(above=0.0, minimum=0.1 * DEGREE, maximum=1e3, scale=DEGREE),
        "distance": length,
        "independent": probability,
    }
    errors: dict[str, Reader[Any]] = {
        "clutter": number(minimum=0.0, maximum=1e3),
        "without_ids": boolean,
        **dict.fromkeys(("miss", "label_noise", "clutter_with_id", "wrong_id"), probability),
    }
    drawn: dict[str, Reader[Any]] = {
        "correlation": lambda child: Correlation(**renamed(fields(child, correlation), {})),
        "errors": lambda child: Errors(**fields(child, errors)),
    }
    kinds: dict[str, dict[str, Reader[Any]]] = {
        "script": {},
        "model": {"peak": probability, "false_alarm": probability, **drawn},
        "recogniser": {
            "responses": _responses,
            "range": _increasing(
                vector(number(minimum=0.0, maximum=MAX_COORDINATE, scale=unit), "near", "far")
            ),
            "range_edge": length,
            **drawn,
        },
    }
    if value.at("kind") is value:
        value.fail("needs a kind: script, model or recogniser")
    kind = choice(*kinds)(value.at("kind"))
    required = ("responses",) if kind == "recogniser" else ()
    found = fields(value, {"kind": text, **kinds[kind]}, required=required)
    del found["kind"]
    if kind == "script":
        return Script()
    if kind == "model":
        return ModelDetector(**found)
    if "range" in found:
        found["near"], found["far"] = found.pop("range")
    return Recogniser(**found)


def _responses(value: Value) -> dict[tuple[str, str], tuple[Response, ...]]:
    """Sides by true class and returned label."""
    width = number(above=0.0, maximum=math.pi, scale=DEGREE)
    readers: dict[str, Reader[Any]] = {
        "direction_deg": angle(),
        "half_width_deg": width,
        "shape": choice("flat", "von_mises"),
        "peak": number(minimum=0.0, maximum=1.0),
        "edge_deg": width,
    }
    required = ("direction_deg", "half_width_deg")

    def side(child: Value) -> Response:
        return Response(**renamed(fields(child, readers, required=required), {}))

    pairs = {
        (class_name, label): child
        for class_name, labels in entries(value).items()
        for label, child in entries(labels).items()
    }
    if not pairs:
        value.fail("needs at least one class and a label that it returns")
    sides = several(lambda child: several(side, child.elements()), pairs.values())
    return dict(zip(pairs, sides, strict=True))


def boolean(value: Value) -> bool:
    """True or false."""
    return bool(choice("true", "false")(value) == "true")


def point(unit: float, *axes: str) -> Reader[tuple[float, ...]]:
    """Coordinates in units to metres."""
    return vector(number(minimum=-MAX_COORDINATE, maximum=MAX_COORDINATE, scale=unit), *axes)


def angle() -> Reader[float]:
    """Degrees to radians, any winding."""
    return number(minimum=-1e4, maximum=1e4, scale=DEGREE)


def renamed(found: dict[str, Any], names: Mapping[str, str]) -> dict[str, Any]:
    """Keys of the file to names of the dataclass; what is in degrees there no longer says so."""
    return {names.get(key, key.removesuffix("_deg")): value for key, value in found.items()}
