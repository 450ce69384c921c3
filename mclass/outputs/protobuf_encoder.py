"""Results in any other log: protobuf, Foxglove's messages wherever one fits."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any

from mclass.footprint import Grid
from mclass.messages import proto_files, proto_json, protobuf
from mclass.messages.prepared import Prepared
from mclass.outputs.encoder import Message, OutputContext, Schema, split_stamp
from mclass.outputs.raster import pack_cells
from mclass.outputs.scene import ObjectScene, object_scene, quaternion_of
from mclass.outputs.values import belief_value, estimate_value, measurement_values, refuse_nan
from mclass.records import LabelMeasurements
from mclass.results import BeliefBlock, ClassMaps, ObjectEstimate

_WHITE = (1.0, 1.0, 1.0, 1.0)
_TYPES = {
    "objects": "mclass.Objects",
    "scene": "foxglove.SceneUpdate",
    "grid": "foxglove.Grid",
    "belief": "mclass.Belief",
    "measurements": "mclass.Measurements",
}
_POSE = "foxglove.PoseInFrame"


class ProtobufEncoder:
    """Encoder of protobuf messages; see `encoder.Encoder`."""

    def __init__(self, context: OutputContext, json_objects: bool) -> None:
        """With ``json_objects`` the objects, which people read, are JSON."""
        self._context = context
        self._json = frozenset(["mclass.Objects"] if json_objects else [])
        self._prepared: dict[str, tuple[ObjectEstimate, Prepared, Prepared]] = {}
        self.channels: Mapping[str, Schema] = {
            context.topic(name): self._schema(type_name) for name, type_name in _TYPES.items()
        }

    def objects(
        self, estimates: Sequence[ObjectEstimate], changed: Sequence[ObjectEstimate], stamp_ns: int
    ) -> Iterator[Message]:
        """All objects, their scene, and poses of those that changed."""
        for estimate in changed:
            self._prepare(estimate)
        entries = [self._prepared[estimate.object_id] for estimate in estimates]
        value = {
            "stamp_ns": int(stamp_ns),
            "frame": self._context.frame,
            "objects": [entry[1] for entry in entries],
        }
        yield self._message("objects", value)
        # An entity replaces the one with its id, so arrows of modes that are gone go too.
        yield self._message("scene", {"entities": [entry[2] for entry in entries]})
        for estimate in changed:
            token = self._context.object_token(estimate.object_id)
            x, y = estimate.position.tolist()
            pose = _pose(x, y, _orientation(estimate))
            value = {**self._header(estimate.stamp_ns), "pose": pose}
            yield self._encode(self._context.topic("pose", token), _POSE, value)

    def maps(self, maps: ClassMaps) -> Iterator[Message]:
        """All classes in one grid."""
        refuse_nan("the class map", maps.class_probabilities, maps.untouched)
        grid = maps.grid
        packed = pack_cells(maps, self._context.all_names)
        yield self._message(
            "grid",
            {
                **self._header(maps.stamp_ns),
                "pose": _corner(grid),
                "column_count": grid.columns,
                "cell_size": (grid.cell_size, grid.cell_size),
                "row_stride": packed.cell_stride * grid.columns,
                "cell_stride": packed.cell_stride,
                "fields": packed.fields,
                "data": packed.data.data,
            },
        )

    def belief(self, block: BeliefBlock) -> Iterator[Message]:
        """One block of a belief."""
        value = belief_value(block, self._context.class_names)
        yield self._message("belief", {**self._header(block.stamp_ns), **value})

    def measurements(self, measurements: LabelMeasurements) -> Iterator[Message]:
        """All measurements."""
        for value in measurement_values(measurements):
            stamps = value["frame_stamps_ns"]
            header = self._header(stamps[-1] if len(stamps) else 0)
            yield self._message("measurements", {**header, **value})

    def _message(self, name: str, value: Mapping[str, Any]) -> Message:
        return self._encode(self._context.topic(name), _TYPES[name], value)

    def _encode(self, topic: str, type_name: str, value: Mapping[str, Any]) -> Message:
        codecs = proto_json if type_name in self._json else protobuf
        return Message(topic, self._schema(type_name), codecs.codec(type_name).encode(value))

    def _schema(self, type_name: str) -> Schema:
        return _json_schema(type_name) if type_name in self._json else _protobuf_schema(type_name)

    def _header(self, stamp_ns: int) -> dict[str, Any]:
        return {"timestamp": split_stamp(stamp_ns), "frame_id": self._context.frame}

    def _prepare(self, estimate: ObjectEstimate) -> None:
        """Everything that messages repeat of one object until it changes."""
        value = Prepared(estimate_value(estimate, self._context.class_names))
        scene = object_scene(estimate, self._context.class_names)
        entity = {
            **self._header(estimate.stamp_ns),
            "id": self._context.object_token(estimate.object_id),
            # It follows the frame if that moves.
            "frame_locked": True,
            **_primitives(scene, self._context.arrow_length),
        }
        self._prepared[estimate.object_id] = estimate, value, Prepared(entity)


@cache
def _protobuf_schema(type_name: str) -> Schema:
    return Schema(type_name, "protobuf", "protobuf", proto_files.descriptor_set(type_name))


@cache
def _json_schema(type_name: str) -> Schema:
    return Schema(type_name, "json", "jsonschema", proto_json.schema_text(type_name).encode())


def _pose(x: float, y: float, heading: float, z: float = 0.0) -> tuple[Any, ...]:
    """Position and orientation of a Pose."""
    return (x, y, z), quaternion_of(heading)


def _corner(grid: Grid) -> tuple[Any, ...]:
    x, y = grid.origin
    return _pose(x, y, 0.0)


def _orientation(estimate: ObjectEstimate) -> float:
    if estimate.modes:
        return estimate.modes[0].orientation
    return float(estimate.class_poses[estimate.class_index, 2])


def _primitives(scene: ObjectScene, arrow: float) -> dict[str, Any]:
    """Text, cube and arrows of one object."""
    return {
        "arrows": [
            {
                "pose": _pose(scene.x, scene.y, heading),
                "shaft_length": 0.8 * arrow,
                "shaft_diameter": 0.1 * arrow,
                "head_length": 0.2 * arrow,
                "head_diameter": 0.2 * arrow,
                "color": (*scene.color, opacity),
            }
            for heading, opacity in scene.arrows
        ],
        "cubes": [
            {
                "pose": _pose(scene.x, scene.y, 0.0),
                "size": (arrow / 4.0,) * 3,
                "color": (*scene.color, 1.0),
            }
        ],
        "texts": [
            {
                "pose": _pose(scene.x, scene.y, 0.0, arrow),
                "billboard": True,
                "font_size": arrow / 3.0,
                "color": _WHITE,
                "text": scene.text,
            }
        ],
    }
