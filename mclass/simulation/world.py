"""A scenario played through: what the robot's sensors report, and the truth behind it.

Arrays in, arrays out; no file is opened. `simulate` makes a whole drive, from which
`write.write_log` makes a log; `simulate_measurements` gives at once what reading that log would.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mclass.errors import ModelError
from mclass.geometry import compose, interpolate_poses, relative_pose, wrap_angle
from mclass.records import BoolArray, FloatArray, Frames, IntArray, LabelMeasurements, PoseTrack
from mclass.simulation.camera import azimuths, planar_mount, project_boxes
from mclass.simulation.detections import (
    Detections,
    clutter_detections,
    joined,
    real_detections,
    scripted_detections,
    to_measurements,
)
from mclass.simulation.motion import Path, plan_path, run_odometry
from mclass.simulation.recognition import Looks, draw_labels, label_probabilities
from mclass.simulation.scenario import Scenario, Script

MAX_MESSAGES = 500_000
"""Most of one kind in a drive."""

MAX_LOOKS = 1_000_000
"""Most frames times objects: more would take gigabytes while they are drawn."""

_SECOND_NS = 1_000_000_000
_ODOMETRY, _DETECTION, _CLUTTER, _CAMERA = range(4)
"""Streams of random numbers: changing what one part draws leaves the others as they were."""


@dataclass(frozen=True)
class Truth:
    """What really stood where, and where the sensor really was.

    Attributes:
        object_ids: (o).
        class_names: Of each object.
        poses: x [m], y [m], orientation [rad], (o, 3).
        against_wall: (o,).
        poses_world_sensor: In every detector frame, (f, 3).
    """

    object_ids: tuple[str, ...]
    class_names: tuple[str, ...]
    poses: FloatArray
    against_wall: BoolArray
    poses_world_sensor: FloatArray


@dataclass(frozen=True)
class Drive:
    """Everything that happened.

    Attributes:
        scenario: Played through.
        seed: Of all that was drawn.
        track: Odometry's poses.
        twists: Speeds [m/s, m/s, rad/s] as measured with each pose, (n, 3).
        frames: Detector frames, with sensor poses as odometry has them.
        info_stamps_ns: Of camera calibration messages.
        detections: What the detector published.
        truth: What it should have.
    """

    scenario: Scenario
    seed: int
    track: PoseTrack
    twists: FloatArray
    frames: Frames
    info_stamps_ns: IntArray
    detections: Detections
    truth: Truth


def simulate(scenario: Scenario, seed: int | None = None) -> Drive:
    """Play a scenario through.

    Args:
        scenario: Checked scenario.
        seed: Instead of the scenario's own.

    Returns:
        The same drive for the same scenario and seed.

    Raises:
        ModelError: If a scripted look does not have its object in the image, or the drive
            is too long.
    """
    seed = scenario.seed if seed is None else seed
    path = plan_path(scenario)
    camera = scenario.camera
    end = int(path.times_ns[-1])
    if isinstance(scenario.detector, Script):
        frame_times = np.array(path.look_times_ns, dtype=np.int64)
    else:
        frame_times = _ticks(camera.rate, end, offset=0.5)
    # Odometry reports at every frame's own time as well, so that no frame needs interpolation
    # where the script is to be met exactly.
    times = _ticks(scenario.odometry.rate, end)
    if isinstance(scenario.detector, Script):
        times = np.union1d(times, frame_times)
    run = run_odometry(
        scenario.odometry, times, path.poses_at(times), np.random.default_rng([seed, _ODOMETRY])
    )
    track = PoseTrack(
        frame=scenario.world_frame,
        child_frame=scenario.robot_frame,
        stamps_ns=scenario.start_ns + times,
        poses_world_child=run.poses_world_robot,
        covariances=run.covariances if run.covariances.any() else None,
    )
    poses_world_robot = path.poses_at(frame_times)
    pose_robot_sensor = planar_mount(camera)
    truth = Truth(
        object_ids=tuple(item.object_id for item in scenario.objects),
        class_names=tuple(item.class_name for item in scenario.objects),
        poses=np.array([[*item.position, item.orientation] for item in scenario.objects]),
        against_wall=np.array([item.against_wall for item in scenario.objects], dtype=bool),
        poses_world_sensor=compose(poses_world_robot, pose_robot_sensor),
    )
    latency = np.random.default_rng([seed, _CAMERA]).uniform(*camera.latency, len(frame_times))
    stamps = scenario.start_ns + frame_times
    frames = _frames(
        scenario,
        track,
        stamps,
        stamps + scenario.log_clock_offset_ns + np.round(latency * _SECOND_NS).astype(np.int64),
    )
    return Drive(
        scenario=scenario,
        seed=seed,
        track=track,
        twists=run.twists,
        frames=frames,
        info_stamps_ns=scenario.start_ns + _ticks(camera.info_rate, end),
        detections=_detect(scenario, seed, path, poses_world_robot, truth),
        truth=truth,
    )


def simulate_measurements(
    scenario: Scenario, seed: int | None = None
) -> tuple[LabelMeasurements, Truth]:
    """A scenario's label measurements without a log between, and the truth.

    The measurements are those that reading the log of the same scenario and seed gives.
    """
    drive = simulate(scenario, seed)
    return to_measurements(drive.detections, scenario, drive.frames), drive.truth


def _ticks(rate: float, end_ns: int, offset: float = 0.0) -> IntArray:
    """Times [ns] of a steady rate from ``offset`` periods after 0 up to the end."""
    count = int(np.floor(end_ns * 1e-9 * rate - offset + 1e-9)) + 1
    if count > MAX_MESSAGES:
        raise ModelError(
            f"{count:,} messages at {rate:g} a second are more than {MAX_MESSAGES:,}. "
            "Lower the rate, or make the drive shorter."
        )
    return np.round((np.arange(count) + offset) * (_SECOND_NS / rate)).astype(np.int64)


def _frames(
    scenario: Scenario, track: PoseTrack, stamps_ns: IntArray, log_times_ns: IntArray
) -> Frames:
    """Frames with the sensor where odometry puts it, and its covariance there."""
    camera = scenario.camera
    poses_world_robot = interpolate_poses(track.stamps_ns, track.poses_world_child, stamps_ns)
    poses_world_sensor = compose(poses_world_robot, planar_mount(camera))
    width, height = camera.image_size
    borders = azimuths(camera, np.array([float(width), 0.0]), np.full(2, height / 2.0))
    return Frames(
        stamps_ns=stamps_ns,
        log_times_ns=log_times_ns,
        poses_world_sensor=poses_world_sensor,
        covariances=_sensor_covariances(track, stamps_ns, poses_world_robot, poses_world_sensor),
        view_directions=wrap_angle(poses_world_robot[:, 2, None] + borders),
    )


def _sensor_covariances(
    track: PoseTrack,
    stamps_ns: IntArray,
    poses_world_robot: FloatArray,
    poses_world_sensor: FloatArray,
) -> FloatArray | None:
    """Covariance of the robot, interpolated, carried along the lever to the sensor."""
    if track.covariances is None:
        return None
    after = np.clip(np.searchsorted(track.stamps_ns, stamps_ns), 1, len(track.stamps_ns) - 1)
    before = after - 1
    span = track.stamps_ns[after] - track.stamps_ns[before]
    fraction = np.clip((stamps_ns - track.stamps_ns[before]) / span, 0.0, 1.0)[:, None, None]
    robot = (1.0 - fraction) * track.covariances[before] + fraction * track.covariances[after]
    offset = poses_world_sensor[:, :2] - poses_world_robot[:, :2]
    lever = np.broadcast_to(np.eye(3), robot.shape).copy()
    lever[:, 0, 2], lever[:, 1, 2] = -offset[:, 1], offset[:, 0]
    return np.asarray(lever @ robot @ lever.transpose(0, 2, 1))


def _detect(
    scenario: Scenario, seed: int, path: Path, poses_world_robot: FloatArray, truth: Truth
) -> Detections:
    """What the detector publishes for all frames."""
    n_frames, n_objects = len(poses_world_robot), len(scenario.objects)
    if n_frames * n_objects > MAX_LOOKS:
        raise ModelError(
            f"{scenario.name}: {n_frames:,} frames of {n_objects:,} objects are more than "
            f"{MAX_LOOKS:,} looks. Lower the camera's rate, or make the drive shorter."
        )
    camera, detector = scenario.camera, scenario.detector
    boxes, visible = project_boxes(camera, scenario.objects, poses_world_robot)
    if isinstance(detector, Script):
        return scripted_detections(scenario, path.look_stops, boxes, visible)
    poses_sensor_object = relative_pose(truth.poses_world_sensor[:, None], truth.poses[None])
    distances = np.hypot(poses_sensor_object[..., 0], poses_sensor_object[..., 1])
    bearings = np.arctan2(poses_sensor_object[..., 1], poses_sensor_object[..., 0])
    in_range = (distances >= camera.min_range) & (distances <= camera.max_range)
    radii = np.array([np.hypot(*item.size[:2]) / 2.0 for item in scenario.objects])
    looks = Looks(
        views=relative_pose(truth.poses[None], truth.poses_world_sensor[:, None])[..., :2],
        bearings=bearings,
        seen=visible & in_range & ~_hidden(distances, bearings, radii),
    )
    probabilities = label_probabilities(scenario, looks)
    rng = np.random.default_rng([seed, _DETECTION])
    returned = draw_labels(detector, looks, probabilities, rng)
    real = real_detections(returned, probabilities, boxes, camera, detector.errors, rng=rng)
    clutter = clutter_detections(
        n_frames,
        len(scenario.label_names),
        n_objects,
        camera,
        detector.errors,
        rng=np.random.default_rng([seed, _CLUTTER]),
    )
    both = joined(real, clutter)
    if detector.errors.without_ids:
        return replace(both, id_index=np.full(len(both), -1))
    return both


def _hidden(distances: FloatArray, bearings: FloatArray, radii: FloatArray) -> BoolArray:
    """Whether a nearer object stands before an object's centre, (f, o)."""
    half_widths = np.arcsin(np.minimum(radii / np.maximum(distances, 1e-9), 1.0))
    apart = np.abs(wrap_angle(bearings[:, :, None] - bearings[:, None, :]))
    nearer = distances[:, None, :] < distances[:, :, None]
    return np.asarray(np.any(nearer & (apart < half_widths[:, None, :]), axis=2))
