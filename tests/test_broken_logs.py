"""Whole runs of `estimate` and `inspect log` over broken logs: right, or refused with a sentence.

That no run leaves half a file, a NaN, a traceback or an output that the format's own library
cannot read with all its checks is asserted in ``broken_runs`` for each run.
"""

from __future__ import annotations

import io
import math
import random
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from broken_runs import (
    DETECTIONS,
    WIDE,
    Workplace,
    add_detections,
    carried_over,
    of_kind,
    read_whole,
    scene,
)
from click.testing import CliRunner
from log_bytes import KINDS, chunks_of, data_end, record_bytes, with_summary
from mcap.reader import make_reader
from mcap.records import Channel, Message, Schema
from mcap.summary import Summary
from mcap.writer import Writer
from scene_logs import OPTICAL, SceneLog, at, box, detection, header, standing_robot

from mclass.commands.cli import main
from mclass.outputs.readback import OutputLog

NAN, INF = float("nan"), float("inf")
UPRIGHT = (0.0, 0.0, math.sin(math.pi / 4), math.cos(math.pi / 4))


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A log with nothing wrong."""
    return scene(tmp_path_factory.mktemp("sound") / "log.mcap", add_detections)


@pytest.fixture(scope="module")
def whole(sound: bytes) -> dict[str, bytes]:
    """It in every kind of file."""
    return {kind: of_kind(sound, kind) for kind in KINDS}


@pytest.fixture
def place(tmp_path: Path) -> Workplace:
    return Workplace(tmp_path)


def flipped(data: bytes, position: int) -> bytes:
    changed = bytearray(data)
    changed[position] ^= 0x41
    return bytes(changed)


class TestKinds:
    @pytest.mark.parametrize("kind", KINDS)
    def test_all_kinds_of_files_give_the_same(
        self, kind: str, whole: dict[str, bytes], place: Workplace
    ) -> None:
        run = place.estimate(whole[kind])
        assert (run.code, run.used, run.skipped) == (0, DETECTIONS, {})
        objects = run.document["objects"]
        assert [entry["id"] for entry in objects] == ["o"]
        assert objects == place.estimate(whole["zstd"]).document["objects"]

    @pytest.mark.parametrize("kind", KINDS)
    def test_everything_is_carried_over_byte_for_byte(
        self, kind: str, whole: dict[str, bytes], place: Workplace
    ) -> None:
        run = place.estimate(whole[kind])
        # A log without chunks gets some; its order stays.
        assert carried_over(run.output.read_bytes()) == read_whole(whole["zstd"])
        if kind in ("zstd", "lz4", "uncompressed", "no_index", "no_summary"):
            data = whole[kind]
            assert run.output.read_bytes().startswith(data[: data_end(data)])

    @pytest.mark.parametrize("kind", KINDS)
    def test_nothing_is_wrong_with_them(
        self, kind: str, whole: dict[str, bytes], place: Workplace
    ) -> None:
        run = place.inspect(whole[kind], "--verify")
        assert run.code == 0
        assert run.document["detection_count"] == DETECTIONS
        assert run.document["problem"] == ""

    def test_estimating_an_output_again_gives_the_same(
        self, whole: dict[str, bytes], place: Workplace
    ) -> None:
        first = place.estimate(whole["zstd"])
        again = place.estimate(first.output.read_bytes())
        assert again.document["objects"] == first.document["objects"]
        assert again.used == DETECTIONS


class TestCut:
    @pytest.mark.parametrize("kind", ["zstd", "unchunked", "no_index", "no_repeats"])
    def test_anywhere(self, kind: str, whole: dict[str, bytes], place: Workplace) -> None:
        data = whole[kind]
        end = data_end(data)
        cuts = [0, 1, 7, 8, 20, *np.linspace(40, end - 1, 12).astype(int).tolist()]
        used = []
        for cut in [*cuts, end, end + 4, end + 13, len(data) - 30, len(data) - 8, len(data) - 1]:
            run = place.estimate(data[:cut])
            shown = place.inspect(data[:cut])
            if run.code == 1:
                used.append(0)
                continue
            used.append(run.used)
            assert shown.code == run.code == (3 if cut < end + 13 else 0)
            found = shown.document["detection_count"]
            assert run.used + sum(run.skipped.values()) == found
        assert used == sorted(used), "more of a log cannot be less"
        assert used[-6:] == [DETECTIONS] * 6
        assert len(set(used)) > 3

    def test_what_is_left_is_carried_over(self, whole: dict[str, bytes], place: Workplace) -> None:
        data = whole["zstd"]
        everything = read_whole(data)
        run = place.estimate(data[: 3 * data_end(data) // 4])
        left = carried_over(run.output.read_bytes())
        assert run.code == 3
        assert len(everything) // 2 < len(left) < len(everything)
        assert left == everything[: len(left)]


Change = Callable[[bytes], bytes]


def _in_chunk(number: int, place: int) -> Change:
    """A flipped bit in the data of a chunk."""

    def change(data: bytes) -> bytes:
        chunk = chunks_of(data)[number]
        return flipped(data, chunk.chunk_start_offset + chunk.chunk_length - place)

    return change


def _chunk_length(number: int, length: int) -> Change:
    """Another length of the record that a chunk is."""

    def change(data: bytes) -> bytes:
        offset = chunks_of(data)[number].chunk_start_offset
        return data[: offset + 1] + struct.pack("<Q", length) + data[offset + 9 :]

    return change


def _summary(edit: Callable[[Summary], None]) -> Change:
    return lambda data: with_summary(data, edit)


def _shifted_chunks(summary: Summary) -> None:
    for chunk in summary.chunk_indexes:
        chunk.chunk_start_offset += 3


def _endless_chunks(summary: Summary) -> None:
    for chunk in summary.chunk_indexes:
        chunk.chunk_length = 1 << 62
        chunk.uncompressed_size = 1 << 62


def _fewer_chunks(summary: Summary) -> None:
    del summary.chunk_indexes[::2]


def _no_definitions(summary: Summary) -> None:
    summary.channels.clear()
    summary.schemas.clear()


def _foreign_channels(summary: Summary) -> None:
    for chunk in summary.chunk_indexes:
        chunk.message_index_offsets = {
            key + 900: value for key, value in chunk.message_index_offsets.items()
        }


def _statistics(summary: Summary) -> None:
    assert summary.statistics is not None
    summary.statistics.message_count = 1
    summary.statistics.channel_message_counts = {1: 1}


LIES: dict[str, Change] = {
    "chunk length 0": _chunk_length(3, 0),
    "chunk length too small": _chunk_length(3, 50),
    "chunk length too large": _chunk_length(3, 6000),
    "chunk length beyond the file": _chunk_length(3, 1 << 40),
    "chunk length beyond everything": _chunk_length(3, (1 << 64) - 1),
    "index of shifted chunks": _summary(_shifted_chunks),
    "index of endless chunks": _summary(_endless_chunks),
    "index of half of the chunks": _summary(_fewer_chunks),
    "index of foreign channels": _summary(_foreign_channels),
    "no definitions in the summary": _summary(_no_definitions),
    "wrong statistics": _summary(_statistics),
    "summary checksum": lambda data: flipped(data, len(data) - 12),
    "summary offset": lambda data: data[:-28] + struct.pack("<Q", len(data) - 60) + data[-20:],
}
"""What is wrong with the file, but costs no data."""

LOSSES: dict[str, tuple[Change, str]] = {
    "bit flipped": (_in_chunk(3, 9), "1 chunk"),
    "bits flipped in two chunks": (lambda d: _in_chunk(2, 9)(_in_chunk(5, 9)(d)), "2 chunks"),
    "zeros in the middle": (
        lambda d: d[: len(d) // 3] + bytes(2000) + d[len(d) // 3 + 2000 :],
        "lost",
    ),
    "zeros at the end": (lambda d: d[: 2 * len(d) // 3] + bytes(100_000), "zeros"),
    "noise in the middle": (
        lambda d: d[: len(d) // 3] + bytes(range(1, 256)) * 5 + d[len(d) // 3 + 1275 :],
        "lost",
    ),
}


class TestLies:
    @pytest.mark.parametrize("name", LIES)
    def test_nothing_is_lost(self, name: str, whole: dict[str, bytes], place: Workplace) -> None:
        run = place.estimate(LIES[name](whole["zstd"]))
        assert (run.code, run.used, run.damage) == (0, DETECTIONS, [])
        assert carried_over(run.output.read_bytes()) == read_whole(whole["zstd"])

    @pytest.mark.parametrize("kind", ["zstd", "lz4", "uncompressed"])
    @pytest.mark.parametrize("name", LOSSES)
    def test_the_rest_is_used(
        self, name: str, kind: str, whole: dict[str, bytes], place: Workplace
    ) -> None:
        change, sentence = LOSSES[name]
        data = change(whole[kind])
        run = place.estimate(data)
        assert run.code == 3
        assert sentence in " ".join(run.damage)
        assert 0 < run.used <= DETECTIONS
        everything = read_whole(whole[kind])
        left = carried_over(run.output.read_bytes())
        assert 0 < len(left) < len(everything)
        assert [entry for entry in everything if entry in left] == left
        assert place.inspect(data, "--verify").code == 3

    def test_unknown_compression_everywhere(
        self, whole: dict[str, bytes], place: Workplace
    ) -> None:
        data = whole["zstd"].replace(b"\x04\x00\x00\x00zstd", b"\x04\x00\x00\x00zsty")
        run = place.estimate(data)
        assert run.code == 1
        assert "compression 'zsty' is not known" in run.stderr
        assert place.inspect(data).code == 3

    def test_unread_chunks_are_checked_on_demand(self, sound: bytes, place: Workplace) -> None:
        """A broken chunk of a channel that nothing reads shows with --verify only."""
        data = of_kind(sound, "zstd", chunk_size=1)
        unread = [
            chunk
            for chunk in chunks_of(data)
            if len(chunk.message_index_offsets) == 1 and 1 in chunk.message_index_offsets
        ]
        assert unread
        broken = flipped(data, unread[0].chunk_start_offset + unread[0].chunk_length - 3)
        assert place.inspect(broken).code == 0
        shown = place.inspect(broken, "--verify")
        assert shown.code == 3
        assert "1 chunk" in shown.document["damage"][0]


class TestOutputs:
    """What is read back from damaged outputs is said to be damaged."""

    @pytest.mark.parametrize(
        "words",
        [
            ("inspect", "objects", "cut.mcap"),
            ("inspect", "objects", "cut.mcap", "--format", "json"),
            ("inspect", "cell", "cut.mcap", "1", "3"),
            ("inspect", "cell", "cut.mcap", "1", "3", "--object", "o"),
            ("fuse", "cut.mcap", "-o", "map.mcap", "--overwrite"),
        ],
    )
    def test_results_of_a_cut_output(
        self, words: tuple[str, ...], place: Workplace, sound: bytes
    ) -> None:
        whole = place.estimate(sound).output.read_bytes()
        (place.folder / "cut.mcap").write_bytes(whole[: data_end(whole)])
        run = [str(place.folder / word) if word.endswith(".mcap") else word for word in words]
        done = CliRunner().invoke(main, run)
        assert done.exit_code == 3
        assert "o" in done.stdout
        assert "the file ends here without an end mark" in " ".join(done.output.split())

    def test_outputs_whose_results_are_lost(self, place: Workplace, sound: bytes) -> None:
        whole = place.estimate(sound).output.read_bytes()
        (place.folder / "cut.mcap").write_bytes(whole[: len(sound)])
        done = CliRunner().invoke(main, ["inspect", "objects", str(place.folder / "cut.mcap")])
        assert done.exit_code == 1
        assert "Or they are lost, since the file is damaged: lost" in done.stderr


class TestNotLogs:
    @pytest.mark.parametrize(
        ("change", "sentence"),
        [
            (lambda _: b"", "is empty"),
            (lambda _: bytes(4096), "zeros"),
            (lambda data: data[:5], "cut off within its first bytes"),
            (lambda data: data.replace(b"\r\n", b"\n"), "as if it were text"),
            (lambda data: data.replace(b"\n", b"\r\n"), "as if it were text"),
            (lambda data: data.decode("latin1").encode(), "as if it were text"),
            (lambda data: data.decode("utf-8", "replace").encode(), "as if it were text"),
            (lambda _: b"#ROSBAG V2.0\n" + bytes(99), "ROS 1 bag"),
            (lambda _: b"SQLite format 3\x00" + bytes(99), "SQLite"),
            (lambda _: b"time,x,y\n1,2,3\n", "not an MCAP file"),
            (lambda data: data[:9] + data[1000:1100], "no detections"),
        ],
    )
    def test_say_what_they_are(
        self, change: Change, sentence: str, whole: dict[str, bytes], place: Workplace
    ) -> None:
        data = change(whole["zstd"])
        run = place.estimate(data)
        assert run.code == 1
        assert sentence in run.stderr


DETECTION_SCHEMA = "vision_msgs/msg/Detection2DArray"


class TestSchemas:
    @pytest.mark.parametrize(
        ("encoding", "schema_encoding", "schema", "sentence"),
        [
            ("cdr", "ros2msg", b"", "is empty"),
            ("cdr", "ros2msg", b"   \n", "is empty"),
            ("cdr", "ros2msg", b"# placeholder\n", "no fields"),
            ("cdr", "ros2msg", b"(unknown)", "not a message field"),
            ("cdr", "ros2msg", b"\xff\xfe\x00", "not UTF-8"),
            ("cdr", "protobuf", b"int8 x", "cannot be decoded"),
            ("cdr", "ros2idl", b"module a { };", "cannot be decoded"),
            ("protobuf", "protobuf", b"\xff\xff", "FileDescriptorSet"),
            ("protobuf", "ros2msg", b"int8 x", "cannot be decoded"),
            ("", "", b"", "cannot be decoded"),
            ("ros1", "ros2msg", b"int8 x", "cannot be decoded"),
        ],
    )
    def test_a_schema_without_use_is_named(
        self,
        encoding: str,
        schema_encoding: str,
        schema: bytes,
        sentence: str,
        place: Workplace,
        tmp_path: Path,
    ) -> None:
        data = of_kind(scene(tmp_path / "scene.mcap", lambda log: None), "unchunked")
        described = (DETECTION_SCHEMA, schema_encoding, schema)
        broken = self._inserted(data, described, encoding)
        run = place.estimate(broken)
        assert run.code == 1
        assert sentence in run.stderr
        assert "/seen" in run.stderr

    @pytest.mark.parametrize(
        "name", ["example_interfaces/srv/AddTwoInts_Event", "nav_msgs/msg/Odometry"]
    )
    def test_an_unreadable_channel_beside_good_ones_is_passed_over(
        self, name: str, place: Workplace, tmp_path: Path
    ) -> None:
        """Service events name types that their schema does not hold."""
        data = of_kind(scene(tmp_path / "scene.mcap", add_detections), "unchunked")
        schema = b"service_msgs/msg/ServiceEventInfo info\nRequest[<=1] request\n"
        broken = self._inserted(data, (name, "ros2msg", schema), "cdr")
        run = place.estimate(broken)
        assert (run.code, run.used) == (0, DETECTIONS)
        assert any(entry[1] == "/seen" for entry in carried_over(run.output.read_bytes()))
        shown = place.inspect(broken).document["channels"]
        assert [entry["used"] for entry in shown if entry["topic"] == "/seen"] == [False]

    def test_messages_that_contradict_their_schema(self, place: Workplace, tmp_path: Path) -> None:
        def fill(log: SceneLog) -> None:
            add_detections(log)
            wrong: list[dict[str, Any]] = [{"detections": 3}, {"header": "no"}, {"x": [1]}]
            for number, message in enumerate(wrong):
                log.add("/camera/detections", DETECTION_SCHEMA, at(1.0) + number, message)

        run = place.estimate(scene(tmp_path / "scene.mcap", fill))
        assert run.code == 3
        assert run.used == DETECTIONS
        assert "of /camera/detections" in run.damage[0]

    def test_json_in_a_channel_of_cdr(self, place: Workplace, tmp_path: Path) -> None:
        data = of_kind(scene(tmp_path / "scene.mcap", lambda log: None), "unchunked")
        text = (
            b"Detection2D[] detections\n================\nMSG: vision_msgs/Detection2D\n"
            b"string id\nResult[] results\n================\nMSG: vision_msgs/Result\nstring id\n"
            b"float64 score\n"
        )
        run = place.estimate(self._inserted(data, (DETECTION_SCHEMA, "ros2msg", text), "cdr"))
        assert run.code == 1
        assert "no detection can be used: lost 2 messages of /seen" in run.stderr

    @staticmethod
    def _inserted(data: bytes, schema: tuple[str, str, bytes], encoding: str) -> bytes:
        """The data section with one channel and two messages more, without a summary."""
        records = record_bytes(Schema(77, schema[2], schema[1], schema[0]))
        records += record_bytes(Channel(77, "/seen", encoding, {}, 77))
        for number in range(2):
            stamp = at(1.0) + number
            records += record_bytes(Message(77, stamp, b'{"detections": []}', stamp, number))
        end = data_end(data)
        return (
            data[:end]
            + records
            + data[end : end + 13]
            + bytes([2])
            + struct.pack("<QQQI", 20, 0, 0, 0)
            + data[-8:]
        )


def good(log: SceneLog) -> None:
    log.detections(1.0, [detection({"cup": 0.9}, WIDE, "o")])


def poses(log: SceneLog, *rows: tuple[float, float, float, float], **more: Any) -> None:
    """Odometry beside that of the standing robot."""
    for row in rows:
        log.odometry(*row, **more)


def camera_of(**options: Any) -> Callable[[SceneLog], None]:
    """A robot whose camera is otherwise than usual."""

    def fill(log: SceneLog) -> None:
        for step in range(31):
            log.odometry(step / 10, 1.0, 2.0, np.pi / 2)
        log.transform(0.0, "base_link", "camera", (0.2, 0.0, 0.5), OPTICAL)
        log.camera(0.0, **options)
        good(log)

    return fill


HOSTILE_IDS = (
    "a/b", "a b", "\x00\x07\x1b[31m", "../../etc/passwd", "x" * 1_000_000, " ", "/", "a//b", "~",
    "日本", "o\n1", "-1", "nan", "__proto__", "<b>&", "%s{0}", "\u202e",
)  # fmt: skip


class TestValues:
    """Bad values are left out and counted; the one good detection is used."""

    @pytest.mark.parametrize(
        ("fill", "note"),
        [
            (lambda log: poses(log, (0.95, NAN, 2.0, 0.0)), "position not finite"),
            (lambda log: poses(log, (0.95, INF, -INF, 0.0)), "position not finite"),
            (lambda log: poses(log, (0.95, 1e200, 2.0, 0.0)), "further than"),
            (lambda log: poses(log, (0.95, 1, 2, 0), quaternion=(0, 0, 0, 0)), "no rotation"),
            (lambda log: poses(log, (0.95, 1, 2, 0), quaternion=(0, 0, NAN, 1)), "no rotation"),
            (lambda log: poses(log, (0.95, 1, 2, 0), covariance=[-1.0] * 36), "semi-definite"),
            (lambda log: poses(log, (0.95, 1, 2, 0), covariance=[NAN] * 36), "not finite"),
            (lambda log: poses(log, (3.1, 1, 2, 0), (2.9, 1, 2, 0)), "out of order"),
        ],
    )
    def test_poses(
        self,
        fill: Callable[[SceneLog], None],
        note: str,
        place: Workplace,
        tmp_path: Path,
    ) -> None:
        clean = place.estimate(scene(tmp_path / "clean.mcap", good))

        def both(log: SceneLog) -> None:
            good(log)
            fill(log)

        run = place.estimate(scene(tmp_path / "scene.mcap", both))
        assert (run.code, run.used) == (0, 1)
        assert note in " ".join(run.document["notes"])
        if "semi" not in note:
            assert run.document["objects"] == clean.document["objects"]

    @pytest.mark.parametrize(
        ("bad", "reason"),
        [
            (detection({"cup": 0.9}, box(400, 200, 300, 280), "o"), "box of negative size"),
            (detection({"cup": 0.9}, box(NAN, 200, 300, 280), "o"), "box not finite"),
            (detection({"cup": 0.9}, box(300, 200, INF, 280), "o"), "box not finite"),
            (detection({"cup": 0.9}, box(3000, 200, 3100, 280), "o"), "box outside"),
            (detection({"dor": 0.9}, WIDE, "o"), "label not in the model"),
            (detection({}, WIDE, "o"), "no label"),
            (detection({"cup": INF}, WIDE, "o"), "score not finite"),
            (detection({"cup": 0.9}, box(340, 200, 341, 280), "x"), "points at no cell"),
        ],
    )
    def test_detections(
        self, bad: dict[str, Any], reason: str, place: Workplace, tmp_path: Path
    ) -> None:
        def fill(log: SceneLog) -> None:
            good(log)
            log.detections(1.5, [bad, bad])
            log.detections(1.6, [])

        run = place.estimate(scene(tmp_path / "scene.mcap", fill))
        assert (run.code, run.used) == (0, 1)
        assert sum(run.skipped.values()) == 2
        assert reason in " ".join(run.skipped)
        alone = scene(tmp_path / "alone.mcap", lambda log: log.detections(1.5, [bad]))
        refused = place.estimate(alone)
        assert refused.code == 1
        assert reason in refused.stderr

    def test_a_label_of_one_class_with_that_of_another(
        self, place: Workplace, tmp_path: Path
    ) -> None:
        """Nothing returns jug's labels together with a third one."""
        place.model.write_text(
            place.model.read_text().replace("      jug: {probability: 0.3, views: {back: 1}}\n", "")
        )

        def fill(log: SceneLog) -> None:
            good(log)
            log.detections(1.5, [detection({"cup": 0.9, "jug": 0.8}, WIDE, "o")])

        run = place.estimate(scene(tmp_path / "scene.mcap", fill))
        assert (run.code, run.used) == (0, 1)
        assert run.skipped == {"labels that no class returns together": 1}

    @pytest.mark.parametrize(
        "options",
        [
            {"k": (0, 0, 320, 240)},
            {"k": (NAN, 500, 320, 240)},
            {"k": (500, INF, 1, 1)},
            {"d": (0.1, NAN, 0.0, 0.0, 0.0)},
        ],
    )
    def test_cameras_without_focal_length(
        self, options: dict[str, Any], place: Workplace, tmp_path: Path
    ) -> None:
        run = place.estimate(scene(tmp_path / "scene.mcap", camera_of(**options), robot=False))
        assert run.code == 1
        assert "without focal length" in run.stderr

    def test_no_pose_at_all(self, place: Workplace, tmp_path: Path) -> None:
        def fill(log: SceneLog) -> None:
            for step in range(30):
                log.odometry(step / 10, NAN, 2.0, 0.0)
            log.transform(0.0, "base_link", "camera", (0.2, 0.0, 0.5), OPTICAL)
            log.camera(0.0)
            good(log)

        run = place.estimate(scene(tmp_path / "scene.mcap", fill, robot=False))
        assert run.code == 1
        assert "30 position not finite" in run.stderr

    @pytest.mark.parametrize(
        ("x", "later", "said"),
        [(NAN, 0.0, "30 position not finite"), (1.0, 1e6, "none is near a detection in time")],
    )
    def test_why_better_poses_are_not_used_is_said(
        self, x: float, later: float, said: str, place: Workplace, tmp_path: Path
    ) -> None:
        def fill(log: SceneLog) -> None:
            for step in range(30):
                log.odometry(later + step / 10, x, 2.0, 0.0)
                place_odom = (1.0 + step / 100, 2.0, 0.0)
                log.transform(step / 10, "odom", "base_link", place_odom, UPRIGHT, topic="/tf")
            log.transform(0.0, "base_link", "camera", (0.2, 0.0, 0.5), OPTICAL)
            log.camera(0.0)
            good(log)

        run = place.estimate(scene(tmp_path / "scene.mcap", fill, robot=False))
        assert (run.code, run.used) == (0, 1)
        notes = run.document["notes"]
        assert f"poses of /odom cannot be used: {said}" in notes
        assert not any("could also come from" in note for note in notes)

    def test_silence_is_no_failure(self, place: Workplace, tmp_path: Path) -> None:
        data = scene(tmp_path / "scene.mcap", lambda log: log.detections(1.0, []))
        run = place.estimate(data)
        assert (run.code, run.used, run.skipped) == (0, 0, {})

    def test_hostile_ids(self, place: Workplace, tmp_path: Path) -> None:
        def fill(log: SceneLog) -> None:
            for number, name in enumerate(HOSTILE_IDS):
                log.detections(0.5 + number / 10, [detection({"cup": 0.9}, WIDE, name)])

        run = place.estimate(scene(tmp_path / "scene.mcap", fill))
        assert run.code == 0
        assert {entry["id"] for entry in run.document["objects"]} == set(HOSTILE_IDS)

    def test_a_frame_of_many_objects_is_written_once(
        self, place: Workplace, tmp_path: Path
    ) -> None:
        """Not all of them once for each: that would take a gigabyte for a few thousand."""

        def fill(log: SceneLog) -> None:
            for number in range(3):
                found = [detection({"cup": 0.9}, WIDE, f"o{i}") for i in range(12 - number)]
                log.detections(0.5 + number / 10, found)

        run = place.estimate(scene(tmp_path / "scene.mcap", fill))
        assert run.used == 33
        with OutputLog.open(run.output) as output:
            (channel,) = [c for c in output.reader.channels if c.topic == "/mclass/objects"]
            assert channel.message_count == 3
            history = output.history()
        assert [len(history[f"o{i}"]) for i in (0, 9, 10, 11)] == [3, 3, 2, 1]

    @pytest.mark.slow
    def test_a_hundred_thousand_detections_in_a_message(
        self, place: Workplace, tmp_path: Path
    ) -> None:
        found = [detection({"cup": 0.9}, WIDE, f"id{i % 3}") for i in range(100_000)]
        run = place.estimate(scene(tmp_path / "scene.mcap", lambda log: log.detections(1.0, found)))
        assert run.used == 3
        assert sum(run.skipped.values()) == 99_997


def shuffled(data: bytes, seed: int) -> bytes:
    """The same messages in another order of the file."""
    found = list(make_reader(io.BytesIO(data)).iter_messages())
    random.Random(seed).shuffle(found)
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=1000)
    writer.start("", "test")
    channels: dict[int, int] = {}
    for schema, channel, message in found:
        if channel.id not in channels:
            assert schema is not None
            number = writer.register_schema(schema.name, schema.encoding, schema.data)
            channels[channel.id] = writer.register_channel(
                channel.topic, channel.message_encoding, number
            )
        writer.add_message(
            channels[channel.id], message.log_time, message.data, message.publish_time
        )
    writer.finish()  # type: ignore[no-untyped-call]
    return stream.getvalue()


def added(data: bytes) -> list[tuple[str, int, int, bytes]]:
    """The messages that a run added, in file order."""
    reader = make_reader(io.BytesIO(data))
    return [
        (channel.topic, message.log_time, message.sequence, message.data)
        for _, channel, message in reader.iter_messages(log_time_order=False)
        if channel.topic.startswith("/mclass/")
    ]


class TestTimes:
    def test_order_and_repetition_do_not_matter(self, place: Workplace, tmp_path: Path) -> None:
        """Messages in any order of the file, poses twice: the same results, digit for digit."""
        times = [0.5 + i / 10 for i in range(12)]

        def written(order: list[int], again: int) -> Callable[[SceneLog], None]:
            def fill(log: SceneLog) -> None:
                for step in [*order, *order[:again]]:
                    log.odometry(step / 10, 1.0 + step / 50, 2.0, np.pi / 2)
                log.transform(0.0, "base_link", "camera", (0.2, 0.0, 0.5), OPTICAL)
                log.camera(0.0)
                for number in [i for i in order if i < len(times)]:
                    label = "cup" if number % 3 else "jug"
                    log.detections(times[number], [detection({label: 0.9}, WIDE, "o")])

            return fill

        expected = place.estimate(
            scene(tmp_path / "a.mcap", written(list(range(31)), 0), robot=False)
        )
        order = np.random.default_rng(5).permutation(31).tolist()
        run = place.estimate(scene(tmp_path / "b.mcap", written(order, 4), robot=False))
        assert run.used == expected.used == len(times)
        assert run.document["objects"] == expected.document["objects"]

    def test_shuffled_logs_give_the_same_results_bit_for_bit(
        self, place: Workplace, tmp_path: Path
    ) -> None:
        """All that the command adds: beliefs, maps, objects at every update, measurements."""

        def fill(log: SceneLog) -> None:
            for number in range(8):
                label = "cup" if number % 3 else "jug"
                names = ("o", "", "p")[: 1 + number % 3]
                found = [detection({label: 0.9 - i / 10}, WIDE, n) for i, n in enumerate(names)]
                log.detections(0.5 + number / 10, found)

        data = scene(tmp_path / "log.mcap", fill)
        run = place.estimate(data, "--every", "0.2")
        expected = added(run.output.read_bytes())
        assert len(expected) > 10
        for seed in range(2):
            other = place.estimate(shuffled(data, seed), "--every", "0.2")
            assert added(other.output.read_bytes()) == expected

    def test_header_and_log_clocks_days_apart(self, place: Workplace, tmp_path: Path) -> None:
        def fill(log: SceneLog) -> None:
            for number in range(3):
                stamp = 1.0 + number / 10
                message = {
                    "header": header(stamp, "camera"),
                    "detections": [detection({"cup": 0.9}, WIDE, "o")],
                }
                late = at(stamp + 5 * 86_400)
                log.add("/camera/detections", DETECTION_SCHEMA, late, message)

        run = place.estimate(scene(tmp_path / "scene.mcap", fill))
        assert (run.code, run.used) == (0, 3)

    def test_clocks_that_share_no_time(self, place: Workplace, tmp_path: Path) -> None:
        data = scene(tmp_path / "scene.mcap", lambda log: add_detections(log, [1e6, 1e6 + 1]))
        run = place.estimate(data)
        assert run.code == 1
        assert "Did their clocks differ?" in run.stderr

    def test_detections_of_one_stamp_and_id_are_one(self, place: Workplace, tmp_path: Path) -> None:
        run = place.estimate(
            scene(tmp_path / "scene.mcap", lambda log: add_detections(log, [1.0] * 4))
        )
        assert run.used == 1
        assert sum(run.skipped.values()) == 3


def test_standing_robots_have_odometry(tmp_path: Path, place: Workplace) -> None:
    """The scene of these tests without detections is refused, not estimated from nothing."""
    run = place.estimate(scene(tmp_path / "scene.mcap", standing_robot, robot=False))
    assert run.code == 1
    assert "no detections were recognised" in run.stderr
