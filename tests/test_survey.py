"""What a log holds and what of it would be used; times as people type them."""

from __future__ import annotations

from datetime import datetime, timezone
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scene_logs import (
    START,
    SceneLog,
    at,
    box,
    detection,
    header,
    make_model,
    standing_robot,
    xyz,
    xyzw,
)

from mclass.config.model_file import parse_model
from mclass.errors import UsageError
from mclass.initialise import template_for
from mclass.logs.reader import LogReader
from mclass.logs.survey import ChannelUse, Survey, survey
from mclass.logs.times import find_time_bound
from mclass.model import FieldMapping, Model

SECOND = 10**9


def look_through(path: Path, model: Model | None = None) -> Survey:
    with LogReader.open(path) as reader:
        return survey(reader, model)


def use_of(found: Survey, topic: str) -> ChannelUse:
    (use,) = [use for use in found.channels if use.topic == topic]
    return use


@pytest.fixture
def log(tmp_path: Path) -> SceneLog:
    return SceneLog(tmp_path / "scene.mcap")


def test_every_channel_has_a_use_and_a_reason(log: SceneLog) -> None:
    standing_robot(log)
    log.camera(0.0, topic="/back/camera_info", frame="back")
    log.add("/chatter", "std_msgs/msg/String", at(0.0), {"data": "hello"})
    log.add(
        "/mclass/objects",
        "vision_msgs/msg/Detection3DArray",
        at(0.0),
        {"header": header(0.0, "odom"), "detections": []},
    )
    pose = {"position": xyz(0, 0, 0), "orientation": xyzw((0, 0, 0, 1))}
    log.add(
        "/pose", "geometry_msgs/msg/PoseStamped", at(0.0), {"header": header(0, "m"), "pose": pose}
    )
    log.transform(0.0, "odom", "base_link", (0, 0, 0), (0, 0, 0, 1), topic="/tf")
    for time in (1.0, 1.5, 9.0):
        log.detections(time, [detection({"cup": 0.9, "pan": 0.1}, identity="a"), detection({})])
    log.add("/notes", "foxglove.ImageAnnotations", at(3.0), {"texts": [], "points": []})
    found = look_through(log.close(), make_model())
    used = {use.topic: (use.role, use.used, use.why) for use in found.channels}
    assert used == {
        "/back/camera_info": ("camera", False, "of no sensor in use"),
        "/camera/camera_info": ("camera", True, "calibration"),
        "/camera/detections": ("detections", True, "Detection2DArray"),
        "/chatter": ("", False, "not a type that is read"),
        "/mclass/objects": ("detections", False, "written by an earlier run"),
        "/notes": ("detections", False, "its schema has no labels where its type has them"),
        "/odom": ("pose", True, "Odometry"),
        "/pose": ("pose", False, "/odom (Odometry) is preferred"),
        "/tf": ("transforms", False, "not needed"),
        "/tf_static": ("transforms", True, "where the sensor sits"),
    }
    assert [use.topic for use in found.channels] == sorted(used)
    odometry = use_of(found, "/odom")
    assert (odometry.count, odometry.encoding, odometry.schema) == (
        31,
        "json",
        "nav_msgs/msg/Odometry",
    )
    assert odometry.rate == pytest.approx(31 / 9.1)
    assert found.detections == ("/camera/detections",)
    assert (found.pose_topic, found.pose_kind, found.pose_count) == ("/odom", "Odometry", 31)
    assert (found.world_frame, found.robot_frame) == ("odom", "base_link")
    assert found.labels == {"cup": 3, "pan": 3}
    assert found.unknown_labels == {"pan": 3}
    assert (found.looks, found.detection_count, found.ids, found.placed) == (3, 6, 1, 2)
    (sensor,) = found.sensors
    assert (sensor.frame, sensor.camera_topic) == ("camera", "/camera/camera_info")
    assert (sensor.image_size, sensor.calibrated, sensor.placed) == ((640, 480), True, True)
    assert found.problem == ""


def test_labels_returned_together_are_counted(log: SceneLog) -> None:
    """In one detection, or under one id in one look; a label repeated counts once."""
    standing_robot(log)
    log.detections(0.1, [detection({"cup": 0.9, "jug": 0.8}), detection({"pan": 0.9})])
    log.detections(
        0.2, [detection({"cup": 0.9}, identity="a"), detection({"jug": 1}, identity="a")]
    )
    log.detections(
        0.3, [detection({"cup": 0.9}, identity="a"), detection({"pan": 1}, identity="b")]
    )
    log.detections(
        0.4, [detection({"pan": 0.9}, identity="a"), detection({"cup": 1}, identity="a")]
    )
    log.detections(
        0.5, [detection({"cup": 0.9}, identity="a"), detection({"cup": 1}, identity="a")]
    )
    path = log.close()
    assert look_through(path).together == (("cup", "jug", 2), ("cup", "pan", 1))
    text = template_for(path)
    classes = parse_model(text, "m").classes
    names = classes.class_names
    returned = {(names[owner], classes.label_names[label]) for owner, label in classes.likelihoods}
    assert {pair for pair in returned if pair[0] != pair[1]} == {
        *(("cup", "jug"), ("jug", "cup"), ("cup", "pan"), ("pan", "cup"))
    }
    assert "# 2 times" in text
    assert "# once" in text
    assert "1 times" not in text


def test_transforms_as_poses(log: SceneLog) -> None:
    log.camera(0.0)
    log.transform(0.0, "base_link", "camera", (0.2, 0.0, 0.5), (-0.5, 0.5, -0.5, 0.5))
    for step in range(5):
        log.transform(step / 10, "odom", "base_link", (step, 0, 0), (0, 0, 0, 1), topic="/tf")
    log.detections(0.2, [detection({"cup": 0.9})])
    found = look_through(log.close())
    assert found.transform == ("odom", "base_link")
    assert (found.pose_topic, found.pose_kind) == ("", "transforms")
    assert use_of(found, "/tf").why == "poses"


def test_what_is_missing_is_said_without_failing(log: SceneLog, tmp_path: Path) -> None:
    log.odometry(0.0, 0.0, 0.0, 0.0)
    path = log.close()
    found = look_through(path)
    assert "no detections" in found.problem
    assert use_of(found, "/odom").used
    named = look_through(path, make_model(odometry=FieldMapping("/nothing")))
    assert "/nothing" in named.problem
    assert use_of(named, "/odom").role == "pose"
    empty = SceneLog(tmp_path / "empty.mcap")
    assert look_through(empty.close()).channels == ()
    silent = SceneLog(tmp_path / "silent.mcap")
    silent.detections(0.0, [])
    found = look_through(silent.close())
    assert "no poses" in found.problem
    assert found.looks == 1


def test_a_sensor_that_nothing_places_is_marked(log: SceneLog) -> None:
    for step in range(5):
        log.odometry(step / 10, 0.0, 0.0, 0.0)
    log.detections(0.2, [detection({"cup": 0.9}, box(0, 0, 1, 1))])
    (sensor,) = look_through(log.close()).sensors
    assert (sensor.placed, sensor.calibrated, sensor.image_size) == (False, False, None)


def test_an_unreadable_channel_says_why(tmp_path: Path) -> None:
    log = SceneLog(tmp_path / "a.mcap")
    standing_robot(log)
    identity = log._writer.register_schema("nav_msgs/msg/Odometry", "ros2msg", b"garbage !!")
    channel = log._writer.register_channel("/broken", "cdr", identity)
    log._writer.add_message(channel, at(0.0), b"\x00\x01\x00\x00", at(0.0))
    found = look_through(log.close())
    use = use_of(found, "/broken")
    assert not use.used
    assert "/broken" in use.why


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1700000000123456789", 1700000000123456789),
        ("0", 0),
        ("+10s", START + 10 * SECOND),
        ("+0.5s", START + SECOND // 2),
        ("+0.1s", START + SECOND // 10),
        ("+250ms", START + SECOND // 4),
        ("+7ns", START + 7),
        ("+3us", START + 3000),
        ("+2m", START + 120 * SECOND),
        ("+2min", START + 120 * SECOND),
        ("+1h", START + 3600 * SECOND),
        ("2023-11-14T22:13:20Z", START),
        ("2023-11-14 22:13:20.000000001z", START + 1),
        ("2023-11-15T00:13:20.5+02:00", START + SECOND // 2),
        ("2016-12-31T23:59:60Z", 1483228800 * SECOND),
        (" +1s ", START + SECOND),
    ],
)
def test_times(text: str, expected: int) -> None:
    assert find_time_bound(text, START) == expected


@pytest.mark.parametrize(
    "text",
    [
        "",
        "10s",
        "+10",
        "-5",
        "+-1s",
        "+1e3s",
        "2023-11-14T22:13:20",
        "2023-13-14T22:13:20Z",
        "2023-11-14T25:13:20Z",
        "1969-12-31T23:59:59Z",
        "9223372036854775808",
        "+999999999999999999h",
        "+1s2",
        "١٠",
    ],
)
def test_what_is_no_time_is_refused_by_name(text: str) -> None:
    with pytest.raises(UsageError, match=r"no time|outside|no date") as caught:
        find_time_bound(text, START)
    assert repr(text) in str(caught.value)


@given(st.integers(0, 4_000_000_000), st.integers(0, 999_999_999))
def test_dates_agree_with_the_calendar(seconds: int, nanoseconds: int) -> None:
    moment = datetime.fromtimestamp(seconds, timezone.utc)
    text = f"{moment:%Y-%m-%dT%H:%M:%S}.{nanoseconds:09d}Z"
    assert find_time_bound(text, 0) == seconds * SECOND + nanoseconds
