"""The tree of frames in a log, and where on the robot a sensor sits."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from mclass import transforms
from mclass.logs.channels import ChannelInfo
from mclass.logs.detections import clean_frames
from mclass.logs.families import TRANSFORMS, TransformFamily, plain_schema_name
from mclass.logs.tables import Table
from mclass.records import BoolArray, FloatArray, IntArray, Tally
from mclass.transforms import Link, Transforms, TransformTree

_ROBOT_FRAMES = ("base_link", "base_footprint")


@dataclass(frozen=True)
class _Edges:
    """Transform messages, one row each."""

    parents: list[str]
    children: list[str]
    stamps_ns: IntArray
    transforms: Transforms
    static: BoolArray


def transform_family(channel: ChannelInfo) -> TransformFamily | None:
    """How the channel's transforms are laid out; None if it holds none."""
    name = plain_schema_name(channel.schema_name)
    return next((family for family in TRANSFORMS if name in family.schemas), None)


def transform_paths(family: TransformFamily, paths: Mapping[str, str]) -> tuple[str, ...] | None:
    """Fields of a transform channel; None if the schema lacks one."""
    wanted = (
        family.stamp,
        family.parent,
        family.child,
        *(f"{family.translation}.{axis}" for axis in "xyz"),
        *(f"{family.rotation}.{axis}" for axis in "xyzw"),
    )
    return wanted if all(path in paths for path in wanted) else None


def is_static_topic(topic: str) -> bool:
    """Whether transforms on a topic hold for ever."""
    return topic.rstrip("/").endswith("static")


def read_tree(tables: Iterable[Table], tally: Tally) -> TransformTree:
    """All links of the transform channels.

    A link is static if it comes from a static topic or never changes. Of several stamps that
    are equal the last wins.
    """
    edges = [found for table in tables if (found := _edges(table, tally)) is not None]
    if not edges:
        return TransformTree()
    parents = np.array([name for part in edges for name in part.parents], dtype=object)
    children = np.array([name for part in edges for name in part.children], dtype=object)
    stamps = np.concatenate([part.stamps_ns for part in edges])
    static = np.concatenate([part.static for part in edges])
    moved = Transforms(
        np.concatenate([part.transforms.translations for part in edges]),
        np.concatenate([part.transforms.rotations_xyzw for part in edges]),
    )
    rotations, turned = transforms.normalize_quaternions(moved.rotations_xyzw)
    usable = (
        turned
        & transforms.finite_rows(moved.translations, transforms.MAX_DISTANCE)
        & (parents != children)
    )
    tally.add("transform that is no rigid motion", int((~usable).sum()))
    moved = Transforms(moved.translations, rotations)
    keys: dict[tuple[str, str], int] = {}
    pairs = zip(parents.tolist(), children.tolist(), strict=True)
    codes = np.array([keys.setdefault(pair, len(keys)) for pair in pairs], dtype=np.int64)
    links = []
    for (parent, child), code in keys.items():
        rows = np.flatnonzero((codes == code) & usable)
        if len(rows):
            links.append(_link(parent, child, stamps[rows], moved.take(rows), static[rows]))
    # Static links first: where a link is published both ways, the static topic is right.
    return TransformTree(sorted(links, key=lambda link: not link.static))


def robot_frame(tree: TransformTree, sensor_frame: str, world_frame: str = "") -> str:
    """The frame whose motion carries a sensor: the root of the static tree that holds it.

    Args:
        tree: Of the log.
        sensor_frame: Of the detections.
        world_frame: The frame of the poses, where the climb ends.
    """
    chain = tree.ancestors(sensor_frame, static_only=True)
    if world_frame in chain:
        chain = chain[: max(chain.index(world_frame), 1)]
    return chain[-1]


def moving_frame(tree: TransformTree, sensor_frame: str) -> tuple[str, str] | None:
    """World and robot frame of a transform chain: the root, and the robot on the way to it.

    The robot is the frame called ``base_link`` or ``base_footprint`` if there is one on the
    way, else the root of the static tree that holds the sensor. None if nothing moves.
    """
    chain = tree.ancestors(sensor_frame)
    if len(chain) < 2:
        return None
    named = [f for f in chain[:-1] if f.rpartition("/")[2] in _ROBOT_FRAMES]
    robot = named[-1] if named else robot_frame(tree, sensor_frame, chain[-1])
    return chain[-1], robot


def mount_from_settings(xyz: tuple[float, ...], rpy: tuple[float, ...]) -> Transforms:
    """One transform, sensor body in robot, from the model file."""
    rotation = transforms.from_roll_pitch_yaw(np.array(rpy, dtype=float))
    return Transforms(np.array([xyz], dtype=float), rotation[None, :])


def add_optical_rotation(mount: Transforms) -> Transforms:
    """Optical frame in robot, from the camera body in robot."""
    optical = Transforms(np.zeros((1, 3)), transforms.OPTICAL_ROTATION[None, :])
    return transforms.compose(mount, optical)


def looks_straight_up(mount: Transforms) -> bool:
    """Whether the z axis of a frame is the robot's vertical: no camera looks there."""
    axes: FloatArray = transforms.rotate(mount.rotations_xyzw, np.array([0.0, 0.0, 1.0]))
    return bool(len(axes) and (axes[:, 2] > np.cos(np.deg2rad(1.0))).all())


def _edges(table: Table, tally: Tally) -> _Edges | None:
    """Rows of a transform channel."""
    family = transform_family(table.channel)
    if family is None:
        return None
    if table.failures:
        tally.add("transform message that could not be read", sum(table.failures.values()))
    message = table.parents("", family.element) if family.element else np.arange(len(table))
    header = np.maximum(table.values(family.stamp).astype(np.int64), 0)
    stamps = np.where(header != 0, header, table.log_times_ns[message])
    static = np.full(len(stamps), is_static_topic(table.channel.topic))
    return _Edges(
        clean_frames(table.values(family.parent)).tolist(),
        clean_frames(table.values(family.child)).tolist(),
        stamps,
        Transforms(
            np.stack([table.floats(f"{family.translation}.{axis}") for axis in "xyz"], axis=1),
            np.stack([table.floats(f"{family.rotation}.{axis}") for axis in "xyzw"], axis=1),
        ),
        static,
    )


def _link(parent: str, child: str, stamps: IntArray, moved: Transforms, static: BoolArray) -> Link:
    """One link; from a static topic its last value alone counts."""
    order = np.argsort(stamps, kind="stable")
    order = order[np.append(np.diff(stamps[order]) > 0, True)]
    same = np.allclose(moved.translations, moved.translations[0], rtol=0, atol=1e-9) and bool(
        (np.abs(moved.rotations_xyzw @ moved.rotations_xyzw[0]) > 1 - 1e-12).all()
    )
    if static.all():
        order = order[-1:]
    if static.all() or same:
        return Link(parent, child, stamps[order], moved.take(order), static=True)
    rows = order[~static[order]]
    return Link(parent, child, stamps[rows], moved.take(rows), static=False)
