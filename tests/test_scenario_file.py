"""Scenario files: what they mean, and what is said about wrong ones."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from mclass.errors import ConfigError
from mclass.simulation.motion import plan_path
from mclass.simulation.scenario import (
    Camera,
    CircleAround,
    DriveTo,
    Errors,
    LookAt,
    ModelDetector,
    Odometry,
    Recogniser,
    Response,
    Script,
)
from mclass.simulation.scenario_file import load_scenario, parse_scenario

CONFIGS = Path(__file__).parent.parent / "configs"
SCENARIOS = sorted((CONFIGS / "scenarios").glob("*.yaml"))

SCRIPT = """\
length_unit: dm
start: 2024-02-29T12:00:00.25+01:00
log_clock_offset: -86400.5
seed: 9
frames: {world: map, robot: base}
objects:
  o1: {class: c1, position: [5, -2], orientation_deg: 90}
  o2: {class: c2, position: [0, 1], orientation_deg: -45, size: [1, 2, 3], against_wall: true}
trajectory:
  speed: 5
  turn_speed_deg: 90
  stops:
    - {position: [1, 2], heading_deg: 180, wait: 3}
    - {look_at: o1, view: [2, -10], wait: 2, labels: [c1, c2]}
    - {look_at: o2, direction_deg: 30, distance: 12}
    - {around: o2, distance: 8, from_deg: 10, to_deg: -20}
detector: {kind: script}
"""


def test_everything_ends_in_metres_radians_and_nanoseconds() -> None:
    scenario = parse_scenario(SCRIPT, "s.yaml")
    assert scenario.start_ns == 1_709_204_400_250_000_000
    assert scenario.log_clock_offset_ns == -86_400_500_000_000
    assert (scenario.world_frame, scenario.robot_frame, scenario.seed) == ("map", "base", 9)
    first, second = scenario.objects
    assert first.object_id == "o1"
    assert first.position == pytest.approx((0.5, -0.2))
    assert first.orientation == pytest.approx(math.pi / 2)
    assert (second.class_name, second.against_wall) == ("c2", True)
    assert second.size == pytest.approx((0.1, 0.2, 0.3))
    assert scenario.trajectory.speed == pytest.approx(0.5)
    assert scenario.trajectory.turn_speed == pytest.approx(math.pi / 2)
    drive, look, other, circle = scenario.trajectory.stops
    assert isinstance(drive, DriveTo)
    assert isinstance(look, LookAt)
    assert isinstance(other, LookAt)
    assert isinstance(circle, CircleAround)
    assert drive.position == pytest.approx((0.1, 0.2))
    assert drive.heading == pytest.approx(math.pi)
    assert drive.wait == 3.0
    assert look.view == pytest.approx((0.2, -1.0))
    assert look.labels == ("c1", "c2")
    assert other.view is None
    assert (other.direction, other.distance) == pytest.approx((math.pi / 6, 1.2))
    assert circle.distance == pytest.approx(0.8)
    assert (circle.from_direction, circle.to_direction) == pytest.approx(
        (math.radians(10), math.radians(-20))
    )
    assert isinstance(scenario.detector, Script)
    assert scenario.label_names == ("c1", "c2")


def test_sensors_and_detectors_in_another_unit() -> None:
    text = SCRIPT.replace("labels: [c1, c2]", "labels: []").replace(
        "detector: {kind: script}",
        """\
odometry:
  rate: 50
  position_by_distance: 0.4
  heading_by_distance_deg: 2
  heading_by_turn_deg: 3
  position_drift: 0.5
  heading_drift_deg: 4
  covariance_factor: 0.5
camera:
  rate: 15
  info_rate: 2
  fx: 400
  width: 800
  mount: {position: [1, 2, 3], rpy_deg: [0, 90, 0]}
  range: [3, 40]
  latency: [0.1, 0.1]
  box_noise: 3
detector:
  kind: recogniser
  range: [6, 30]
  range_edge: 2
  responses:
    c1:
      c1: [{direction_deg: 90, half_width_deg: 45}]
    c2:
      c1: [{direction_deg: 0, half_width_deg: 30, shape: von_mises, peak: 0.5, edge_deg: 9}]
  correlation: {direction_deg: 18, distance: 3, independent: 0.4}
  errors: {miss: 0.1, label_noise: 0.2, clutter: 1.5, clutter_with_id: 0.3, wrong_id: 0.4,
           without_ids: true}
""",
    )
    scenario = parse_scenario(text, "s.yaml")
    # After 4 dm the error is 0.8 dm: 0.4 sqrt(4); in metres 0.08 = x sqrt(0.4).
    assert scenario.odometry.position_by_distance * math.sqrt(0.4) == pytest.approx(0.08)
    assert scenario.odometry.heading_by_distance * math.sqrt(0.4) == pytest.approx(math.radians(4))
    expected = (50, math.radians(3), 0.05, math.radians(4), 0.5)
    odometry = scenario.odometry
    assert isinstance(odometry, Odometry)
    assert (
        odometry.rate,
        odometry.heading_by_turn,
        odometry.position_drift,
        odometry.heading_drift,
        odometry.covariance_factor,
    ) == pytest.approx(expected)
    camera = scenario.camera
    assert camera.intrinsics == (400.0, *Camera().intrinsics[1:])
    assert camera.image_size == (800, 480)
    assert camera.mount_xyz == pytest.approx((0.1, 0.2, 0.3))
    assert camera.mount_rpy == pytest.approx((0.0, math.pi / 2, 0.0))
    assert (camera.min_range, camera.max_range) == pytest.approx((0.3, 4.0))
    assert (camera.rate, camera.info_rate, camera.latency, camera.box_noise) == (
        15.0,
        2.0,
        (0.1, 0.1),
        3.0,
    )
    detector = scenario.detector
    assert isinstance(detector, Recogniser)
    assert (detector.near, detector.far, detector.range_edge) == pytest.approx((0.6, 3.0, 0.2))
    assert detector.responses["c2", "c1"] == (
        Response(0.0, math.radians(30), "von_mises", 0.5, math.radians(9)),
    )
    assert detector.errors == Errors(0.1, 0.2, 1.5, 0.3, 0.4, without_ids=True)
    correlation = detector.correlation
    assert (correlation.direction, correlation.distance, correlation.independent) == pytest.approx(
        (math.radians(18), 0.3, 0.4)
    )


@pytest.mark.parametrize(
    ("given", "stamp"),
    [
        ("1700000000123456789", 1_700_000_000_123_456_789),
        ('"2023-11-14T22:13:20.123456789Z"', 1_700_000_000_123_456_789),
        ("2023-11-15 00:13:20+02:00", 1_700_000_000_000_000_000),
    ],
)
def test_start_times(given: str, stamp: int) -> None:
    text = SCRIPT.replace("2024-02-29T12:00:00.25+01:00", given)
    assert parse_scenario(text, "s.yaml").start_ns == stamp


WRONG = [
    ("start: 2024-02-29T12:00:00.25+01:00", "start: noon", 2, "start", "nanoseconds since 1970"),
    ("start: 2024-02-29", "start: 2023-02-29", 2, "start", "nanoseconds since 1970"),
    ("start: 2024-02", "start: 2124-02", 2, "start", "before 2038"),
    ("log_clock_offset: -86400.5", "log_clock_offset: -9e9", 3, "log_clock_offset", "before 1970"),
    ("seed: 9", "sede: 9", 4, "sede", "Did you mean 'seed'"),
    ("class: c1, ", "", 7, "objects.o1.class", "missing"),
    ("against_wall: true", "against_wall: yes", 8, "objects.o2.against_wall", "true"),
    ("size: [1, 2, 3]", "size: [1, 2]", 8, "objects.o2.size", "length, width, height"),
    ("speed: 5", "speed: 0", 10, "trajectory.speed", "at least 0.01"),
    ("look_at: o1", "look_at: o3", 14, "trajectory.stops[1].look_at", "unknown object 'o3'"),
    ("wait: 2, labels", "labels", 14, "trajectory.stops[1]", "half-way through wait"),
    ("view: [2, -10]", "view: [0, 0]", 14, "trajectory.stops[1].view", "own centre"),
    ("view: [2, -10]", "distance: 10", 14, "trajectory.stops[1]", "direction_deg and distance"),
    (", distance: 12}", "}", 15, "trajectory.stops[2]", "direction_deg and distance"),
    (", to_deg: -20", "", 16, "trajectory.stops[3].to_deg", "missing"),
    ("around: o2, ", "", 16, "trajectory.stops[3]", "position, look_at, around"),
    ("kind: script", "kind: oracle", 17, "detector.kind", "recogniser"),
    ("kind: script", "peak: 1", 17, "detector", "needs a kind"),
    ("kind: script", "kind: script, peak: 1", 17, "detector.peak", "unknown key"),
    ("labels: [c1, c2]", "labels: []", 17, "detector", "none does"),
    ("kind: script", "kind: model", 17, "detector", "needs a model"),
    ("kind: script", "kind: recogniser", 17, "detector.responses", "missing"),
    ("length_unit: dm", "model: nothing.yaml", 1, "model", "cannot be used"),
]


@pytest.mark.parametrize(("old", "new", "line", "key", "message"), WRONG)
def test_faults_name_their_place(old: str, new: str, line: int, key: str, message: str) -> None:
    assert old in SCRIPT
    with pytest.raises(ConfigError) as caught:
        parse_scenario(SCRIPT.replace(old, new, 1), "s.yaml")
    found = [(p.line, p.key) for p in caught.value.problems if message in p.message]
    assert (line, key) in found, caught.value


def test_all_faults_are_found_in_one_run() -> None:
    text = SCRIPT.replace("seed: 9", "seed: x").replace("speed: 5", "speed: fast")
    with pytest.raises(ConfigError) as caught:
        parse_scenario(text.replace("view: [2, -10]", "view: 2"), "s.yaml")
    keys = {problem.key for problem in caught.value.problems}
    assert keys >= {"seed", "trajectory.speed", "trajectory.stops[1].view"}


def test_names_must_be_those_of_the_model() -> None:
    text = f"model: {CONFIGS / 'paper_toy.yaml'}\n" + SCRIPT.replace("class: c2", "class: c3")
    with pytest.raises(ConfigError) as caught:
        parse_scenario(text.replace("[c1, c2]", "[c1, c4]"), "s.yaml")
    messages = " ".join(problem.message for problem in caught.value.problems)
    assert "unknown class 'c3'" in messages
    assert "unknown label of the model 'c4'" in messages


def test_a_wrong_model_is_reported_with_its_own_lines(tmp_path: Path) -> None:
    (tmp_path / "model.yaml").write_text("viewpoints: 3\n")
    scenario = tmp_path / "s.yaml"
    scenario.write_text("model: model.yaml\n" + SCRIPT)
    with pytest.raises(ConfigError) as caught:
        load_scenario(scenario)
    paths = {problem.path for problem in caught.value.problems}
    assert paths == {str(scenario), str(tmp_path / "model.yaml")}


@pytest.mark.parametrize("path", SCENARIOS, ids=lambda path: path.stem)
def test_the_robot_of_a_scenario_that_we_ship_drives_through_nothing(path: Path) -> None:
    scenario = load_scenario(path)
    assert scenario.model is not None
    assert not isinstance(scenario.detector, ModelDetector)
    driven = plan_path(scenario)
    poses = driven.poses_at(np.arange(0, driven.times_ns[-1], 50_000_000))
    for item in scenario.objects:
        distance = np.hypot(*(poses[:, :2] - item.position).T)
        assert distance.min() > 0.45, item.object_id
