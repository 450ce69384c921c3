"""What a scenario file describes, as frozen dataclasses: metres, radians, seconds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from mclass.model import Model


@dataclass(frozen=True)
class SceneObject:
    """A labelled box standing on the ground.

    Attributes:
        object_id: As the detector reports it.
        class_name: Its true class.
        position: Of its centre [m].
        orientation: Of its frame in the world [rad].
        size: Extent along its own x, y and z [m].
        against_wall: Told in the truth only: this one cannot be seen from behind.
    """

    object_id: str
    class_name: str
    position: tuple[float, float]
    orientation: float
    size: tuple[float, float, float] = (0.28, 0.28, 0.37)
    against_wall: bool = False


@dataclass(frozen=True)
class DriveTo:
    """Drive straight to ``position`` [m], end with ``heading`` [rad] if given, stand [s]."""

    position: tuple[float, float]
    heading: float | None = None
    wait: float = 0.0


@dataclass(frozen=True)
class LookAt:
    """Drive to where the sensor looks straight at an object, and stand there [s].

    The sensor's place is given from the object: either ``direction`` (a world azimuth
    [rad]) and ``distance`` [m], or ``view``, a point in the object's own frame [m].
    A scripted detector returns ``labels`` half-way through ``wait``.
    """

    object_id: str
    direction: float = 0.0
    distance: float = 0.0
    view: tuple[float, float] | None = None
    wait: float = 0.0
    labels: tuple[str, ...] = ()


@dataclass(frozen=True)
class CircleAround:
    """Strafe around an object, the sensor looking at it from ``distance`` [m] all the way.

    Directions are world azimuths [rad] of the sensor seen from the object; the circle is
    driven counter-clockwise when ``to_direction`` is the greater.
    """

    object_id: str
    distance: float
    from_direction: float
    to_direction: float


Stop = DriveTo | LookAt | CircleAround


@dataclass(frozen=True)
class Trajectory:
    """Stops in order; the robot starts standing at the first.

    Between stops it turns on the spot, drives straight and turns on the spot.
    ``speed`` [m/s] and ``turn_speed`` [rad/s] hold everywhere.
    """

    stops: tuple[Stop, ...]
    speed: float = 0.4
    turn_speed: float = 0.8


@dataclass(frozen=True)
class Odometry:
    """How often odometry reports, how it errs, and how much of that it admits.

    Every standard deviation is that of an independent error after one unit and grows with the
    square root of the way, the turn or the time, so the covariance is known exactly.

    Attributes:
        rate: Messages per second.
        position_by_distance: Error along the way [m per sqrt(m)].
        heading_by_distance: [rad per sqrt(m)].
        heading_by_turn: [rad per sqrt(rad)].
        position_drift: Random walk of the position, standing or not [m per sqrt(s)].
        heading_drift: Random walk of the heading, standing or not [rad per sqrt(s)].
        covariance_factor: What the messages claim, as a multiple of the true covariance.
    """

    rate: float = 20.0
    position_by_distance: float = 0.0
    heading_by_distance: float = 0.0
    heading_by_turn: float = 0.0
    position_drift: float = 0.0
    heading_drift: float = 0.0
    covariance_factor: float = 1.0


@dataclass(frozen=True)
class Camera:
    """A pinhole camera on the robot, and the detector's pace behind it.

    Attributes:
        rate: Detector frames per second; a scripted detector has a frame at each of its
            measurements instead.
        info_rate: Camera calibration messages per second.
        image_size: Width and height [pixel].
        intrinsics: fx, fy, cx, cy [pixel].
        mount_xyz: Camera on the robot [m].
        mount_rpy: Roll, pitch and yaw of the camera body (x forward, y left, z up) [rad];
            positive pitch looks down.
        min_range: Objects nearer than this are not detected [m].
        max_range: Nor are objects farther than this [m].
        latency: Shortest and longest time from image to log [s].
        box_noise: Standard deviation of each edge of a box [pixel].
    """

    rate: float = 5.0
    info_rate: float = 1.0
    image_size: tuple[int, int] = (640, 480)
    intrinsics: tuple[float, float, float, float] = (457.0, 457.0, 319.5, 239.5)
    mount_xyz: tuple[float, float, float] = (0.1, 0.0, 0.3)
    mount_rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    min_range: float = 0.3
    max_range: float = 4.0
    latency: tuple[float, float] = (0.05, 0.13)
    box_noise: float = 0.0


@dataclass(frozen=True)
class Script:
    """Returns what the stops say, when they say it, and nothing else."""


@dataclass(frozen=True)
class Correlation:
    """How far apart two looks must be for their errors to differ.

    Attributes:
        direction: Correlation length of errors over the direction of view [rad].
        distance: The same over the range [m].
        independent: Share of the error's variance that is new in every frame, 0..1.
    """

    direction: float = 0.2
    distance: float = 0.3
    independent: float = 0.2


@dataclass(frozen=True)
class Errors:
    """What goes wrong beside recognition itself; every figure is a probability.

    Attributes:
        miss: An object that was recognised is not reported.
        label_noise: A label of a reported object flips: dropped if returned, added if not.
        clutter: Mean number of detections per frame that lie on no object.
        clutter_with_id: A clutter detection carries some object's id.
        wrong_id: A real detection carries another object's id.
        without_ids: No detection has an id at all.
    """

    miss: float = 0.0
    label_noise: float = 0.0
    clutter: float = 0.0
    clutter_with_id: float = 0.0
    wrong_id: float = 0.0
    without_ids: bool = False


@dataclass(frozen=True)
class ModelDetector:
    """Draws from the model itself: each label is returned or not, by its own probability.

        P(label | class, view) = false_alarm + (1 - false_alarm) peak p(label | class, view) / s

    where p is the model's density and s its greatest value over labels and views of the class.
    """

    peak: float = 0.95
    false_alarm: float = 0.01
    correlation: Correlation = Correlation()
    errors: Errors = Errors()


@dataclass(frozen=True)
class Response:
    """One side from which one label is returned.

    Attributes:
        direction: Middle of the side, in the object's frame [rad].
        half_width: Where the response has fallen to half [rad].
        shape: ``flat`` stays at its peak and then cuts off; ``von_mises`` is a round lobe.
        peak: Greatest probability.
        edge: Width over which a flat response falls [rad].
    """

    direction: float
    half_width: float
    shape: Literal["flat", "von_mises"] = "flat"
    peak: float = 0.98
    edge: float = 0.07


@dataclass(frozen=True)
class Recogniser:
    """A recogniser that is not the model: sides with flat tops, cut off by range.

    Attributes:
        responses: By (class name, label name); responses to one label combine as
            independent chances.
        near: Range below which recognition fades [m].
        far: Range beyond which it fades [m].
        range_edge: Width over which it fades [m].
        correlation: Of recognition and of every error on a real object.
        errors: What goes wrong besides.
    """

    responses: Mapping[tuple[str, str], tuple[Response, ...]]
    near: float = 0.5
    far: float = 3.0
    range_edge: float = 0.15
    correlation: Correlation = Correlation()
    errors: Errors = Errors()


Detector = Script | ModelDetector | Recogniser


@dataclass(frozen=True)
class Scenario:
    """A whole scenario.

    Attributes:
        name: File name as shown to people.
        start_ns: Header stamp of the first message.
        log_clock_offset_ns: Log clock minus the clock of the header stamps.
        seed: Of all that is drawn, unless another is asked for.
        objects: What stands in the world.
        trajectory: Of the robot.
        odometry: Its own idea of that.
        camera: What it looks with.
        detector: What is returned.
        world_frame: Name of the odometry frame.
        robot_frame: Name of the robot's frame.
        model: Model file to attach to the log; needed by a `ModelDetector`.
    """

    name: str
    objects: tuple[SceneObject, ...]
    trajectory: Trajectory
    detector: Detector
    start_ns: int = 1_318_248_000_000_000_000
    log_clock_offset_ns: int = 0
    seed: int = 0
    odometry: Odometry = Odometry()
    camera: Camera = Camera()
    world_frame: str = "odom"
    robot_frame: str = "base_link"
    model: Model | None = field(default=None, repr=False)

    @property
    def label_names(self) -> tuple[str, ...]:
        """Every label that may be returned: the model's, else the detector's in order."""
        if self.model is not None:
            return self.model.classes.label_names
        if isinstance(self.detector, Recogniser):
            return tuple(dict.fromkeys(label for _, label in self.detector.responses))
        stops = (stop for stop in self.trajectory.stops if isinstance(stop, LookAt))
        return tuple(dict.fromkeys(label for stop in stops for label in stop.labels))
