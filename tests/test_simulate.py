"""The simulated world: motion, camera, odometry, detectors, measurements."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from models import lopsided_model
from scipy.stats import norm

from mclass import transforms
from mclass.errors import ModelError
from mclass.geometry import compose, relative_pose, wrap_angle
from mclass.model import Model
from mclass.records import FloatArray
from mclass.simulation.camera import azimuths, mount_quaternion, planar_mount, project_boxes
from mclass.simulation.detections import Detections, to_measurements
from mclass.simulation.motion import plan_path, run_odometry
from mclass.simulation.recognition import Looks, correlated_uniforms, label_probabilities
from mclass.simulation.scenario import (
    Camera,
    CircleAround,
    Correlation,
    DriveTo,
    Errors,
    LookAt,
    ModelDetector,
    Odometry,
    Recogniser,
    Response,
    Scenario,
    SceneObject,
    Script,
    Trajectory,
)
from mclass.simulation.world import simulate, simulate_measurements

SECOND = 1_000_000_000

BOOKS = SceneObject("o1", "books", (4.0, 2.0), math.radians(255.0))
PARTS = SceneObject("o2", "parts", (2.0, -1.5), math.radians(315.0), size=(0.2, 0.3, 0.4))


def front_and_back(own: str, other: str) -> dict[tuple[str, str], tuple[Response, ...]]:
    front, back = Response(math.pi / 2, 0.8, edge=0.05), Response(-math.pi / 2, 0.8, edge=0.05)
    return {(own, own): (front, back), (own, other): (front,)}


PERFECT = Errors()
EXACT = Odometry()
CAMERA = Camera()


def drive_around(
    errors: Errors = PERFECT, odometry: Odometry = EXACT, camera: Camera = CAMERA
) -> Scenario:
    """Once around one object and a look at the other."""
    return Scenario(
        name="around.yaml",
        objects=(BOOKS, PARTS),
        trajectory=Trajectory(
            (
                DriveTo((0.0, 0.0)),
                CircleAround("o2", 1.3, math.radians(120.0), math.radians(480.0)),
                LookAt("o1", direction=math.radians(-100.0), distance=1.5, wait=2.0),
            )
        ),
        detector=Recogniser(
            front_and_back("books", "parts") | front_and_back("parts", "books"), errors=errors
        ),
        odometry=odometry,
        camera=camera,
    )


# Motion


def test_path_turns_drives_and_waits_at_the_stated_speeds() -> None:
    stops = (DriveTo((1.0, 2.0)), DriveTo((1.0, 5.0), heading=math.pi, wait=1.5))
    path = plan_path(replace(drive_around(), trajectory=Trajectory(stops, 0.5, math.pi / 4)))

    # Turn by 90° at 45°/s, 3 m at 0.5 m/s, turn by 90° again, wait.
    assert path.times_ns.tolist() == [0, 2 * SECOND, 8 * SECOND, 10 * SECOND, 11_500_000_000]
    expected = [[1, 2, 0], [1, 2, 90], [1, 5, 90], [1, 5, 180], [1, 5, 180]]
    np.testing.assert_allclose(path.poses_world_robot * [1, 1, 180 / math.pi], expected, atol=1e-12)
    np.testing.assert_allclose(path.poses_at(np.array([5 * SECOND])), [[1, 3.5, math.pi / 2]])


@pytest.mark.parametrize(
    ("stop", "expected"),
    [
        (LookAt("o2", direction=math.radians(47.0), distance=1.2), (2.8183992, -0.6223756)),
        # Orientation 315°: (0.3, -0.8) of the object is ((0.3 - 0.8) / √2, (-0.3 - 0.8) / √2).
        (LookAt("o2", view=(0.3, -0.8)), (2.0 - 0.35355339, -1.5 - 0.77781746)),
    ],
)
def test_the_sensor_not_the_robot_stands_where_a_look_says(
    stop: LookAt, expected: tuple[float, float]
) -> None:
    camera = Camera(mount_xyz=(0.12, -0.05, 0.4), mount_rpy=(0.1, 0.3, 0.7))
    scenario = replace(drive_around(camera=camera), trajectory=Trajectory((stop,)))
    sensor = compose(plan_path(scenario).poses_world_robot[-1], planar_mount(camera))

    np.testing.assert_allclose(sensor[:2], expected, atol=1e-6)
    towards = math.atan2(-1.5 - sensor[1], 2.0 - sensor[0])
    assert abs(wrap_angle(sensor[2] - towards)) < 1e-12


@pytest.mark.parametrize(("start", "end"), [(120.0, 480.0), (30.0, -200.0)])
def test_a_circle_keeps_its_distance_and_its_eye_on_the_object(start: float, end: float) -> None:
    camera = Camera(mount_xyz=(0.12, -0.05, 0.4), mount_rpy=(0.0, 0.0, 0.7))
    circle = CircleAround("o2", 1.3, math.radians(start), math.radians(end))
    path = plan_path(replace(drive_around(camera=camera), trajectory=Trajectory((circle,))))
    times = np.linspace(0, path.times_ns[-1], 50).astype(np.int64)
    sensor = compose(path.poses_at(times), planar_mount(camera))

    seen = relative_pose(sensor, np.array([2.0, -1.5, 0.0]))
    np.testing.assert_allclose(seen[:, 0], 1.3, atol=1e-12)
    np.testing.assert_allclose(seen[:, 1], 0.0, atol=1e-12)
    directions = np.unwrap(np.arctan2(sensor[:, 1] + 1.5, sensor[:, 0] - 2.0))
    np.testing.assert_allclose(
        directions - directions[0], np.radians(end - start) * times / times[-1], atol=1e-9
    )


# Odometry

NOISY = Odometry(
    position_by_distance=0.03,
    heading_by_distance=0.02,
    heading_by_turn=0.04,
    position_drift=0.01,
    heading_drift=0.005,
)


def test_odometry_without_errors_is_the_truth() -> None:
    drive = simulate(drive_around())
    assert drive.frames.covariances is None
    np.testing.assert_allclose(
        drive.frames.poses_world_sensor, drive.truth.poses_world_sensor, atol=1e-12
    )


def test_odometry_errors_have_the_covariance_that_is_claimed() -> None:
    path = plan_path(drive_around())
    times = np.arange(0, path.times_ns[-1], SECOND // 10)
    true_poses = path.poses_at(times)
    # Far from the origin and turned, so that a lever arm about the wrong point would show.
    far = np.array([300.0, -200.0, 1.0])
    true_poses = compose(np.broadcast_to(far, true_poses.shape), true_poses)
    runs = [
        run_odometry(NOISY, times, true_poses, np.random.default_rng(seed)) for seed in range(400)
    ]
    for row in (len(times) // 2, -1):
        errors = np.array([run.poses_world_robot[row] - true_poses[row] for run in runs])
        errors[:, 2] = wrap_angle(errors[:, 2])
        squared = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(runs[0].covariances[row]), errors)
        # Mean of 400 chi squares of three degrees: standard deviation 0.12.
        assert abs(squared.mean() - 3.0) < 0.5


def test_covariance_claimed_can_be_less_than_the_truth() -> None:
    honest = simulate(drive_around(odometry=NOISY))
    vain = simulate(drive_around(odometry=replace(NOISY, covariance_factor=0.25)))
    assert honest.track.covariances is not None
    assert vain.track.covariances is not None
    np.testing.assert_array_equal(honest.track.poses_world_child, vain.track.poses_world_child)
    np.testing.assert_allclose(vain.track.covariances, 0.25 * honest.track.covariances)


# Camera


def test_box_of_an_object_straight_ahead() -> None:
    camera = Camera(
        intrinsics=(400.0, 500.0, 320.0, 240.0), mount_xyz=(0.1, 0.0, 0.3), max_range=9.0
    )
    item = SceneObject("o", "c", (2.1, 0.0), 0.0, size=(0.4, 0.6, 0.5))
    boxes, visible = project_boxes(camera, (item,), np.zeros((1, 3)))

    # The near face is 1.8 m ahead, from 0.3 m below to 0.2 m above the camera.
    expected = [320 - 400 * 0.3 / 1.8, 240 - 500 * 0.2 / 1.8]
    expected += [320 + 400 * 0.3 / 1.8, 240 + 500 * 0.3 / 1.8]
    np.testing.assert_allclose(boxes[0, 0], expected)
    assert visible.tolist() == [[True]]


@pytest.mark.parametrize(
    ("pose", "seen"),
    [
        ((0.0, 0.0, 0.0), True),
        ((0.0, 0.0, 0.56), True),  # half of it, perspective included, at 0.575
        ((0.0, 0.0, 0.59), False),
        ((0.0, 0.0, math.pi), False),
    ],
)
def test_an_object_is_seen_while_half_of_it_is_in_the_image(
    pose: tuple[float, float, float], seen: bool
) -> None:
    item = SceneObject("o", "c", (2.1, 0.0), 0.0)
    boxes, visible = project_boxes(Camera(), (item,), np.array([pose]))
    assert bool(visible[0, 0]) is seen
    assert np.all((boxes >= 0.0) & (boxes <= [640.0, 480.0, 640.0, 480.0]))


def test_pixels_of_a_tilted_camera_point_back_to_where_they_came_from() -> None:
    camera = Camera(mount_rpy=(0.15, 0.3, -0.5), mount_xyz=(0.0, 0.0, 0.0))
    points = np.array([[2.0, -1.0, -0.4], [1.0, -0.9, -0.1], [3.0, -0.2, -1.5]])
    body = transforms.rotate(transforms.conjugate(mount_quaternion(camera)), points)
    fx, fy, cx, cy = camera.intrinsics
    columns, rows = cx - fx * body[:, 1] / body[:, 0], cy - fy * body[:, 2] / body[:, 0]
    np.testing.assert_allclose(
        azimuths(camera, columns, rows), np.arctan2(points[:, 1], points[:, 0])
    )


def test_positive_pitch_looks_down_and_positive_yaw_to_the_left() -> None:
    mount = mount_quaternion(Camera(mount_rpy=(0.0, 0.2, 0.5)))
    axis = transforms.rotate(mount, np.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(
        axis, [math.cos(0.5) * math.cos(0.2), math.sin(0.5) * math.cos(0.2), -math.sin(0.2)]
    )


def test_a_nearer_object_hides_what_is_behind_it() -> None:
    front = SceneObject("front", "parts", (1.5, 0.0), math.pi / 2)
    behind = SceneObject("behind", "parts", (2.5, 0.05), math.pi / 2)
    aside = SceneObject("aside", "parts", (2.5, 0.9), math.pi / 2)
    always = Response(0.0, math.pi, peak=1.0)
    scenario = replace(
        drive_around(),
        objects=(behind, front, aside),
        trajectory=Trajectory((DriveTo((0.0, 0.0), wait=4.0),)),
        detector=Recogniser({("parts", "parts"): (always,)}, near=0.0, far=9.0),
    )
    measurements, _ = simulate_measurements(scenario)
    names = {measurements.object_ids[i] for i in measurements.object_index}
    assert names == {"front", "aside"}


# Recognition


def looks_at(scenario: Scenario, views: FloatArray) -> Looks:
    """The same views of every object."""
    many = np.repeat(views[:, None], len(scenario.objects), axis=1)
    return Looks(many, np.zeros(many.shape[:2]), np.ones(many.shape[:2], dtype=bool))


def test_responses_are_flat_or_round_and_fade_with_range() -> None:
    flat = Response(math.pi / 2, 0.8, "flat", peak=0.9, edge=0.1)
    round_lobe = Response(0.0, 0.5, "von_mises", peak=0.6)
    scenario = replace(
        drive_around(),
        objects=(BOOKS,),
        detector=Recogniser(
            {("books", "books"): (flat,), ("books", "parts"): (round_lobe,)}, near=0.5, far=3.0
        ),
    )
    angles = np.array([math.pi / 2, math.pi / 2 + 0.5, math.pi / 2 - 0.8, 0.0, 0.5, -0.5, math.pi])
    views = 1.5 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    probabilities = label_probabilities(scenario, looks_at(scenario, views))[:, 0]
    np.testing.assert_allclose(probabilities[:3, 0], [0.9, 0.9, 0.45], atol=1e-4)
    np.testing.assert_allclose(probabilities[3:6, 1], [0.6, 0.3, 0.3], atol=1e-4)
    assert probabilities[6, 0] < 1e-3

    away = np.array([[0.0, 0.5], [0.0, 3.0], [0.0, 4.0]])
    faded = label_probabilities(scenario, looks_at(scenario, away))[:, 0, 0]
    np.testing.assert_allclose(faded, [0.45, 0.45, 0.0], atol=1e-4)


def test_model_detector_returns_labels_as_often_as_the_model_says() -> None:
    classes = lopsided_model()
    scenario = replace(
        drive_around(),
        objects=(replace(BOOKS, class_name="three"),),
        detector=ModelDetector(peak=0.9, false_alarm=0.02),
        model=Model("m.yaml", "", "m", classes),
    )
    views = np.array([[0.9, -0.8], [0.2, -0.8]])
    probabilities = label_probabilities(scenario, looks_at(scenario, views))[:, 0]

    # Class "three" never gives "a"; "b" has one Gaussian and a little clutter.
    np.testing.assert_allclose(probabilities[:, 0], 0.02)
    entry = classes.likelihoods[2, 1]
    density = np.exp(entry.log_likelihood(views))
    np.testing.assert_allclose(probabilities[0, 1], 0.02 + 0.98 * 0.9)
    np.testing.assert_allclose(probabilities[1, 1], 0.02 + 0.98 * 0.9 * density[1] / density[0])
    assert probabilities[1, 1] < 0.7


def test_model_detector_without_a_model_is_refused() -> None:
    with pytest.raises(ModelError, match="needs a model"):
        simulate(replace(drive_around(), detector=ModelDetector()))


def test_errors_are_uniform_and_alike_over_the_stated_length() -> None:
    angles = np.array([0.0, 0.3, 1.2, math.pi - 1e-9, -math.pi + 1e-9])
    ranges = np.array([1.0, 1.0, 1.0, 1.0, 1.0])
    angles, ranges = np.append(angles, [0.0, 0.0]), np.append(ranges, [1.4, 3.0])
    views = ranges[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    correlation = Correlation(direction=0.3, distance=0.4, independent=0.25)
    draws = np.concatenate(
        [correlated_uniforms(views, correlation, 40, np.random.default_rng(s)) for s in range(150)],
        axis=1,
    )
    # 6000 draws: a frequency is known to 0.006, a correlation to 0.013 (one deviation).
    for level in (0.05, 0.5, 0.9):
        assert np.abs((draws < level).mean(axis=1) - level).max() < 0.025
    correlations = np.corrcoef(norm.ppf(draws))
    assert correlations[0, 1] == pytest.approx(0.75 * math.exp(-0.5), abs=0.05)
    assert correlations[0, 2] == pytest.approx(0.75 * math.exp(-8.0), abs=0.05)
    assert correlations[3, 4] == pytest.approx(0.75, abs=0.05)
    assert correlations[0, 5] == pytest.approx(0.75 * math.exp(-0.5), abs=0.05)
    assert correlations[0, 6] == pytest.approx(0.0, abs=0.05)


def test_errors_last_as_long_as_the_view_does() -> None:
    """A standing robot's detector repeats itself unless the errors are independent."""
    stand = Trajectory((LookAt("o2", view=(0.0, 1.3), wait=60.0),))
    half = {("parts", "parts"): (Response(math.pi / 2, 0.8, peak=0.5),)}
    rates = []
    for independent in (0.0, 1.0):
        correlation = Correlation(0.3, 0.3, independent)
        scenario = replace(
            drive_around(), trajectory=stand, detector=Recogniser(half, correlation=correlation)
        )
        rates.append([len(simulate_measurements(scenario, seed)[0]) / 300 for seed in range(30)])
    assert set(rates[0]) == {0.0, 1.0}
    assert max(abs(rate - 0.5) for rate in rates[1]) < 0.15


# Errors of the detector


def test_clutter_misses_and_wrong_ids_come_as_often_as_stated() -> None:
    errors = Errors(miss=0.3, clutter=0.5, clutter_with_id=0.4, wrong_id=0.1)
    clean = [simulate(drive_around(), seed).detections for seed in range(40)]
    dirty = [simulate(drive_around(errors), seed).detections for seed in range(40)]
    n_frames = sum(len(simulate(drive_around(), seed).frames) for seed in range(40))

    def count(runs: list[Detections], real: bool) -> int:
        return sum(int(np.sum((run.true_index >= 0) == real)) for run in runs)

    assert count(clean, real=False) == 0
    assert count(dirty, real=False) / n_frames == pytest.approx(0.5, abs=0.05)
    assert count(dirty, real=True) / count(clean, real=True) == pytest.approx(0.7, abs=0.06)
    real = np.concatenate([run.id_index[run.true_index >= 0] for run in dirty])
    true = np.concatenate([run.true_index[run.true_index >= 0] for run in dirty])
    assert np.mean(real != true) == pytest.approx(0.1, abs=0.02)
    ids_of_clutter = np.concatenate([run.id_index[run.true_index < 0] for run in dirty])
    assert np.mean(ids_of_clutter >= 0) == pytest.approx(0.4, abs=0.05)
    assert {int(i) for i in ids_of_clutter} == {-1, 0, 1}


def seen_pairs(detections: Detections) -> list[tuple[int, int]]:
    """Frame and object of every detection."""
    pairs = zip(detections.frame_index, detections.true_index, strict=True)
    return [(int(frame), int(item)) for frame, item in pairs]


def test_label_noise_flips_labels_of_reported_objects_alone() -> None:
    clean = [simulate(drive_around(), seed).detections for seed in range(40)]
    dirty = [simulate(drive_around(Errors(label_noise=0.1)), seed).detections for seed in range(40)]
    flips = total = 0
    for before, after in zip(clean, dirty, strict=True):
        # A detection whose labels were all flipped away is missing; none is new.
        places = {key: row for row, key in enumerate(seen_pairs(before))}
        rows = [places[key] for key in seen_pairs(after)]
        flips += int(np.sum((before.scores[rows] > 0) != (after.scores > 0)))
        flips += int(np.sum(np.delete(before.scores, rows, axis=0) > 0))
        total += before.scores.size
    assert flips / total == pytest.approx(0.1, abs=0.02)


def test_detections_without_ids() -> None:
    measurements, _ = simulate_measurements(drive_around(Errors(without_ids=True)))
    assert len(measurements) > 20
    assert set(measurements.object_index.tolist()) == {-1}


def test_each_part_draws_from_its_own_stream() -> None:
    plain = simulate(drive_around(), 7)
    cluttered = simulate(drive_around(Errors(clutter=1.0), odometry=NOISY), 7)
    real = cluttered.detections.true_index >= 0
    np.testing.assert_array_equal(cluttered.detections.boxes[real], plain.detections.boxes)
    np.testing.assert_array_equal(cluttered.detections.scores[real], plain.detections.scores)
    np.testing.assert_array_equal(cluttered.frames.log_times_ns, plain.frames.log_times_ns)


def test_the_seed_alone_decides() -> None:
    scenario = drive_around(Errors(clutter=0.3, label_noise=0.1), odometry=NOISY)
    first, again, other = (simulate_measurements(scenario, seed)[0] for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.scores, again.scores)
    np.testing.assert_array_equal(first.directions, again.directions)
    assert not np.array_equal(first.frames.poses_world_sensor, other.frames.poses_world_sensor)


# Measurements


def test_measurements_point_at_their_objects() -> None:
    measurements, truth = simulate_measurements(drive_around(camera=Camera(max_range=2.0)))
    centers = truth.poses[measurements.object_index, :2]
    sensor = measurements.frames.poses_world_sensor[measurements.frame_index, :2]
    bearing = np.arctan2(*(centers - sensor).T[::-1])
    right, left = measurements.directions.T
    assert np.all(wrap_angle(bearing - right) > 0.0)
    assert np.all(wrap_angle(left - bearing) > 0.0)
    assert np.all(wrap_angle(left - right) < 0.7)
    borders = measurements.frames.view_directions[measurements.frame_index]
    assert np.all(wrap_angle(right - borders[:, 0]) > -1e-12)
    assert np.all(wrap_angle(borders[:, 1] - left) > -1e-12)


def test_detections_that_share_an_id_in_a_frame_are_one_measurement() -> None:
    scenario = drive_around()
    frames = simulate(scenario).frames
    boxes = np.array([[10.0, 10, 20, 30], [300, 100, 340, 200], [50, 0, 60, 9], [0, 0, 9, 9]])
    detections = Detections(
        frame_index=np.array([4, 4, 4, 5]),
        boxes=boxes,
        id_index=np.array([1, -1, 1, 1]),
        true_index=np.array([1, -1, -1, 1]),
        scores=np.array([[0.0, 0.6], [0.7, 0.0], [0.8, 0.9], [0.0, 0.5]]),
    )
    measurements = to_measurements(detections, scenario, frames)
    assert measurements.frame_index.tolist() == [4, 4, 5]
    assert measurements.object_index.tolist() == [1, -1, 1]
    assert [measurements.label_names_of(row) for row in range(3)] == [
        ("books", "parts"),
        ("books",),
        ("parts",),
    ]
    assert measurements.scores.tolist() == [0.8, 0.9, 0.7, 0.5]
    # From the left edge of the box at 10 to the right edge of the box at 50.
    right, left = measurements.directions[0]
    fx, _, cx, _ = scenario.camera.intrinsics
    assert left - right == pytest.approx(math.atan((cx - 10) / fx) - math.atan((cx - 60) / fx))


def test_clocks_and_latency() -> None:
    day = 86_400 * SECOND
    camera = Camera(latency=(0.05, 0.13), rate=10.0)
    drive = simulate(replace(drive_around(camera=camera), log_clock_offset_ns=-3 * day))
    late = drive.frames.log_times_ns - drive.frames.stamps_ns + 3 * day
    assert late.min() >= 50_000_000
    assert late.max() <= 130_000_000
    assert late.std() > 10_000_000
    np.testing.assert_array_equal(np.diff(drive.frames.stamps_ns), SECOND // 10)


# Scripts


def scripted(*stops: DriveTo | LookAt) -> Scenario:
    return replace(drive_around(), trajectory=Trajectory(stops), detector=Script())


def test_a_script_is_followed_to_the_letter() -> None:
    scenario = scripted(
        DriveTo((0.0, 0.0)),
        LookAt("o2", direction=0.8, distance=1.2, wait=1.0, labels=("parts", "books")),
        LookAt("o1", direction=3.0, distance=0.9, wait=1.0),
        LookAt("o1", direction=2.0, distance=0.9, wait=1.0, labels=("books",)),
    )
    measurements, truth = simulate_measurements(scenario)
    assert [measurements.label_names_of(row) for row in range(2)] == [
        ("parts", "books"),
        ("books",),
    ]
    assert [measurements.object_ids[i] for i in measurements.object_index] == ["o2", "o1"]
    assert measurements.scores.tolist() == [1.0, 1.0, 1.0]
    sensor = measurements.frames.poses_world_sensor
    expected = [2.0 + 1.2 * math.cos(0.8), -1.5 + 1.2 * math.sin(0.8)]
    np.testing.assert_allclose(sensor[0, :2], expected, atol=1e-14)
    np.testing.assert_array_equal(sensor, truth.poses_world_sensor)


def test_a_script_cannot_see_what_the_camera_does_not() -> None:
    look = LookAt("o2", direction=0.8, distance=1.2, wait=1.0, labels=("parts",))
    up = Camera(mount_rpy=(0.0, -1.2, 0.0))
    with pytest.raises(ModelError, match=r"around\.yaml: stop 1 looks at o2"):
        simulate(replace(scripted(look), camera=up))


# Sizes


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"odometry": Odometry(rate=100_000.0)}, "at 100000 a second"),
        (
            {
                "camera": Camera(rate=10_000.0),
                "objects": (BOOKS, PARTS, replace(BOOKS, object_id="o3")),
            },
            "3 objects are more than 1,000,000 looks",
        ),
        ({"trajectory": Trajectory((DriveTo((0, 0)), DriveTo((1e7, 0))), 1.0)}, "116 days"),
    ],
)
def test_drives_without_end_are_refused_before_they_begin(
    change: dict[str, Any], message: str
) -> None:
    with pytest.raises(ModelError, match=message):
        simulate(replace(drive_around(), **change))
