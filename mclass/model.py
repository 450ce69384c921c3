"""The checked model file as frozen dataclasses; lengths in metres, angles in radians."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from mclass.classes import ClassModel

LENGTH_UNITS: Mapping[str, float] = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001}
"""Metres in one unit."""


@dataclass(frozen=True)
class TransformSource:
    """Poses from a transform chain: ``parent`` (world) to ``child`` (robot or sensor)."""

    parent: str
    child: str


@dataclass(frozen=True)
class FieldMapping:
    """Where a message of any type keeps what is needed; dotted paths, ``[]`` for each element.

    For detections: ``label`` (required), ``score``, ``id``, ``box``, ``stamp``, ``frame``;
    for poses: ``x``, ``y`` (required), ``heading`` or ``quaternion``, ``stamp``, ``frame``.
    ``box_format`` is ``center`` (cx, cy, w, h), ``corner`` (left, top, w, h) or ``corners``
    (left, top, right, bottom); None lets the field names decide.
    """

    topic: str
    fields: Mapping[str, str] = field(default_factory=dict)
    box_format: Literal["center", "corner", "corners"] | None = None


@dataclass(frozen=True)
class CameraSettings:
    """A camera that the log does not describe.

    ``intrinsics`` is (fx, fy, cx, cy) [pixel]; ``mount_xyz`` [m] and ``mount_rpy`` [rad] place
    the camera body (x forward, y left, z up) on the robot.
    """

    intrinsics: tuple[float, float, float, float] | None = None
    image_size: tuple[int, int] | None = None
    distortion_model: str = "plumb_bob"
    distortion: tuple[float, ...] = ()
    mount_xyz: tuple[float, float, float] | None = None
    mount_rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class LogSettings:
    """Which channels to use and how to read them; None lets the log decide."""

    odometry: FieldMapping | TransformSource | None = None
    detections: tuple[FieldMapping, ...] = ()
    camera_info: str | None = None
    camera: CameraSettings | None = None
    min_score: float = 0.0
    labels: Mapping[str, str] = field(default_factory=dict)
    max_gap_ns: int = 500_000_000


@dataclass(frozen=True)
class GridSettings:
    """Cells, orientation bins and footprints. Lengths in metres."""

    cell_size: float = 0.1
    orientation_bins: int = 72
    footprint: Literal["cone", "ray"] = "cone"
    min_range: float = 0.2
    max_range: float = 4.0
    origin: tuple[float, float] | None = None
    size: tuple[float, float] | None = None


@dataclass(frozen=True)
class InferenceSettings:
    """How evidence is weighed.

    ``outside_probability`` is the factor on an object's likelihood in a cell that one of its
    detections does not point at: small, not zero, so that one wrong box cannot rule out
    the place that all others agree on.
    """

    preset: Literal["paper", "robust"] = "paper"
    outside_probability: float = 1e-9


@dataclass(frozen=True)
class Model:
    """A whole model file.

    Attributes:
        name: File name as shown to people.
        source: Its text, as attached to outputs.
        length_unit: Of the file, for display.
        objects: Known positions [m] by object id.
    """

    name: str
    source: str
    length_unit: str
    classes: ClassModel
    log: LogSettings = LogSettings()
    grid: GridSettings = GridSettings()
    inference: InferenceSettings = InferenceSettings()
    objects: Mapping[str, tuple[float, float]] = field(default_factory=dict)
