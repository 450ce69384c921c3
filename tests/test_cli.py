"""Every command as people type it: what it prints, how it ends, what it leaves behind."""

from __future__ import annotations

import json
import math
import os
import pty
import re
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from mcap.reader import make_reader
from sample_runs import (
    CONFIGS,
    SAMPLES,
    estimated,
    mclass,
    mclass_process,
    objects_of,
    sample,
)

from mclass.commands.cli import main

CAS_LAB = SAMPLES / "cas_lab.mcap"
MODEL = CONFIGS / "cas_lab.yaml"
START_NS = 1318248000000000000
"""Log time of the first message of cas_lab: 2011-10-10T12:00:00Z."""


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return estimated("cas_lab", tmp_path_factory.mktemp("output"))


def assert_like(value: Any, pattern: Any, where: str = "") -> None:
    """A JSON value has the documented keys and types; more keys may be there."""
    if isinstance(pattern, dict):
        assert isinstance(value, dict), where
        for key, inner in pattern.items():
            assert key in value, f"{where}.{key} is missing"
            assert_like(value[key], inner, f"{where}.{key}")
    elif isinstance(pattern, list):
        assert isinstance(value, list), where
        for index, entry in enumerate(value):
            assert_like(entry, pattern[index % len(pattern)], f"{where}[{index}]")
    elif callable(pattern) and not isinstance(pattern, type):
        assert pattern(value), f"{where}: {value!r}"
    else:
        assert type(value) is pattern, f"{where}: {value!r} is no {pattern.__name__}"


def messages_in(log: Path) -> int:
    """As its own statistics say."""
    with log.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    return summary.statistics.message_count


def degrees(value: Any) -> bool:
    return isinstance(value, float) and 0.0 <= value < 360.0


def stamp(value: Any) -> bool:
    return isinstance(value, str) and re.fullmatch(r"\d{19}", value) is not None


def distribution(value: Any) -> bool:
    """Probabilities by class, the background among them."""
    return "background" in value and math.isclose(sum(value.values()), 1.0, abs_tol=1e-9)


MODE = {"orientation_deg": degrees, "mass": float, "std_deg": float}
OBJECT = {
    "id": str,
    "class": str,
    "class_probabilities": distribution,
    "position": [float, float],
    "position_std": [float, float],
    "orientation_deg": degrees,
    "modes": [MODE],
    "measurements": int,
    "stamp_ns": stamp,
    "joint_map": {"class": str, "orientation_deg": degrees, "position": [float, float]},
}
OBJECTS = {"frame": str, "objects": [OBJECT]}
CELL = {
    "cell": {"row": int, "column": int, "center": [float, float], "size": float},
    "class_probabilities": distribution,
    "orientation": dict,
    "measurements": int,
}
DENSITY = {"bins_deg": [degrees], "density": [float], "modes": [MODE]}


class TestEstimate:
    def test_writes_beside_the_log(self, tmp_path: Path) -> None:
        log = sample("cas_lab", tmp_path)
        before = log.read_bytes()
        done = mclass("estimate", log)
        assert sorted(path.name for path in tmp_path.iterdir()) == [
            "cas_lab.mcap",
            "cas_lab.mclass.mcap",
        ]
        assert log.read_bytes() == before
        assert "cas_lab.mclass.mcap" in done.stdout
        assert "cas_lab.mcap#mclass.yaml" in done.stdout
        assert "5 used, 0 skipped" in done.stdout
        assert done.stderr == ""

    def test_json(self, tmp_path: Path) -> None:
        out = tmp_path / "out.mcap"
        document = mclass("estimate", CAS_LAB, "-o", out, "--format", "json").document
        assert_like(document, {"input": str, "output": str, "model": str, **OBJECTS})
        assert_like(document["measurements"], {"used": int, "skipped": dict})
        assert document["output"] == str(out)
        assert document["measurements"] == {"used": 5, "skipped": {}}
        assert [entry["id"] for entry in document["objects"]] == ["o1", "o2", "o3"]

    def test_same_bytes_again(self, tmp_path: Path) -> None:
        first = estimated("cas_lab", tmp_path).read_bytes()
        assert estimated("cas_lab", tmp_path, "--overwrite").read_bytes() == first

    def test_existing_output_needs_overwrite(self, tmp_path: Path) -> None:
        out = tmp_path / "out.mcap"
        out.write_bytes(b"mine")
        assert "--overwrite" in mclass("estimate", CAS_LAB, "-o", out, code=1).stderr
        assert out.read_bytes() == b"mine"
        mclass("estimate", CAS_LAB, "-o", out, "--overwrite")
        assert objects_of(out)

    @pytest.mark.parametrize("link", [False, True])
    def test_output_is_not_the_input(self, link: bool, tmp_path: Path) -> None:
        log = sample("cas_lab", tmp_path)
        before, out = log.read_bytes(), log
        if link:
            out = tmp_path / "link.mcap"
            out.symlink_to(log)
        done = mclass("estimate", log, "-o", out, "--overwrite", code=1)
        assert "input" in done.stderr
        assert log.read_bytes() == before

    def test_output_folder_must_exist(self, tmp_path: Path) -> None:
        out = tmp_path / "nowhere" / "out.mcap"
        assert str(out.parent) in mclass("estimate", CAS_LAB, "-o", out, code=1).stderr

    @pytest.mark.parametrize(
        ("start", "end"),
        [
            ("+10s", "+20s"),
            (str(START_NS + 10 * 10**9), str(START_NS + 20 * 10**9)),
            ("2011-10-10T12:00:10Z", "2011-10-10T14:00:20+02:00"),
            ("+10000ms", "+0.3333333333m"),
        ],
    )
    def test_time_bounds(self, start: str, end: str, tmp_path: Path) -> None:
        out = tmp_path / "out.mcap"
        bounds = ("-S", start, "-E", end, "--format", "json")
        document = mclass("estimate", CAS_LAB, "-o", out, *bounds).document
        assert [(entry["id"], entry["measurements"]) for entry in document["objects"]] == [
            ("o3", 1)
        ]

    @pytest.mark.parametrize(
        ("start", "end", "code", "sentence"),
        [
            ("+10s", "+5s", 2, "the end '+5s' is not after the start '+10s'"),
            ("+10s", "+10s", 2, "nothing lies between"),
            ("+12s", "+13s", 1, "no detection can be used: none lies between the given times"),
            ("+2000s", "+2010s", 1, "nothing is logged from +2000s. The log holds"),
            ("1", "2", 1, "nothing is logged before 2. The log holds"),
        ],
    )
    def test_time_bounds_without_detections(
        self, start: str, end: str, code: int, sentence: str, tmp_path: Path
    ) -> None:
        out = tmp_path / "out.mcap"
        done = mclass("estimate", CAS_LAB, "-o", out, "-S", start, "-E", end, code=code)
        assert sentence in done.stderr
        assert not out.exists()

    def test_time_bounds_apart(self, tmp_path: Path) -> None:
        counts = []
        for index, bounds in enumerate([("--start", "+25s"), ("--end", "+25s")]):
            out = tmp_path / f"{index}.mcap"
            done = mclass("estimate", CAS_LAB, "-o", out, *bounds, "--format", "json")
            counts.append(done.document["measurements"]["used"])
        assert counts == [3, 2]

    def test_prefix(self, tmp_path: Path) -> None:
        topics = topics_of(estimated("cas_lab", tmp_path, "--prefix", "/second/try"))
        assert "/second/try/objects" in topics
        assert not any(topic.startswith("/mclass") for topic in topics)

    def test_every(self, tmp_path: Path) -> None:
        once = topics_of(estimated("cas_lab", tmp_path))
        often = topics_of(estimated("cas_lab", tmp_path, "--overwrite", "--every", "10"))
        assert once["/mclass/grid"] == 1
        assert often["/mclass/grid"] > 2
        assert often["/mclass/objects"] == once["/mclass/objects"] == 5

    def test_model_beside_the_log_comes_first(self, tmp_path: Path) -> None:
        log = sample("cas_lab", tmp_path)
        text = MODEL.read_text(encoding="utf-8")
        (tmp_path / "mclass.yaml").write_text(text.replace("0.499", "0.4"), encoding="utf-8")
        document = mclass("estimate", log, "--format", "json").document
        assert document["model"] == "mclass.yaml"

    def test_no_model(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.chdir(tmp_path)
        log = truncated(tmp_path)
        done = mclass("estimate", log, code=2)
        assert "no model" in done.stderr
        assert "mclass init" in done.stderr
        assert "The log is damaged (lost " in done.stderr
        assert "a model that was attached to it may be lost" in done.stderr
        assert [path.name for path in tmp_path.iterdir()] == [log.name]

    def test_plot(self, tmp_path: Path) -> None:
        picture = tmp_path / "map.png"
        estimated("cas_lab", tmp_path, "--plot", picture)
        assert picture.read_bytes().startswith(b"\x89PNG")

    def test_damaged_log(self, tmp_path: Path) -> None:
        out = tmp_path / "out.mcap"
        log = truncated(tmp_path)
        done = mclass("estimate", log, "-c", MODEL, "-o", out, "--format", "json", code=3)
        assert done.document["damage"]
        assert done.document["measurements"]["used"] == 4
        assert set(objects_of(out)) == {"o1", "o2", "o3"}
        text = mclass("estimate", log, "-c", MODEL, "-o", out, "--overwrite", code=3).stdout
        assert "damaged" in text


def topics_of(log: Path) -> Mapping[str, int]:
    with log.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    counts = summary.statistics.channel_message_counts
    return {channel.topic: counts.get(key, 0) for key, channel in summary.channels.items()}


def truncated(folder: Path) -> Path:
    """The first half of a sample log: its summary and the model attached are gone."""
    log = folder / "cut.mcap"
    log.write_bytes(CAS_LAB.read_bytes()[:60_000])
    return log


def missing(folder: Path) -> Path:
    return folder / "missing.mcap"


def empty(folder: Path) -> Path:
    log = folder / "empty.mcap"
    log.write_bytes(b"")
    return log


def not_mcap(folder: Path) -> Path:
    log = folder / "text.mcap"
    log.write_text("odometry, detections\n" * 100, encoding="utf-8")
    return log


def directory(folder: Path) -> Path:
    log = folder / "folder.mcap"
    log.mkdir()
    return log


BAD_LOGS: tuple[Callable[[Path], Path], ...] = (missing, empty, not_mcap, directory)
LOG_COMMANDS: tuple[tuple[str, ...], ...] = (
    ("estimate", "LOG"),
    ("estimate", "LOG", "-c", str(MODEL), "--format", "json"),
    ("init", "LOG"),
    ("inspect", "log", "LOG"),
    ("inspect", "log", "LOG", "--verify"),
    ("inspect", "objects", "LOG"),
    ("inspect", "cell", "LOG", "0", "0"),
)


@pytest.mark.parametrize("make", BAD_LOGS, ids=lambda make: make.__name__)
@pytest.mark.parametrize("command", LOG_COMMANDS, ids=" ".join)
def test_bad_logs_are_refused_with_their_name(
    command: tuple[str, ...], make: Callable[[Path], Path], tmp_path: Path
) -> None:
    log = make(tmp_path)
    before = sorted(tmp_path.iterdir())
    done = mclass(*(str(log) if word == "LOG" else word for word in command), code=1)
    assert done.stderr.startswith(f"Error: {log}: ")
    assert len(done.stderr.splitlines()) == 1
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize("words", [("objects", CAS_LAB), ("cell", CAS_LAB, "0", "0")])
def test_logs_without_results_say_what_to_do(words: tuple[str | Path, ...]) -> None:
    assert "mclass estimate" in mclass("inspect", *words, code=1).stderr


class TestUsage:
    @pytest.mark.parametrize(
        "arguments",
        [
            ("nonsense",),
            ("estimate",),
            ("estimate", CAS_LAB, "--nonsense"),
            ("estimate", CAS_LAB, "extra"),
            ("estimate", CAS_LAB, "--format", "xml"),
            ("estimate", CAS_LAB, "--every", "0"),
            ("estimate", CAS_LAB, "--every", "-1"),
            ("estimate", CAS_LAB, "-S", "yesterday"),
            ("estimate", CAS_LAB, "-S", "-10s"),
            ("estimate", CAS_LAB, "-E", "2011-10-10T12:00:10"),
            ("estimate", CAS_LAB, "-c", "missing.yaml"),
            ("estimate", CAS_LAB, "-c", CAS_LAB),
            ("init",),
            ("check",),
            ("check", "missing.yaml"),
            ("check", CAS_LAB),
            ("inspect", "nonsense"),
            ("inspect", "cell", CAS_LAB, "1"),
            ("inspect", "cell", CAS_LAB, "1", "north"),
            ("inspect", "model", "missing.yaml"),
            ("simulate", "missing.yaml"),
            ("simulate", MODEL),
        ],
        ids=lambda arguments: " ".join(str(a).rpartition("/")[2] for a in arguments),
    )
    def test_wrong_usage(
        self, arguments: tuple[str | Path, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.chdir(tmp_path)
        before = sorted(SAMPLES.iterdir())
        mclass(*arguments, code=2)
        assert list(tmp_path.iterdir()) == []
        assert sorted(SAMPLES.iterdir()) == before

    def test_wrong_model_names_every_fault(self, tmp_path: Path) -> None:
        model = tmp_path / "wrong.yaml"
        text = MODEL.read_text(encoding="utf-8").replace("length_unit: dm", "length_unit: parsec")
        model.write_text(text.replace("footprint: cone", "footprint: cube"), encoding="utf-8")
        arguments: tuple[tuple[str | Path, ...], ...] = (
            ("check", model),
            ("inspect", "model", model),
            ("estimate", CAS_LAB, "-c", model, "-o", tmp_path / "out.mcap"),
        )
        for words in arguments:
            stderr = mclass(*words, code=2).stderr
            assert re.search(r"wrong\.yaml:\d+:\d+: length_unit: ", stderr)
            assert re.search(r"wrong\.yaml:\d+:\d+: grid\.footprint: ", stderr)
        assert not (tmp_path / "out.mcap").exists()


class TestInit:
    def test_writes_where_estimate_looks(self, tmp_path: Path) -> None:
        log = sample("cas_lab_protobuf", tmp_path)
        assert str(tmp_path / "mclass.yaml") in mclass("init", log).stdout
        assert "is valid" in mclass("check", tmp_path / "mclass.yaml").stdout
        assert mclass("estimate", log, "--format", "json").document["model"] == "mclass.yaml"

    def test_keeps_what_is_there(self, tmp_path: Path) -> None:
        log, model = sample("cas_lab", tmp_path), tmp_path / "mclass.yaml"
        model.write_text("mine", encoding="utf-8")
        assert "--overwrite" in mclass("init", log, code=2).stderr
        assert model.read_text(encoding="utf-8") == "mine"
        mclass("init", log, "--overwrite")
        assert "physics_books" in model.read_text(encoding="utf-8")

    def test_stdout(self, tmp_path: Path) -> None:
        printed = mclass("init", CAS_LAB, "-o", "-").stdout
        mclass("init", CAS_LAB, "-o", tmp_path / "model.yaml")
        assert printed == (tmp_path / "model.yaml").read_text(encoding="utf-8")


class TestCheck:
    def test_text(self) -> None:
        done = mclass("check", MODEL)
        assert done.stdout.startswith("cas_lab.yaml is valid: 2 classes, 2 labels, lengths in dm")
        assert "physics_books" in done.stdout

    def test_json(self) -> None:
        document = mclass("check", MODEL, "--format", "json").document
        violation = {
            "class": str,
            "label": str,
            "position": [float, float],
            "ratio": float,
            "share": float,
        }
        assert_like(document, {"model": str, "valid": bool, "violations": [violation]})
        found = [(entry["class"], entry["label"]) for entry in document["violations"]]
        assert found == [("physics_books", "robot_parts"), ("robot_parts", "physics_books")]


class TestInspectLog:
    def test_text(self) -> None:
        stdout = mclass("inspect", "log", CAS_LAB).stdout
        for words in ("/odom", "/detections", "physics_books 3", "not used: "):
            assert words in stdout

    def test_json(self) -> None:
        document = mclass("inspect", "log", CAS_LAB, "--format", "json").document
        channel = {"topic": str, "schema": str, "used": bool, "why": str}
        assert_like(document, {"log": str, "damage": [str], "channels": [channel]})
        used = {entry["topic"] for entry in document["channels"] if entry["used"]}
        assert used == {"/camera/camera_info", "/detections", "/odom", "/tf_static"}

    def test_damage(self, tmp_path: Path) -> None:
        log = truncated(tmp_path)
        for options in ((), ("--verify",)):
            document = mclass("inspect", "log", log, "--format", "json", *options, code=3).document
            assert document["damage"]
        assert "damaged" in mclass("inspect", "log", log, code=3).stdout

    def test_only_verify_reads_everything(self, tmp_path: Path) -> None:
        """A flipped bit in a chunk that is not needed is found when asked for."""
        log = tmp_path / "flipped.mcap"
        data = bytearray(CAS_LAB.read_bytes())
        data[50_000] ^= 1
        log.write_bytes(data)
        stdout = mclass("inspect", "log", log, "--verify", "-c", MODEL, code=3).stdout
        assert "damaged" in stdout
        assert re.search(r"\d problems?, as said below", " ".join(stdout.split()))
        assert "nothing is wrong" not in stdout

    def test_verify_says_what_was_checked(self) -> None:
        stdout = " ".join(mclass("inspect", "log", CAS_LAB, "--verify").stdout.split())
        size, messages = CAS_LAB.stat().st_size, messages_in(CAS_LAB)
        assert f"verified {size:,} bytes, {messages:,} messages in" in stdout
        assert "checksums, message indexes and times: nothing is wrong" in stdout
        for options, verified in (((), False), (("--verify",), True)):
            command = ("inspect", "log", CAS_LAB, "--format", "json", *options)
            found = mclass(*command).document["verified"]
            assert (found is not None) == verified
        assert_like(found, {"bytes": int, "chunks": int, "messages": int, "data_checksum": bool})
        assert (found["messages"], found["attachments"]) == (messages, 2)
        assert found["problems"] == []


class TestInspectObjects:
    def test_text(self, output: Path) -> None:
        stdout = mclass("inspect", "objects", output).stdout
        for words in ("3 objects, frame odom", "robot_parts", "0.6154", "315.1", "x 2.00"):
            assert words in stdout
        assert max(map(len, stdout.splitlines())) <= 80

    def test_json(self, output: Path) -> None:
        document = mclass("inspect", "objects", output, "--format", "json").document
        assert_like(document, OBJECTS)
        assert document["frame"] == "odom"
        for entry in document["objects"]:
            assert sum(mode["mass"] for mode in entry["modes"]) == pytest.approx(1.0, abs=1e-9)
            assert "history" not in entry
            assert "tie" not in entry

    def test_history(self, output: Path) -> None:
        objects = objects_of(output, "--history")
        assert_like(list(objects.values()), [{**OBJECT, "history": [{**OBJECT, "labels": [str]}]}])
        counts = {key: [s["measurements"] for s in e["history"]] for key, e in objects.items()}
        assert counts == {"o1": [1, 2], "o2": [1, 2], "o3": [1]}
        stamps = [int(step["stamp_ns"]) for step in objects["o1"]["history"]]
        assert stamps == sorted(stamps)
        assert objects["o2"]["history"][0]["tie"] == ["physics_books", "robot_parts"]
        stdout = mclass("inspect", "objects", output, "--history").stdout
        assert "object o1" in stdout
        assert "257.7" in stdout

    def test_plot(self, output: Path, tmp_path: Path) -> None:
        picture = tmp_path / "objects.svg"
        mclass("inspect", "objects", output, "--plot", picture)
        assert b"<svg" in picture.read_bytes()[:1000]

    @pytest.mark.parametrize("name", ["picture.gif", "picture", "nowhere/picture.png"])
    def test_plot_that_cannot_be_drawn(self, output: Path, name: str, tmp_path: Path) -> None:
        arguments = ("inspect", "objects", output, "--plot", tmp_path / name)
        result = CliRunner().invoke(main, [str(argument) for argument in arguments])
        assert result.exit_code in (1, 2)
        assert "Error: " in result.stderr
        assert "This is a bug" not in result.stderr
        assert not (tmp_path / name).exists()
        assert list(tmp_path.iterdir()) == []

    @pytest.mark.parametrize("name", ["picture.gif", "nowhere/picture.png", "folder.png"])
    def test_plots_are_refused_before_the_work(self, name: str, tmp_path: Path) -> None:
        (tmp_path / "folder.png").mkdir()
        out = tmp_path / "out.mcap"
        command = ("estimate", CAS_LAB, "-o", out, "--plot", tmp_path / name)
        result = CliRunner().invoke(main, [str(argument) for argument in command])
        assert result.exit_code in (1, 2)
        assert result.stdout == ""
        assert "Error: " in result.stderr
        assert [path.name for path in tmp_path.iterdir()] == ["folder.png"]

    def test_without_matplotlib_nothing_is_done(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        for name in [name for name in sys.modules if name.startswith("mclass.plot")]:
            monkeypatch.delitem(sys.modules, name)
        monkeypatch.setitem(sys.modules, "matplotlib", None)
        command = ("estimate", CAS_LAB, "-o", tmp_path / "o.mcap", "--plot", tmp_path / "p.png")
        assert "mclass[plot]" in mclass(*command, code=2).stderr
        assert list(tmp_path.iterdir()) == []


class TestInspectCell:
    def test_text(self, output: Path) -> None:
        stdout = mclass("inspect", "cell", output, "2.1", "-1.5").stdout
        assert "center (2.10, -1.50) m in odom" in stdout
        assert "robot_parts     0.6012" in stdout

    def test_json(self, output: Path) -> None:
        arguments = ("inspect", "cell", output, "2.15", "-1.55", "--format", "json")
        document = mclass(*arguments).document
        assert_like(document, CELL)
        assert document["cell"]["center"] == pytest.approx((2.1, -1.5))
        assert document["cell"]["size"] == pytest.approx(0.2)
        assert set(document["orientation"]) == {"physics_books", "robot_parts"}
        for density in document["orientation"].values():
            assert_like(density, DENSITY)
            bins = density["bins_deg"]
            assert len(bins) == len(density["density"]) == 360
            assert bins[:2] == [0.0, 1.0]
            total = sum(density["density"]) * math.tau / len(bins)
            assert total == pytest.approx(1.0, abs=1e-6)
        assert "history" not in document

    def test_object_and_history(self, output: Path) -> None:
        arguments = ("inspect", "cell", output, "4", "2", "--object", "o1", "--format", "json")
        document = mclass(*arguments, "--history").document
        assert_like(document, {**CELL, "history": [{**CELL, "labels": [str], "stamp_ns": stamp}]})
        assert [step["measurements"] for step in document["history"]] == [1, 2]
        last = document["history"][-1]["class_probabilities"]
        assert last == pytest.approx(document["class_probabilities"], abs=1e-6)
        assert last == pytest.approx(objects_of(output)["o1"]["class_probabilities"], abs=1e-6)
        assert mclass(*arguments).document == {
            key: value for key, value in document.items() if key != "history"
        }

    def test_grid_history(self, output: Path) -> None:
        arguments = ("inspect", "cell", output, "2.1", "-1.5", "--format", "json", "--history")
        document = mclass(*arguments).document
        assert [step["labels"] for step in document["history"]] == [
            ["physics_books", "robot_parts"],
            ["robot_parts"],
        ]

    def test_untouched_cell_keeps_its_prior(self, output: Path) -> None:
        arguments = ("inspect", "cell", output, "0.5", "0.5", "--format", "json")
        document = mclass(*arguments).document
        assert document["measurements"] == 0
        assert document["class_probabilities"] == pytest.approx(
            {"background": 1 / 3, "physics_books": 1 / 3, "robot_parts": 1 / 3}
        )

    @pytest.mark.parametrize("point", [("-0.3", "-3.2"), ("-.1", "-3"), ("-1e-1", "-3.0")])
    def test_negative_coordinates_as_typed(self, point: tuple[str, str], output: Path) -> None:
        document = mclass("inspect", "cell", output, *point, "--format", "json").document
        x, y = map(float, point)
        half = document["cell"]["size"] / 2 + 1e-9
        assert document["cell"]["center"] == [
            pytest.approx(x, abs=half),
            pytest.approx(y, abs=half),
        ]

    def test_options_before_and_after_numbers(self, output: Path) -> None:
        before = mclass("inspect", "cell", "--format", "json", output, "-0.1", "-3").document
        assert (
            before == mclass("inspect", "cell", output, "-0.1", "-3", "--format", "json").document
        )

    @pytest.mark.parametrize(
        ("point", "options"),
        [
            (("100", "0"), ()),
            (("0", "-1e9"), ()),
            (("nan", "0"), ()),
            (("inf", "0"), ()),
            (("0", "0"), ("--object", "o9")),
            (("0", "0"), ("--objekt", "o1")),
        ],
    )
    def test_refused(self, point: tuple[str, str], options: tuple[str, ...], output: Path) -> None:
        done = mclass_any("inspect", "cell", output, *point, *options)
        assert done.exit_code in (1, 2)
        assert done.stderr.count("Error: ") == 1
        assert "This is a bug" not in done.stderr

    def test_plot(self, output: Path, tmp_path: Path) -> None:
        for index, options in enumerate([(), ("--history",), ("--object", "o2")]):
            picture = tmp_path / f"{index}.svg"
            arguments = ("inspect", "cell", output, "2", "-1.5", "--plot", picture)
            mclass(*arguments, *options)
            assert picture.exists()


def mclass_any(*arguments: str | Path) -> Any:
    """A command whose exit code the caller looks at."""
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


class TestInspectModel:
    def test_json(self) -> None:
        document = mclass("inspect", "model", MODEL, "--format", "json").document
        viewpoint = {"weight": float, "position": [float, float], "covariance": list}
        entry = {"class": str, "label": str, "probability": float, "viewpoints": [viewpoint]}
        assert_like(document, {"model": str, "priors": distribution, "likelihoods": [entry]})
        first = document["likelihoods"][0]["viewpoints"][0]
        assert first["position"] == pytest.approx((0.0, 1.0))
        assert first["covariance"][0] == pytest.approx((0.1, 0.0))


class TestSimulate:
    @pytest.mark.parametrize("encoding", ["ros2", "protobuf", "json"])
    def test_writes_log_and_truth(self, encoding: str, tmp_path: Path) -> None:
        log, truth = tmp_path / "log.mcap", tmp_path / "truth.json"
        scenario = CONFIGS / "scenarios" / "paper_toy.yaml"
        options = ("--encoding", encoding, "--truth", truth)
        assert "1 objects" in mclass("simulate", scenario, "-o", log, *options).stdout
        assert json.loads(truth.read_text(encoding="utf-8"))
        mclass("simulate", scenario, "-o", log, code=1)
        mclass("simulate", scenario, "-o", log, "--overwrite")

    def test_default_name(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.chdir(tmp_path)
        mclass("simulate", CONFIGS / "scenarios" / "paper_toy.yaml")
        assert (tmp_path / "paper_toy.mcap").exists()


class TestProcess:
    """What only a process of its own shows."""

    def test_version_and_help(self) -> None:
        assert re.fullmatch(rb"mclass, version \d+\.\d+\.\d+\n", mclass_process("--version").stdout)
        assert mclass_process("-h").returncode == 0

    def test_installed_program(self) -> None:
        program = Path(sys.executable).with_name("mclass")
        done = subprocess.run([program, "--version"], capture_output=True, check=True)
        assert done.stdout == mclass_process("--version").stdout

    def test_the_package_runs_as_a_module(self) -> None:
        done = subprocess.run(
            [sys.executable, "-m", "mclass", "--version"], capture_output=True, check=True
        )
        assert done.stdout == mclass_process("--version").stdout

    @pytest.mark.parametrize(
        ("encoding", "output_format"),
        [
            ("ascii", "text"),
            ("cp1252", "json"),
            pytest.param("ascii", "json", marks=pytest.mark.slow),
            pytest.param("cp1252", "text", marks=pytest.mark.slow),
        ],
    )
    def test_any_encoding_of_stdout(
        self, encoding: str, output_format: str, tmp_path: Path
    ) -> None:
        model, out = tmp_path / "modèle.yaml", tmp_path / "sortie_é漢.mcap"
        text = MODEL.read_text(encoding="utf-8")
        text = text.replace("  robot_parts:", "  pièces漢:", 1).replace(
            "  robot_parts:\n    prior", "  pièces漢:\n    prior"
        )
        model.write_text(text, encoding="utf-8")
        environment = {"PYTHONIOENCODING": encoding, "PYTHONUTF8": "0"}
        if output_format == "text":
            made = tmp_path / "init_é漢.yaml"
            done = mclass_process("init", CAS_LAB, "-o", made, environment=environment)
            assert done.returncode == 0
            done.stdout.decode(encoding)
        for arguments in (
            ("estimate", CAS_LAB, "-c", model, "-o", out),
            ("inspect", "objects", out, "--history"),
            ("inspect", "cell", out, "2.1", "-1.5"),
            ("inspect", "model", model),
            ("check", model),
        ):
            options = ("--format", output_format)
            done = mclass_process(*arguments, *options, environment=environment)
            assert done.returncode == 0, done.stderr.decode(errors="replace")
            shown = done.stdout.decode(encoding)
            if output_format == "json":
                json.loads(shown)
            elif arguments[0] == "inspect":
                assert "pi" in shown, "the class's name, escaped where it must be"

    def test_reader_that_goes_away(self, output: Path) -> None:
        for command in (
            "inspect objects OUT --history",
            "inspect log OUT",
            "inspect cell OUT 2 -1.5",
        ):
            line = (
                f'{sys.executable} -c "$PROGRAM" {command.replace("OUT", str(output))} | head -n 1'
            )
            program = "from mclass.commands.cli import main; main(prog_name='mclass')"
            done = subprocess.run(
                ["bash", "-c", line],
                env={**os.environ, "PROGRAM": program},
                capture_output=True,
                check=False,
            )
            assert done.stderr == b""
            assert len(done.stdout.splitlines()) == 1

    def test_closed_stdout(self, output: Path) -> None:
        """A reader that was never there."""
        read, write = os.pipe()
        os.close(read)
        program = "from mclass.commands.cli import main; main(prog_name='mclass')"
        words = [
            sys.executable,
            "-c",
            program,
            "inspect",
            "objects",
            str(output),
            "--format",
            "json",
        ]
        done = subprocess.run(words, stdout=write, stderr=subprocess.PIPE, check=False)
        os.close(write)
        assert done.returncode == 1
        assert done.stderr == b""

    @pytest.mark.parametrize(
        ("variables", "colored"),
        [({}, True), ({"NO_COLOR": "1"}, False), ({"TERM": "dumb"}, False)],
    )
    def test_color_on_terminals_only(
        self, variables: Mapping[str, str], colored: bool, output: Path
    ) -> None:
        shown = on_terminal(["inspect", "objects", str(output)], variables)
        assert ("\x1b[" in shown) == colored
        assert "robot_parts" in shown
        assert "\x1b" not in mclass_process("inspect", "objects", output).stdout.decode()


def on_terminal(arguments: list[str], variables: Mapping[str, str]) -> str:
    """What a command shows on a terminal of its own."""
    controller, terminal = pty.openpty()
    environment = {key: value for key, value in os.environ.items() if key != "NO_COLOR"}
    program = "from mclass.commands.cli import main; main(prog_name='mclass')"
    with subprocess.Popen(
        [sys.executable, "-c", program, *arguments],
        stdout=terminal,
        stderr=subprocess.DEVNULL,
        stdin=subprocess.DEVNULL,
        env={**environment, "TERM": "xterm", **variables},
    ):
        os.close(terminal)
        shown = bytearray()
        try:
            while block := os.read(controller, 4096):
                shown += block
        except OSError:  # the other end is closed
            pass
    os.close(controller)
    return shown.decode()


class TestUnexpected:
    """Whatever happens inside ends as a sentence and an exit code."""

    @pytest.mark.parametrize(
        ("error", "code", "words"),
        [
            (KeyboardInterrupt(), 130, "interrupted"),
            (MemoryError(), 1, "memory"),
            (ZeroDivisionError("no"), 1, "This is a bug"),
            (RecursionError("no"), 1, "This is a bug"),
        ],
        ids=lambda value: type(value).__name__,
    )
    def test_ends_with_a_sentence(
        self, error: BaseException, code: int, words: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def fail(*_: object, **__: object) -> None:
            raise error

        monkeypatch.setattr("mclass.config.model_file.load_model", fail)
        monkeypatch.delenv("MCLASS_DEBUG", raising=False)
        done = mclass_any("check", MODEL)
        assert done.exit_code == code
        assert words in done.stderr
        assert done.stderr.count("\n") == 1

    def test_debugging_shows_where(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def fail(*_: object) -> None:
            raise ZeroDivisionError

        monkeypatch.setattr("mclass.config.model_file.load_model", fail)
        monkeypatch.setenv("MCLASS_DEBUG", "1")
        assert isinstance(mclass_any("check", MODEL).exception, ZeroDivisionError)
