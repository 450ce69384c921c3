"""The simulated camera: boxes of objects in the image, and directions of pixels."""

from __future__ import annotations

import numpy as np

from mclass import transforms
from mclass.records import BoolArray, FloatArray
from mclass.simulation.scenario import Camera, SceneObject

_NEAREST_DEPTH = 0.05
"""Corners beside or behind the lens are drawn from this depth [m], far outside the image."""

_LEAST_VISIBLE = 0.5
"""Share of an object's box that must lie in the image."""


def mount_quaternion(camera: Camera) -> FloatArray:
    """Rotation of the camera body (x forward, y left, z up) on the robot, x, y, z, w, (4,)."""
    return transforms.from_roll_pitch_yaw(np.array(camera.mount_rpy))


def planar_mount(camera: Camera) -> FloatArray:
    """Pose of the sensor on the robot in the ground plane: x, y, azimuth of the axis, (3,)."""
    axis = transforms.rotate(mount_quaternion(camera), np.array([1.0, 0.0, 0.0]))
    return np.array([camera.mount_xyz[0], camera.mount_xyz[1], np.arctan2(axis[1], axis[0])])


def project_boxes(
    camera: Camera, objects: tuple[SceneObject, ...], poses_world_robot: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Boxes of all objects in all frames.

    Args:
        camera: Intrinsics and mounting.
        objects: (o).
        poses_world_robot: (f, 3).

    Returns:
        Left, top, right and bottom edge [pixel], cut off at the image's border, (f, o, 4),
        and whether at least half of the box is inside the image, (f, o).
    """
    corners = np.array([_corners(item) for item in objects]).reshape(-1, 3)
    offsets = corners[:, :2] - poses_world_robot[:, None, :2]
    cosine, sine = np.cos(poses_world_robot[:, 2, None]), np.sin(poses_world_robot[:, 2, None])
    robot = np.stack(
        [
            cosine * offsets[..., 0] + sine * offsets[..., 1],
            cosine * offsets[..., 1] - sine * offsets[..., 0],
            np.broadcast_to(corners[:, 2], offsets.shape[:2]),
        ],
        axis=-1,
    )
    back = transforms.conjugate(mount_quaternion(camera))
    body = transforms.rotate(back, robot - np.array(camera.mount_xyz))
    fx, fy, cx, cy = camera.intrinsics
    depth = np.maximum(body[..., 0], _NEAREST_DEPTH)
    columns = (cx - fx * body[..., 1] / depth).reshape(len(offsets), len(objects), 8)
    rows = (cy - fy * body[..., 2] / depth).reshape(len(offsets), len(objects), 8)
    whole = np.stack(
        [columns.min(axis=2), rows.min(axis=2), columns.max(axis=2), rows.max(axis=2)], axis=-1
    )
    boxes = clip_boxes(camera, whole)
    in_front = np.all(body[..., 0].reshape(len(offsets), len(objects), 8) > _NEAREST_DEPTH, axis=2)
    return boxes, in_front & (_areas(boxes) >= _LEAST_VISIBLE * _areas(whole))


def clip_boxes(camera: Camera, boxes: FloatArray) -> FloatArray:
    """Boxes cut off at the image's border, (..., 4)."""
    width, height = camera.image_size
    return np.clip(boxes, 0.0, np.array([width, height, width, height], dtype=float))


def azimuths(camera: Camera, columns: FloatArray, rows: FloatArray) -> FloatArray:
    """Directions of pixels on the ground plane, from the robot's heading [rad]."""
    fx, fy, cx, cy = camera.intrinsics
    body = np.stack([np.ones_like(columns), (cx - columns) / fx, (cy - rows) / fy], axis=-1)
    robot = transforms.rotate(mount_quaternion(camera), body)
    return np.asarray(np.arctan2(robot[..., 1], robot[..., 0]))


def _corners(item: SceneObject) -> FloatArray:
    """World coordinates of the eight corners [m], (8, 3)."""
    length, width, height = item.size
    x, y, z = np.meshgrid([-length / 2.0, length / 2.0], [-width / 2.0, width / 2.0], [0.0, height])
    cosine, sine = np.cos(item.orientation), np.sin(item.orientation)
    return np.stack(
        [
            item.position[0] + (cosine * x - sine * y).ravel(),
            item.position[1] + (sine * x + cosine * y).ravel(),
            z.ravel(),
        ],
        axis=-1,
    )


def _areas(boxes: FloatArray) -> FloatArray:
    return (boxes[..., 2] - boxes[..., 0]) * (boxes[..., 3] - boxes[..., 1])
