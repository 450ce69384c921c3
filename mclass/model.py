"""The checked model file as frozen dataclasses; lengths in metres, angles in radians."""

from __future__ import annotations

import hashlib
import math
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
    the camera body (x forward, y left, z up) on the robot. ``rectified`` says that detections
    come from rectified images, whose distortion is undone already.
    """

    intrinsics: tuple[float, float, float, float] | None = None
    image_size: tuple[int, int] | None = None
    distortion_model: str = "plumb_bob"
    distortion: tuple[float, ...] = ()
    mount_xyz: tuple[float, float, float] | None = None
    mount_rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rectified: bool = False


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
    """How evidence is weighed; the defaults are the plain paper, `ROBUST` what real logs need.

    Attributes:
        preset: Name of the set of defaults that the file started from.
        probabilities: Every label is a yes or no in every look, with a probability; else a
            returned label adds its density and a missing one nothing.
        detection_probability: That the best label is returned from the best viewpoint.
        false_alarm: Probability that a label is returned for no reason, per look.
        silence: Frames that had a cell in view and returned nothing for it count; needs
            ``probabilities``.
        view_margin: How far within the border of the field of view a cell must be [m].
        correlation: Widths [m], [rad] within which looks from one place share one vote;
            None counts every look in full.
        outside_probability: Factor on an object's likelihood in a cell that one of its
            detections does not point at: small, not zero, so that one wrong box cannot
            rule out the place that all others agree on.
        pointing_std: Standard deviation [rad] of a box's edges: beyond them the factor falls
            off as a Gaussian down to ``outside_probability``; 0 for at once.
        pose_uncertainty: The covariance of the poses widens viewpoints and box edges.
        drift: Rate of an unknown random walk of the poses [m/sqrt(s)], beside their covariance.
        score_weights: (score, weight) points, increasing: what a label counts by its score,
            linear between them and constant beyond; empty for 1 whatever the score.
        association: In a log without object ids, find which detections are of one object;
            needs ``probabilities``.
        one_cause: A detection is caused by one cell of the grid that it points at, or by
            none: they share its evidence, instead of each taking all of it.
        trajectory_samples: Beliefs of objects are averaged over so many trajectories drawn
            from the poses' covariance and drift, which err together; 0 takes poses as
            independent.
    """

    preset: Literal["paper", "robust"] = "paper"
    probabilities: bool = False
    detection_probability: float = 0.95
    false_alarm: float = 0.01
    silence: bool = False
    view_margin: float = 0.2
    correlation: tuple[float, float] | None = None
    outside_probability: float = 1e-9
    pointing_std: float = 0.0
    pose_uncertainty: bool = False
    drift: float = 0.0
    score_weights: tuple[tuple[float, float], ...] = ()
    association: bool = False
    one_cause: bool = False
    trajectory_samples: int = 0

    @property
    def log_outside(self) -> float:
        """Logarithm of ``outside_probability``."""
        return math.log(self.outside_probability)


PAPER = InferenceSettings()
ROBUST = InferenceSettings(
    preset="robust",
    probabilities=True,
    silence=True,
    correlation=(0.3, 0.12),
    outside_probability=1e-3,
    pointing_std=0.05,
    association=True,
)


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

    @property
    def hash(self) -> str:
        """Of the text, as outputs and records of batches name it."""
        return f"sha256:{hashlib.sha256(self.source.encode('utf-8', 'replace')).hexdigest()}"
