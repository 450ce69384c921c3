"""What is written is read back, from every encoding."""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from lopsided_results import CLASS_NAMES, STAMP_NS, estimate, maps, mode
from numpy.testing import assert_array_equal
from written_output import (
    ENCODINGS,
    LOG_TIME_NS,
    STRANGE_ID,
    belief,
    measurements,
    messages,
    model,
    objects,
    write_everything,
)

from mclass.errors import LogError, UsageError
from mclass.footprint import Grid
from mclass.logs.chunks import ChunkContent, ChunkEntry, read_chunk
from mclass.logs.reader import LogReader
from mclass.logs.source import Source
from mclass.logs.writer import LogWriter
from mclass.messages import protobuf, ros
from mclass.outputs import values
from mclass.outputs.channels import Encoding, OutputChannels
from mclass.outputs.readback import OutputLog
from mclass.outputs.track import SENSOR, track_of
from mclass.records import Frames, LabelMeasurements
from mclass.results import BeliefBlock, ObjectEstimate


@pytest.fixture(scope="module", params=ENCODINGS)
def written(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("output") / "out.mcap"
    write_everything(path, request.param)
    return path


def assert_same(actual: Any, expected: Any) -> None:
    """Equal fields of two dataclasses of a type, arrays bit by bit."""
    assert type(actual) is type(expected)
    for name, value in vars(expected).items():
        other = getattr(actual, name)
        if isinstance(value, np.ndarray):
            assert_array_equal(other, value, err_msg=name)
            assert other.dtype == value.dtype
            if value.dtype.kind == "f":
                assert_array_equal(np.signbit(other), np.signbit(value))
        elif isinstance(value, Frames):
            assert_same(other, value)
        else:
            assert other == value, name


def test_header_is_read(written: Path) -> None:
    with OutputLog.open(written) as output:
        assert (output.frame, output.prefix) == ("odom", "/mclass")
        assert output.class_names == CLASS_NAMES
        assert output.model_name == "office.yaml"
        assert output.model_text == model().source
        assert output.metadata["input_hash"] == "sha256:00"
        assert output.metadata["settings"] == '{"every": 2}'
        assert output.metadata["model_hash"].startswith("sha256:")


def test_recorded_objects_are_read_and_others_are_none(written: Path) -> None:
    with OutputLog.open(written) as output:
        for text, expected in (
            ('{"start": "+1s"}', {"start": "+1s"}),
            ('["input"]', {}),
            ("{", {}),
            (None, {}),
        ):
            output.metadata = {} if text is None else {"settings": text}
            assert output.recorded("settings") == expected
        # Settings of another shape leave the sensor's own track.
        output.metadata = {"settings": '["input"]'}
        found = output.measurements()
        assert track_of(output, model(), found).child_frame == SENSOR


def test_latest_objects_are_read(written: Path) -> None:
    with OutputLog.open(written) as output:
        found = output.objects()
    assert [entry.object_id for entry in found] == ["o1", STRANGE_ID]
    for actual, expected in zip(found, objects(), strict=True):
        assert_same(actual, expected)


def test_maps_are_read_as_precise_as_float32(written: Path) -> None:
    with OutputLog.open(written) as output:
        found = output.maps()
    expected = maps()
    assert (found.grid, found.stamp_ns) == (expected.grid, expected.stamp_ns)
    assert found.log_time_ns == expected.log_time_ns
    assert_array_equal(found.cells, expected.cells)
    np.testing.assert_allclose(found.class_probabilities, expected.class_probabilities, atol=1e-7)
    np.testing.assert_allclose(found.class_probabilities.sum(axis=1), 1.0, atol=1e-15)
    np.testing.assert_allclose(found.untouched, expected.untouched, atol=1e-7)


@pytest.mark.parametrize(("object_id", "blocks"), [("", 2), ("o1", 1)])
def test_beliefs_are_read(written: Path, object_id: str, blocks: int) -> None:
    with OutputLog.open(written) as output:
        found = output.belief(object_id)
    expected = belief(object_id, blocks, 0.5 if object_id else 0.0)
    assert len(found) == blocks
    for actual, block in zip(found, expected, strict=True):
        assert_same(actual, block)


def test_belief_of_a_cell_is_that_cells(written: Path) -> None:
    # Cell 9 is in row 1, column 3: x from 0.5 to 1, y from 2.5 to 3.
    with OutputLog.open(written) as output:
        found = output.belief_at(0.75, 2.75)
        assert found.cells.tolist() == [9]
        assert_array_equal(found.log_density[0], belief()[1].log_density[1])
        assert found.log_cell_mass.tolist() == [-11.0]
        assert found.measurements.tolist() == [3]
        untouched = output.belief_at(-0.9, 2.1)
        assert (len(untouched.cells), untouched.grid.columns) == (0, 6)
        with pytest.raises(UsageError, match=r"\(5, 2\.1\) m .* x -1 to 2 m and y 2 to 4 m"):
            output.belief_at(5.0, 2.1)
        with pytest.raises(LogError, match=r"no belief of object 'nobody'"):
            output.belief_at(0.75, 2.75, "nobody")


def test_measurements_are_read_exactly(written: Path) -> None:
    with OutputLog.open(written) as output:
        assert_same(output.measurements(), measurements())


def write(path: Path, encoding: Encoding, steps: list[list[ObjectEstimate]]) -> None:
    with LogWriter(path) as writer:
        channels = OutputChannels(writer, encoding, "odom", model())
        channels.write_header(0)
        for step in steps:
            channels.write_objects(step, step[-1].log_time_ns, step[-1].stamp_ns)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_history_has_each_estimate_once(encoding: Encoding, tmp_path: Path) -> None:
    first = estimate("a", stamp_ns=1_000, measurements=1)
    other = estimate("b", stamp_ns=2_000, measurements=1)
    # The detector saw the same object twice at one stamp: two measurements.
    second = estimate("a", stamp_ns=2_000, measurements=2, modes=(mode(10.0, 1.0, 5.0),))
    third = estimate("a", stamp_ns=2_000, measurements=3, position=(0.25, -0.0))
    write(
        tmp_path / "out.mcap", encoding, [[first], [first, other], [second, other], [third, other]]
    )
    with OutputLog.open(tmp_path / "out.mcap") as output:
        history = output.history()
        assert list(history) == ["a", "b"]
        assert list(output.history("b")) == ["b"]
        assert output.history("nobody") == {}
    for actual, expected in zip(history["a"], (first, second, third), strict=True):
        assert_same(actual, expected)
    assert_same(history["b"][0], other)
    assert len(history["b"]) == 1


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_outputs_without_objects_are_read(encoding: Encoding, tmp_path: Path) -> None:
    with LogWriter(tmp_path / "out.mcap") as writer:
        OutputChannels(writer, encoding, "odom", model()).write_header(0)
    with OutputLog.open(tmp_path / "out.mcap") as output:
        assert output.objects() == ()
        assert output.history() == {}
        for read in (output.maps, output.belief, output.measurements):
            with pytest.raises(LogError, match=r"out\.mcap: the output holds no "):
                read()


def later(block: BeliefBlock, seconds: float, shift: float) -> BeliefBlock:
    made = dict(vars(block))
    made["log_time_ns"] += round(seconds * 1e9)
    made["stamp_ns"] += round(seconds * 1e9)
    made["log_cell_mass"] = block.log_cell_mass - shift
    return BeliefBlock(**made)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_the_latest_belief_counts(encoding: Encoding, tmp_path: Path) -> None:
    with LogWriter(tmp_path / "out.mcap") as writer:
        channels = OutputChannels(writer, encoding, "odom", model())
        channels.write_header(0)
        # Block by block, each at all times, as an estimate makes them.
        for block in belief():
            for seconds in (0.0, 40.0, 500.0):
                channels.write_belief(later(block, seconds, seconds))
        for seconds in (0.0, 40.0):
            channels.write_belief(later(belief("o1", 1)[0], seconds, seconds))
        # Written again without a new measurement, as at the end of a log.
        channels.write_belief(later(belief("o1", 1)[0], 40.0, 40.0))
        step = estimate(stamp_ns=STAMP_NS + 2_000_000_000_000)
        channels.write_objects([step], step.log_time_ns, step.stamp_ns)
    with OutputLog.open(tmp_path / "out.mcap") as output:
        assert [block.log_cell_mass[0] for block in output.belief()] == [-500.0, -510.0]
        assert [block.log_cell_mass[0] for block in output.belief("o1")] == [-40.0]
        assert output.belief_at(0.75, 2.75).log_cell_mass.tolist() == [-511.0]


def test_only_the_end_of_a_long_output_is_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    big = [np.zeros((3, 2, 30_000), np.float32) for _ in range(2)]
    with LogWriter(tmp_path / "out.mcap") as writer:
        channels = OutputChannels(writer, "ros2", "odom", model())
        channels.write_header(0)
        for seconds in range(0, 1000, 50):
            for block, density in zip(belief(), big, strict=True):
                made = later(block, float(seconds), 0.0)
                channels.write_belief(BeliefBlock(**{**vars(made), "log_density": density}))
    unpacked: list[int] = []

    def counted(source: Source, entry: ChunkEntry) -> ChunkContent:
        unpacked.append(entry.offset)
        return read_chunk(source, entry)

    monkeypatch.setattr("mclass.logs.reader.read_chunk", counted)
    with OutputLog.open(tmp_path / "out.mcap") as output:
        assert len(output.reader.index.chunks) >= 10
        assert len(output.belief()) == 2
    assert 1 <= len(unpacked) <= 4


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_lost_parts_are_said(encoding: Encoding, tmp_path: Path) -> None:
    with LogWriter(tmp_path / "out.mcap") as writer:
        channels = OutputChannels(writer, encoding, "odom", model())
        channels.write_header(0)
        channels.write_belief(belief()[1])
    with (
        OutputLog.open(tmp_path / "out.mcap") as output,
        pytest.raises(LogError, match="1 of 2 parts of the belief are lost"),
    ):
        output.belief()


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("covariances", [True, False])
def test_many_measurements_take_several_messages(
    encoding: Encoding, covariances: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(values, "ROWS_PER_MESSAGE", 4)
    expected = measurements(11, covariances)
    with LogWriter(tmp_path / "out.mcap") as writer:
        channels = OutputChannels(writer, encoding, "odom", model())
        channels.write_header(0)
        channels.write_measurements(expected)
    with OutputLog.open(tmp_path / "out.mcap") as output:
        counts = {channel.topic: channel.message_count for channel in output.reader.channels}
        assert counts["/mclass/measurements"] == 5
        assert_same(output.measurements(), expected)


finite = st.floats(width=64)
ids = st.lists(st.text(st.characters(exclude_categories=["Cs"]), max_size=5), max_size=3)


@st.composite
def any_measurements(draw: st.DrawFn) -> LabelMeasurements:
    frames = draw(st.integers(0, 7))
    rows = draw(st.integers(0, 9)) if frames else 0
    object_ids = tuple(draw(ids))
    counts = draw(st.lists(st.integers(0, 2), min_size=rows, max_size=rows))

    def floats(*shape: int) -> Any:
        size = int(np.prod(shape))
        return np.array(draw(st.lists(finite, min_size=size, max_size=size))).reshape(shape)

    def integers(size: int, low: int, high: int) -> Any:
        drawn = draw(st.lists(st.integers(low, high), min_size=size, max_size=size))
        return np.array(drawn, dtype=np.int64)

    return LabelMeasurements(
        frames=Frames(
            integers(frames, 0, 2**62),
            integers(frames, 0, 2**62),
            floats(frames, 3),
            draw(st.sampled_from([None, floats(frames, 3, 3)])),
            floats(frames, 2),
        ),
        frame_index=integers(rows, 0, frames - 1) if rows else integers(0, 0, 0),
        directions=floats(rows, 2),
        object_index=integers(rows, -1, len(object_ids) - 1),
        object_ids=object_ids,
        label_offsets=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        labels=integers(sum(counts), 0, 1),
        scores=floats(sum(counts)),
        label_names=("books", "parts"),
    )


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(any_measurements())
def test_any_measurements_survive(
    monkeypatch: pytest.MonkeyPatch, expected: LabelMeasurements
) -> None:
    monkeypatch.setattr(values, "ROWS_PER_MESSAGE", 3)
    for codec in (ros.codec("mclass_msgs/msg/Measurements"), protobuf.codec("mclass.Measurements")):
        parts = [codec.decode(codec.encode(value)) for value in values.measurement_values(expected)]
        assert_same(values.measurements_from(parts), expected)


@pytest.fixture(scope="module")
def payloads(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[Encoding, str, bytes]]:
    """Every message that is read back, in every encoding."""
    found: list[tuple[Encoding, str, bytes]] = []
    for encoding in ENCODINGS:
        path = tmp_path_factory.mktemp("payloads") / "out.mcap"
        write_everything(path, encoding)
        objects_topic = "estimates" if encoding == "ros2" else "objects"
        for name in (objects_topic, "grid", "belief", "measurements"):
            data = messages(path, f"/mclass/{name}")[-1][2].data
            found.append((encoding, f"/mclass/{name}", data))
    return found


@settings(
    max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.data())
def test_changed_messages_are_read_or_refused(
    payloads: list[tuple[Encoding, str, bytes]], tmp_path: Path, data: st.DataObject
) -> None:
    encoding, topic, payload = data.draw(st.sampled_from(payloads))
    changed = bytearray(payload)
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(changed) - 1))
        changed[place] = data.draw(st.integers(0, 255))
    del changed[data.draw(st.integers(len(changed) // 2, len(changed))) :]
    with LogWriter(tmp_path / "out.mcap", overwrite=True) as writer:
        channels = OutputChannels(writer, encoding, "odom", model())
        channels.write_header(0)
        writer.write(channels._channels[topic], LOG_TIME_NS, bytes(changed))
    with OutputLog.open(tmp_path / "out.mcap") as output:
        reads: list[Callable[[], object]] = [
            output.objects,
            output.history,
            output.maps,
            output.measurements,
            lambda: output.belief("o1"),
            lambda: output.belief_at(0.75, 2.75, "o1"),
        ]
        for read in reads:
            with contextlib.suppress(LogError, UsageError):
                read()


def test_a_log_that_was_not_estimated_says_what_to_do(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "in.mcap"):
        pass
    with pytest.raises(LogError, match=r"in\.mcap: no /mclass channels: run `mclass estimate`"):
        OutputLog.open(tmp_path / "in.mcap")


@pytest.mark.parametrize(
    "pairs", [{}, {"frame": "odom", "prefix": "/mclass", "classes": "3"}, {"frame": "odom"}]
)
def test_foreign_metadata_of_our_name_is_refused(pairs: dict[str, str], tmp_path: Path) -> None:
    with LogWriter(tmp_path / "in.mcap") as writer:
        writer.add_metadata("mclass", pairs)
    with pytest.raises(LogError, match="not ours or broken"):
        OutputLog.open(tmp_path / "in.mcap")


def test_another_prefix_is_found(tmp_path: Path) -> None:
    write_everything(tmp_path / "out.mcap", "ros2", "/robot/boxes/")
    with OutputLog.open(tmp_path / "out.mcap") as output:
        assert output.prefix == "/robot/boxes"
        assert len(output.objects()) == 2
        assert {
            channel.topic.startswith("/robot/boxes/") for channel in output.reader.channels
        } == {True}


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_the_last_estimate_of_an_output_counts(encoding: Encoding, tmp_path: Path) -> None:
    """An output is a log, too: estimating it again adds channels of the same names."""
    write(tmp_path / "once.mcap", encoding, [[estimate("old")]])
    with (
        LogReader.open(tmp_path / "once.mcap") as source,
        LogWriter(tmp_path / "twice.mcap", source=source) as writer,
    ):
        channels = OutputChannels(writer, encoding, "map", model())
        channels.write_header(0)
        step = estimate("new")
        channels.write_objects([step], step.log_time_ns, step.stamp_ns)
    with OutputLog.open(tmp_path / "twice.mcap") as output:
        assert output.frame == "map"
        assert [entry.object_id for entry in output.objects()] == ["new"]


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_messages_that_contradict_themselves_are_refused(
    encoding: Encoding, tmp_path: Path
) -> None:
    block = belief("", 1)[0]
    broken = BeliefBlock(**{**vars(block), "cells": np.array([1, 2])})
    with LogWriter(tmp_path / "out.mcap") as writer:
        channels = OutputChannels(writer, encoding, "odom", model())
        channels.write_header(0)
        channels.write_belief(broken)
    with (
        OutputLog.open(tmp_path / "out.mcap") as output,
        pytest.raises(LogError, match=r"out\.mcap: log_cell_mass has 3 numbers, not \(2,\)"),
    ):
        output.belief()


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"probabilities": (1.5, 0.3, 0.2)}, "1.5, outside [0, 1]"),
        ({"probabilities": (0.5, -0.1, 0.6)}, "-0.1, outside [0, 1]"),
        ({"position": (0.0, float("-inf"))}, "-inf, outside"),
        ({"modes": (mode(1e300, 1.0, 3.0),)}, "outside [-10, 10]"),
        ({"modes": (mode(1.0, 2.0, 3.0),)}, "2.0, outside [0, 1]"),
        ({"modes": (mode(1.0, 1.0, -3.0),)}, "outside [0, inf]"),
    ],
)
def test_objects_with_impossible_numbers_are_refused(
    changed: dict[str, Any], said: str, tmp_path: Path
) -> None:
    with LogWriter(tmp_path / "out.mcap") as writer:
        channels = OutputChannels(writer, "protobuf", "odom", model())
        channels.write_header(0)
        channels.write_objects([estimate(**changed)], LOG_TIME_NS, STAMP_NS)
    with (
        OutputLog.open(tmp_path / "out.mcap") as output,
        pytest.raises(LogError, match=f"object 'o1' holds .*{re.escape(said)}"),
    ):
        output.objects()


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("log_cell_mass", 0.5, "log_cell_mass holds 0.5"),
        ("log_density", np.inf, "log_density holds inf"),
        ("log_density", -np.inf, "the greatest log_density holds -inf"),
        ("log_class_probability", -np.inf, "the greatest log_class_probability holds -inf"),
    ],
)
def test_beliefs_with_impossible_numbers_are_refused(
    name: str, value: float, said: str, tmp_path: Path
) -> None:
    block = belief("", 1)[0]
    broken = replace(block, **{name: np.full_like(getattr(block, name), value)})
    with LogWriter(tmp_path / "out.mcap") as writer:
        channels = OutputChannels(writer, "ros2", "odom", model())
        channels.write_header(0)
        channels.write_belief(broken)
    with OutputLog.open(tmp_path / "out.mcap") as output, pytest.raises(LogError, match=said):
        output.belief()


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_objects_of_other_classes_are_refused(encoding: Encoding, tmp_path: Path) -> None:
    with LogWriter(tmp_path / "out.mcap") as writer:
        OutputChannels(writer, encoding, "odom", model()).write_header(0)
        writer.add_metadata(
            "mclass", {"frame": "odom", "prefix": "/mclass", "classes": '["books", "cups"]'}
        )
        channels = OutputChannels(writer, encoding, "odom", model())
        channels.write_objects([estimate()], LOG_TIME_NS, STAMP_NS)
    with (
        OutputLog.open(tmp_path / "out.mcap") as output,
        pytest.raises(LogError, match="other classes than the log's model"),
    ):
        output.objects()


def test_a_cell_on_a_border_belongs_to_the_cell_above_and_right(tmp_path: Path) -> None:
    write_everything(tmp_path / "out.mcap", "ros2")
    with OutputLog.open(tmp_path / "out.mcap") as output:
        assert output.belief_at(0.5, 2.5).cells.tolist() == [9]
        assert Grid((-1.0, 2.0), 0.5, 4, 6).cell_at(0.5, 2.5) == 9


@pytest.mark.parametrize(
    ("most", "expected"), [(1, [9]), (3, [3, 6, 9]), (10, list(range(10))), (99, list(range(10)))]
)
def test_maps_over_time_are_evenly_chosen(most: int, expected: list[int], tmp_path: Path) -> None:
    with LogWriter(tmp_path / "out.mcap", profile="ros2") as writer:
        channels = OutputChannels(writer, "ros2", "odom", model())
        channels.write_header(0)
        for index in range(10):
            channels.write_maps(replace(maps(), stamp_ns=index, log_time_ns=index))
    with OutputLog.open(tmp_path / "out.mcap") as output:
        assert [found.stamp_ns for found in output.maps_over_time(most)] == expected


def test_every_block_of_every_belief_is_read(written: Path) -> None:
    with OutputLog.open(written) as output:
        found = list(output.beliefs())
    expected = [*belief(), *belief("o1", 1, 0.5)]
    assert len(found) == len(expected)
    for actual, block in zip(found, expected, strict=True):
        assert_same(actual, block)


def test_account_of_the_input_is_recorded(tmp_path: Path) -> None:
    account = {"used": 3, "skipped": {"no pose": 2}, "notes": ("poses: /odom",), "damage": ()}
    with LogWriter(tmp_path / "out.mcap", profile="ros2") as writer:
        OutputChannels(writer, "ros2", "odom", model()).write_header(0, account=account)
    with OutputLog.open(tmp_path / "out.mcap") as output:
        assert json.loads(output.metadata["account"]) == {
            "used": 3,
            "skipped": {"no pose": 2},
            "notes": ["poses: /odom"],
            "damage": [],
        }
