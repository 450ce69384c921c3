"""Several outputs in one map: the belief is that of one log that holds all measurements."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

import mclass
from mclass.commands.cli import main
from mclass.config.frames_file import load_frames
from mclass.fusion import fuse
from mclass.geometry import compose
from mclass.joining import Part, join
from mclass.outputs.channels import Encoding
from mclass.records import FloatArray, IntArray, LabelMeasurements

LAB = Path(__file__).parent.parent / "sample_logs" / "cas_lab.mcap"

MODEL = """
background: {prior: 1.0, likelihood: 0.01}
viewpoints:
  front: {position: [0.4, 1.6], covariance: [0.4, 0.2]}
  side: {position: [1.3, -0.2], covariance: 0.3}
classes:
  door:
    prior: 1.0
    labels:
      door: {probability: 0.7, views: {front: 0.6, side: 0.4}}
      box: {probability: 0.2, views: {front: 0.5}, covariance: 0.5}
  box:
    prior: 0.6
    labels:
      box: {probability: 0.8, views: {side: 0.7, front: 0.3}}
      door: {probability: 0.1, views: {side: 0.5}}
grid: {cell_size: 1.0, orientation_bins: 24, range: [0.2, 3.0]}
"""
PAPER = MODEL + "inference: {preset: paper}\n"
ROBUST = MODEL + "inference: {preset: robust, correlation: {range: 0.5, direction_deg: 20}}\n"
DRIFTING = MODEL + (
    "inference: {preset: robust, pose_uncertainty: true, drift: 0.08,  # odometry\n"
    "  correlation: false}\n"
)
DAY = 86_400_000_000_000


def drive(seed: int, count: int = 15, **changes: Any) -> LabelMeasurements:
    """Looks at three places from around them, some in vain; two objects have ids."""
    rng = np.random.default_rng(seed)
    places = np.array([[2.1, 0.4], [-1.2, 1.3], [0.3, -1.7]])
    which = rng.integers(3, size=count)
    around = rng.uniform(-np.pi, np.pi, count)
    reach = rng.uniform(1.0, 2.2, count)[:, None]
    positions = places[which] + reach * np.column_stack([np.cos(around), np.sin(around)])
    axes = around + np.pi + rng.normal(0.0, 0.05, count)
    half = rng.uniform(0.1, 0.25, count)
    labels = [["door"], ["box"], ["door", "box"], []]
    arguments: dict[str, Any] = {
        "poses": np.column_stack([positions, axes]),
        "labels": [labels[i] for i in rng.choice(4, size=count, p=[0.4, 0.3, 0.15, 0.15])],
        "label_names": ("box", "door"),
        "directions": np.column_stack([axes - half, axes + half]),
        "object_ids": [("first", "second", None)[i] for i in which],
        "view_directions": np.column_stack([axes - 0.5, axes + 0.5]),
        "covariances": rng.uniform(0.0, 0.02, (count, 1, 1)) * np.diag([1.0, 2.0, 0.3]),
        "stamps_ns": 1_700_000_000_000_000_000 + 400_000_000 * np.arange(count),
    }
    found = mclass.measurements_from_arrays(**{**arguments, **changes})
    names = mclass.parse_model(PAPER, "m").classes.label_names
    assert set(names) == set(found.label_names)
    return join([Part(found, np.zeros(3))], names)


def rows_of(measurements: LabelMeasurements, frames: IntArray) -> LabelMeasurements:
    """The part of the measurements that some frames hold, as a log of its own."""
    old = measurements.frames
    rows = np.flatnonzero(np.isin(measurements.frame_index, frames))
    spans = [
        np.arange(measurements.label_offsets[row], measurements.label_offsets[row + 1])
        for row in rows
    ]
    taken = np.concatenate(spans)
    return replace(
        measurements,
        frames=replace(
            old,
            stamps_ns=old.stamps_ns[frames],
            log_times_ns=old.log_times_ns[frames],
            poses_world_sensor=old.poses_world_sensor[frames],
            covariances=None if old.covariances is None else old.covariances[frames],
            view_directions=old.view_directions[frames],
        ),
        frame_index=np.searchsorted(frames, measurements.frame_index[rows]),
        directions=measurements.directions[rows],
        object_index=measurements.object_index[rows],
        label_offsets=np.cumsum([0, *map(len, spans)]),
        labels=measurements.labels[taken],
        scores=measurements.scores[taken],
    )


def seen_from(measurements: LabelMeasurements, pose: FloatArray) -> LabelMeasurements:
    """The same in a world whose origin stands at a pose of this one."""
    turn = -pose[2]
    cosine, sine = np.cos(turn), np.sin(turn)
    x, y = cosine * -pose[0] - sine * -pose[1], sine * -pose[0] + cosine * -pose[1]
    return join([Part(measurements, np.array([x, y, turn]))], measurements.label_names)


def written(measurements: LabelMeasurements, model: str, path: Path, **options: Any) -> Path:
    mclass.infer(measurements, model, output=path, **options)
    return path


def assert_equal_beliefs(one: mclass.Estimate, other: mclass.Estimate, atol: float = 1e-5) -> None:
    """In every probability: classes of objects and cells, orientations, places."""
    assert one.object_ids == other.object_ids
    assert len(one.object_ids) > 0
    np.testing.assert_allclose(one.class_probabilities, other.class_probabilities, atol=atol)
    assert one.maps is not None
    assert other.maps is not None
    assert one.maps.grid == other.maps.grid
    np.testing.assert_array_equal(one.maps.cells, other.maps.cells)
    np.testing.assert_allclose(
        one.maps.class_probabilities, other.maps.class_probabilities, atol=atol
    )
    for left, right in zip(one.grid_belief(), other.grid_belief(), strict=True):
        np.testing.assert_allclose(
            np.exp(left.log_density), np.exp(right.log_density), atol=10 * atol
        )
    for key, belief in one.object_beliefs.items():
        mine, yours = (
            dict(zip(b.cells.tolist(), np.exp(b.log_cell_mass), strict=True))
            for b in (belief, other.object_beliefs[key])
        )
        for cell in mine.keys() | yours.keys():
            assert mine.get(cell, 0.0) == pytest.approx(yours.get(cell, 0.0), abs=atol)


@pytest.mark.parametrize(
    ("text", "encoding"), [(PAPER, "json"), (ROBUST, "ros2")], ids=["paper", "robust"]
)
def test_fused_belief_is_that_of_one_log(tmp_path: Path, text: str, encoding: Encoding) -> None:
    whole = drive(1)
    frames = np.arange(len(whole.frames))
    parts = [rows_of(whole, frames[start::3]) for start in range(3)]
    outputs = [
        written(part, text, tmp_path / f"{index}.mcap", encoding=encoding)
        for index, part in enumerate(parts)
    ]
    fused = fuse(outputs, tmp_path / "map.mcap")
    alone = mclass.infer(whole, text)
    assert fused.used == alone.used
    assert fused.used + sum(fused.skipped.values()) == len(whole)
    assert fused.skipped == alone.skipped
    assert_equal_beliefs(fused, alone)
    for estimate, other in zip(fused.objects, alone.objects, strict=True):
        np.testing.assert_allclose(estimate.position, other.position, atol=1e-5)
        assert estimate.measurements == other.measurements
        assert estimate.stamp_ns == other.stamp_ns
    with mclass.OutputLog.open(tmp_path / "map.mcap") as log:
        assert log.metadata["encoding"] == encoding
        assert all(channel.topic.startswith("/mclass/") for channel in log.reader.channels)
        stored = log.measurements()
    for name in ("frame_index", "directions", "labels", "label_offsets", "object_index"):
        np.testing.assert_array_equal(getattr(stored, name), getattr(whole, name))
    np.testing.assert_array_equal(stored.frames.covariances, whole.frames.covariances)


@pytest.mark.parametrize("text", [MODEL, ROBUST, PAPER], ids=["default", "robust", "paper"])
def test_robots_with_worlds_grids_prefixes_and_encodings_of_their_own(
    tmp_path: Path, text: str
) -> None:
    whole = drive(11, 24)
    places = whole.frames.poses_world_sensor[:, 0]
    parts = [rows_of(whole, np.sort(found)) for found in np.array_split(np.argsort(places), 3)]
    poses = [np.zeros(3), np.array([1.37, -2.21, 0.83]), np.array([-40.6, 8.05, -2.9])]
    encodings: list[Encoding] = ["ros2", "json", "protobuf"]
    outputs, lines, origins = [], [], set()
    for number, (part, pose, encoding) in enumerate(zip(parts, poses, encodings, strict=True)):
        path = tmp_path / f"robot{number}" / "run.mclass.mcap"
        path.parent.mkdir()
        settings = {"encoding": encoding, "frame": f"odom{number}", "prefix": f"/robot{number}"}
        outputs.append(written(seen_from(part, pose), text, path, **settings))
        x, y, heading = map(float, pose)
        lines.append(f"{path}: {{x: {x}, y: {y}, heading_deg: {math.degrees(heading)!r}}}\n")
        alone = mclass.infer(part, text)
        assert alone.maps is not None
        origins.add(alone.maps.grid.origin)
    assert len(origins) == 3
    yaml = tmp_path / "frames.yaml"
    yaml.write_text("".join(lines))
    fused = fuse(outputs, tmp_path / "map.mcap", frames=yaml, prefix="/all")
    assert_equal_beliefs(fused, mclass.infer(whole, text))
    with mclass.OutputLog.open(tmp_path / "map.mcap") as log:
        assert (log.frame, log.prefix, log.metadata["encoding"]) == ("map", "/all", "protobuf")


def log_joint(found: mclass.Estimate) -> tuple[FloatArray, FloatArray]:
    """Of every touched cell: log belief over class and orientation, background apart."""
    blocks = list(found.grid_belief())
    cells = np.concatenate([block.cells for block in blocks])
    order = np.argsort(cells)
    classes = np.concatenate([block.log_class_probability for block in blocks])[order]
    density = np.concatenate([block.log_density for block in blocks])[order]
    return classes[:, 1:, None] + density - classes[:, :1, None], cells[order]


def test_the_papers_beliefs_are_added_and_the_prior_counts_once() -> None:
    fixed = PAPER.replace("0.2, 3.0]", "0.2, 3.0], origin: [-4, -4], size: [8, 8]")
    whole = drive(2)
    frames = np.arange(len(whole.frames))
    halves = [mclass.infer(rows_of(whole, frames[start::2]), fixed) for start in (0, 1)]
    fused, cells = log_joint(mclass.infer(join_of(halves), fixed))
    priors = mclass.parse_model(fixed, "m").classes.log_priors
    prior = priors[1:, None] - np.log(2 * np.pi) - priors[0]
    total = np.zeros_like(fused) + prior
    for half in halves:
        belief, touched = log_joint(half)
        total[np.searchsorted(cells, touched)] += belief - prior
    np.testing.assert_allclose(total, fused, atol=2e-3)


def join_of(parts: Sequence[mclass.Estimate]) -> LabelMeasurements:
    names = parts[0].model.classes.label_names
    return join([Part(part.measurements, np.zeros(3)) for part in parts], names)


def test_looks_of_different_logs_share_a_vote(tmp_path: Path) -> None:
    # The same looks again, in another log, by another robot, are hardly more evidence.
    first = drive(3, 6)
    later = replace(first.frames, stamps_ns=first.frames.stamps_ns + DAY)
    again = replace(first, frames=later)
    changes = {}
    for name, text in (("robust", ROBUST), ("paper", PAPER)):
        one = written(first, text, tmp_path / f"{name}1.mcap")
        two = written(again, text, tmp_path / f"{name}2.mcap")
        fused, alone = fuse([one, two]).maps, mclass.infer(first, text).maps
        assert fused is not None
        assert alone is not None
        difference = fused.class_probabilities - alone.class_probabilities
        changes[name] = np.abs(difference).sum(axis=1).max() / 2.0
    assert changes["robust"] < 0.02
    assert changes["paper"] > 0.1


def test_worlds_are_related_by_frames(tmp_path: Path) -> None:
    # Turned by a right angle and moved by whole cells, so that cells coincide.
    pose = np.array([3.0, -2.0, np.pi / 2])
    whole = drive(4)
    frames = np.arange(len(whole.frames))
    one, two = (rows_of(whole, frames[start::2]) for start in (0, 1))
    written(one, ROBUST, tmp_path / "one.mclass.mcap", frame="odom")
    written(seen_from(two, pose), ROBUST, tmp_path / "two.mclass.mcap", frame="odom")
    yaml = tmp_path / "frames.yaml"
    yaml.write_text(
        "one: {x: 0, y: 0, heading_deg: 0}\ntwo.mclass.mcap: {x: 3, y: -2, heading_deg: 90}\n"
    )
    outputs = [tmp_path / "one.mclass.mcap", tmp_path / "two.mclass.mcap"]
    fused = fuse(outputs, frames=yaml)
    alone = mclass.infer(whole, ROBUST)
    assert fused.frame == "map"
    assert_equal_beliefs(fused, alone)
    unrelated = fuse(outputs)
    assert np.abs(unrelated.positions - alone.positions).max() > 0.3


def test_a_moved_measurement_by_hand() -> None:
    found = mclass.measurements_from_arrays(
        [[1.0, 0.0, 0.1]],
        [["a"]],
        ("a",),
        directions=[[0.2, 0.4]],
        view_directions=[[-0.3, 0.5]],
        covariances=[[[4.0, 1.0, 0.5], [1.0, 2.0, 0.25], [0.5, 0.25, 3.0]]],
    )
    pose = np.array([10.0, 20.0, np.pi / 2])
    moved = join([Part(found, pose)], ("a",))
    expected = compose(pose, found.frames.poses_world_sensor[0])
    np.testing.assert_allclose(moved.frames.poses_world_sensor[0], expected)
    np.testing.assert_allclose(moved.frames.poses_world_sensor[0, :2], [10.0, 21.0])
    np.testing.assert_allclose(moved.directions[0], [0.2 + np.pi / 2, 0.4 + np.pi / 2])
    np.testing.assert_allclose(moved.frames.view_directions[0], [np.pi / 2 - 0.3, np.pi / 2 + 0.5])
    assert moved.frames.covariances is not None
    np.testing.assert_allclose(
        moved.frames.covariances[0],
        [[2.0, -1.0, -0.25], [-1.0, 4.0, 0.5], [-0.25, 0.5, 3.0]],
        atol=1e-12,
    )


def test_rows_ids_and_labels_are_joined_by_hand() -> None:
    one = mclass.measurements_from_arrays(
        [[0, 0, 0], [2, 0, 0]],
        [["b", "a"], ["b"]],
        ("a", "b"),
        object_ids=["x", None],
        stamps_ns=[10, 30],
    )
    two = mclass.measurements_from_arrays(
        [[1, 0, 0], [3, 0, 0], [4, 0, 0]],
        [["b"], [], ["c", "b"]],
        ("c", "b"),
        object_ids=["x", None, "w"],
        stamps_ns=[10, 20, 40],
        covariances=np.ones((3, 3, 3)),
    )
    origin = np.zeros(3)
    joined = join([Part(one, origin), Part(two, origin)], ("c", "b", "a"))
    np.testing.assert_array_equal(joined.frames.stamps_ns, [10, 10, 20, 30, 40])
    np.testing.assert_array_equal(joined.frames.poses_world_sensor[:, 0], [0, 1, 3, 2, 4])
    np.testing.assert_array_equal(joined.frame_index, [0, 1, 3, 4])
    assert joined.object_ids == ("w", "x")
    np.testing.assert_array_equal(joined.object_index, [1, 1, -1, 0])
    assert [joined.label_names_of(row) for row in range(4)] == [
        ("b", "a"),
        ("b",),
        ("b",),
        ("c", "b"),
    ]
    assert joined.frames.covariances is not None
    np.testing.assert_array_equal(joined.frames.covariances[:, 0, 0], [0, 1, 1, 0, 1])
    apart = join([Part(one, origin, "p"), Part(two, origin, "q")], ("a", "b", "c"))
    assert apart.object_ids == ("p/x", "q/w", "q/x")
    with pytest.raises(mclass.UsageError, match=r"lacks: c\. It knows a, b"):
        join([Part(two, origin)], ("a", "b"))


def test_each_log_drifts_from_its_own_beginning(tmp_path: Path) -> None:
    one, two = drive(5, 7), drive(6, 6)
    late = replace(two, frames=replace(two.frames, stamps_ns=two.frames.stamps_ns + 100 * DAY))
    first = written(one, DRIFTING, tmp_path / "one.mcap")
    soon = written(two, DRIFTING, tmp_path / "soon.mcap")
    much_later = written(late, DRIFTING, tmp_path / "late.mcap")
    assert_equal_beliefs(fuse([first]), mclass.infer(one, DRIFTING))
    fused = fuse([first, much_later], tmp_path / "map.mcap")
    order_free = fuse([soon, first])
    np.testing.assert_allclose(fused.class_probabilities, order_free.class_probabilities, atol=1e-5)
    # What is read back from the map is the map's own belief: drift does not count again.
    with mclass.OutputLog.open(tmp_path / "map.mcap") as log:
        again = mclass.infer(log.measurements(), log.model_text)
    assert again.model.inference.drift == 0.0
    assert "# odometry" in again.model.source
    assert_equal_beliefs(again, fused)
    np.testing.assert_allclose(
        fuse([tmp_path / "map.mcap"]).class_probabilities, fused.class_probabilities, atol=1e-5
    )


def test_separate_ids_are_different_objects(tmp_path: Path) -> None:
    (tmp_path / "b").mkdir()
    model = PAPER + "objects: {first: {position: [2.1, 0.4]}}\n"
    outputs = [written(drive(7), model, tmp_path / "run.mclass.mcap")]
    outputs += [written(drive(8), model, tmp_path / "b" / "run.mclass.mcap")]
    fused = fuse(outputs, separate_ids=True)
    assert fused.object_ids == ("run-2/first", "run-2/second", "run/first", "run/second")
    own = mclass.infer(drive(7), model)
    rows = [fused.object_ids.index(f"run/{name}") for name in own.object_ids]
    np.testing.assert_allclose(fused.class_probabilities[rows], own.class_probabilities, atol=1e-5)
    np.testing.assert_array_equal(fused.positions[0], [2.1, 0.4])


def command(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def test_parts_of_a_log_make_the_whole(tmp_path: Path) -> None:
    whole, early, late = (tmp_path / f"{name}.mclass.mcap" for name in ("whole", "early", "late"))
    assert command("estimate", LAB, "-o", whole).exit_code == 0
    with mclass.OutputLog.open(whole) as log:
        stamps = log.measurements().frames.log_times_ns
    middle = int(stamps[len(stamps) // 2])
    assert command("estimate", LAB, "-o", early, "-E", middle).exit_code == 0
    assert command("estimate", LAB, "-o", late, "-S", middle).exit_code == 0
    fused = command("fuse", early, late, "-o", tmp_path / "map.mcap", "--format", "json")
    assert fused.exit_code == 0, fused.output
    shown = json.loads(command("inspect", "objects", whole, "--format", "json").stdout)
    document = json.loads(fused.stdout)
    assert document["measurements"] == {"used": 5, "skipped": {}}
    expected = sorted(shown["objects"], key=lambda entry: str(entry["id"]))
    for ours, theirs in zip(document["objects"], expected, strict=True):
        assert ours["class_probabilities"] == pytest.approx(theirs["class_probabilities"], abs=1e-5)
        assert ours["orientation_deg"] == pytest.approx(theirs["orientation_deg"], abs=1e-3)
    cell = command("inspect", "cell", tmp_path / "map.mcap", 4.05, 2.05, "--history")
    assert cell.exit_code == 0, cell.output
    text = command("fuse", tmp_path / "map.mcap", "-o", tmp_path / "again.mcap")
    assert text.exit_code == 0, text.output
    assert "measurements  5 used, 0 skipped" in text.stdout

    # Evidence must not count twice, however it comes in; and nothing fused is changed.
    for repeat in ([whole, early], [tmp_path / "map.mcap", late], [whole, whole]):
        refused = command("fuse", *repeat, "-o", tmp_path / "no.mcap")
        assert refused.exit_code == 2
        assert "would count twice" in refused.stderr
    itself = command("fuse", early, late, "-o", late, "--overwrite")
    assert itself.exit_code == 2
    assert "never changed" in itself.stderr
    unread = command("fuse", LAB, "-o", tmp_path / "no.mcap")
    assert unread.exit_code == 1
    assert "no /mclass channels" in unread.stderr
    assert not (tmp_path / "no.mcap").exists()


def test_what_does_not_fit_together_is_refused(tmp_path: Path) -> None:
    one = written(drive(1), PAPER, tmp_path / "one.mcap", frame="odom")
    two = written(drive(2), ROBUST, tmp_path / "two.mcap", frame="map")
    with pytest.raises(mclass.UsageError, match="different models"):
        fuse([one, two])
    with pytest.raises(mclass.UsageError, match="different worlds, map and odom"):
        fuse([one, two], model=PAPER)
    assert fuse([one, two], model=PAPER, frame="x").frame == "x"


def test_one_trajectory_is_not_drawn_for_several_logs(tmp_path: Path) -> None:
    text = DRIFTING.replace("drift: 0.08", "drift: 0.08, trajectory_samples: 2")
    outputs = [written(drive(9, 3), text, tmp_path / "one.mcap")]
    outputs += [written(drive(10, 3), text, tmp_path / "two.mcap")]
    with pytest.raises(mclass.UsageError, match=r"inference\.trajectory_samples"):
        fuse(outputs)
    assert fuse(outputs, model=DRIFTING).used > 0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: {x: 1, y: 2, heading_deg: 3}\n", "b: missing"),
        ("a: {x: 1, y: 2}\nb: {x: 0, y: 0, heading_deg: 0}\n", "1:1: a.heading_deg: missing"),
        ("a: {x: east, y: 2, heading_deg: 3}\nb: {}\n", "1:8: a.x: must be a number"),
        ("a: &p {x: 1, y: 2, heading_deg: 3}\nb: *p\nbb: *p\n", "3:1: bb: unknown log 'bb'"),
        ("a: &p {x: 1, y: 2, heading_deg: 3}\nb: *p\nb.mcap: *p\n", "3:1: b.mcap: is b again"),
        ("a: &p {x: 1, y: 2, heading_deg: 3}\nb: *p\nsame.mcap: *p\n", "stands for 2 logs"),
        ("- a\n", "must be a section"),
        ("", "empty"),
    ],
)
def test_faults_of_frames_are_told_with_their_place(
    tmp_path: Path, text: str, message: str
) -> None:
    path = tmp_path / "frames.yaml"
    path.write_text(text)
    names = [("x/a.mcap", "same.mcap", "a"), ("b.mcap", "same.mcap", "b")]
    with pytest.raises(mclass.ConfigError) as caught:
        load_frames(path, names)
    assert message in str(caught.value)


def test_frames_by_path_name_or_stem(tmp_path: Path) -> None:
    path = tmp_path / "frames.yaml"
    path.write_text(
        "x/a.mcap: {x: 1e1, y: -2, heading_deg: 90}\nb: {x: 0, y: 0.5, heading_deg: -45}\n"
    )
    first, second = load_frames(path, [("x/a.mcap", "a.mcap", "a"), ("y/b.mcap", "b.mcap", "b")])
    np.testing.assert_allclose(first, [10.0, -2.0, np.pi / 2])
    np.testing.assert_allclose(second, [0.0, 0.5, -np.pi / 4])
