"""From logs to label measurements, by scenes whose geometry is worked out by hand."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scene_logs import (
    OPTICAL,
    SECOND,
    START,
    SceneLog,
    at,
    box,
    detection,
    header,
    make_model,
    read,
    stamp,
    standing_robot,
    xyz,
    xyzw,
)

from mclass import transforms
from mclass.errors import LogError
from mclass.logs.measurements import MERGED, NO_CAMERA
from mclass.model import CameraSettings, FieldMapping, TransformSource

NORTH = math.pi / 2


@pytest.fixture
def log(tmp_path: Path) -> SceneLog:
    return SceneLog(tmp_path / "scene.mcap")


def test_a_box_by_hand(log: SceneLog) -> None:
    standing_robot(log)
    # 100 pixels to the right of the axis at a focal length of 500 is atan(0.2) to the right.
    log.detections(1.0, [detection({"jug": 0.9, "cup": 0.7}, box(270, 200, 420, 280), "a")])
    contents = read(log.close())
    found = contents.measurements
    np.testing.assert_allclose(found.frames.poses_world_sensor, [[1.0, 2.2, NORTH]], atol=1e-12)
    expected = [[NORTH - math.atan(0.2), NORTH + math.atan(0.1)]]
    np.testing.assert_allclose(found.directions, expected, atol=1e-12)
    half = math.atan(0.64)
    np.testing.assert_allclose(
        found.frames.view_directions, [[NORTH - half, NORTH + half]], atol=1e-12
    )
    assert found.label_names_of(0) == ("cup", "jug")
    assert found.scores.tolist() == [0.7, 0.9]
    assert found.object_ids == ("a",)
    assert found.stamps_ns.tolist() == [at(1.0)]
    assert found.log_times_ns.tolist() == [at(1.1)]
    assert (contents.frame, contents.track.child_frame) == ("odom", "base_link")
    assert contents.encoding == "json"
    assert contents.unknown_labels == {}


def test_poses_are_taken_at_the_header_stamp_on_the_arc_between(log: SceneLog) -> None:
    # A quarter circle of radius 1 in 0.4 s; log times are days off.
    log.odometry(0.0, 0.0, 0.0, 0.0)
    log.odometry(0.4, 1.0, 1.0, NORTH)
    log.camera(0.0)
    log.transform(0.0, "base_link", "camera", (0.0, 0.0, 0.0), OPTICAL)
    log.detections(0.2, [detection({"cup": 1.0}, box(320, 0, 320, 480))], delay=3e5)
    found = read(log.close()).measurements
    middle = [math.sin(math.pi / 4), 1 - math.cos(math.pi / 4), math.pi / 4]
    np.testing.assert_allclose(found.frames.poses_world_sensor, [middle], atol=1e-9)
    assert found.directions[0, 0] == found.directions[0, 1] == pytest.approx(math.pi / 4)


def test_a_tilted_camera_sees_wider_on_the_ground(log: SceneLog) -> None:
    for time in (0.0, 0.5, 1.0):
        log.odometry(time, 0.0, 0.0, 0.0)
    log.camera(0.0)
    pitch = transforms.from_roll_pitch_yaw(np.array([0.0, math.pi / 3, 0.3]))
    turn = transforms.multiply(pitch, transforms.OPTICAL_ROTATION)
    log.transform(0.0, "base_link", "camera", (0.1, 0.2, 1.0), turn.tolist())
    log.detections(0.5, [detection({"cup": 1.0}, box(70, 200, 570, 280))])
    found = read(log.close()).measurements
    # Slopes of ±1/2 in the image double where the axis is foreshortened by cos 60°.
    np.testing.assert_allclose(
        found.directions, [[0.3 - math.pi / 4, 0.3 + math.pi / 4]], atol=1e-12
    )
    np.testing.assert_allclose(found.frames.poses_world_sensor, [[0.1, 0.2, 0.3]], atol=1e-12)


def test_a_leaning_robot_leans_its_camera(log: SceneLog) -> None:
    lean = transforms.from_roll_pitch_yaw(np.array([0.0, math.pi / 3, 0.3]))
    for time in (0.0, 0.5):
        log.odometry(time, 0.0, 0.0, 0.0, quaternion=lean.tolist())
    log.camera(0.0)
    log.transform(0.0, "base_link", "camera", (0.0, 0.0, 0.0), OPTICAL)
    log.detections(0.2, [detection({"cup": 1.0}, box(70, 200, 570, 280))])
    found = read(log.close()).measurements
    np.testing.assert_allclose(
        found.directions, [[0.3 - math.pi / 4, 0.3 + math.pi / 4]], atol=1e-12
    )


@pytest.mark.parametrize("roll", [math.pi, math.pi / 2])
def test_a_rolled_camera_keeps_right_and_left(log: SceneLog, roll: float) -> None:
    standing_robot(log)
    mount = transforms.from_roll_pitch_yaw(np.array([roll, 0.0, 0.0]))
    turn = transforms.multiply(mount, transforms.OPTICAL_ROTATION)
    log.transform(1.0, "base_link", "camera", (0.0, 0.0, 0.0), turn.tolist())
    # Upside down: image left is right. On its right side: the image's upper edge is on the right.
    bbox = box(170, 200, 370, 280) if roll == math.pi else box(300, 90, 340, 290)
    log.detections(1.0, [detection({"cup": 1.0}, bbox)])
    found = read(log.close()).measurements
    expected = [[NORTH - math.atan(0.3), NORTH + math.atan(0.1)]]
    np.testing.assert_allclose(found.directions, expected, atol=1e-12)


def test_a_camera_that_looks_down_has_the_robots_heading(log: SceneLog) -> None:
    standing_robot(log)
    down = transforms.from_roll_pitch_yaw(np.array([0.0, math.pi / 2, 0.0]))
    turn = transforms.multiply(down, transforms.OPTICAL_ROTATION)
    log.transform(1.0, "base_link", "camera", (0.0, 0.0, 1.0), turn.tolist())
    log.detections(1.0, [detection({"cup": 1.0}, box(310, 230, 330, 250))])
    contents = read(log.close())
    np.testing.assert_allclose(contents.measurements.frames.poses_world_sensor[:, 2], [NORTH])
    assert contents.tally.counts == {"box straight above or below the sensor": 1}


def test_a_pan_tilt_head_is_followed(log: SceneLog) -> None:
    standing_robot(log)
    log.transform(0.0, "head", "camera_2", (0.5, 0.0, 0.0), OPTICAL)
    for step in range(11):
        turn = transforms.from_heading(np.array(0.1 * step))
        log.transform(step / 10, "base_link", "head", (0.0, 0.0, 1.0), turn.tolist(), topic="/tf")
    log.camera(0.0, frame="camera_2", topic="/head/camera_info")
    for time in (0.55, 2.0):
        log.detections(time, [detection({"cup": 1.0})], frame="camera_2", topic="/head/detections")
    contents = read(log.close())
    angle = NORTH + 0.55
    expected = [[1 + 0.5 * math.cos(angle), 2 + 0.5 * math.sin(angle), angle]]
    np.testing.assert_allclose(contents.measurements.frames.poses_world_sensor, expected)
    assert contents.tally.counts == {"no transform to the sensor within 0.5 s": 1}


def test_poses_from_a_chain_of_transforms(log: SceneLog) -> None:
    log.transform(0.0, "base_link", "camera", (0.2, 0.0, 0.5), OPTICAL)
    log.camera(0.0)
    quarter = transforms.from_heading(np.array(NORTH)).tolist()
    for step in range(10):
        log.transform(step / 10, "map", "odom", (10.0, 0.0, 0.0), quarter, topic="/tf")
        log.transform(
            step / 10, "odom", "base_link", (step / 10, 0.0, 0.0), (0, 0, 0, 1), topic="/tf"
        )
    log.detections(0.55, [detection({"cup": 1.0})])
    path = log.close()
    contents = read(path)
    expected = [[10.0, 0.75, NORTH]]
    np.testing.assert_allclose(
        contents.measurements.frames.poses_world_sensor, expected, atol=1e-12
    )
    assert (contents.frame, contents.track.child_frame) == ("map", "base_link")
    short = read(path, make_model(odometry=TransformSource("odom", "camera")))
    np.testing.assert_allclose(
        short.measurements.frames.poses_world_sensor[:, :2], [[0.75, 0.0]], atol=1e-12
    )
    with pytest.raises(LogError, match="no transforms lead from 'mars'"):
        read(path, make_model(odometry=TransformSource("mars", "camera")))


def test_velocities_are_integrated_and_placed_by_log_time(log: SceneLog) -> None:
    for step in range(21):
        log.add(
            "/cmd_vel",
            "geometry_msgs/msg/Twist",
            at(step / 10),
            {"linear": xyz(1.0, 0.0, 0.0), "angular": xyz(0.0, 0.0, 0.5)},
        )
    log.camera(0.0)
    log.detections(-5000.0, [detection({"cup": 1.0})], delay=5001.0)
    contents = read(log.close())
    # Radius 2, half a radian: x = 2 sin(1/2), y = 2 (1 - cos(1/2)).
    expected = [[2 * math.sin(0.5), 2 * (1 - math.cos(0.5)), 0.5]]
    np.testing.assert_allclose(contents.measurements.frames.poses_world_sensor, expected)
    assert any("log time" in note for note in contents.notes)


def test_stamped_velocities_are_placed_by_their_stamps(log: SceneLog) -> None:
    for step in range(21):
        log.add(
            "/twist",
            "geometry_msgs/msg/TwistStamped",
            at(step / 10 + 1000.0),
            {
                "header": header(step / 10, "base_link"),
                "twist": {"linear": xyz(0.0, 1.0, 0.0), "angular": xyz(0.0, 0.0, 0.0)},
            },
        )
    log.camera(0.0)
    log.detections(1.0, [detection({"cup": 1.0})], delay=1000.0)
    contents = read(log.close())
    np.testing.assert_allclose(
        contents.measurements.frames.poses_world_sensor, [[0.0, 1.0, 0.0]], atol=1e-12
    )


def test_no_pose_across_or_beyond_a_gap(log: SceneLog) -> None:
    for time in (0.0, 0.5, 2.0):
        log.odometry(time, time, 0.0, 0.0)
    log.camera(0.0)
    times = (-0.6, -0.4, 0.3, 0.6, 2.0, 2.4, 2.6)
    for time in times:
        log.detections(time, [detection({"cup": 1.0})])
    path = log.close()
    contents = read(path)
    kept = [at(time) for time in (-0.4, 0.3, 2.0, 2.4)]
    assert contents.measurements.frames.stamps_ns.tolist() == kept
    x = contents.measurements.frames.poses_world_sensor[:, 0]
    np.testing.assert_allclose(x, [0.0, 0.3, 2.0, 2.0])
    assert contents.tally.counts == {"no pose within 0.5 s": 3}
    assert len(read(path, make_model(max_gap_ns=1500 * 10**6)).measurements) == 7


def test_poses_are_sorted_and_cleaned(log: SceneLog) -> None:
    log.odometry(0.2, 2.0, 0.0, 0.0)
    log.odometry(0.0, 0.0, 0.0, 0.0)
    log.odometry(0.1, 50.0, 0.0, 0.0)
    log.odometry(0.1, 1.0, 0.0, 0.0)
    log.odometry(0.15, float("nan"), 0.0, 0.0)
    log.odometry(0.16, 9.0, 0.0, 0.0, quaternion=(0, 0, 0, 0))
    log.odometry(0.17, 9.0, float("inf"), 0.0)
    log.camera(0.0)
    log.detections(0.05, [detection({"cup": 1.0})])
    contents = read(log.close())
    np.testing.assert_allclose(contents.track.poses_world_child[:, 0], [0.0, 1.0, 2.0])
    np.testing.assert_allclose(contents.measurements.frames.poses_world_sensor[0, 0], 0.5)
    assert contents.pose_tally.counts == {
        "position not finite": 2,
        "orientation is no rotation": 1,
        "pose out of order (sorted)": 1,
        "pose with a stamp met before (last kept)": 1,
    }


def _covariance(xx: float, yy: float, aa: float, ya: float = 0.0) -> list[float]:
    matrix = np.diag([xx, yy, 1e6, 1e6, 1e6, aa])
    matrix[1, 5] = matrix[5, 1] = ya
    return [float(value) for value in matrix.ravel()]


def test_covariances_are_planar_and_swing_with_the_lever(log: SceneLog) -> None:
    log.transform(0.0, "base_link", "camera", (2.0, 0.0, 0.0), OPTICAL)
    log.camera(0.0)
    log.odometry(0.0, 0.0, 0.0, 0.0, covariance=_covariance(0.1, 0.2, 0.01, 0.02))
    log.odometry(0.1, 0.0, 0.0, 0.0, covariance=_covariance(0.1, -0.2, 0.01))
    log.odometry(0.2, 0.0, 0.0, 0.0, covariance=_covariance(float("nan"), 0.2, 0.01))
    log.odometry(0.3, 0.0, 0.0, 0.0, covariance=_covariance(0.3, 0.4, 0.03, 0.04))
    for time in (0.0, 0.15, 0.25):
        log.detections(time, [detection({"cup": 1.0})])
    contents = read(log.close())
    assert contents.track.covariances is not None
    np.testing.assert_allclose(contents.track.covariances[:, 0, 0], [0.1, 0.1, 0.1, 0.3])
    assert contents.pose_tally.counts == {
        "covariance not finite (left out)": 1,
        "covariance not positive semi-definite (left out)": 1,
    }
    sensor = contents.measurements.frames.covariances
    assert sensor is not None
    # y of the sensor is y + 2 heading: 0.2 + 2 * 2 * 0.02 + 4 * 0.01.
    expected = [[0.1, 0.0, 0.0], [0.0, 0.32, 0.04], [0.0, 0.04, 0.01]]
    np.testing.assert_allclose(sensor[0], expected, atol=1e-15)
    np.testing.assert_allclose(sensor[2, 0, 0], 0.2)


def test_covariances_left_zero_are_unknown(log: SceneLog) -> None:
    standing_robot(log)
    log.detections(1.0, [])
    contents = read(log.close())
    assert contents.track.covariances is None
    assert contents.measurements.frames.covariances is None


def test_covariances_that_are_all_nan_are_counted(log: SceneLog) -> None:
    for step in range(4):
        log.odometry(step / 10, 1.0, 2.0, 0.0, covariance=[math.nan] * 36)
    log.detections(0.1, [])
    contents = read(log.close())
    assert contents.track.covariances is None
    assert contents.pose_tally.counts == {"covariance not finite (left out)": 4}


def test_covariances_not_told_are_those_told_before(log: SceneLog) -> None:
    unknown = [-1.0] + [0.0] * 35
    for step, covariance in enumerate(
        (unknown, _covariance(0.1, 0.2, 0.01), [0.0] * 36, unknown, _covariance(0.3, 0.2, 0.01))
    ):
        log.odometry(step / 10, 1.0, 2.0, 0.0, covariance=covariance)
    log.detections(0.1, [])
    contents = read(log.close())
    assert contents.track.covariances is not None
    assert contents.track.covariances[:, 0, 0].tolist() == [0.1, 0.1, 0.1, 0.1, 0.3]
    assert contents.pose_tally.counts == {}


def test_frames_without_detections_stay(log: SceneLog) -> None:
    standing_robot(log)
    for time in (1.0, 1.1, 1.2):
        log.detections(time, [])
    contents = read(log.close())
    assert len(contents.measurements) == 0
    assert contents.measurements.frames.stamps_ns.tolist() == [at(1.0), at(1.1), at(1.2)]


def test_messages_of_one_stamp_and_sensor_are_one_frame(log: SceneLog) -> None:
    standing_robot(log)
    log.detections(1.0, [detection({"cup": 0.6}, identity="a")], delay=0.1)
    log.detections(1.0, [detection({"jug": 0.7}, identity="b")], delay=0.2)
    log.detections(1.0, [detection({"jug": 0.8}, identity="a")], delay=0.3, topic="/other")
    model = make_model(
        detections=(FieldMapping("/camera/detections"), FieldMapping("/other")),
    )
    contents = read(log.close(), model)
    found = contents.measurements
    assert len(found.frames) == 1
    assert found.frames.log_times_ns.tolist() == [at(1.3)]
    assert [found.object_ids[i] for i in found.object_index] == ["a", "b"]
    assert found.label_names_of(0) == ("cup", "jug")
    assert contents.tally.counts == {MERGED: 1}


def test_detections_that_share_an_id_are_merged(log: SceneLog) -> None:
    standing_robot(log)
    log.detections(
        1.0,
        [
            detection({"cup": 0.5}, box(300, 0, 310, 480), "b"),
            detection({"cup": 0.3}, box(0, 0, 10, 480)),
            detection({"jug": 0.9, "cup": 0.4}, box(320, 0, 420, 480), "a"),
            detection({"cup": 0.8}, box(270, 0, 330, 480), "a"),
            detection({"cup": 0.6}, box(10, 0, 20, 480)),
        ],
    )
    contents = read(log.close())
    found = contents.measurements
    ids = [found.object_ids[i] if i >= 0 else None for i in found.object_index]
    assert ids == ["b", None, "a", None]
    assert found.label_names_of(2) == ("cup", "jug")
    assert found.scores.tolist() == [0.5, 0.3, 0.8, 0.9, 0.6]
    expected = [NORTH - math.atan(0.2), NORTH + math.atan(0.1)]
    np.testing.assert_allclose(found.directions[2], expected)
    assert contents.tally.counts == {MERGED: 1}


def test_labels_are_translated_gated_and_counted(log: SceneLog) -> None:
    standing_robot(log)
    log.add(
        "/labels",
        "vision_msgs/msg/LabelInfo",
        at(0.0),
        {"class_map": [{"class_id": 3, "class_name": "jug"}, {"class_id": 4, "class_name": "mug"}]},
    )
    log.detections(
        1.0,
        [
            detection({"0": 0.9}),  # by the model file
            detection({"3": 0.9}),  # by the log's list
            detection({"4": 0.9}),  # by the log's list, then the model file
            detection({"cup": 0.9, "jug": 0.2, "pan": 0.9}),
            detection({"jug": 0.2, "pan": 0.9}),
            detection({"pan": 0.1}),
            detection({"pan": 0.9, "pot": 0.9}),
            detection({}),
            detection({"cup": float("inf")}),
            detection({"cup": float("nan")}),
            detection([("cup", 0.6), ("cup", 0.7)]),
        ],
    )
    model = make_model(min_score=0.5, labels={"0": "cup", "mug": "cup"})
    contents = read(log.close(), model)
    found = contents.measurements
    sets = [found.label_names_of(row) for row in range(len(found))]
    assert sets == [("cup",), ("jug",), ("cup",), ("cup",), ("cup",)]
    assert found.scores[-1] == 0.7
    assert contents.tally.counts == {
        "score below 0.5": 1,
        "score not finite": 2,
        "label not in the model": 2,
        "no label": 1,
    }
    assert contents.unknown_labels == {"pan": 4, "pot": 1}


def test_bad_boxes_are_counted_by_reason(log: SceneLog) -> None:
    standing_robot(log)
    nan = float("nan")
    log.detections(
        1.0,
        [
            detection({"cup": 1.0}, box(600, 100, 800, 200)),  # clipped
            detection({"cup": 1.0}, box(640.5, 100, 800, 200)),
            detection({"cup": 1.0}, box(100, -50, 200, -1)),
            detection({"cup": 1.0}, box(nan, 100, 800, 200)),
            detection({"cup": 1.0}, box(300, 100, 200, 200)),
            detection({"cup": 1.0}, box(320, 100, 320, 200)),  # a ray
            detection({"cup": 1.0}, box(0, 0, 0, 0)),  # no box at all
            detection({"cup": 1.0}, box(-float("inf"), 100, 800, 200)),
        ],
    )
    contents = read(log.close())
    edges = contents.measurements.directions
    expected = [NORTH - math.atan(320 / 500), NORTH - math.atan(280 / 500)]
    np.testing.assert_allclose(edges[0], expected)
    np.testing.assert_allclose(edges[1], [NORTH, NORTH])
    assert edges[1, 0] == edges[1, 1]
    assert np.isnan(edges[2]).all()
    assert contents.tally.counts == {
        "box outside the image": 2,
        "box not finite": 2,
        "box of negative size": 1,
    }


def test_boxes_beyond_the_lens_are_counted(log: SceneLog) -> None:
    standing_robot(log)
    log.camera(0.0, d=(-0.3, 0.0, 0.0, 0.0, 0.0), k=(400.0, 400.0, 320.0, 240.0))
    # r - 0.3 r³ never exceeds 0.70: pixels beyond 280 from the centre show nothing.
    log.detections(
        1.0,
        [
            detection({"cup": 1.0}, box(310, 240, 590, 240)),
            detection({"cup": 1.0}, box(310, 240, 620, 240)),
        ],
    )
    contents = read(log.close())
    assert len(contents.measurements) == 1
    assert contents.tally.counts == {"box beyond what the lens can show": 1}
    assert np.isnan(contents.measurements.frames.view_directions).all()


def test_ids_are_kept_whatever_they_are(log: SceneLog) -> None:
    standing_robot(log)
    ids = ["a/b", "a b", "\x00\n", "x" * 100_000, "ünï", " "]
    log.detections(1.0, [detection({"cup": 1.0}, identity=name) for name in ids])
    assert list(read(log.close()).measurements.object_ids) == ids


def test_ten_thousand_detections_in_one_message(log: SceneLog) -> None:
    standing_robot(log)
    log.detections(
        1.0, [detection({"cup": 1.0}, identity=str(row % 7_000)) for row in range(10_000)]
    )
    contents = read(log.close())
    assert len(contents.measurements) == 7_000
    assert contents.tally.counts == {MERGED: 3_000}


def test_the_log_bounds_detections_by_log_time(log: SceneLog) -> None:
    standing_robot(log)
    for step in range(10):
        log.detections(1.0 + step / 10, [detection({"cup": 1.0})])
    contents = read(log.close(), start_ns=at(1.3), end_ns=at(1.5))
    assert contents.measurements.log_times_ns.tolist() == [at(1.3), at(1.4)]
    assert contents.measurements.stamps_ns.tolist() == [at(1.2), at(1.3)]


def test_stamps_of_zero_are_replaced_by_log_times(log: SceneLog) -> None:
    standing_robot(log)
    log.detections(1.0, [detection({"cup": 1.0})])
    log.detections(-START / SECOND, [detection({"cup": 1.0})], delay=START / SECOND + 2.0)
    contents = read(log.close())
    np.testing.assert_allclose(contents.measurements.stamps_ns, [at(1.0), at(2.0)], rtol=1e-15)
    assert any("without stamp" in note for note in contents.notes)


def test_odometry_comes_before_poses_and_covers_most(log: SceneLog) -> None:
    for step in range(31):
        pose = {"position": xyz(9.0, 9.0, 0.0), "orientation": xyzw((0, 0, 0, 1))}
        message = {"header": header(step / 10, "map"), "pose": pose}
        log.add("/a_pose", "geometry_msgs/msg/PoseStamped", at(step / 10), message)
        log.odometry(step / 10, 1.0, 0.0, 0.0, topic="/early")
    for step in range(26, 70):
        log.odometry(step / 10, 2.0, 0.0, 0.0, topic="/late")
    log.camera(0.0)
    for time in (1.0, 2.0, 2.8):
        log.detections(time, [detection({"cup": 1.0})])
    path = log.close()
    contents = read(path)
    assert "poses: /early (Odometry)" in contents.notes
    assert any("/late" in note and "/a_pose" in note for note in contents.notes)
    assert contents.measurements.frames.poses_world_sensor[:, 0].tolist() == [1.0] * 3
    chosen = read(path, make_model(odometry=FieldMapping("/a_pose")))
    assert chosen.measurements.frames.poses_world_sensor[:, 0].tolist() == [9.0] * 3
    assert chosen.frame == "map"


def test_a_source_that_covers_nothing_gives_way(log: SceneLog) -> None:
    log.odometry(900.0, 1.0, 0.0, 0.0)
    for step in range(31):
        pose = {"position": xyz(9.0, 9.0, 0.0), "orientation": xyzw((0, 0, 0, 1))}
        message = {"timestamp": stamp(step / 10), "frame_id": "map", "pose": pose}
        log.add("/pose", "foxglove.PoseInFrame", at(step / 10), message)
    log.camera(0.0)
    log.detections(1.0, [detection({"cup": 1.0})])
    contents = read(log.close())
    assert contents.measurements.frames.poses_world_sensor[:, 0].tolist() == [9.0]


def test_a_missing_topic_is_named_with_those_present(log: SceneLog) -> None:
    standing_robot(log)
    log.detections(1.0, [])
    path = log.close()
    for given_, key in (
        ({"odometry": FieldMapping("/odometry")}, "log.odometry"),
        ({"detections": (FieldMapping("/dets"),)}, "log.detections"),
        ({"camera_info": "/cam"}, "log.camera_info"),
    ):
        with pytest.raises(LogError, match=r"/odom.*" + key) as caught:
            read(path, make_model(**given_))
        assert caught.value.path == str(path)
        assert caught.value.topic in ("/odometry", "/dets", "/cam")


def test_logs_without_detections_or_poses_say_what_is_there(tmp_path: Path) -> None:
    log = SceneLog(tmp_path / "a.mcap")
    standing_robot(log)
    with pytest.raises(LogError, match=r"no detections.*/odom"):
        read(log.close())
    log = SceneLog(tmp_path / "b.mcap")
    log.detections(1.0, [])
    with pytest.raises(LogError, match=r"no poses.*/camera/detections"):
        read(log.close())
    log = SceneLog(tmp_path / "c.mcap")
    log.odometry(0.0, float("nan"), 0.0, 0.0)
    log.detections(0.0, [])
    with pytest.raises(LogError, match=r"/odom: 1 position not finite"):
        read(log.close())


def test_the_camera_is_found_by_frame_then_namespace(log: SceneLog) -> None:
    standing_robot(log)
    log.camera(0.0, topic="/left/camera_info", frame="left_eye", k=(250.0, 250.0, 320.0, 240.0))
    # In the same namespace as the detections, but with another frame than these.
    log.detections(1.0, [detection({"cup": 1.0}, box(320, 0, 370, 480))], frame="camera")
    log.detections(
        1.1,
        [detection({"cup": 1.0}, box(320, 0, 370, 480))],
        frame="base_link",
        topic="/left/detections",
    )
    log.detections(
        1.2,
        [detection({"cup": 1.0}, box(320, 0, 370, 480))],
        frame="base_link",
        topic="/right/detections",
    )
    topics = ("/camera/detections", "/left/detections", "/right/detections")
    path = log.close()
    model = make_model(detections=tuple(FieldMapping(topic) for topic in topics))
    contents = read(path, model)
    slopes = np.tan(NORTH - contents.measurements.directions[:, 0])
    np.testing.assert_allclose(slopes, [0.1, 0.2])
    assert contents.tally.counts == {NO_CAMERA: 1}
    told = make_model(
        detections=(FieldMapping("/right/detections"),), camera_info="/left/camera_info"
    )
    slopes = np.tan(NORTH - read(path, told).measurements.directions[:, 0])
    np.testing.assert_allclose(slopes, [0.2])


def test_the_latest_calibration_before_the_stamp_counts(log: SceneLog) -> None:
    standing_robot(log)
    log.camera(1.5, k=(250.0, 250.0, 320.0, 240.0))
    log.camera(2.5, k=(0.0, 0.0, 0.0, 0.0))
    for time in (-0.1, 1.0, 1.6, 2.6):
        log.detections(time, [detection({"cup": 1.0}, box(320, 0, 370, 480))])
    contents = read(log.close())
    slopes = np.tan(NORTH - contents.measurements.directions[:, 0])
    np.testing.assert_allclose(slopes, [0.1, 0.1, 0.2])
    assert contents.tally.counts == {"camera without focal length": 1}
    assert len(contents.measurements.frames) == 4


def test_binned_and_cropped_images_have_other_intrinsics(log: SceneLog) -> None:
    standing_robot(log)
    roi = {"x_offset": 100, "y_offset": 40, "width": 400, "height": 400}
    log.camera(0.0, topic="/camera/camera_info", binning_x=2, binning_y=2, roi=roi)
    log.detections(1.0, [detection({"cup": 1.0}, box(110, 0, 160, 200))])
    found = read(log.close()).measurements
    # Axis at (320 - 100) / 2 = 110, focal length 250, the image 200 wide.
    np.testing.assert_allclose(found.directions, [[NORTH - math.atan(0.2), NORTH]])
    expected = [[NORTH - math.atan(90 / 250), NORTH + math.atan(110 / 250)]]
    np.testing.assert_allclose(found.frames.view_directions, expected)


@pytest.mark.parametrize(
    ("projection", "focal", "center"),
    [
        ([250.0, 0.0, 300.0, -25.0, 0.0, 240.0, 200.0, 0.0, 0.0, 0.0, 1.0, 0.0], 250.0, 300.0),
        ([0.0] * 12, 500.0, 320.0),
        (None, 500.0, 320.0),
    ],
    ids=["P", "P left zero", "no P"],
)
def test_rectified_images_have_the_intrinsics_of_p(
    log: SceneLog, projection: list[float] | None, focal: float, center: float
) -> None:
    """No distortion is undone, and P is used where it was filled in."""
    standing_robot(log)
    more: dict[str, Any] = {} if projection is None else {"p": projection}
    log.camera(0.0, topic="/camera/camera_info", d=(-0.4, 0.2, 0.01, 0.0, 0.0), **more)
    log.detections(1.0, [detection({"cup": 1.0}, box(320, 0, 420, 480))])
    path = log.close()
    found = read(path, make_model(camera=CameraSettings(rectified=True)))
    expected = [NORTH - math.atan((x - center) / focal) for x in (420.0, 320.0)]
    np.testing.assert_allclose(found.measurements.directions, [expected], atol=1e-12)
    assert any("as those of rectified images" in note for note in found.notes)
    distorted = read(path)
    assert abs(distorted.measurements.directions[0, 0] - expected[0]) > 0.002
    assert not any("rectified" in note for note in distorted.notes)


def test_rectified_images_are_turned_back_by_r(log: SceneLog) -> None:
    """Turned by 0.1 about the camera's y (down): its view to the right by 0.1, and rolled."""
    standing_robot(log)
    turn, roll = 0.1, 0.3
    about_y = [[math.cos(turn), 0, -math.sin(turn)], [0, 1, 0], [math.sin(turn), 0, math.cos(turn)]]
    about_z = [[math.cos(roll), math.sin(roll), 0], [-math.sin(roll), math.cos(roll), 0], [0, 0, 1]]
    r = (np.array(about_z) @ np.array(about_y)).ravel().tolist()
    p = [250.0, 0.0, 300.0, -25.0, 0.0, 240.0, 200.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    log.camera(0.0, topic="/camera/camera_info", d=(-0.4, 0.2, 0.01, 0.0, 0.0), p=p, r=r)
    # The axis of the rectified camera is 0.1 to the right; a pixel to the right of it by 0.5
    # focal lengths lies, rolled back by 0.3, 0.5 cos(0.3) to the right of it.
    log.detections(1.0, [detection({"cup": 1.0}, box(300, 200, 300, 200))])
    log.detections(2.0, [detection({"cup": 1.0}, box(425, 200, 425, 200))])
    found = read(log.close(), make_model(camera=CameraSettings(rectified=True))).measurements
    off = math.atan(0.5 * math.cos(roll))
    expected = [[NORTH - turn] * 2, [NORTH - turn - off] * 2]
    np.testing.assert_allclose(found.directions, expected, atol=1e-12)


@pytest.mark.parametrize("r", [[0.0] * 9, [1.0, 0, 0, 0, 1, 0, 0, 0, 1]])
def test_r_left_zero_turns_nothing(log: SceneLog, r: list[float]) -> None:
    standing_robot(log)
    p = [250.0, 0.0, 300.0, 0.0, 0.0, 240.0, 200.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    log.camera(0.0, topic="/camera/camera_info", p=p, r=r)
    log.detections(1.0, [detection({"cup": 1.0}, box(425, 0, 425, 480))])
    found = read(log.close(), make_model(camera=CameraSettings(rectified=True))).measurements
    np.testing.assert_allclose(found.directions, [[NORTH - math.atan(0.5)] * 2], atol=1e-12)


@pytest.mark.parametrize("r", [[1.0, 0, 0, 0, 1, 0, 0, 0, -1], [1.0] * 9, [math.nan] * 9])
def test_r_that_is_no_rotation_is_no_calibration(log: SceneLog, r: list[float]) -> None:
    standing_robot(log)
    p = [250.0, 0.0, 300.0, 0.0, 0.0, 240.0, 200.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    log.camera(0.0, topic="/camera/camera_info", p=p, r=r)
    log.detections(1.0, [detection({"cup": 1.0}, box(425, 0, 425, 480))])
    contents = read(log.close(), make_model(camera=CameraSettings(rectified=True)))
    assert contents.tally.total == 1


def test_a_topic_of_rectified_images_is_pointed_out(log: SceneLog) -> None:
    standing_robot(log)
    log.camera(0.0, topic="/camera/camera_info", d=(-0.4, 0.2, 0.0, 0.0, 0.0))
    topic = "/camera/image_rect/detections"
    log.detections(1.0, [detection({"cup": 1.0}, box(320, 0, 420, 480))], topic=topic)
    assert any("set log.camera.rectified" in note for note in read(log.close()).notes)


def test_an_unknown_distortion_model_is_counted_and_said(log: SceneLog) -> None:
    standing_robot(log)
    log.camera(0.0, topic="/camera/camera_info", model="magic", d=(0.1,))
    log.detections(1.0, [detection({"cup": 1.0})])
    contents = read(log.close())
    assert contents.tally.counts == {"camera calibration that cannot be used": 1}
    assert any("magic" in note for note in contents.notes)


def test_a_camera_of_the_model_file(log: SceneLog) -> None:
    for step in range(11):
        log.odometry(step / 10, 1.0, 2.0, NORTH)
    log.detections(0.5, [detection({"cup": 1.0}, box(320, 0, 370, 480))])
    path = log.close()
    bare = read(path)
    assert bare.tally.counts == {NO_CAMERA: 1}
    assert len(bare.measurements.frames) == 1
    camera = CameraSettings(
        intrinsics=(250.0, 250.0, 320.0, 240.0),
        image_size=(640, 480),
        mount_xyz=(0.0, -0.5, 0.3),
        mount_rpy=(0.0, 0.0, 0.25),
    )
    found = read(path, make_model(camera=camera)).measurements
    heading = NORTH + 0.25
    np.testing.assert_allclose(found.frames.poses_world_sensor, [[1.5, 2.0, heading]])
    np.testing.assert_allclose(found.directions, [[heading - math.atan(0.2), heading]])


def test_a_camera_frame_with_z_up_is_a_body_frame(log: SceneLog) -> None:
    for step in range(11):
        log.odometry(step / 10, 0.0, 0.0, 0.0)
    turn = transforms.from_heading(np.array(0.4)).tolist()
    log.transform(0.0, "base_link", "camera", (0.2, 0.0, 0.5), turn)
    log.camera(0.0)
    log.detections(0.5, [detection({"cup": 1.0}, box(320, 0, 320, 480))])
    contents = read(log.close())
    np.testing.assert_allclose(contents.measurements.directions, [[0.4, 0.4]])
    assert any("z axis points up" in note for note in contents.notes)


def _volume(
    center: tuple[float, float, float],
    size: tuple[float, float, float],
    turn: tuple[float, ...] = (0, 0, 0, 1),
) -> dict[str, object]:
    return {
        "results": [{"hypothesis": {"class_id": "cup", "score": 1.0}}],
        "bbox": {
            "center": {"position": xyz(*center), "orientation": xyzw(turn)},
            "size": xyz(*size),
        },
        "id": "",
    }


@pytest.mark.parametrize("frame", ["lidar", "odom"])
def test_3d_boxes_span_their_corners(log: SceneLog, frame: str) -> None:
    standing_robot(log)
    log.transform(0.0, "base_link", "lidar", (0.0, 0.0, 1.0), (0, 0, 0, 1))
    near = (3.0, 1.0, 0.0) if frame == "lidar" else (0.0, 5.0, 0.0)
    turned = tuple(transforms.from_heading(np.array(0.0 if frame == "lidar" else NORTH)).tolist())
    found = [
        _volume(near, (2.0, 2.0, 1.0), turned),
        _volume(near, (0.0, 0.0, 0.0), (0, 0, 0, 0)),
        _volume((0.1, 0.1, 0.0) if frame == "lidar" else (1.1, 2.1, 0.0), (2.0, 2.0, 1.0)),
        _volume(near, (-1.0, 2.0, 1.0)),
        _volume((float("nan"), 1.0, 0.0), (1.0, 2.0, 1.0)),
    ]
    log.add(
        "/boxes",
        "vision_msgs/msg/Detection3DArray",
        at(1.0),
        {"header": header(1.0, frame), "detections": found},
    )
    contents = read(log.close())
    # Seen from the robot the box reaches from x = 2, y = 0 to x = 2, y = 2.
    expected = [[NORTH, NORTH + math.pi / 4], [NORTH + math.atan2(1, 3)] * 2]
    np.testing.assert_allclose(contents.measurements.directions, expected, atol=1e-12)
    np.testing.assert_allclose(contents.measurements.frames.poses_world_sensor, [[1, 2, NORTH]])
    assert contents.tally.counts == {
        "box around the sensor": 1,
        "box of negative size": 1,
        "box not finite": 1,
    }


def test_our_own_detections_with_boxes_and_bearings(log: SceneLog) -> None:
    standing_robot(log)
    log.add(
        "/seen",
        "mclass.Detections",
        at(1.0),
        {
            "timestamp": stamp(1.0),
            "frame_id": "base_link",
            "detections": [
                {
                    "id": "a",
                    "labels": [{"name": "cup", "score": 0.5}, {"name": "jug", "score": 0.25}],
                    "bearing": {"right": -0.2, "left": 0.3},
                },
                {"labels": [{"name": "cup"}], "bearing": {"right": 0.0, "left": 0.0}},
                {"id": "c", "labels": [{"name": "jug", "score": 0.5}]},
            ],
        },
    )
    log.add(
        "/seen",
        "mclass.Detections",
        at(1.5),
        {
            "timestamp": stamp(1.5),
            "frame_id": "camera",
            "detections": [
                {
                    "labels": [{"name": "cup"}],
                    "box": {"x": 320.0, "y": 100.0, "width": 50.0, "height": 20.0},
                }
            ],
        },
    )
    found = read(log.close()).measurements
    expected = [
        [NORTH - 0.2, NORTH + 0.3],
        [NORTH, NORTH],
        [np.nan, np.nan],
        [NORTH - math.atan(0.1), NORTH],
    ]
    np.testing.assert_allclose(found.directions, expected, atol=1e-12)
    assert found.scores.tolist() == [0.5, 0.25, 1.0, 0.5, 1.0]
    assert [found.object_ids[i] if i >= 0 else None for i in found.object_index] == [
        "a",
        None,
        "c",
        None,
    ]


@pytest.mark.parametrize("encoding", ["json", "protobuf"])
def test_bearings_are_given_or_not_in_every_encoding(log: SceneLog, encoding: str) -> None:
    standing_robot(log)
    bearings: list[dict[str, float] | None] = [
        {"right": -0.2, "left": 0.3},
        None,
        {"right": 0.0, "left": 0.0},
        {"left": 0.4},
        {"right": math.nan, "left": math.nan},
    ]
    found = [
        {
            "id": f"o{number}",
            "labels": [{"name": "cup", "score": 0.75}],
            **({} if bearing is None else {"bearing": bearing}),
        }
        for number, bearing in enumerate(bearings)
    ]
    message = {"frame_id": "base_link", "detections": found}
    if encoding == "json":
        log.add("/seen", "mclass.Detections", at(1.0), {"timestamp": stamp(1.0), **message})
    else:
        times = dict(zip(("seconds", "nanos"), divmod(at(1.0), SECOND), strict=True))
        log.protobuf("/seen", "mclass.Detections", at(1.0), {"timestamp": times, **message})
    contents = read(log.close())
    expected = [[NORTH - 0.2, NORTH + 0.3], [np.nan, np.nan], [NORTH, NORTH]]
    np.testing.assert_allclose(contents.measurements.directions, expected, atol=1e-12)
    assert contents.tally.counts == {"box not finite": 2}


def test_image_annotations_are_read_by_place(log: SceneLog) -> None:
    standing_robot(log)

    def outline(left: float, top: float, right: float, bottom: float) -> dict[str, object]:
        corners = [(left, top), (right, top), (right, bottom), (left, bottom)]
        return {"type": 2, "points": [{"x": x, "y": y} for x, y in corners]}

    def text(
        label: str, x: float, y: float, identity: str = "", score: str = "", time: float = 1.0
    ) -> dict[str, object]:
        metadata = [{"key": "id", "value": identity}, {"key": "score", "value": score}]
        position = {"x": x, "y": y}
        return {
            "timestamp": stamp(time),
            "text": label,
            "position": position,
            "metadata": metadata,
        }

    log.add(
        "/annotations",
        "foxglove.ImageAnnotations",
        at(1.1),
        {
            "timestamp": stamp(1.0),
            "points": [
                outline(270, 100, 420, 200),
                {"type": 3, "points": [{"x": 101, "y": 100}]},
                outline(100, 110, 600, 400),
            ],
            "texts": [
                text("cup", 101, 106, "big", "0.9"),
                text("cup", 270, 96, "small", "0.8"),
                text("jug", 270, 80, "small", "0.7"),
                text("jug", 101, 106, "other"),
                text("cup", 350, 148, "", "bad", time=1.3),
            ],
        },
    )
    model = make_model(detections=(FieldMapping("/annotations"),))
    contents = read(log.close(), model)
    found = contents.measurements
    narrow = [NORTH - math.atan(0.2), NORTH + math.atan(0.1)]
    wide = [NORTH - math.atan(280 / 500), NORTH + math.atan(220 / 500)]
    np.testing.assert_allclose(found.directions, [wide, narrow, wide])
    assert [found.object_ids[i] for i in found.object_index] == ["big", "small", "other"]
    assert found.label_names_of(1) == ("cup", "jug")
    assert found.scores.tolist() == [0.9, 0.8, 0.7, 1.0]
    assert contents.tally.counts == {"score not finite": 1}
    assert found.frames.stamps_ns.tolist() == [at(1.0), at(1.3)]


def test_annotations_beside_real_detections_are_not_counted_twice(log: SceneLog) -> None:
    standing_robot(log)
    log.detections(1.0, [detection({"cup": 1.0})])
    message = {
        "timestamp": stamp(1.0),
        "points": [{"type": 2, "points": [{"x": 1, "y": 1}]}],
        "texts": [{"text": "cup", "position": {"x": 1, "y": 1}}],
    }
    for _ in range(3):
        log.add("/annotations", "foxglove.ImageAnnotations", at(1.0), message)
    contents = read(log.close())
    assert contents.detections == 1
    assert any("/annotations" in note for note in contents.notes)


def test_results_of_an_earlier_run_are_no_detections(log: SceneLog) -> None:
    standing_robot(log)
    log.add(
        "/mclass/objects",
        "vision_msgs/msg/Detection3DArray",
        at(1.0),
        {"header": header(1.0, "odom"), "detections": [_volume((1.0, 9.0, 0.0), (1.0, 1.0, 1.0))]},
    )
    message = {"stamp": stamp(1.0), "frame_id": "camera", "objects": [{"label": "cup", "id": 7}]}
    log.add("/custom", "my.Objects", at(1.0), message)
    contents = read(log.close())
    assert contents.measurements.object_ids == ("7",)


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_every_detection_is_used_or_counted(tmp_path: Path, data: st.DataObject) -> None:
    number = st.one_of(
        st.floats(-100, 800), st.sampled_from([float("nan"), float("inf"), 0.0, 1e300, -1e300])
    )
    boxes = st.tuples(number, number, number, number).map(lambda edges: box(*edges))
    name = st.sampled_from(["cup", "jug", "pan", ""])
    labels = st.lists(st.tuples(name, number), max_size=3)
    one = st.builds(detection, labels, boxes, st.sampled_from(["", "a", "b", "/"]))
    message = st.tuples(st.floats(-1.0, 3.0), st.lists(one, max_size=5))
    messages = data.draw(st.lists(message, max_size=4))
    model = make_model(min_score=data.draw(st.sampled_from([0.0, 0.5])))
    log = SceneLog(tmp_path / "random.mcap")
    standing_robot(log, seconds=1)
    for time, found in [*messages, (0.5, [])]:
        log.detections(time, found)
    contents = read(log.close(), model)
    assert contents.detections == sum(len(found) for _, found in messages)


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_whatever_the_poses_nothing_but_numbers_comes_out(
    tmp_path: Path, data: st.DataObject
) -> None:
    number = st.one_of(
        st.floats(-10, 10),
        st.sampled_from([float("nan"), float("inf"), 0.0, 1e300, -1e300, 1e-300, 7e6]),
    )
    four = st.tuples(number, number, number, number)
    poses = data.draw(st.lists(st.tuples(number, number, four, number), max_size=5))
    mount = data.draw(st.tuples(st.tuples(number, number, number), four))
    focal = data.draw(number)
    corners = data.draw(st.lists(st.tuples(number, number, number), min_size=2, max_size=2))
    log = SceneLog(tmp_path / "random.mcap")
    log.odometry(0.1, 0.0, 0.0, 0.0)
    for step, (x, y, turn, variance) in enumerate(poses):
        covariance = _covariance(variance, abs(variance), 1.0)
        log.odometry(step / 10, x, y, 0.0, quaternion=turn, covariance=covariance)
    log.transform(0.0, "base_link", "camera", *mount)
    log.transform(0.0, "base_link", "lidar", *mount)
    # An image without a size cannot clip anything.
    log.camera(0.0, k=(focal, 500.0, 320.0, 240.0), size=(0, 0))
    log.detections(0.2, [detection({"cup": 1.0}, box(-1e300, 0, 1e300, 1e300))])
    log.detections(0.3, [detection({"cup": 1.0}, box(300, 0, 400, 1e300))])
    boxes = [_volume(corners[0], corners[1]), _volume(corners[1], corners[0], mount[1])]
    message = {"header": header(0.25, "lidar"), "detections": boxes}
    log.add("/boxes", "vision_msgs/msg/Detection3DArray", at(0.25), message)
    model = make_model(detections=(FieldMapping("/camera/detections"), FieldMapping("/boxes")))
    contents = read(log.close(), model)
    covariances = contents.measurements.frames.covariances
    assert covariances is None or np.isfinite(covariances).all()
    assert contents.detections == 4


def test_stamps_before_1970_are_none(log: SceneLog) -> None:
    standing_robot(log)
    message = {
        "header": {"stamp": {"sec": -(2**31), "nanosec": 0}, "frame_id": "camera"},
        "detections": [detection({"cup": 1.0})],
    }
    log.add("/camera/detections", "vision_msgs/msg/Detection2DArray", at(1.0), message)
    log.detections(2.0, [])
    found = read(log.close()).measurements
    assert found.frames.stamps_ns.tolist() == [at(1.0), at(2.0)]


@pytest.mark.parametrize(
    "number", [1_700_000_001, 1_700_000_001.0, 1_700_000_001_000, 1_700_000_001 * SECOND]
)
def test_plain_numbers_as_stamps(log: SceneLog, number: float) -> None:
    standing_robot(log)
    message = {"timestamp": number, "frame": "camera", "label": "cup", "score": 0.5}
    log.add("/custom", "my.Type", at(2.0), message)
    assert read(log.close()).measurements.stamps_ns.tolist() == [at(1.0)]


def test_messages_that_cannot_be_decoded_are_counted(log: SceneLog) -> None:
    standing_robot(log)
    log.detections(1.0, [detection({"cup": 1.0})])
    log.raw("/camera/detections", "vision_msgs/msg/Detection2DArray", at(1.2), b"{not json")
    log.raw("/odom", "nav_msgs/msg/Odometry", at(1.2), b"[]")
    contents = read(log.close())
    assert len(contents.measurements) == 1
    assert {topic: sum(c.values()) for topic, c in contents.unreadable.items()} == {
        "/camera/detections": 1,
        "/odom": 1,
    }


def test_poses_of_a_frame_that_no_transform_knows(log: SceneLog) -> None:
    for time in (0.0, 0.5, 1.0):
        log.odometry(time, 1.0, 2.0, NORTH, child="base_footprint")
    log.transform(0.0, "base_link", "camera", (0.2, 0.0, 0.5), OPTICAL)
    log.camera(0.0)
    log.detections(0.5, [detection({"cup": 1.0})])
    contents = read(log.close())
    expected = [[1.0, 2.2, NORTH]]
    np.testing.assert_allclose(contents.measurements.frames.poses_world_sensor, expected)
    assert any("base_link is taken for it" in note for note in contents.notes)
