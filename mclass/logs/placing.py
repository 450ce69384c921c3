"""Where the sensor was at each look, and which way it looked: poses, mounts and cameras joined."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from mclass import camera, geometry, transforms
from mclass.blockwise import blocks
from mclass.errors import ModelError
from mclass.logs import directions
from mclass.logs.inputs import Inputs
from mclass.logs.sensors import Sensor
from mclass.records import BoolArray, FloatArray, IntArray


@dataclass
class PlacedLooks:
    """The sensor at each look; rows without a pose or mount hold zeros.

    Attributes:
        posed: Which looks have a pose, (m,).
        mounted: Which know where the sensor sits, (m,).
        sensor_index: Index into the inputs' sensors, (m,).
        rotations: Sensor in the world, (m, 4).
        poses: x, y, heading of the sensor, (m, 3).
        shifts: What to add to positions in the sensor's frame, turned into the world, (m, 3).
        covariances: Of ``poses``, (m, 3, 3), or None.
        views: World azimuths of the right and left border of the view, (m, 2), or NaN.
    """

    posed: BoolArray
    mounted: BoolArray
    sensor_index: IntArray
    rotations: FloatArray
    poses: FloatArray
    shifts: FloatArray
    covariances: FloatArray | None
    views: FloatArray


def place_looks(inputs: Inputs, max_gap_ns: int) -> PlacedLooks:
    """Where the sensor was at each look, and which way it looked."""
    track, count = inputs.track, inputs.detections.n_looks
    looks = PlacedLooks(
        posed=track.covered(inputs.stamps_ns, max_gap_ns),
        mounted=np.zeros(count, bool),
        sensor_index=np.zeros(count, np.int64),
        rotations=np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)),
        poses=np.zeros((count, 3)),
        shifts=np.zeros((count, 3)),
        covariances=None,
        views=np.full((count, 2), np.nan),
    )
    if track.poses.covariances is not None:
        looks.covariances = np.zeros((count, 3, 3))
    for index, (sensor, rows) in enumerate(inputs.sensors):
        looks.sensor_index[rows] = index
        looks.mounted[rows] = sensor.mounted
        posed = np.flatnonzero(looks.posed[rows])
        for part in blocks(len(posed)):
            _place_sensor(inputs, looks, sensor, rows[posed[part]], posed[part])
    return looks


def _place_sensor(
    inputs: Inputs, looks: PlacedLooks, sensor: Sensor, rows: IntArray, posed: IntArray
) -> None:
    """Fill in the looks ``rows`` of one sensor, which have poses."""
    if not len(rows):
        return
    robot, tilts, covariances = inputs.track.at(inputs.stamps_ns[rows])
    mount = sensor.mount.take(posed)
    heading = robot[:, 2].copy()
    if sensor.fixed:
        rotations = mount.rotations_xyzw
        lever = np.zeros((len(rows), 2))
        ground = np.column_stack([robot[:, :2], np.zeros(len(rows))])
        looks.shifts[rows] = mount.translations - ground
    else:
        body = transforms.multiply(transforms.from_heading(robot[:, 2]), tilts)
        rotations = transforms.multiply(body, mount.rotations_xyzw)
        lever = transforms.rotate(body, mount.translations)[:, :2]
        forward = np.array([0.0, 0.0, 1.0] if sensor.optical else [1.0, 0.0, 0.0])
        azimuth, level = camera.ray_azimuths(rotations, np.tile(forward, (len(rows), 1)))
        heading = np.where(level, azimuth, heading)
    looks.rotations[rows] = rotations
    looks.poses[rows] = np.column_stack([robot[:, :2] + lever, geometry.wrap_angle(heading)])
    if covariances is not None and looks.covariances is not None:
        # The sensor swings with the heading at the end of its lever.
        jacobian = np.tile(np.eye(3), (len(rows), 1, 1))
        jacobian[:, 0, 2], jacobian[:, 1, 2] = -lever[:, 1], lever[:, 0]
        looks.covariances[rows] = jacobian @ covariances @ np.swapaxes(jacobian, 1, 2)
    if sensor.camera is not None:
        calibrations = sensor.camera.calibrations
        which = sensor.camera.rows_at(inputs.stamps_ns[rows])
        # What is wrong with a calibration is said where boxes need it.
        with suppress(ModelError):
            looks.views[rows] = directions.view_directions(calibrations, which, rotations)
