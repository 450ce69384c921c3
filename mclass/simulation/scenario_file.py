"""A scenario file to a checked `Scenario`, or every fault in it at once.

The same YAML, the same checks and the same kind of messages as for model files.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
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
from mclass.errors import ConfigError, UsageError
from mclass.logs.times import find_time_bound
from mclass.model import LENGTH_UNITS, Model
from mclass.simulation.scenario import (
    CircleAround,
    Detector,
    DriveTo,
    LookAt,
    ModelDetector,
    Recogniser,
    Scenario,
    SceneObject,
    Script,
    Stop,
    Trajectory,
)
from mclass.simulation.scenario_sections import (
    DEGREE,
    MAX_COORDINATE,
    MAX_SECONDS,
    angle,
    boolean,
    point,
    read_camera,
    read_detector,
    read_odometry,
    renamed,
)

_LAST_STAMP_NS = 2**31 * 10**9

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
        "odometry": lambda value: read_odometry(value, unit),
        "camera": lambda value: read_camera(value, unit),
        "detector": lambda value: read_detector(value, unit),
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
    """Nanoseconds since 1970, or a date and time as in RFC 3339."""
    given = value.node.value
    try:
        if not isinstance(given, str) or given.startswith("+"):
            raise UsageError("nothing to count from")
        stamp_ns = find_time_bound(given, 0)
    except UsageError:
        value.fail(
            "must be nanoseconds since 1970, or a date and time with offset such as "
            "2024-05-17T09:30:00Z"
        )
    if stamp_ns >= _LAST_STAMP_NS:
        value.fail("must lie before 2038, after which ROS stamps end")
    return stamp_ns


def _seconds(minimum: float, maximum: float) -> Reader[int]:
    """Seconds to nanoseconds."""
    bounded = number(minimum=minimum, maximum=maximum)
    return lambda value: round(bounded(value) * 1e9)


def _frames(value: Value) -> dict[str, str]:
    found = fields(value, {"world": text, "robot": text})
    return {f"{key}_frame": name for key, name in found.items()}


def _objects(value: Value, unit: float) -> tuple[SceneObject, ...]:
    length = number(above=0.0, maximum=MAX_COORDINATE, scale=unit)
    readers: dict[str, Reader[Any]] = {
        "class": text,
        "position": point(unit, "x", "y"),
        "orientation_deg": angle(),
        "size": vector(length, "length", "width", "height"),
        "against_wall": boolean,
    }
    required = ("class", "position", "orientation_deg")
    given = entries(value)
    if not given:
        value.fail("needs at least one object")
    found = several(lambda child: fields(child, readers, required=required), given.values())
    return tuple(
        SceneObject(object_id=object_id, **renamed(item, {"class": "class_name"}))
        for object_id, item in zip(given, found, strict=True)
    )


def _trajectory(value: Value, unit: float, ids: Collection[str]) -> Trajectory:
    readers: dict[str, Reader[Any]] = {
        "stops": lambda child: several(lambda one: _stop(one, unit, ids), child.elements()),
        "speed": number(minimum=1e-3, maximum=1e3, scale=unit),
        "turn_speed_deg": number(minimum=DEGREE, maximum=1e3 * DEGREE, scale=DEGREE),
    }
    trajectory = Trajectory(**renamed(fields(value, readers, required=("stops",)), {}))
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

    distance = number(above=0.0, maximum=MAX_COORDINATE, scale=unit)
    wait = number(minimum=0.0, maximum=MAX_SECONDS)
    kinds: dict[str, dict[str, Reader[Any]]] = {
        "position": {"position": point(unit, "x", "y"), "heading_deg": angle(), "wait": wait},
        "look_at": {
            "look_at": object_id,
            "direction_deg": angle(),
            "distance": distance,
            "view": point(unit, "x", "y"),
            "wait": wait,
            "labels": lambda child: several(text, child.elements()),
        },
        "around": {
            "around": object_id,
            "distance": distance,
            "from_deg": angle(),
            "to_deg": angle(),
        },
    }
    here = [key for key in kinds if value.at(key) is not value]
    if len(here) != 1:
        value.fail("must have one of the keys position, look_at, around, which say what it is")
    kind = here[0]
    required = tuple(kinds[kind]) if kind == "around" else (kind,)
    found = fields(value, kinds[kind], required=required)
    if kind == "position":
        return DriveTo(**renamed(found, {}))
    if kind == "around":
        names = {"around": "object_id", "from_deg": "from_direction", "to_deg": "to_direction"}
        return CircleAround(**renamed(found, names))
    from_world = {"direction_deg", "distance"} & found.keys()
    if (len(from_world), "view" in found) not in ((2, False), (0, True)):
        value.fail("give either direction_deg and distance, or view, to say where to look from")
    if found.get("view") == (0.0, 0.0):
        value.at("view").fail("is the object's own centre; stand somewhere else")
    if found.get("labels") and not found.get("wait"):
        value.fail("labels are returned half-way through wait; give wait in seconds")
    return LookAt(**renamed(found, {"look_at": "object_id"}))


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
