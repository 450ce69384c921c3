"""Cameras of a log, and where the sensor of a detection sits and looks."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mclass import transforms
from mclass.camera import Calibrations, are_rotations, has_focal_length
from mclass.logs import mounting
from mclass.logs.detections import clean_frames, read_stamps
from mclass.logs.sources import CameraSource
from mclass.logs.tables import Table
from mclass.model import CameraSettings, Model
from mclass.records import BoolArray, FloatArray, IntArray
from mclass.transforms import Transforms, TransformTree


@dataclass(frozen=True)
class CameraTrack:
    """The calibration of one camera over time.

    Attributes:
        topic: Its channel, empty for the model file's camera.
        frame: Its optical frame.
        stamps_ns: Increasing, (n,); empty for a calibration that always holds.
        rows: Row of ``calibrations`` from each stamp on, (n,).
        calibrations: Distinct calibrations, (m,).
    """

    topic: str
    frame: str
    stamps_ns: IntArray
    rows: IntArray
    calibrations: Calibrations

    def rows_at(self, query_ns: IntArray) -> IntArray:
        """The latest calibration at each time, the first before any."""
        if not len(self.stamps_ns):
            return np.zeros(len(query_ns), np.int64)
        latest = np.searchsorted(self.stamps_ns, query_ns, side="right") - 1
        return self.rows[np.maximum(latest, 0)]


@dataclass(frozen=True)
class Sensor:
    """The sensor of some looks.

    Attributes:
        frame: Its frame, empty if unknown.
        optical: Whether that frame looks along z (a camera) and not along x.
        camera: What turns its pixels into rays, None if nothing does.
        mount: Sensor in robot at each look, (m,); in the world if ``fixed``.
        mounted: At which looks that is known, (m,).
        fixed: Whether detections are given in a frame of the world; the robot is the sensor then.
        placed: Whether the mount was told, by the log or the model file, and not assumed.
        notes: How it was found.
    """

    frame: str
    optical: bool
    camera: CameraTrack | None
    mount: Transforms
    mounted: BoolArray
    fixed: bool
    placed: bool
    notes: tuple[str, ...]


def read_camera(
    table: Table, source: CameraSource, *, by_log_time: bool, rectified: bool = False
) -> CameraTrack | None:
    """Calibrations of one channel; None if it has no usable message.

    Args:
        table: The channel's messages.
        source: Where its fields are.
        by_log_time: Place calibrations by log time.
        rectified: Pixels are those of rectified images, which have no distortion and the
            intrinsics in P, as seen by a camera turned by R; where P was left zero, those in K.
    """
    if not len(table):
        return None
    frames = clean_frames(table.values(source.family.frame))
    names = table.values(source.fields["model"]) if "model" in source.fields else None
    model = str(names[-1]) if names is not None else ""
    kept = np.arange(len(table)) if names is None else np.flatnonzero(names == model)
    matrix = _lists(table, source.fields["intrinsics"], 9)[kept]
    intrinsics = matrix[:, [0, 4, 2, 5]]
    coefficients = np.zeros((len(kept), 0))
    turns = np.tile(np.eye(3), (len(kept), 1, 1))
    if rectified:
        model = ""
        if "projection" in source.fields:
            projected = _lists(table, source.fields["projection"], 12)[kept][:, [0, 5, 2, 6]]
            given = has_focal_length(projected)
            intrinsics = np.where(given[:, None], projected, intrinsics)
            if "rectification" in source.fields:
                turns[given] = _rectifications(_lists(table, source.fields["rectification"], 9))[
                    kept[given]
                ]
    elif "coefficients" in source.fields:
        coefficients = _lists(table, source.fields["coefficients"], None)[kept]
    sizes = np.stack([_numbers(table, source, key)[kept] for key in ("width", "height")], axis=1)
    binning = [_numbers(table, source, f"binning_{axis}")[kept] for axis in "xy"]
    offset = np.stack([_numbers(table, source, f"roi_{axis}")[kept] for axis in "xy"], axis=1)
    region = np.stack(
        [_numbers(table, source, f"roi_{key}")[kept] for key in ("width", "height")], axis=1
    )
    # Intrinsics are those of the full sensor; pixels are those of the part that was read out.
    scale = np.maximum(np.stack(binning, axis=1), 1.0)
    partial = (region > 0).all(axis=1, keepdims=True)
    intrinsics = np.concatenate(
        [
            intrinsics[:, :2] / scale,
            (intrinsics[:, 2:] - np.where(partial, offset, 0.0)) / scale,
        ],
        axis=1,
    )
    sizes = np.where(partial, region, sizes) / scale
    stamps = read_stamps(table, [source.family.stamp])[kept]
    log_times = table.log_times_ns[kept]
    stamps = log_times if by_log_time else np.where(stamps != 0, stamps, log_times)
    order = np.argsort(stamps, kind="stable")
    # A calibration with a number that is none is no calibration: without a focal length it is
    # refused where it is needed.
    # R turns the optical frame into that of the rectified image, its transpose back.
    back = np.swapaxes(turns, 1, 2).reshape(-1, 9)
    everything = np.concatenate([intrinsics, back, coefficients], axis=1)
    everything = np.where(transforms.finite_rows(everything)[:, None], everything, 0.0)
    everything = np.concatenate([everything, sizes], axis=1)
    distinct, rows = np.unique(everything[order], axis=0, return_inverse=True)
    calibrations = Calibrations(
        "" if not model and not coefficients.any() else model or "plumb_bob",
        distinct[:, :4],
        distinct[:, 13:-2],
        distinct[:, -2:],
        distinct[:, 4:13].reshape(-1, 3, 3) if rectified else None,
    )
    frame = next((name for name in frames[kept].tolist() if name), "")
    return CameraTrack(table.channel.topic, frame, stamps[order], rows.reshape(-1), calibrations)


def _rectifications(matrices: FloatArray) -> FloatArray:
    """R as rotations, (n, 3, 3): the identity where it was left zero, NaN where it is none."""
    matrices = matrices.reshape(-1, 3, 3)
    unknown = (matrices == 0.0).all(axis=(1, 2))
    good = are_rotations(matrices)
    result = np.where(unknown[:, None, None], np.eye(3), matrices)
    return np.where((unknown | good)[:, None, None], result, np.nan)


def settings_camera(settings: CameraSettings | None) -> CameraTrack | None:
    """The camera that the model file describes, None if it gives no intrinsics."""
    if settings is None or settings.intrinsics is None:
        return None
    size = settings.image_size or (0, 0)
    return CameraTrack(
        "",
        "",
        np.zeros(0, np.int64),
        np.zeros(0, np.int64),
        Calibrations(
            settings.distortion_model if settings.distortion else "",
            np.array([settings.intrinsics], dtype=float),
            np.array([settings.distortion], dtype=float).reshape(1, -1),
            np.array([size], dtype=float),
        ),
    )


def choose_camera(cameras: Sequence[CameraTrack], topic: str, frame: str) -> CameraTrack | None:
    """The camera of a detection topic: by its frame, else by namespace, else the only one."""
    named = [found for found in cameras if frame and found.frame == frame]
    candidates = named or list(cameras)
    if len(candidates) == 1:
        return candidates[0]
    shared = [_shared_names(found.topic, topic) for found in candidates]
    closest = [c for c, n in zip(candidates, shared, strict=True) if n == max(shared)]
    if candidates and (named or (max(shared) > 0 and len(closest) == 1)):
        return min(closest, key=lambda found: found.topic)
    return None


def find_sensor(
    topic: str,
    frame: str,
    stamps_ns: IntArray,
    world_and_robot: tuple[str, str],
    tree: TransformTree,
    cameras: Sequence[CameraTrack],
    model: Model | None,
    *,
    has_boxes: bool,
) -> Sensor:
    """Camera and mount of the looks of one topic and frame.

    The mount is, in this order: the model file's ``camera.mount``; the chain of transforms
    from the robot; the robot itself, looking ahead. An optical frame is one that boxes or a
    calibration belong to.

    Args:
        topic: Of the detections.
        frame: Of the detections; empty if they do not say.
        stamps_ns: When the mount is wanted, (m,).
        world_and_robot: Frames of the poses.
        tree: Of the log.
        cameras: Of the log.
        model: For its camera and the widest gap.
        has_boxes: Whether there are image boxes.
    """
    settings = model.log.camera if model is not None else None
    max_gap_ns = model.log.max_gap_ns if model is not None else 500_000_000
    notes = []
    used = settings_camera(settings) or choose_camera(cameras, topic, frame)
    # A calibration of another frame says nothing about a sensor that returns no boxes.
    if used is not None and not has_boxes and used.frame != frame and frame and used.topic:
        used = None
    optical = has_boxes or used is not None or "optical" in frame
    if used is not None and used.frame and (has_boxes or not frame):
        frame = used.frame
    world, robot = world_and_robot
    everywhere, placed, fixed = np.ones(len(stamps_ns), bool), True, False
    found = None
    if not optical and frame and (frame == world or _is_fixed(tree, robot, frame)):
        fixed = True
        found = tree.lookup(world, frame, stamps_ns, max_gap_ns)
        placed = found is not None or frame == world
        place = f"its own world frame, seen from {robot or 'the robot'}"
        mount, mounted = found or (transforms.identity(len(stamps_ns)), everywhere)
    elif settings is not None and settings.mount_xyz is not None:
        mount = mounting.mount_from_settings(settings.mount_xyz, settings.mount_rpy)
        mounted, place = everywhere, "the mount in the model file"
        mount = (mounting.add_optical_rotation(mount) if optical else mount).repeat(len(stamps_ns))
    else:
        if frame and robot and frame != robot:
            found = tree.lookup(robot, frame, stamps_ns, max_gap_ns)
        if found is None:
            ahead = transforms.identity(1)
            mount = mounting.add_optical_rotation(ahead) if optical else ahead
            mount, mounted = mount.repeat(len(stamps_ns)), everywhere
            place = "the robot's own place, looking ahead (no transform and no log.camera.mount)"
            placed = frame == robot and not optical
            if placed:
                place = "the frame of the poses"
        else:
            mount, mounted = found
            place = f"the transforms from {robot}"
            if optical and mounting.looks_straight_up(mount):
                mount = mounting.add_optical_rotation(mount)
                place += ", taken as a body frame (x ahead) since its z axis points up"
    notes.append(f"sensor {frame or 'without a frame'} of {topic}: placed by {place}")
    if has_boxes:
        notes.append(
            _camera_note(
                topic, used, cameras, rectified=settings is not None and settings.rectified
            )
        )
    return Sensor(frame, optical, used, mount, mounted, fixed, placed, tuple(notes))


def _is_fixed(tree: TransformTree, robot: str, frame: str) -> bool:
    """Whether a frame is reached from the robot only by undoing the robot's own motion."""
    path = tree.path(robot, frame) or []
    return any(not down and not link.static for link, down in path)


def _camera_note(
    topic: str, used: CameraTrack | None, cameras: Sequence[CameraTrack], *, rectified: bool
) -> str:
    """Which calibration turns boxes into directions, or why none does."""
    if used is not None:
        where = f"the calibration on {used.topic}" if used.topic else "the model file's camera"
        note = f"boxes of {topic}: pixels become directions by {where}"
        if rectified:
            return f"{note}, as those of rectified images (log.camera.rectified)"
        if "rect" in topic and used.calibrations.coefficients.any():
            note += (
                "; its distortion is undone, though the topic's name speaks of rectified images: "
                "if they are, set log.camera.rectified"
            )
        return note
    if cameras:
        topics = ", ".join(found.topic for found in cameras)
        return (
            f"boxes of {topic}: no calibration is certain to be theirs ({topics}); "
            "set log.camera_info"
        )
    return f"boxes of {topic}: no calibration in the log; set log.camera"


def _shared_names(first: str, second: str) -> int:
    """Number of leading names that two topics share."""
    pairs = zip(first.strip("/").split("/"), second.strip("/").split("/"), strict=False)
    return sum(1 for _ in itertools.takewhile(lambda pair: pair[0] == pair[1], pairs))


def _numbers(table: Table, source: CameraSource, key: str) -> FloatArray:
    """One number a message, 0 where the schema has none or it is not finite."""
    if key not in source.fields:
        return np.zeros(len(table))
    return np.nan_to_num(table.floats(source.fields[key]), nan=0.0, posinf=0.0, neginf=0.0)


def _lists(table: Table, path: str, size: int | None) -> FloatArray:
    """Lists or arrays of numbers as rows, zeros where a list is short; ``size`` None for any."""
    values = table.floats(path)
    if values.ndim == 2:
        return values
    spans = table.spans("", path)
    counts = np.diff(spans)
    width = int(counts.max(initial=0)) if size is None else size
    result = np.zeros((len(counts), min(width, 64)))
    column = np.arange(result.shape[1])
    filled = column < counts[:, None]
    result[filled] = values[(spans[:-1, None] + column)[filled]]
    return result
