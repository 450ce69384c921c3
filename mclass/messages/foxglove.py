"""Foxglove's schemas, those that we read or write: names, types and numbers of their fields.

They are stated here rather than taken from a package, so that what an output embeds does not
change with what happens to be installed. Each stands in a file of its own, as Foxglove has it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

PACKAGE = "foxglove"

_MESSAGES: Mapping[str, str] = {
    "ArrowPrimitive": (
        "Pose pose = 1; double shaft_length = 2; double shaft_diameter = 3; "
        "double head_length = 4; double head_diameter = 5; Color color = 6;"
    ),
    "CameraCalibration": (
        "google.protobuf.Timestamp timestamp = 1; string frame_id = 9; fixed32 width = 2; "
        "fixed32 height = 3; string distortion_model = 4; repeated double D = 5; "
        "repeated double K = 6; repeated double R = 7; repeated double P = 8;"
    ),
    "CircleAnnotation": (
        "google.protobuf.Timestamp timestamp = 1; Point2 position = 2; double diameter = 3; "
        "double thickness = 4; Color fill_color = 5; Color outline_color = 6; "
        "repeated KeyValuePair metadata = 7;"
    ),
    "Color": "double r = 1; double g = 2; double b = 3; double a = 4;",
    "CubePrimitive": "Pose pose = 1; Vector3 size = 2; Color color = 3;",
    "CylinderPrimitive": (
        "Pose pose = 1; Vector3 size = 2; double bottom_scale = 3; double top_scale = 4; "
        "Color color = 5;"
    ),
    "FrameTransform": (
        "google.protobuf.Timestamp timestamp = 1; string parent_frame_id = 2; "
        "string child_frame_id = 3; Vector3 translation = 4; Quaternion rotation = 5;"
    ),
    "FrameTransforms": "repeated FrameTransform transforms = 1;",
    "Grid": (
        "google.protobuf.Timestamp timestamp = 1; string frame_id = 2; Pose pose = 3; "
        "fixed32 column_count = 4; Vector2 cell_size = 5; fixed32 row_stride = 6; "
        "fixed32 cell_stride = 7; repeated PackedElementField fields = 8; bytes data = 9;"
    ),
    "ImageAnnotations": (
        "optional google.protobuf.Timestamp timestamp = 5; repeated CircleAnnotation circles = 1; "
        "repeated PointsAnnotation points = 2; repeated TextAnnotation texts = 3; "
        "repeated KeyValuePair metadata = 4;"
    ),
    "KeyValuePair": "string key = 1; string value = 2;",
    "LinePrimitive": (
        "enum Type { LINE_STRIP = 0; LINE_LOOP = 1; LINE_LIST = 2; } Type type = 1; "
        "Pose pose = 2; double thickness = 3; bool scale_invariant = 4; "
        "repeated Point3 points = 5; Color color = 6; repeated Color colors = 7; "
        "repeated fixed32 indices = 8;"
    ),
    "ModelPrimitive": (
        "Pose pose = 1; Vector3 scale = 2; Color color = 3; bool override_color = 4; "
        "string url = 5; string media_type = 6; bytes data = 7;"
    ),
    "Odometry": (
        "google.protobuf.Timestamp timestamp = 1; string frame_id = 2; "
        "string body_frame_id = 3; Pose pose = 4; optional Vector3 linear_velocity = 5; "
        "optional Vector3 angular_velocity = 6; repeated double pose_covariance = 7; "
        "repeated double velocity_covariance = 8; repeated KeyValuePair metadata = 9;"
    ),
    "PackedElementField": (
        "enum NumericType { UNKNOWN = 0; UINT8 = 1; INT8 = 2; UINT16 = 3; INT16 = 4; "
        "UINT32 = 5; INT32 = 6; FLOAT32 = 7; FLOAT64 = 8; } "
        "string name = 1; fixed32 offset = 2; NumericType type = 3;"
    ),
    "Point2": "double x = 1; double y = 2;",
    "Point3": "double x = 1; double y = 2; double z = 3;",
    "PointsAnnotation": (
        "enum Type { UNKNOWN = 0; POINTS = 1; LINE_LOOP = 2; LINE_STRIP = 3; LINE_LIST = 4; } "
        "google.protobuf.Timestamp timestamp = 1; Type type = 2; repeated Point2 points = 3; "
        "Color outline_color = 4; repeated Color outline_colors = 5; Color fill_color = 6; "
        "double thickness = 7; repeated KeyValuePair metadata = 8;"
    ),
    "Pose": "Vector3 position = 1; Quaternion orientation = 2;",
    "PoseInFrame": ("google.protobuf.Timestamp timestamp = 1; string frame_id = 2; Pose pose = 3;"),
    "Quaternion": "double x = 1; double y = 2; double z = 3; double w = 4;",
    "SceneEntity": (
        "google.protobuf.Timestamp timestamp = 1; string frame_id = 2; string id = 3; "
        "google.protobuf.Duration lifetime = 4; bool frame_locked = 5; "
        "repeated KeyValuePair metadata = 6; repeated ArrowPrimitive arrows = 7; "
        "repeated CubePrimitive cubes = 8; repeated SpherePrimitive spheres = 9; "
        "repeated CylinderPrimitive cylinders = 10; repeated LinePrimitive lines = 11; "
        "repeated TriangleListPrimitive triangles = 12; repeated TextPrimitive texts = 13; "
        "repeated ModelPrimitive models = 14;"
    ),
    "SceneEntityDeletion": (
        "enum Type { MATCHING_ID = 0; ALL = 1; } google.protobuf.Timestamp timestamp = 1; "
        "Type type = 2; string id = 3;"
    ),
    "SceneUpdate": (
        "repeated SceneEntityDeletion deletions = 1; repeated SceneEntity entities = 2;"
    ),
    "SpherePrimitive": "Pose pose = 1; Vector3 size = 2; Color color = 3;",
    "TextAnnotation": (
        "google.protobuf.Timestamp timestamp = 1; Point2 position = 2; string text = 3; "
        "double font_size = 4; Color text_color = 5; Color background_color = 6; "
        "repeated KeyValuePair metadata = 7;"
    ),
    "TextPrimitive": (
        "Pose pose = 1; bool billboard = 2; double font_size = 3; bool scale_invariant = 4; "
        "Color color = 5; string text = 6;"
    ),
    "TriangleListPrimitive": (
        "Pose pose = 1; repeated Point3 points = 2; Color color = 3; "
        "repeated Color colors = 4; repeated fixed32 indices = 5;"
    ),
    "Vector2": "double x = 1; double y = 2;",
    "Vector3": "double x = 1; double y = 2; double z = 3;",
}

_WORD = re.compile(r"[\w.]+")
_GOOGLE = {
    "google.protobuf.Duration": "google/protobuf/duration.proto",
    "google.protobuf.Timestamp": "google/protobuf/timestamp.proto",
}


def proto_text(message: str) -> str | None:
    """The ``.proto`` file of one message, None for one that is not listed here."""
    body = _MESSAGES.get(message)
    if body is None:
        return None
    words = set(_WORD.findall(body))
    imports = {f"{PACKAGE}/{word}.proto" for word in words & _MESSAGES.keys()}
    imports |= {_GOOGLE[word] for word in words & _GOOGLE.keys()}
    lines = ['syntax = "proto3";', f"package {PACKAGE};"]
    lines += [f'import "{path}";' for path in sorted(imports)]
    lines.append(f"message {message} {{ {body} }}")
    return "\n".join(lines)
