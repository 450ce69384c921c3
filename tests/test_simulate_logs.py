"""Simulated logs: what is written, in every encoding, and the sample logs."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from mclass.commands.simulate import simulate as command
from mclass.errors import LogError
from mclass.logs.measurements import read_measurements
from mclass.logs.reader import LogReader
from mclass.messages import proto_json, protobuf, ros
from mclass.simulation.scenario import Errors, Odometry, Recogniser, Scenario
from mclass.simulation.scenario_file import load_scenario
from mclass.simulation.world import Drive, simulate, simulate_measurements
from mclass.simulation.write import Encoding, truth_text, write_log

ROOT = Path(__file__).parent.parent
SCENARIOS = ROOT / "configs" / "scenarios"
SAMPLES = ROOT / "sample_logs"
ENCODINGS: tuple[Encoding, ...] = ("ros2", "protobuf", "json")
DECODERS: Mapping[str, Callable[[str, bytes], dict[str, Any]]] = {
    "cdr": lambda name, data: ros.codec(name).decode(data),
    "protobuf": lambda name, data: protobuf.codec(name).decode(data),
    "json": lambda name, data: proto_json.codec(name).decode(data),
}
SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def office() -> Scenario:
    """The office, for a short while."""
    scenario = load_scenario(SCENARIOS / "office.yaml")
    stops = scenario.trajectory.stops[:2]
    return replace(scenario, trajectory=replace(scenario.trajectory, stops=stops))


@pytest.fixture(scope="module")
def office_drive(office: Scenario) -> Drive:
    return simulate(office)


@pytest.fixture(scope="module")
def office_logs(
    office_drive: Drive, tmp_path_factory: pytest.TempPathFactory
) -> dict[Encoding, Path]:
    folder = tmp_path_factory.mktemp("office")
    paths = {encoding: folder / f"{encoding}.mcap" for encoding in ENCODINGS}
    for encoding, path in paths.items():
        write_log(office_drive, path, encoding)
    return paths


def messages(path: Path) -> list[tuple[str, int, dict[str, Any]]]:
    """Topic, log time and content of every message in file order."""
    found = []
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            assert schema is not None
            value = DECODERS[channel.message_encoding](schema.name, message.data)
            found.append((channel.topic, message.log_time, value))
    return found


def extras(path: Path) -> tuple[dict[str, bytes], dict[str, dict[str, str]]]:
    """Attachments and metadata by name."""
    with path.open("rb") as stream:
        reader = make_reader(stream)
        attachments = {found.name: found.data for found in reader.iter_attachments()}
        return attachments, {found.name: found.metadata for found in reader.iter_metadata()}


def assert_same(first: Any, second: Any) -> None:
    """Equal structure and text; numbers equal but for the last digits of another machine."""
    numbers: tuple[list[float], list[float]] = ([], [])
    texts: tuple[list[str], list[str]] = ([], [])
    for value, own_numbers, own_texts in zip((first, second), numbers, texts, strict=True):
        take_apart(value, own_numbers, own_texts)
    assert texts[0] == texts[1]
    np.testing.assert_allclose(numbers[0], numbers[1], rtol=1e-9, atol=1e-9)


def take_apart(value: Any, numbers: list[float], texts: list[str]) -> None:
    """Fractions into ``numbers``, everything else and the structure into ``texts``."""
    if isinstance(value, Mapping):
        value = list(value.items())
    if isinstance(value, list | tuple | np.ndarray):
        texts.append(f"{len(value)}:")
        if isinstance(value, np.ndarray):
            numbers.extend(value.tolist())
            return
        for element in value:
            take_apart(element, numbers, texts)
    elif isinstance(value, float):
        numbers.append(value)
    else:
        texts.append(str(value))


# What is written


@pytest.fixture(scope="module")
def decoded(office_logs: dict[Encoding, Path]) -> dict[str, list[tuple[int, Any]]]:
    """Log time and message by topic, as another ROS reader has them."""
    found: dict[str, list[tuple[int, Any]]] = {}
    with office_logs["ros2"].open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, message, value in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, value))
    return found


def stamp(header: Any) -> int:
    return int(header.stamp.sec * SECOND + header.stamp.nanosec)


def test_odometry_in_ros(office_drive: Drive, decoded: dict[str, list[tuple[int, Any]]]) -> None:
    drive, offset = office_drive, 400 * 86_400 * SECOND
    assert len(decoded["/odom"]) == len(decoded["/tf"]) == len(drive.track.stamps_ns)
    row = 137
    log_time, odometry = decoded["/odom"][row]
    assert stamp(odometry.header) == drive.track.stamps_ns[row] == log_time - offset
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("odom", "base_link")
    pose = odometry.pose.pose
    x, y, heading = drive.track.poses_world_child[row]
    assert (pose.position.x, pose.position.y, pose.position.z) == (x, y, 0.0)
    assert 2.0 * np.arctan2(pose.orientation.z, pose.orientation.w) == pytest.approx(heading)
    covariance = np.array(odometry.pose.covariance).reshape(6, 6)
    assert drive.track.covariances is not None
    expected = drive.track.covariances[row]
    assert expected[2, 2] > 0.0
    np.testing.assert_array_equal(covariance[np.ix_([0, 1, 5], [0, 1, 5])], expected)
    assert odometry.twist.twist.linear.y == drive.twists[row, 1]
    assert odometry.twist.twist.angular.z == drive.twists[row, 2]

    (moved,) = decoded["/tf"][row][1].transforms
    assert (moved.header.frame_id, moved.child_frame_id) == ("odom", "base_link")
    assert moved.transform.translation.x == x


def test_camera_in_ros(decoded: dict[str, list[tuple[int, Any]]]) -> None:
    mounts = decoded["/tf_static"][0][1].transforms
    frames = [(mount.header.frame_id, mount.child_frame_id) for mount in mounts]
    assert frames == [("base_link", "camera_link"), ("camera_link", "camera_optical_frame")]
    tilt = mounts[0].transform.rotation
    assert 2.0 * np.arctan2(tilt.y, tilt.w) == pytest.approx(np.radians(8.0))
    assert mounts[0].transform.translation.z == 0.35

    info = decoded["/camera/camera_info"][0][1]
    assert (info.width, info.height) == (640, 480)
    assert list(info.k) == [457, 0, 319.5, 0, 457, 239.5, 0, 0, 1]


def test_detections_in_ros(office_drive: Drive, decoded: dict[str, list[tuple[int, Any]]]) -> None:
    arrays, drive = decoded["/detections"], office_drive
    assert len(arrays) == len(drive.frames)
    given = drive.detections
    counts = [len(array.detections) for _, array in arrays]
    assert counts == np.bincount(given.frame_index, minlength=len(drive.frames)).tolist()
    assert 0 in counts
    frame = int(np.flatnonzero(np.sum(given.scores > 0, axis=1) == 2)[0])
    log_time, array = arrays[given.frame_index[frame]]
    assert stamp(array.header) == drive.frames.stamps_ns[given.frame_index[frame]]
    assert log_time == drive.frames.log_times_ns[given.frame_index[frame]]
    first = int(np.searchsorted(given.frame_index, given.frame_index[frame]))
    detection = array.detections[frame - first]
    assert detection.id == "printer_1"
    names = drive.scenario.label_names
    assert [(r.hypothesis.class_id, r.hypothesis.score) for r in detection.results] == [
        (names[label], given.scores[frame, label]) for label in np.flatnonzero(given.scores[frame])
    ]
    left, top, right, bottom = given.boxes[frame]
    box = detection.bbox
    assert box.center.position.x - box.size_x / 2 == pytest.approx(left)
    assert box.center.position.x + box.size_x / 2 == pytest.approx(right)
    assert box.center.position.y - box.size_y / 2 == pytest.approx(top)
    assert box.center.position.y + box.size_y / 2 == pytest.approx(bottom)


BOX = ("center_x", "center_y", "width", "height")


def in_order(fields: Mapping[str, Any]) -> list[Any]:
    """Values by the names of their fields."""
    return [fields[key] for key in sorted(fields)]


def plain(topic: str, value: dict[str, Any]) -> Any:
    """What a message says, whatever its schema calls it."""
    if topic == "/detections" and "header" in value:
        return [
            (
                *in_order(value["header"]["stamp"]),
                *(result["hypothesis"]["class_id"], result["hypothesis"]["score"]),
                one["id"],
                *in_order(one["bbox"]["center"]["position"]),
                *(one["bbox"]["size_x"], one["bbox"]["size_y"]),
            )
            for one in value["detections"]
            for result in one["results"]
        ]
    if topic == "/detections":
        times = in_order(value["timestamp"])
        return [
            (*times, *in_order(label), one["id"], *(one["box"][key] for key in BOX))
            for one in value["detections"]
            for label in one["labels"]
        ]
    if "covariance" in value.get("pose", {}):
        time, pose = value["header"]["stamp"], value["pose"]["pose"]
        covariance, twist = value["pose"]["covariance"], value["twist"]["twist"]
        linear, angular = twist["linear"], twist["angular"]
    elif topic == "/odom":
        time, pose, covariance = value["timestamp"], value["pose"], value["pose_covariance"]
        linear, angular = value["linear_velocity"], value["angular_velocity"]
    elif topic.startswith("/tf"):
        return [
            [
                *in_order(one.get("header", {"stamp": one.get("timestamp")})["stamp"]),
                *in_order(one.get("transform", one)["translation"]),
                *in_order(one.get("transform", one)["rotation"]),
            ]
            for one in value["transforms"]
        ]
    else:
        matrix = value["k"] if "k" in value else value["K"]
        return [value["width"], value["height"], list(matrix)]
    vectors = (time, pose["position"], pose["orientation"], linear, angular)
    return [in_order(vector) for vector in vectors], list(covariance)


def test_the_three_encodings_hold_the_same_numbers(office_logs: dict[Encoding, Path]) -> None:
    contents = [
        [
            (topic.replace("camera_info", "calibration"), log_time, plain(topic, value))
            for topic, log_time, value in messages(office_logs[encoding])
        ]
        for encoding in ENCODINGS
    ]
    assert contents[0] == contents[1]
    assert contents[1] == contents[2]
    assert len(contents[0]) > 500


def test_truth_model_and_seed_go_along(
    office_drive: Drive, office_logs: dict[Encoding, Path]
) -> None:
    attachments, metadata = extras(office_logs["protobuf"])
    truth = json.loads(attachments["truth.json"])
    assert truth == json.loads(truth_text(office_drive))
    assert truth["objects"][3] == {
        "id": "monitor_2",
        "class": "monitor",
        "x": 5.5,
        "y": 2.6,
        "phi": 180.0,
        "against_wall": True,
    }
    assert truth["classes"] == ["printer", "cabinet", "monitor"]
    assert truth["camera_mount"]["rpy_deg"] == [0.0, 8.0, 0.0]
    model = (ROOT / "configs" / "office.yaml").read_bytes()
    assert attachments["mclass.yaml"] == model
    assert metadata["mclass_simulation"] == {"scenario": "office.yaml", "seed": "1"}


def test_the_same_drive_gives_the_same_bytes(
    office: Scenario, office_logs: dict[Encoding, Path], tmp_path: Path
) -> None:
    write_log(simulate(office), tmp_path / "again.mcap")
    assert (tmp_path / "again.mcap").read_bytes() == office_logs["ros2"].read_bytes()


def test_logs_are_in_the_order_of_their_log_times(office_logs: dict[Encoding, Path]) -> None:
    times = [log_time for _, log_time, _ in messages(office_logs["json"])]
    assert times == sorted(times)


def test_a_drive_that_stands_still_and_sees_nothing(office: Scenario, tmp_path: Path) -> None:
    stops = office.trajectory.stops[:1]
    empty = replace(
        office,
        trajectory=replace(office.trajectory, stops=stops),
        detector=Recogniser({("printer", "printer"): ()}, errors=Errors()),
        odometry=Odometry(),
        model=None,
    )
    write_log(simulate(empty), tmp_path / "still.mcap")
    topics = {topic for topic, _, _ in messages(tmp_path / "still.mcap")}
    assert topics == {"/odom", "/tf", "/tf_static", "/camera/camera_info"}


def test_stamps_that_ros_cannot_hold_leave_no_file(office: Scenario, tmp_path: Path) -> None:
    late = replace(office, start_ns=2**31 * SECOND)
    with pytest.raises(LogError):
        write_log(simulate(late), tmp_path / "late.mcap")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("without_ids", [False, True])
def test_reading_a_log_gives_the_measurements_that_skip_it(
    encoding: Encoding, without_ids: bool, office: Scenario, tmp_path: Path
) -> None:
    assert isinstance(office.detector, Recogniser)
    assert office.model is not None
    errors = Errors(clutter=2.0, clutter_with_id=0.7, wrong_id=0.3, without_ids=without_ids)
    busy = replace(office, detector=replace(office.detector, errors=errors))
    write_log(simulate(busy), tmp_path / "log.mcap", encoding)
    with LogReader.open(tmp_path / "log.mcap") as reader:
        contents = read_measurements(reader, office.model)
    read, (direct, _) = contents.measurements, simulate_measurements(busy)

    assert contents.frame == "odom"
    assert ("merged with another detection of the same id" in contents.tally.counts) != without_ids
    for name in ("frame_index", "labels", "label_offsets"):
        np.testing.assert_array_equal(getattr(read, name), getattr(direct, name))
    for name in ("directions", "scores"):
        np.testing.assert_allclose(getattr(read, name), getattr(direct, name), atol=1e-12)
    read_ids = [None if i < 0 else read.object_ids[i] for i in read.object_index]
    assert read_ids == [None if i < 0 else direct.object_ids[i] for i in direct.object_index]
    for name in ("stamps_ns", "log_times_ns"):
        np.testing.assert_array_equal(getattr(read.frames, name), getattr(direct.frames, name))
    for name in ("poses_world_sensor", "covariances", "view_directions"):
        np.testing.assert_allclose(
            getattr(read.frames, name), getattr(direct.frames, name), atol=1e-12
        )


# The command


def test_command_writes_the_log_and_the_truth(tmp_path: Path) -> None:
    log, truth = tmp_path / "toy.mcap", tmp_path / "truth.json"
    arguments = [str(SCENARIOS / "paper_toy.yaml"), "-o", str(log), "--truth", str(truth)]
    result = CliRunner().invoke(command, [*arguments, "--encoding", "json", "--seed", "3"])
    assert result.exit_code == 0, result.output
    assert result.stdout == f"{log}: 1 objects, 3 camera frames, 3 detections, json\n"
    assert json.loads(truth.read_text())["objects"][0]["phi"] == 45.0
    attachments, metadata = extras(log)
    assert attachments["truth.json"] == truth.read_bytes()
    assert metadata["mclass_simulation"]["seed"] == "3"


@pytest.mark.parametrize("existing", ["toy.mcap", "truth.json"])
def test_command_writes_both_or_neither(existing: str, tmp_path: Path) -> None:
    arguments = [str(SCENARIOS / "paper_toy.yaml"), "-o", str(tmp_path / "toy.mcap")]
    arguments += ["--truth", str(tmp_path / "truth.json")]
    (tmp_path / existing).write_text("kept")
    result = CliRunner().invoke(command, arguments)
    assert isinstance(result.exception, LogError)
    assert [path.name for path in tmp_path.iterdir()] == [existing]
    assert (tmp_path / existing).read_text() == "kept"

    assert CliRunner().invoke(command, [*arguments, "--overwrite"]).exit_code == 0
    assert len(messages(tmp_path / "toy.mcap")) > 1000
    assert json.loads((tmp_path / "truth.json").read_text())["frame"] == "odom"


def test_command_names_the_log_after_the_scenario(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(command, [str(SCENARIOS / "paper_toy.yaml")])
    assert result.exit_code == 0
    assert [path.name for path in tmp_path.iterdir()] == ["paper_toy.mcap"]


def test_truth_does_not_replace_the_log(tmp_path: Path) -> None:
    same = str(tmp_path / "x.mcap")
    arguments = [str(SCENARIOS / "paper_toy.yaml"), "-o", same, "--truth", same, "--overwrite"]
    assert CliRunner().invoke(command, arguments).exit_code == 2
    assert list(tmp_path.iterdir()) == []


def test_command_refuses_what_is_not_there(tmp_path: Path) -> None:
    result = CliRunner().invoke(command, [str(tmp_path / "no.yaml"), "-o", "x.mcap"])
    assert result.exit_code == 2
    assert "does not exist" in result.output


# The sample logs


@pytest.mark.parametrize(
    ("name", "scenario", "encoding"),
    [
        ("paper_toy", "paper_toy", "ros2"),
        ("cas_lab", "cas_lab", "ros2"),
        ("cas_lab_protobuf", "cas_lab", "protobuf"),
        ("cas_lab_json", "cas_lab", "json"),
    ],
)
def test_sample_logs_are_what_their_scenarios_make(
    name: str, scenario: str, encoding: Encoding, tmp_path: Path
) -> None:
    sample, again = SAMPLES / f"{name}.mcap", tmp_path / "again.mcap"
    write_log(simulate(load_scenario(SCENARIOS / f"{scenario}.yaml")), again, encoding)
    assert_same(messages(sample), messages(again))
    assert extras(sample) == extras(again)
    assert sample.stat().st_size < 1_000_000
    assert f" {scenario}.yaml -o {name}.mcap" in (SAMPLES / "make").read_text().replace(
        "$scenarios/", ""
    )


def test_the_script_that_makes_them_is_well_formed() -> None:
    subprocess.run(["sh", "-n", SAMPLES / "make"], check=True)


def test_the_sensor_of_the_experiment_stands_where_the_paper_says() -> None:
    drive = simulate(load_scenario(SCENARIOS / "cas_lab.yaml"))
    seen = drive.detections.id_index
    offsets = drive.frames.poses_world_sensor[:, :2] - drive.truth.poses[seen, :2]
    assert [drive.truth.object_ids[row] for row in seen] == ["o2", "o3", "o2", "o1", "o1"]
    directions = np.degrees(np.arctan2(offsets[:, 1], offsets[:, 0])) % 360.0
    np.testing.assert_allclose(directions, [47, 93, 222, 147, 0], atol=1e-9)
    np.testing.assert_allclose(np.hypot(*offsets.T), [1.2, 1.2, 1.1, 0.9, 1.0], atol=1e-12)
    returned = drive.detections.scores > 0
    assert returned.tolist() == [[1, 1], [0, 1], [0, 1], [1, 0], [1, 1]]
