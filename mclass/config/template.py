"""The commented model file that `mclass init` writes."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import yaml

from mclass.config.model_file import DEFAULT_PRESET
from mclass.config.scalars import text_problem
from mclass.model import FieldMapping, GridSettings, TransformSource

_MAX_CLASSES = 30
_MAX_NOTE = 300
_PLAIN = re.compile(r"[A-Za-z/_][A-Za-z0-9/_.-]*")


@dataclass(frozen=True)
class TemplateFacts:
    """What is known about a log, or nothing at all.

    Attributes:
        log_name: File name of the log.
        schema: Path or address of the JSON Schema for editors.
        odometry: Where poses come from, if the log holds any.
        detections: Where detections come from.
        camera_info: Topic of the calibration.
        has_camera: Whether calibration and mounting are in the log.
        frame: World frame of the poses.
        sensor_frame: Frame of the detections.
        label_counts: Labels seen, as the detector names them, and how often.
        label_names: Names for those of them that are mere numbers, from the log.
        together: Pairs of labels seen in one detection, and how often: the two classes share
            a side.
        notes: Sentences to pass on: choices made, what is missing.
    """

    log_name: str = ""
    schema: str = ""
    odometry: FieldMapping | TransformSource | None = None
    detections: tuple[FieldMapping, ...] = ()
    camera_info: str | None = None
    has_camera: bool = False
    frame: str = ""
    sensor_frame: str = ""
    label_counts: Mapping[str, int] = field(default_factory=dict)
    label_names: Mapping[str, str] = field(default_factory=dict)
    together: tuple[tuple[str, str, int], ...] = ()
    notes: tuple[str, ...] = ()


def model_template(facts: TemplateFacts) -> str:
    """A model file for a log, with comments that teach the format; it loads as it stands.

    The viewpoints are a first guess (sensor 1.3 m in front of or behind the object), which
    the comments say how to replace. Labels that cannot be names are left out and said so.
    """
    if not _class_counts(facts):
        example = {"cup": 0, "mug": 0}
        facts = replace(facts, label_counts=example, together=(("cup", "mug", 0),))
    return "\n".join([*_head(facts), *_VIEWPOINTS, *_classes(facts), *_log(facts), *_REST, ""])


def quoted(name: str) -> str:
    """A name as YAML text: plain where that is safe for every reader of YAML."""
    node = yaml.ScalarNode("", name)
    if _PLAIN.fullmatch(name) and not text_problem(node):
        return name
    return json.dumps(name, ensure_ascii=False)


def _head(facts: TemplateFacts) -> list[str]:
    lines = []
    if facts.schema:
        lines.append(f"# yaml-language-server: $schema={_one_line(facts.schema)}")
    lines += [
        f"# Model file of mclass{f' for {_one_line(facts.log_name)}' if facts.log_name else ''}:",
        "# what the detector returns for each class of object, and from where it returns it.",
        "# Check it with `mclass check`, look at it with `mclass inspect model`.",
    ]
    if facts.notes:
        lines += ["#", *(f"# Note: {_one_line(note)}" for note in facts.notes)]
    return [*lines, *_UNITS]


def _classes(facts: TemplateFacts) -> list[str]:
    """One class a label; labels seen together are shared by the two classes' fronts."""
    counts = _class_counts(facts)
    lines = list(_CLASSES)
    ranked = sorted(facts.label_counts, key=lambda label: (-facts.label_counts[label], label))
    others = dict.fromkeys(_named(facts, label) for label in ranked)
    left_out = [name for name in others if name not in counts]
    if left_out:
        shown = ", ".join(_one_line(name, 40) for name in left_out[:20])
        more = f" and {len(left_out) - 20} more" if len(left_out) > 20 else ""
        lines.append(f"  # Labels seen, but not made classes of: {shown}{more}")
    partners: dict[str, dict[str, int]] = {name: {} for name in counts}
    for first, second, count in facts.together:
        one, other = _named(facts, first), _named(facts, second)
        if one in partners and other in partners and one != other:
            partners[one][other] = partners[one].get(other, 0) + count
            partners[other][one] = partners[one][other]
    for name, count in counts.items():
        seen = f"seen {_times(count)}" if count else "an example"
        own = "{probability: 0.95, views: {front: 0.5, back: 0.5}, clutter: 0.005}"
        shared = "{probability: 0.9, views: {front: 0.5}, clutter: 0.005}"
        lines += [f"  {quoted(name)}:  # {seen}", "    prior: 1", "    labels:"]
        lines.append(f"      {quoted(name)}: {own}")
        if partners[name]:
            lines.append("      # Returned together: they look alike from some side. The front?")
        for other, together in partners[name].items():
            often = f"  # {_times(together)}" if together else ""
            lines.append(f"      {quoted(other)}: {shared}{often}")
    return lines


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count:,} times"


def _class_counts(facts: TemplateFacts) -> dict[str, int]:
    """How often each class to be was seen, most frequent first."""
    counts: dict[str, int] = {}
    for label, count in facts.label_counts.items():
        name = _named(facts, label)
        if _is_text(name) and _is_text(label) and name != "background":
            counts[name] = counts.get(name, 0) + count
    ranked = sorted(counts, key=lambda name: (-counts[name], name))
    return {name: counts[name] for name in ranked[:_MAX_CLASSES]}


def _named(facts: TemplateFacts, label: str) -> str:
    return facts.label_names.get(label, label)


def _is_text(name: str) -> bool:
    """Whether a model file can hold this name, with quotes if need be."""
    return name.isprintable() and not text_problem(yaml.ScalarNode("", name, style='"'))


def _log(facts: TemplateFacts) -> list[str]:
    frames = []
    if facts.frame:
        frames.append(f"results are in the frame {_one_line(facts.frame)}")
    if facts.sensor_frame:
        frames.append(f"detections are in {_one_line(facts.sensor_frame)}")
    lines = list(_LOG)
    if frames:
        lines.append(f"  # In this log {', '.join(frames)}.")
    lines.append(_odometry(facts.odometry))
    sources = [_source(source) for source in facts.detections if _is_text(source.topic)]
    if sources:
        listed = sources[0] if len(sources) == 1 else f"[{', '.join(sources)}]"
        lines.append(f"  detections: {listed}")
    else:
        lines.append("  # detections: /detections")
    if facts.camera_info is not None and _is_text(facts.camera_info):
        lines.append(f"  camera_info: {quoted(facts.camera_info)}")
    classes = _class_counts(facts)
    if facts.label_names and classes:
        # Labels that are not listed are left out, so those that keep their name are listed too.
        lines.append("  labels:  # the detector's names -> the names above; others are left out")
        names = {label: _named(facts, label) for label in facts.label_counts if _is_text(label)}
        lines += [
            f"    {quoted(label)}: {quoted(name)}"
            for label, name in names.items()
            if name in classes
        ]
    else:
        lines.append("  # The detector's names -> the names above; others are left out.")
        lines.append('  # labels: {"0": cup, "41": cup, "73": mug}')
    return [*lines, *_LOG_OPTIONS, *(_RECTIFIED if facts.has_camera else _CAMERA)]


def _odometry(source: FieldMapping | TransformSource | None) -> str:
    if isinstance(source, TransformSource) and _is_text(source.parent) and _is_text(source.child):
        return f"  tf: {{parent: {quoted(source.parent)}, child: {quoted(source.child)}}}"
    if isinstance(source, FieldMapping) and _is_text(source.topic):
        return f"  odometry: {_source(source)}"
    return "  # odometry: /odom     # or tf: {parent: map, child: base_link}"


def _source(mapping: FieldMapping) -> str:
    if not mapping.fields:
        return quoted(mapping.topic)
    entries = {"topic": mapping.topic, **mapping.fields}
    if mapping.box_format:
        entries["box_format"] = mapping.box_format
    return "{" + ", ".join(f"{key}: {quoted(value)}" for key, value in entries.items()) + "}"


def _one_line(text: str, limit: int = _MAX_NOTE) -> str:
    """Text that cannot end the comment it stands in."""
    printable = "".join(c if c.isprintable() else " " for c in text)
    return printable if len(printable) <= limit else printable[: limit - 3] + "..."


def _block(text: str) -> list[str]:
    return text.removeprefix("\n").removesuffix("\n").split("\n")


_UNITS = _block("""

# Unit of every length in this file: m, dm, cm or mm. Variances are in its square, densities
# (background likelihood, clutter) in one over its square.
length_unit: m

# No object here. `likelihood` is the density at which any label is returned by mistake.
background: {prior: 1, likelihood: 0.01}
""")

_VIEWPOINTS = _block("""

# Where the SENSOR stands when an object is recognised, as Gaussians in the object's own frame:
# the object at [0, 0]. An object's orientation is the angle of its x axis in the world, and
# arrows point along that axis. Which side is the front is yours to choose: here it is +y, so an
# object of orientation 0 faces 90 degrees. `covariance` is a variance, [xx, yy], or a matrix
# [[xx, xy], [xy, yy]]. A variance of 0.3 at 1.3 m means, to one standard deviation, seen from
# 0.75 to 1.85 m away and from 23 degrees to either side.
viewpoints:
  front: {position: [0, 1.3], covariance: 0.3}
  back: {position: [0, -1.3], covariance: 0.3}
  # left: {position: [-1.3, 0], covariance: 0.3}
  # With a term for the object's bearing from the sensor's heading, in degrees:
  # right: {position: [1.3, 0], covariance: [0.3, 0.2], bearing: {mean_deg: 0, std_deg: 30}}
""")

_CLASSES = _block("""

# What the detector returns for an object of each class, and from which viewpoints.
#   probability  how often the label is returned when the sensor stands right
#   views        viewpoints and their weights (of one label: 1 in all), or a list of names
#   covariance   in place of the viewpoints' own
#   clutter      density of the label from anywhere: one false label cannot decide alone
# A label returned from all sides says nothing about orientation. Name only the viewpoints
# from which it really is returned; and where two classes look alike from one side, give each
# the other's label from that side:
#   other_class: {probability: 0.9, views: {front: 0.5}, clutter: 0.005}
classes:
""")

_LOG = _block("""

# What to read. All of it is found by message type when left out.
log:
""")

_LOG_OPTIONS = _block("""
  # Any other message type: name the topic and the paths of its fields.
  # detections: {topic: /boxes, label: "boxes[].name", score: "boxes[].score", box: "boxes[].rect"}
  # min_score: 0.5        # leave out detections with a lower score
  # max_gap: 0.5          # seconds without a pose that are bridged
""")

_RECTIFIED = _block("""
  # Does the detector look at rectified images? Then their distortion is undone already:
  # camera: {rectified: true}
""")

_CAMERA = _block("""
  # Camera, in pixels, and its place on the robot, where the log does not say:
  # camera:
  #   {fx: 525, fy: 525, cx: 319.5, cy: 239.5, width: 640, height: 480,
  #    mount: {position: [0.1, 0, 0.3], rpy_deg: [0, 0, 0]}}
  # With `rectified: true` where the detector looks at rectified images.
""")

_GRID = GridSettings()

_REST = _block(f"""

# The map. Its extent follows the data unless `origin: [x, y]` and `size: [width, height]` are
# given. A detection touches the cells in the cone of its box, or on the ray through its
# centre, that lie within `range`.
grid:
  cell_size: {_GRID.cell_size:g}
  orientation_bins: {_GRID.orientation_bins}
  footprint: {_GRID.footprint}
  range: [{_GRID.min_range:g}, {_GRID.max_range:g}]

# `paper` is the plain filter; `robust` adds what real detectors need.
inference: {{preset: {DEFAULT_PRESET}}}

# Objects whose position is known, by the detector's object id.
# objects:
#   o1: {{position: [2.0, -1.5]}}
""")
