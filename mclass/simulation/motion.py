"""Where the robot is, and where its odometry believes it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mclass.errors import ModelError
from mclass.geometry import (
    compose,
    integrate_twists,
    interpolate_poses,
    inverse,
    log,
    relative_pose,
    rotate,
    wrap_angle,
)
from mclass.records import FloatArray, IntArray
from mclass.simulation.camera import planar_mount
from mclass.simulation.scenario import CircleAround, DriveTo, Odometry, Scenario

MAX_DAYS = 30
"""Longest drive: more is a slip of units."""

_SECOND_NS = 1_000_000_000
_DAY_NS = 86_400 * _SECOND_NS


@dataclass(frozen=True)
class Path:
    """The true motion: constant twists between knots.

    Attributes:
        times_ns: Time of every knot since the start, strictly increasing, (k,).
        poses_world_robot: (k, 3).
        look_times_ns: When each scripted look happens, since the start.
        look_stops: Index of its stop in the trajectory.
    """

    times_ns: IntArray
    poses_world_robot: FloatArray
    look_times_ns: tuple[int, ...]
    look_stops: tuple[int, ...]

    def poses_at(self, times_ns: IntArray) -> FloatArray:
        """True poses at any times since the start, (n, 3)."""
        return interpolate_poses(self.times_ns, self.poses_world_robot, times_ns)


class _Driver:
    """Collects knots while it follows the stops."""

    def __init__(self, speed: float, turn_speed: float) -> None:
        self.speed = speed
        self.turn_speed = turn_speed
        self.times: list[int] = [0]
        self.poses: list[FloatArray] = []

    @property
    def pose(self) -> FloatArray:
        return self.poses[-1]

    def reach(self, pose: FloatArray, seconds: float) -> None:
        """Move to a pose along one twist."""
        if not self.poses:
            self.poses.append(pose)
        elif duration := round(seconds * _SECOND_NS):
            self.times.append(self.times[-1] + duration)
            self.poses.append(pose)

    def turn(self, heading: float) -> None:
        angle = abs(float(wrap_angle(heading - self.pose[2])))
        self.reach(np.array([*self.pose[:2], heading]), angle / self.turn_speed)

    def drive(self, position: FloatArray, heading: float | None) -> None:
        """Turn towards the position, drive there, turn to the heading."""
        if not self.poses:
            self.reach(np.array([*position, 0.0 if heading is None else heading]), 0.0)
            return
        way = position - self.pose[:2]
        distance = float(np.hypot(*way))
        if distance > 1e-9:
            self.turn(float(np.arctan2(way[1], way[0])))
            self.reach(np.array([*position, self.pose[2]]), distance / self.speed)
        if heading is not None:
            self.turn(heading)

    def circle(self, center: FloatArray, sweep: float) -> None:
        """Strafe around a point through ``sweep`` [rad], in steps of less than half a turn."""
        steps = max(1, int(np.ceil(abs(sweep) / (np.pi / 2.0))))
        start = self.pose
        seconds = abs(sweep) / steps * float(np.hypot(*(start[:2] - center))) / self.speed
        for step in range(1, steps + 1):
            angle = sweep * step / steps
            position = center + rotate(angle, start[:2] - center)
            self.reach(np.array([*position, wrap_angle(start[2] + angle)]), seconds)

    def stand(self, seconds: float) -> None:
        self.reach(self.pose, seconds)


def plan_path(scenario: Scenario) -> Path:
    """The motion that the trajectory's stops describe.

    Raises:
        ModelError: If it takes longer than `MAX_DAYS`.
    """
    pose_robot_sensor = planar_mount(scenario.camera)
    objects = {item.object_id: item for item in scenario.objects}
    driver = _Driver(scenario.trajectory.speed, scenario.trajectory.turn_speed)
    look_times: list[int] = []
    look_stops: list[int] = []
    for index, stop in enumerate(scenario.trajectory.stops):
        if isinstance(stop, DriveTo):
            driver.drive(np.array(stop.position), stop.heading)
            driver.stand(stop.wait)
            continue
        center = np.array(objects[stop.object_id].position)
        if isinstance(stop, CircleAround):
            direction = stop.from_direction
            offset = stop.distance * _unit(direction)
        elif stop.view is not None:
            offset = rotate(objects[stop.object_id].orientation, np.array(stop.view))
        else:
            offset = stop.distance * _unit(stop.direction)
        pose_world_sensor = np.array([*(center + offset), np.arctan2(-offset[1], -offset[0])])
        pose_world_robot = compose(pose_world_sensor, inverse(pose_robot_sensor))
        driver.drive(pose_world_robot[:2], float(pose_world_robot[2]))
        if isinstance(stop, CircleAround):
            driver.circle(center, stop.to_direction - stop.from_direction)
        else:
            arrived = driver.times[-1]
            driver.stand(stop.wait)
            if stop.labels:
                look_times.append((arrived + driver.times[-1]) // 2)
                look_stops.append(index)
    if driver.times[-1] > MAX_DAYS * _DAY_NS:
        raise ModelError(
            f"{scenario.name}: the drive would take {driver.times[-1] / _DAY_NS:,.0f} days, more "
            f"than {MAX_DAYS}. Check the positions' unit, the speed and the waits."
        )
    return Path(
        times_ns=np.array(driver.times, dtype=np.int64),
        poses_world_robot=np.array(driver.poses),
        look_times_ns=tuple(look_times),
        look_stops=tuple(look_stops),
    )


def _unit(direction: float) -> FloatArray:
    return np.array([np.cos(direction), np.sin(direction)])


@dataclass(frozen=True)
class OdometryRun:
    """What odometry reports.

    Attributes:
        poses_world_robot: With their errors, (n, 3).
        covariances: As claimed, of (x, y, heading) in the world frame, (n, 3, 3).
        twists: Forward and leftward speed [m/s] and turn rate [rad/s] as measured, (n, 3).
    """

    poses_world_robot: FloatArray
    covariances: FloatArray
    twists: FloatArray


def run_odometry(
    settings: Odometry, times_ns: IntArray, true_poses: FloatArray, rng: np.random.Generator
) -> OdometryRun:
    """Integrate measured motion with its independent errors, and their covariance.

    With errors δ_k ~ N(0, Q_k) in the robot's frame, the error of the pose, carried
    to the world's origin, is the sum of Ad(X_k) δ_k to first order; its covariance is
    therefore a running sum, moved back to where the robot is.

    Args:
        settings: Rates and errors.
        times_ns: Strictly increasing, (n,).
        true_poses: At these times, (n, 3).
        rng: Source of the errors.

    Returns:
        Exact where every error is zero.
    """
    seconds = np.diff(times_ns) * 1e-9
    steps = log(relative_pose(true_poses[:-1], true_poses[1:]))
    way, turn = np.hypot(steps[:, 0], steps[:, 1]), np.abs(steps[:, 2])
    walk = settings.position_drift**2 * seconds
    heading_variance = (
        settings.heading_by_distance**2 * way
        + settings.heading_by_turn**2 * turn
        + settings.heading_drift**2 * seconds
    )
    along = settings.position_by_distance**2 * way
    with np.errstate(invalid="ignore"):
        directions = np.where(way[:, None] > 0.0, steps[:, :2] / way[:, None], 0.0)
    step_covariances = np.zeros((len(steps), 3, 3))
    step_covariances[:, :2, :2] = (
        along[:, None, None] * directions[:, :, None] * directions[:, None, :]
    )
    step_covariances[:, 0, 0] += walk
    step_covariances[:, 1, 1] += walk
    step_covariances[:, 2, 2] = heading_variance

    normal = rng.standard_normal((len(steps), 4))
    noise = np.empty_like(steps)
    noise[:, :2] = (np.sqrt(along) * normal[:, 0])[:, None] * directions
    noise[:, :2] += np.sqrt(walk)[:, None] * normal[:, 1:3]
    noise[:, 2] = np.sqrt(heading_variance) * normal[:, 3]
    measured = steps + noise
    rates = np.concatenate([measured / seconds[:, None], np.zeros((1, 3))])
    # Summing steps costs a few ulps; without errors the poses must be the true ones exactly.
    poses = integrate_twists(times_ns, rates, true_poses[0]) if noise.any() else true_poses

    local = _from_first(true_poses)
    carried = _adjoint(local[:-1]) @ step_covariances @ _adjoint(local[:-1]).transpose(0, 2, 1)
    summed = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(carried, axis=0)])
    lever = np.broadcast_to(np.eye(3), summed.shape).copy()
    lever[:, 0, 2], lever[:, 1, 2] = -local[:, 1], local[:, 0]
    turn_world = _rotation(np.full(len(local), true_poses[0, 2]))
    to_world = turn_world @ lever
    covariances = settings.covariance_factor * to_world @ summed @ to_world.transpose(0, 2, 1)
    return OdometryRun(poses, 0.5 * (covariances + covariances.transpose(0, 2, 1)), rates)


def _from_first(poses: FloatArray) -> FloatArray:
    """Poses seen from the first of them, which keeps sums small far from the origin."""
    return relative_pose(np.broadcast_to(poses[0], poses.shape), poses)


def _rotation(headings: FloatArray) -> FloatArray:
    """Rotation of (x, y, heading) vectors, (n, 3, 3)."""
    matrices = np.broadcast_to(np.eye(3), (len(headings), 3, 3)).copy()
    cosine, sine = np.cos(headings), np.sin(headings)
    matrices[:, 0, 0] = matrices[:, 1, 1] = cosine
    matrices[:, 0, 1], matrices[:, 1, 0] = -sine, sine
    return matrices


def _adjoint(poses: FloatArray) -> FloatArray:
    """Adjoint of SE(2): a small motion in the body, as a motion about the origin, (n, 3, 3)."""
    matrices = _rotation(poses[:, 2])
    matrices[:, 0, 2], matrices[:, 1, 2] = poses[:, 1], -poses[:, 0]
    return matrices
