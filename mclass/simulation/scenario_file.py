"""A scenario file to a checked `Scenario`, or every fault in it at once.

The same YAML, the same checks and the same kind of messages as for model files.
"""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from mclass.config import yaml_source
from mclass.config.checks import (
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
    unknown_name,
    vector,
)
from mclass.config.model_file import load_model
from mclass.config.yaml_source import Problems
from mclass.errors import ConfigError
from mclass.model import LENGTH_UNITS, Model
from mclass.simulation.scenario import (
    Camera,
    CircleAround,
    Correlation,
    Detector,
    DriveTo,
    Errors,
    LookAt,
    ModelDetector,
    Odometry,
    Recogniser,
    Response,
    Scenario,
    SceneObject,
    Script,
    Stop,
    Trajectory,
)

_MAX_COORDINATE = 1e7
_MAX_SECONDS = 86_400.0
_MAX_RATE = 10_000.0
_DEGREE = math.radians(1.0)
_RFC3339 = re.compile(r"(\d{4}-\d\d-\d\d)[Tt ](\d\d:\d\d:\d\d)(?:\.(\d{1,9}))?([Zz]|[+-]\d\d:\d\d)")

_CAMERA_GROUPS = {"intrinsics": ("fx", "fy", "cx", "cy"), "image_size": ("width", "height")}
"""Fields of `Camera` that the file gives one by one, as the model file does."""

_SECTIONS = (
    "length_unit",
    "model",
    "seed",
    "start",
    "log_clock_offset",
    "frames",
    "objects",
    "trajectory",
    "odometry",
    "camera",
    "detector",
)


def load_scenario(path: Path | str) -> Scenario:
    """The scenario in a file, with the model file that it names.

    Raises:
        ConfigError: If the file, or the model it names, cannot be read or is wrong; holds
            every fault.
    """
    path = Path(path)
    source = yaml_source.decode(yaml_source.read_bytes(path), str(path))
    return parse_scenario(source, path.name, str(path), folder=path.parent)


def parse_scenario(
    source: str, name: str, shown_path: str | None = None, *, folder: Path = Path()
) -> Scenario:
    """The scenario in a text.

    Args:
        source: YAML.
        name: Of the scenario.
        shown_path: Of the file in messages; the name when left out.
        folder: Where the path of a model starts.

    Raises:
        ConfigError: If it is wrong; holds every fault.
    """
    problems = Problems(shown_path or name)
    root = yaml_source.compose(source, problems)
    try:
        scenario = _scenario(Value(root, "", root.start_mark, problems), name, folder)
    except Rejected:
        problems.raise_any()
        raise
    problems.raise_any()
    return scenario


def _scenario(root: Value, name: str, folder: Path) -> Scenario:
    top = children(root, _SECTIONS, required=("objects", "trajectory", "detector"))
    unit = LENGTH_UNITS[attempt(choice(*LENGTH_UNITS), top.get("length_unit"), "m")]
    readers: dict[str, Reader[Any]] = {
        "model": lambda value: _model(value, folder),
        "seed": integer(0, 2**31),
        "start": _stamp,
        "log_clock_offset": _seconds(-1e10, 1e10),
        "frames": _frames,
        "objects": lambda value: _objects(value, unit),
        "odometry": lambda value: _odometry(value, unit),
        "camera": lambda value: _camera(value, unit),
        "detector": lambda value: _detector(value, unit),
    }
    found = {key: attempt(read, top.get(key), None) for key, read in readers.items()}
    objects: tuple[SceneObject, ...] = found["objects"] or ()
    ids = [item.object_id for item in objects]
    trajectory = attempt(
        lambda value: _trajectory(value, unit, ids), top.get("trajectory"), Trajectory(())
    )
    root.problems.raise_any()
    detector: Detector = found.pop("detector")
    given = {key: value for key, value in found.items() if value is not None}
    if "start" in given:
        given["start_ns"] = given.pop("start")
    if "log_clock_offset" in given:
        given["log_clock_offset_ns"] = given.pop("log_clock_offset")
    frames = given.pop("frames", {})
    scenario = Scenario(name=name, trajectory=trajectory, detector=detector, **frames, **given)
    if scenario.start_ns + scenario.log_clock_offset_ns < 0:
        top["log_clock_offset"].note("puts the log's clock before 1970")
    _check_labels(top, scenario)
    return scenario


def _model(value: Value, folder: Path) -> Model:
    """The model file beside the scenario; its own faults are those of the scenario too."""
    path = folder / text(value)
    try:
        return load_model(path)
    except ConfigError as error:
        value.note(f"the model {path} cannot be used")
        value.problems.found.extend(error.problems)
        raise Rejected from error


def _stamp(value: Value) -> int:
    """Nanoseconds since 1970, or a time as in RFC 3339 with up to nine decimals."""
    given = value.node.value if isinstance(value.node.value, str) else ""
    if re.fullmatch(r"\d{1,19}", given) and int(given) < 2**62:
        return int(given)
    parts = _RFC3339.fullmatch(given)
    if parts is None:
        value.fail('must be nanoseconds since 1970 or a time like "2024-05-17T09:30:00Z"')
    day, clock, decimals, zone = parts.groups()
    try:
        moment = datetime.datetime.fromisoformat(
            f"{day}T{clock}{'+00:00' if zone in 'Zz' else zone}"
        )
    except ValueError as error:
        value.fail(f"is not a time: {error}")
    since = moment - datetime.datetime(1970, 1, 1, tzinfo=datetime.timezone.utc)
    whole = since.days * 86_400 + since.seconds
    if not 0 <= whole < 2**31:
        value.fail("must lie between 1970 and 2038, which ROS stamps can hold")
    return whole * 1_000_000_000 + int((decimals or "0").ljust(9, "0"))


def _seconds(minimum: float, maximum: float) -> Reader[int]:
    """Seconds to nanoseconds."""
    bounded = number(minimum=minimum, maximum=maximum)
    return lambda value: round(bounded(value) * 1e9)


def _boolean(value: Value) -> bool:
    return bool(choice("true", "false")(value) == "true")


def _frames(value: Value) -> dict[str, str]:
    found = fields(value, {"world": text, "robot": text})
    return {f"{key}_frame": name for key, name in found.items()}


def _point(unit: float, *axes: str) -> Reader[tuple[float, ...]]:
    return vector(number(minimum=-_MAX_COORDINATE, maximum=_MAX_COORDINATE, scale=unit), *axes)


def _angle() -> Reader[float]:
    """Degrees to radians, any winding."""
    return number(minimum=-1e4, maximum=1e4, scale=_DEGREE)


def _renamed(found: dict[str, Any], names: Mapping[str, str]) -> dict[str, Any]:
    """Keys of the file to names of the dataclass."""
    return {names.get(key, key.removesuffix("_deg")): value for key, value in found.items()}


def _objects(value: Value, unit: float) -> tuple[SceneObject, ...]:
    length = number(above=0.0, maximum=_MAX_COORDINATE, scale=unit)
    readers: dict[str, Reader[Any]] = {
        "class": text,
        "position": _point(unit, "x", "y"),
        "orientation_deg": _angle(),
        "size": vector(length, "length", "width", "height"),
        "against_wall": _boolean,
    }
    required = ("class", "position", "orientation_deg")
    given = entries(value)
    if not given:
        value.fail("needs at least one object")
    found = several(lambda child: fields(child, readers, required=required), given.values())
    return tuple(
        SceneObject(object_id=object_id, **_renamed(item, {"class": "class_name"}))
        for object_id, item in zip(given, found, strict=True)
    )


def _trajectory(value: Value, unit: float, ids: Collection[str]) -> Trajectory:
    readers: dict[str, Reader[Any]] = {
        "stops": lambda child: several(lambda one: _stop(one, unit, ids), child.elements()),
        "speed": number(minimum=1e-3, maximum=1e3, scale=unit),
        "turn_speed_deg": number(minimum=_DEGREE, maximum=1e3 * _DEGREE, scale=_DEGREE),
    }
    trajectory = Trajectory(**_renamed(fields(value, readers, required=("stops",)), {}))
    if not trajectory.stops:
        value.at("stops").fail("needs at least one stop: where the robot starts")
    return trajectory


def _stop(value: Value, unit: float, ids: Collection[str]) -> Stop:
    """One stop; which kind it is shows in its first word."""

    def object_id(child: Value) -> str:
        given = text(child)
        if ids and given not in ids:
            child.fail(unknown_name(given, "object", ids))
        return given

    distance = number(above=0.0, maximum=_MAX_COORDINATE, scale=unit)
    wait = number(minimum=0.0, maximum=_MAX_SECONDS)
    kinds: dict[str, dict[str, Reader[Any]]] = {
        "position": {"position": _point(unit, "x", "y"), "heading_deg": _angle(), "wait": wait},
        "look_at": {
            "look_at": object_id,
            "direction_deg": _angle(),
            "distance": distance,
            "view": _point(unit, "x", "y"),
            "wait": wait,
            "labels": lambda child: several(text, child.elements()),
        },
        "around": {
            "around": object_id,
            "distance": distance,
            "from_deg": _angle(),
            "to_deg": _angle(),
        },
    }
    here = [key for key in kinds if value.at(key) is not value]
    if len(here) != 1:
        value.fail("must have one of the keys position, look_at, around, which say what it is")
    kind = here[0]
    required = tuple(kinds[kind]) if kind == "around" else (kind,)
    found = fields(value, kinds[kind], required=required)
    if kind == "position":
        return DriveTo(**_renamed(found, {}))
    if kind == "around":
        names = {"around": "object_id", "from_deg": "from_direction", "to_deg": "to_direction"}
        return CircleAround(**_renamed(found, names))
    from_world = {"direction_deg", "distance"} & found.keys()
    if (len(from_world), "view" in found) not in ((2, False), (0, True)):
        value.fail("give either direction_deg and distance, or view, to say where to look from")
    if found.get("view") == (0.0, 0.0):
        value.at("view").fail("is the object's own centre; stand somewhere else")
    if found.get("labels") and not found.get("wait"):
        value.fail("labels are returned half-way through wait; give wait in seconds")
    return LookAt(**_renamed(found, {"look_at": "object_id"}))


def _odometry(value: Value, unit: float) -> Odometry:
    error = {"minimum": 0.0, "maximum": 1e6}
    readers: dict[str, Reader[Any]] = {
        "rate": number(above=0.0, maximum=_MAX_RATE),
        # Errors grow with the root of the distance, so its unit enters with its root.
        "position_by_distance": number(scale=math.sqrt(unit), **error),
        "heading_by_distance_deg": number(scale=_DEGREE / math.sqrt(unit), **error),
        "heading_by_turn_deg": number(scale=_DEGREE, **error),
        "position_drift": number(scale=unit, **error),
        "heading_drift_deg": number(scale=_DEGREE, **error),
        "covariance_factor": number(**error),
    }
    return Odometry(**_renamed(fields(value, readers), {}))


def _camera(value: Value, unit: float) -> Camera:
    focal, center = number(above=0.0, maximum=1e6), number(minimum=-1e6, maximum=1e6)
    pixels = integer(1, 100_000)
    rate = number(above=0.0, maximum=_MAX_RATE)
    from_sensor = number(minimum=0.0, maximum=_MAX_COORDINATE, scale=unit)
    tilt = number(minimum=-2.0 * math.pi, maximum=2.0 * math.pi, scale=_DEGREE)
    mount: dict[str, Reader[Any]] = {
        "position": _point(unit, "x", "y", "z"),
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
            vector(number(minimum=0.0, maximum=_MAX_SECONDS), "min", "max"), equal=True
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
    placed = _renamed(found.pop("mount", {}), {"position": "mount_xyz", "rpy_deg": "mount_rpy"})
    return replace(default, **found, **placed)


def _increasing(reader: Reader[tuple[float, ...]], *, equal: bool = False) -> Reader[Any]:
    def read(value: Value) -> tuple[float, ...]:
        low, high = reader(value)
        if high < low or (high == low and not equal):
            value.fail("the minimum must be less than the maximum")
        return low, high

    return read


def _detector(value: Value, unit: float) -> Detector:
    """One of three detectors; ``kind`` says which."""
    probability = number(minimum=0.0, maximum=1.0)
    length = number(above=0.0, maximum=_MAX_COORDINATE, scale=unit)
    correlation: dict[str, Reader[Any]] = {
        "direction_deg": number(above=0.0, minimum=0.1 * _DEGREE, maximum=1e3, scale=_DEGREE),
        "distance": length,
        "independent": probability,
    }
    errors: dict[str, Reader[Any]] = {
        "clutter": number(minimum=0.0, maximum=1e3),
        "without_ids": _boolean,
        **dict.fromkeys(("miss", "label_noise", "clutter_with_id", "wrong_id"), probability),
    }
    drawn: dict[str, Reader[Any]] = {
        "correlation": lambda child: Correlation(**_renamed(fields(child, correlation), {})),
        "errors": lambda child: Errors(**fields(child, errors)),
    }
    kinds: dict[str, dict[str, Reader[Any]]] = {
        "script": {},
        "model": {"peak": probability, "false_alarm": probability, **drawn},
        "recogniser": {
            "responses": _responses,
            "range": _increasing(
                vector(number(minimum=0.0, maximum=_MAX_COORDINATE, scale=unit), "near", "far")
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
    angle = number(above=0.0, maximum=math.pi, scale=_DEGREE)
    readers: dict[str, Reader[Any]] = {
        "direction_deg": _angle(),
        "half_width_deg": angle,
        "shape": choice("flat", "von_mises"),
        "peak": number(minimum=0.0, maximum=1.0),
        "edge_deg": angle,
    }
    required = ("direction_deg", "half_width_deg")

    def side(child: Value) -> Response:
        return Response(**_renamed(fields(child, readers, required=required), {}))

    pairs = {
        (class_name, label): child
        for class_name, labels in entries(value).items()
        for label, child in entries(labels).items()
    }
    if not pairs:
        value.fail("needs at least one class and a label that it returns")
    sides = several(lambda child: several(side, child.elements()), pairs.values())
    return dict(zip(pairs, sides, strict=True))


def _check_labels(top: Mapping[str, Value], scenario: Scenario) -> None:
    """Names of classes and labels that no part of the file accounts for."""
    detector, model = scenario.detector, scenario.model
    stops = [stop for stop in scenario.trajectory.stops if isinstance(stop, LookAt)]
    scripted = {label for stop in stops for label in stop.labels}
    if isinstance(detector, Script) != bool(scripted):
        if scripted:
            message = "stops give labels, which only a detector of kind: script returns"
        else:
            message = "a script returns the labels that stops give, but none does"
        top["detector"].note(message)
    if isinstance(detector, ModelDetector) and model is None:
        top["detector"].note("a detector of kind: model needs a model; name one under model")
    returned = scripted
    true_classes = {item.class_name for item in scenario.objects}
    if isinstance(detector, Recogniser):
        returned = {label for _, label in detector.responses}
        for name in sorted(true_classes - {owner for owner, _ in detector.responses}):
            top["detector"].at("responses").note(
                f"no responses for the class {name}, which an object has; add what is returned"
            )
    if model is not None:
        for name in sorted(true_classes - set(model.classes.class_names)):
            top["objects"].note(unknown_name(name, "class", model.classes.class_names))
        for label in sorted(returned - set(model.classes.label_names)):
            message = unknown_name(label, "label of the model", model.classes.label_names)
            top["trajectory" if label in scripted else "detector"].note(message)
