"""Which message types play which role, as tables of field paths.

Layouts changed between releases (``vision_msgs``) and between languages, so every entry is a
list of alternatives, of which the first that the embedded schema has is used. Nothing is
assumed about a schema beyond these paths: a type is what its fields are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

Role = Literal["detections", "pose", "transforms", "velocity", "camera", "label names"]
BoxFormat = Literal["center", "corner", "corners"]

Alternatives = tuple[str, ...]


@dataclass(frozen=True)
class DetectionFamily:
    """Where detections are in a message.

    Attributes:
        name: For people.
        schemas: Type names, as `plain_schema_name` gives them.
        rank: Smaller is preferred when several channels hold detections.
        element: Level of one detection: the list that holds them, or empty.
        boxes: Box formats with the paths of their four numbers, first match wins.
        box_angle: Turn of the box in the image [rad].
        bearing: Right and left edge [rad] in the sensor's frame, counter-clockwise from its x axis.
        volume: Path of a 3-D box: its pose and its size.
    """

    name: str
    schemas: tuple[str, ...]
    rank: int
    element: str
    stamp: Alternatives
    frame: Alternatives
    label: Alternatives
    score: Alternatives = ()
    id: Alternatives = ()
    boxes: tuple[tuple[BoxFormat, tuple[str, str, str, str]], ...] = ()
    box_angle: Alternatives = ()
    bearing: tuple[str, str] | None = None
    volume: tuple[str, str] | None = None


@dataclass(frozen=True)
class PoseFamily:
    """Where a pose is in a message."""

    schemas: tuple[str, ...]
    rank: int
    stamp: Alternatives
    frame: Alternatives
    position: Alternatives
    orientation: Alternatives
    child: Alternatives = ()
    covariance: Alternatives = ()


@dataclass(frozen=True)
class VelocityFamily:
    """Where forward, leftward and turning speed are in a message."""

    name: str
    schemas: tuple[str, ...]
    linear: str
    angular: str
    stamp: Alternatives = ()
    frame: Alternatives = ()


@dataclass(frozen=True)
class TransformFamily:
    """Where transforms between frames are in a message; ``element`` as for detections."""

    schemas: tuple[str, ...]
    element: str
    stamp: str
    parent: str
    child: str
    translation: str
    rotation: str


@dataclass(frozen=True)
class CameraFamily:
    """Where a camera's calibration is in a message."""

    schemas: tuple[str, ...]
    stamp: str
    frame: str
    fields: Mapping[str, Alternatives] = field(default_factory=dict)


_HEADER_STAMP = ("header.stamp",)
_HEADER_FRAME = ("header.frame_id",)
_STAMP = ("timestamp",)
_FRAME = ("frame_id",)


def _vision_detection(name: str, rank: int, element: str, *, solid: bool) -> DetectionFamily:
    """A vision_msgs type; foxy, galactic, humble and later, and ROS 1, are alternatives."""
    dot = f"{element}." if element else ""
    return DetectionFamily(
        name=name,
        schemas=(f"vision_msgs/{name}",),
        rank=rank,
        element=element,
        stamp=_HEADER_STAMP,
        frame=(*_HEADER_FRAME, f"{dot}header.frame_id") if element else _HEADER_FRAME,
        label=(
            f"{dot}results[].hypothesis.class_id",
            f"{dot}results[].hypothesis.id",
            f"{dot}results[].class_id",
            f"{dot}results[].id",
        ),
        score=(f"{dot}results[].hypothesis.score", f"{dot}results[].score"),
        id=(f"{dot}id", f"{dot}tracking_id"),
        boxes=()
        if solid
        else tuple(
            (
                "center",
                (f"{dot}{x}.x", f"{dot}{x}.y", f"{dot}bbox.size_x", f"{dot}bbox.size_y"),
            )
            for x in ("bbox.center.position", "bbox.center")
        ),
        box_angle=() if solid else (f"{dot}bbox.center.theta",),
        volume=(f"{dot}bbox.center", f"{dot}bbox.size") if solid else None,
    )


def _yolo_boxes(dot: str) -> tuple[tuple[BoxFormat, tuple[str, str, str, str]], ...]:
    sizes = (("bbox.size.x", "bbox.size.y"), ("bbox.size_x", "bbox.size_y"))
    return tuple(
        ("center", (f"{dot}{x}.x", f"{dot}{x}.y", f"{dot}{width}", f"{dot}{height}"))
        for x in ("bbox.center.position", "bbox.center")
        for width, height in sizes
    )


def _box_paths(a: str, b: str, c: str, d: str) -> tuple[str, str, str, str]:
    dot = "detections[].box."
    return (dot + a, dot + b, dot + c, dot + d)


DETECTIONS: tuple[DetectionFamily, ...] = (
    _vision_detection("Detection2DArray", 0, "detections[]", solid=False),
    DetectionFamily(
        name="mclass.Detections",
        schemas=("mclass.Detections", "mclass_msgs/Detections"),
        rank=0,
        element="detections[]",
        stamp=(*_STAMP, *_HEADER_STAMP),
        frame=(*_FRAME, *_HEADER_FRAME),
        label=("detections[].labels[].name", "detections[].label"),
        score=("detections[].labels[].score", "detections[].score"),
        id=("detections[].id",),
        boxes=(
            ("corner", _box_paths("x", "y", "width", "height")),
            ("center", _box_paths("center_x", "center_y", "width", "height")),
        ),
        bearing=("detections[].bearing.right", "detections[].bearing.left"),
    ),
    DetectionFamily(
        name="DetectionArray",
        schemas=("yolo_msgs/DetectionArray", "yolov8_msgs/DetectionArray"),
        rank=1,
        element="detections[]",
        stamp=_HEADER_STAMP,
        frame=_HEADER_FRAME,
        label=("detections[].class_name", "detections[].class_id"),
        score=("detections[].score",),
        id=("detections[].id",),
        boxes=_yolo_boxes("detections[]."),
        box_angle=("detections[].bbox.center.theta",),
    ),
    _vision_detection("Detection2D", 2, "", solid=False),
    _vision_detection("Detection3DArray", 3, "detections[]", solid=True),
    _vision_detection("Detection3D", 4, "", solid=True),
)

MAPPED_RANK, GUESSED_RANK, ANNOTATIONS_RANK = -1, 5, 6
"""Ranks of a channel that the model file maps, of guessed fields, and of annotations."""

ANNOTATION_SCHEMAS = ("foxglove.ImageAnnotations",)

POSES: tuple[PoseFamily, ...] = (
    PoseFamily(
        schemas=("nav_msgs/Odometry", "foxglove.Odometry"),
        rank=0,
        stamp=(*_HEADER_STAMP, *_STAMP),
        frame=(*_HEADER_FRAME, *_FRAME),
        child=("child_frame_id", "body_frame_id"),
        position=("pose.pose.position", "pose.position"),
        orientation=("pose.pose.orientation", "pose.orientation"),
        covariance=("pose.covariance", "pose_covariance[]", "pose_covariance", "pose.covariance[]"),
    ),
    PoseFamily(
        schemas=("geometry_msgs/PoseWithCovarianceStamped",),
        rank=1,
        stamp=_HEADER_STAMP,
        frame=_HEADER_FRAME,
        position=("pose.pose.position",),
        orientation=("pose.pose.orientation",),
        covariance=("pose.covariance", "pose.covariance[]"),
    ),
    PoseFamily(
        schemas=("geometry_msgs/PoseStamped", "foxglove.PoseInFrame"),
        rank=2,
        stamp=(*_HEADER_STAMP, *_STAMP),
        frame=(*_HEADER_FRAME, *_FRAME),
        position=("pose.position",),
        orientation=("pose.orientation",),
    ),
)

TRANSFORM_RANK, VELOCITY_RANK = 3, 4

VELOCITIES: tuple[VelocityFamily, ...] = (
    VelocityFamily(
        "TwistStamped",
        ("geometry_msgs/TwistStamped",),
        "twist.linear",
        "twist.angular",
        _HEADER_STAMP,
        _HEADER_FRAME,
    ),
    VelocityFamily("Twist", ("geometry_msgs/Twist",), "linear", "angular"),
)


def _foxglove_transform(schema: str, element: str) -> TransformFamily:
    dot = f"{element}." if element else ""
    return TransformFamily(
        (schema,),
        element,
        f"{dot}timestamp",
        f"{dot}parent_frame_id",
        f"{dot}child_frame_id",
        f"{dot}translation",
        f"{dot}rotation",
    )


TRANSFORMS: tuple[TransformFamily, ...] = (
    TransformFamily(
        ("tf2_msgs/TFMessage", "tf/tfMessage"),
        "transforms[]",
        "transforms[].header.stamp",
        "transforms[].header.frame_id",
        "transforms[].child_frame_id",
        "transforms[].transform.translation",
        "transforms[].transform.rotation",
    ),
    _foxglove_transform("foxglove.FrameTransforms", "transforms[]"),
    _foxglove_transform("foxglove.FrameTransform", ""),
    TransformFamily(
        ("geometry_msgs/TransformStamped",),
        "",
        "header.stamp",
        "header.frame_id",
        "child_frame_id",
        "transform.translation",
        "transform.rotation",
    ),
)

_CALIBRATION_FIELDS: Mapping[str, Alternatives] = {
    "width": ("width",),
    "height": ("height",),
    "model": ("distortion_model",),
    "intrinsics": ("k", "K", "k[]", "K[]"),
    "coefficients": ("d[]", "D[]", "d", "D"),
    "rectification": ("r", "R", "r[]", "R[]"),
    "projection": ("p", "P", "p[]", "P[]"),
    "binning_x": ("binning_x",),
    "binning_y": ("binning_y",),
    "roi_x": ("roi.x_offset",),
    "roi_y": ("roi.y_offset",),
    "roi_width": ("roi.width",),
    "roi_height": ("roi.height",),
}

CAMERAS: tuple[CameraFamily, ...] = (
    CameraFamily(
        ("sensor_msgs/CameraInfo",), "header.stamp", "header.frame_id", _CALIBRATION_FIELDS
    ),
    CameraFamily(("foxglove.CameraCalibration",), "timestamp", "frame_id", _CALIBRATION_FIELDS),
)

LABEL_NAME_SCHEMAS = ("vision_msgs/LabelInfo",)
LABEL_NAME_FIELDS = ("class_map[].class_id", "class_map[].class_name")


def plain_schema_name(name: str) -> str:
    """A type's name without what differs between ROS versions and Foxglove's ROS packages.

    ``nav_msgs/msg/Odometry`` becomes ``nav_msgs/Odometry``, ``foxglove_msgs/msg/Grid``
    becomes ``foxglove.Grid``.
    """
    plain = name.replace("/msg/", "/")
    if plain.startswith("foxglove_msgs/"):
        plain = "foxglove." + plain.removeprefix("foxglove_msgs/")
    return plain


def role_of(schema_name: str) -> Role | None:
    """What a message of this type is used for, None if its type does not say."""
    name = plain_schema_name(schema_name)
    roles: tuple[tuple[Role, tuple[str, ...]], ...] = (
        ("detections", tuple(s for f in DETECTIONS for s in f.schemas) + ANNOTATION_SCHEMAS),
        ("pose", tuple(s for f in POSES for s in f.schemas)),
        ("transforms", tuple(s for f in TRANSFORMS for s in f.schemas)),
        ("velocity", tuple(s for f in VELOCITIES for s in f.schemas)),
        ("camera", tuple(s for f in CAMERAS for s in f.schemas)),
        ("label names", LABEL_NAME_SCHEMAS),
    )
    for role, schemas in roles:
        if name in schemas:
            return role
    return None


def first_present(alternatives: Alternatives, paths: Mapping[str, str]) -> str | None:
    """The first alternative that a schema has."""
    return next((path for path in alternatives if path in paths), None)
