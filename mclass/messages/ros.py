"""The ROS 2 messages that we write: their definitions, schemas and codecs."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

from mclass import resources
from mclass.messages.cdr import CdrCodec
from mclass.messages.definitions import normalise_name, parse_definitions

# Fields alone, as released for Humble and later.
_FIELDS: Mapping[str, str] = {
    "builtin_interfaces/Duration": "int32 sec, uint32 nanosec",
    "builtin_interfaces/Time": "int32 sec, uint32 nanosec",
    "foxglove_msgs/Grid": (
        "builtin_interfaces/Time timestamp, string frame_id, geometry_msgs/Pose pose, "
        "uint32 column_count, foxglove_msgs/Vector2 cell_size, uint32 row_stride, "
        "uint32 cell_stride, foxglove_msgs/PackedElementField[] fields, uint8[] data"
    ),
    "foxglove_msgs/PackedElementField": (
        "string name, uint32 offset, uint8 UNKNOWN=0, uint8 UINT8=1, uint8 INT8=2, "
        "uint8 UINT16=3, uint8 INT16=4, uint8 UINT32=5, uint8 INT32=6, uint8 FLOAT32=7, "
        "uint8 FLOAT64=8, uint8 type"
    ),
    "foxglove_msgs/Vector2": "float64 x, float64 y",
    "geometry_msgs/Point": "float64 x, float64 y, float64 z",
    "geometry_msgs/Pose": "geometry_msgs/Point position, geometry_msgs/Quaternion orientation",
    "geometry_msgs/Pose2D": "float64 x, float64 y, float64 theta",
    "geometry_msgs/PoseStamped": "std_msgs/Header header, geometry_msgs/Pose pose",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose, float64[36] covariance",
    "geometry_msgs/Quaternion": "float64 x, float64 y, float64 z, float64 w",
    "geometry_msgs/Transform": (
        "geometry_msgs/Vector3 translation, geometry_msgs/Quaternion rotation"
    ),
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header, string child_frame_id, geometry_msgs/Transform transform"
    ),
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear, geometry_msgs/Vector3 angular",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist, float64[36] covariance",
    "geometry_msgs/Vector3": "float64 x, float64 y, float64 z",
    "nav_msgs/MapMetaData": (
        "builtin_interfaces/Time map_load_time, float32 resolution, uint32 width, "
        "uint32 height, geometry_msgs/Pose origin"
    ),
    "nav_msgs/OccupancyGrid": "std_msgs/Header header, nav_msgs/MapMetaData info, int8[] data",
    "nav_msgs/Odometry": (
        "std_msgs/Header header, string child_frame_id, geometry_msgs/PoseWithCovariance pose, "
        "geometry_msgs/TwistWithCovariance twist"
    ),
    "sensor_msgs/CameraInfo": (
        "std_msgs/Header header, uint32 height, uint32 width, string distortion_model, "
        "float64[] d, float64[9] k, float64[9] r, float64[12] p, uint32 binning_x, "
        "uint32 binning_y, sensor_msgs/RegionOfInterest roi"
    ),
    "sensor_msgs/CompressedImage": "std_msgs/Header header, string format, uint8[] data",
    "sensor_msgs/RegionOfInterest": (
        "uint32 x_offset, uint32 y_offset, uint32 height, uint32 width, bool do_rectify"
    ),
    "std_msgs/ColorRGBA": "float32 r, float32 g, float32 b, float32 a",
    "std_msgs/Header": "builtin_interfaces/Time stamp, string frame_id",
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "vision_msgs/BoundingBox2D": "vision_msgs/Pose2D center, float64 size_x, float64 size_y",
    "vision_msgs/BoundingBox3D": "geometry_msgs/Pose center, geometry_msgs/Vector3 size",
    "vision_msgs/Detection2D": (
        "std_msgs/Header header, vision_msgs/ObjectHypothesisWithPose[] results, "
        "vision_msgs/BoundingBox2D bbox, string id"
    ),
    "vision_msgs/Detection2DArray": (
        "std_msgs/Header header, vision_msgs/Detection2D[] detections"
    ),
    "vision_msgs/Detection3D": (
        "std_msgs/Header header, vision_msgs/ObjectHypothesisWithPose[] results, "
        "vision_msgs/BoundingBox3D bbox, string id"
    ),
    "vision_msgs/Detection3DArray": (
        "std_msgs/Header header, vision_msgs/Detection3D[] detections"
    ),
    "vision_msgs/ObjectHypothesis": "string class_id, float64 score",
    "vision_msgs/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis, geometry_msgs/PoseWithCovariance pose"
    ),
    "vision_msgs/Point2D": "float64 x, float64 y",
    "vision_msgs/Pose2D": "vision_msgs/Point2D position, float64 theta",
    "visualization_msgs/Marker": (
        "int32 ARROW=0, int32 CUBE=1, int32 SPHERE=2, int32 CYLINDER=3, int32 LINE_STRIP=4, "
        "int32 LINE_LIST=5, int32 CUBE_LIST=6, int32 SPHERE_LIST=7, int32 POINTS=8, "
        "int32 TEXT_VIEW_FACING=9, int32 MESH_RESOURCE=10, int32 TRIANGLE_LIST=11, "
        "int32 ADD=0, int32 MODIFY=0, int32 DELETE=2, int32 DELETEALL=3, "
        "std_msgs/Header header, string ns, int32 id, int32 type, int32 action, "
        "geometry_msgs/Pose pose, geometry_msgs/Vector3 scale, std_msgs/ColorRGBA color, "
        "builtin_interfaces/Duration lifetime, bool frame_locked, geometry_msgs/Point[] points, "
        "std_msgs/ColorRGBA[] colors, string texture_resource, "
        "sensor_msgs/CompressedImage texture, visualization_msgs/UVCoordinate[] uv_coordinates, "
        "string text, string mesh_resource, visualization_msgs/MeshFile mesh_file, "
        "bool mesh_use_embedded_materials"
    ),
    "visualization_msgs/MarkerArray": "visualization_msgs/Marker[] markers",
    "visualization_msgs/MeshFile": "string filename, uint8[] data",
    "visualization_msgs/UVCoordinate": "float32 u, float32 v",
}


@cache
def schema_text(name: str) -> str:
    """Schema of a message as logs embed it: its definition, then those it uses.

    Args:
        name: ``package/msg/Type`` or ``package/Type``; of ours or one of the standard
            messages known here.

    Raises:
        MclassError: If the message is not known here.
    """
    root = normalise_name(name)
    names = [root]
    texts = []
    for current in names:  # grows while it is walked
        text = _definition_text(current)
        texts.append(text if current == root else f"{'=' * 80}\nMSG: {current}\n{text}")
        names.extend(used for used in _used_types(text) if used not in names)
    return "".join(texts)


@cache
def codec(name: str) -> CdrCodec:
    """Encoder and decoder of a message; see `schema_text` for the names."""
    return CdrCodec(parse_definitions(name, schema_text(name), "ros2msg"), normalise_name(name))


def _definition_text(name: str) -> str:
    """Definition of one type, ending with a line break."""
    if name in _FIELDS:
        return "\n".join(_FIELDS[name].split(", ")) + "\n"
    package, _, type_name = name.partition("/")
    return resources.read_text("schemas", f"{package}/msg/{type_name}.msg")


def _used_types(text: str) -> list[str]:
    """Types of other packages' or own messages that a definition names."""
    words = [line.split()[0] for line in text.splitlines() if line and not line.startswith("#")]
    return list(dict.fromkeys(word.partition("[")[0] for word in words if "/" in word))
