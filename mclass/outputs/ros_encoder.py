"""Results in a ROS 2 log: cdr throughout, standard messages wherever one fits."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np

from mclass.footprint import Grid
from mclass.messages import ros
from mclass.messages.prepared import Prepared
from mclass.outputs.encoder import Message, OutputContext, Schema, split_stamp
from mclass.outputs.raster import occupancy, pack_cells
from mclass.outputs.scene import ObjectScene, object_scene, quaternion_of
from mclass.outputs.values import (
    belief_value,
    estimate_value,
    measurement_values,
    refuse_nan,
)
from mclass.records import FloatArray, LabelMeasurements
from mclass.results import BeliefBlock, ClassMaps, ObjectEstimate

_ARROW, _CUBE, _TEXT = 0, 1, 9
_ADD, _DELETE_ALL = 0, 3
_TEXT_ID, _CUBE_ID, _FIRST_ARROW_ID = 0, 1, 2
_WHITE = (1.0, 1.0, 1.0, 1.0)
_POSE_NUMBERS = 7

_TYPES = {
    "objects": "vision_msgs/msg/Detection3DArray",
    "estimates": "mclass_msgs/msg/Estimates",
    "markers": "visualization_msgs/msg/MarkerArray",
    "grid": "foxglove_msgs/msg/Grid",
    "belief": "mclass_msgs/msg/Belief",
    "measurements": "mclass_msgs/msg/Measurements",
}
_OCCUPANCY = "nav_msgs/msg/OccupancyGrid"
_POSE = "geometry_msgs/msg/PoseStamped"


class RosEncoder:
    """Encoder of ROS 2 messages; see `encoder.Encoder`."""

    def __init__(self, context: OutputContext) -> None:
        self._context = context
        self._prepared: dict[str, tuple[ObjectEstimate, Prepared, Prepared, list[Prepared]]] = {}
        channels = {context.topic(name): _schema(type_name) for name, type_name in _TYPES.items()}
        for name in context.all_names:
            channels[context.class_topic(name)] = _schema(_OCCUPANCY)
        self.channels: Mapping[str, Schema] = channels

    def objects(
        self, estimates: Sequence[ObjectEstimate], changed: Sequence[ObjectEstimate], stamp_ns: int
    ) -> Iterator[Message]:
        """All objects three ways, and poses of those that changed."""
        for estimate in changed:
            self._prepare(estimate)
        entries = [self._prepared[estimate.object_id] for estimate in estimates]
        header = self._header(stamp_ns)
        clear = {"header": header, "action": _DELETE_ALL}
        yield self._message(
            "objects", {"header": header, "detections": [entry[1] for entry in entries]}
        )
        yield self._message(
            "estimates", {"header": header, "objects": [entry[2] for entry in entries]}
        )
        # Cleared first: an object that has fewer modes than before must lose their arrows.
        markers = [clear, *(marker for entry in entries for marker in entry[3])]
        yield self._message("markers", {"markers": markers})
        for estimate in changed:
            token = self._context.object_token(estimate.object_id)
            value = {"header": self._header(estimate.stamp_ns), "pose": _named_pose(estimate)}
            yield _encode(self._context.topic("pose", token), _POSE, value)

    def maps(self, maps: ClassMaps) -> Iterator[Message]:
        """One occupancy grid a class, and all classes in full precision."""
        refuse_nan("the class map", maps.class_probabilities, maps.untouched)
        context, grid = self._context, maps.grid
        header = self._header(maps.stamp_ns)
        info = {
            "map_load_time": header["stamp"],
            "resolution": grid.cell_size,
            "width": grid.columns,
            "height": grid.rows,
            "origin": _corner(grid),
        }
        for name, percent in zip(context.all_names, occupancy(maps), strict=True):
            value = {"header": header, "info": info, "data": percent}
            yield _encode(context.class_topic(name), _OCCUPANCY, value)
        packed = pack_cells(maps, context.all_names)
        yield self._message(
            "grid",
            {
                "timestamp": header["stamp"],
                "frame_id": context.frame,
                "pose": _corner(grid),
                "column_count": grid.columns,
                "cell_size": (grid.cell_size, grid.cell_size),
                "row_stride": packed.cell_stride * grid.columns,
                "cell_stride": packed.cell_stride,
                "fields": [
                    {"name": name, "offset": offset, "type": kind}
                    for name, offset, kind in packed.fields
                ],
                "data": packed.data,
            },
        )

    def belief(self, block: BeliefBlock) -> Iterator[Message]:
        """One block of a belief."""
        value = belief_value(block, self._context.class_names)
        yield self._message("belief", {"header": self._header(block.stamp_ns), **value})

    def measurements(self, measurements: LabelMeasurements) -> Iterator[Message]:
        """All measurements."""
        for value in measurement_values(measurements):
            stamps = value["frame_stamps_ns"]
            header = self._header(stamps[-1] if len(stamps) else 0)
            yield self._message("measurements", {"header": header, **value})

    def _message(self, name: str, value: Mapping[str, Any]) -> Message:
        return _encode(self._context.topic(name), _TYPES[name], value)

    def _header(self, stamp_ns: int) -> dict[str, Any]:
        seconds, nanoseconds = split_stamp(stamp_ns)
        stamp = {"sec": seconds, "nanosec": nanoseconds}
        return {"stamp": stamp, "frame_id": self._context.frame}

    def _prepare(self, estimate: ObjectEstimate) -> None:
        """Everything that messages repeat of one object until it changes."""
        header = self._header(estimate.stamp_ns)
        full = Prepared(estimate_value(estimate, self._context.class_names))
        detection = Prepared(_detection(estimate, self._context.all_names, header))
        scene = object_scene(estimate, self._context.class_names)
        namespace = self._context.object_token(estimate.object_id)
        markers = _markers(scene, namespace, self._context.arrow_length, header)
        self._prepared[estimate.object_id] = estimate, detection, full, markers


def _encode(topic: str, type_name: str, value: Mapping[str, Any]) -> Message:
    return Message(topic, _schema(type_name), ros.codec(type_name).encode(value))


@cache
def _schema(type_name: str) -> Schema:
    return Schema(type_name, "cdr", "ros2msg", ros.schema_text(type_name).encode())


def _pose(x: float, y: float, heading: float) -> tuple[float, ...]:
    """Numbers of a Pose."""
    return (x, y, 0.0, *quaternion_of(heading))


def _corner(grid: Grid) -> tuple[float, ...]:
    x, y = grid.origin
    return _pose(x, y, 0.0)


def _named_pose(estimate: ObjectEstimate) -> tuple[float, ...]:
    """Position and heaviest orientation given the named class."""
    x, y = estimate.position.tolist()
    return _pose(x, y, _orientation(estimate))


def _orientation(estimate: ObjectEstimate) -> float:
    if estimate.modes:
        return estimate.modes[0].orientation
    return float(estimate.class_poses[estimate.class_index, 2])


def _detection(
    estimate: ObjectEstimate, names: Sequence[str], header: Mapping[str, Any]
) -> dict[str, Any]:
    """A Detection3D with a result for the background and each class.

    The background's pose is the object's position without a turn. Covariances are known, and
    given, for the named class alone; the size of the object is not known.
    """
    x, y = estimate.position
    poses = [(x, y, 0.0), *estimate.class_poses]
    results = []
    for index, (name, (pose_x, pose_y, heading)) in enumerate(zip(names, poses, strict=True)):
        numbers: FloatArray = np.zeros(_POSE_NUMBERS + 36)
        numbers[:_POSE_NUMBERS] = _pose(pose_x, pose_y, heading)
        if index == 1 + estimate.class_index:
            covariance = numbers[_POSE_NUMBERS:].reshape(6, 6)
            covariance[0, 0], covariance[1, 1] = estimate.position_std**2
            covariance[5, 5] = estimate.modes[0].std ** 2 if estimate.modes else 0.0
        score = float(estimate.class_probabilities[index])
        results.append({"hypothesis": {"class_id": name, "score": score}, "pose": numbers})
    return {
        "header": header,
        "results": results,
        "bbox": {"center": _named_pose(estimate)},
        "id": estimate.object_id,
    }


def _markers(
    scene: ObjectScene, namespace: str, arrow: float, header: Mapping[str, Any]
) -> list[Prepared]:
    """Text, cube and arrows of one object; they follow the frame if that moves."""
    common = {"header": header, "ns": namespace, "action": _ADD, "frame_locked": True}
    text = {
        "id": _TEXT_ID,
        "type": _TEXT,
        "pose": (scene.x, scene.y, arrow, 0.0, 0.0, 0.0, 1.0),
        "scale": (0.0, 0.0, arrow / 3.0),
        "color": _WHITE,
        "text": scene.text,
    }
    cube = {
        "id": _CUBE_ID,
        "type": _CUBE,
        "pose": _pose(scene.x, scene.y, 0.0),
        "scale": (arrow / 4.0,) * 3,
        "color": (*scene.color, 1.0),
    }
    arrows = [
        {
            "id": _FIRST_ARROW_ID + index,
            "type": _ARROW,
            "pose": _pose(scene.x, scene.y, heading),
            "scale": (arrow, arrow / 10.0, arrow / 10.0),
            "color": (*scene.color, opacity),
        }
        for index, (heading, opacity) in enumerate(scene.arrows)
    ]
    return [Prepared({**common, **marker}) for marker in (text, cube, *arrows)]
