"""Texts and JSON documents of hand-made results, letter by letter."""

from __future__ import annotations

import dataclasses
import io
import json
import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lopsided_results import CLASS_NAMES, STAMP_NS, cell, estimate, mode

from mclass.checks import Violation
from mclass.logs.survey import ChannelUse, SensorUse, Survey
from mclass.results import OrientationMode
from mclass.text import (
    LogFacts,
    Terminal,
    cell_json,
    cell_text,
    check_json,
    check_text,
    estimate_json,
    estimate_text,
    history_text,
    log_json,
    log_text,
    objects_json,
    objects_text,
)
from mclass.text.terminal import display_width, table, wrap
from mclass.text.values import (
    degrees,
    degrees_text,
    probability_text,
    seconds_text,
    share_text,
    stamp_text,
)

UNICODE = Terminal()
ASCII = Terminal(unicode=False)


class TestObjectsJson:
    def test_one_object_in_full(self) -> None:
        document = objects_json([estimate(class_index=0, tie=(0, 1))], CLASS_NAMES, "odom")
        assert document["frame"] == "odom"
        (entry,) = document["objects"]
        approximate = {
            "orientation_deg": entry.pop("orientation_deg"),
            "modes": entry.pop("modes"),
            "joint_map": entry.pop("joint_map"),
            "class_poses": entry.pop("class_poses"),
        }
        assert entry == {
            "id": "o1",
            "class": "books",
            "class_probabilities": {"background": 0.1506, "books": 0.849382, "parts": 1.8e-5},
            "position": [4.0, -2.5],
            "position_std": [0.05, 0.061],
            "measurements": 12,
            "stamp_ns": "1700000000123456789",
            "labels": ["books"],
            "tie": ["books", "parts"],
        }
        assert approximate["orientation_deg"] == pytest.approx(257.75)
        first, second = approximate["modes"]
        assert first == pytest.approx({"orientation_deg": 257.75, "mass": 0.75, "std_deg": 9.125})
        assert second == pytest.approx({"orientation_deg": 77.5, "mass": 0.25, "std_deg": 12.0})
        assert approximate["joint_map"]["class"] == "parts"
        assert approximate["joint_map"]["position"] == [1.25, 7.5]
        assert approximate["joint_map"]["orientation_deg"] == pytest.approx(30.0)
        assert approximate["class_poses"]["books"]["position"] == [4.0, -2.5]
        assert approximate["class_poses"]["parts"]["orientation_deg"] == pytest.approx(30.0)

    def test_no_tie_no_key(self) -> None:
        assert "tie" not in objects_json([estimate()], CLASS_NAMES, "odom")["objects"][0]

    def test_history_belongs_to_its_object(self) -> None:
        past = [estimate("o2", stamp_ns=5, measurements=1), estimate("o2", stamp_ns=9)]
        document = objects_json([estimate("o1"), estimate("o2")], CLASS_NAMES, "odom", {"o2": past})
        first, second = document["objects"]
        assert first["history"] == []
        assert [step["stamp_ns"] for step in second["history"]] == ["5", "9"]
        assert second["history"][0]["labels"] == ["books"]
        assert second["history"][0]["measurements"] == 1

    def test_empty(self) -> None:
        assert objects_json([], CLASS_NAMES, "map") == {"frame": "map", "objects": []}

    def test_what_json_cannot_say_is_null(self) -> None:
        lost = estimate(modes=(OrientationMode(1.0, 1.0, math.inf),), position_std=(math.nan, 1.0))
        document = objects_json([lost], CLASS_NAMES, "odom")
        text = json.dumps(document, allow_nan=False)
        entry = json.loads(text)["objects"][0]
        assert entry["modes"][0]["std_deg"] is None
        assert entry["position_std"] == [None, 1.0]


class TestCellJson:
    def test_one_cell_in_full(self) -> None:
        document = cell_json(cell(), CLASS_NAMES)
        books = document["orientation"]["books"]
        assert document["cell"] == {"row": 3, "column": 7, "center": [2.75, 3.75], "size": 0.5}
        assert document["class_probabilities"] == {
            "background": 0.125,
            "books": 0.75,
            "parts": 0.125,
        }
        assert books["bins_deg"] == [0.0, 45.0, 90.0, 135.0, 180.0, 225.0, 270.0, 315.0]
        assert books["density"] == cell().density[0].tolist()
        assert books["modes"][0]["orientation_deg"] == pytest.approx(90.0)
        assert document["orientation"]["parts"]["modes"] == []
        assert document["measurements"] == 3
        assert document["stamp_ns"] == str(STAMP_NS)
        assert "history" not in document
        json.dumps(document, allow_nan=False)

    def test_history_is_oldest_first(self) -> None:
        steps = [cell(stamp_ns=3, measurements=1, labels=("parts",)), cell(measurements=2)]
        history = cell_json(cell(), CLASS_NAMES, steps)["history"]
        assert [step["measurements"] for step in history] == [1, 2]
        assert history[0]["labels"] == ["parts"]
        assert history[0]["stamp_ns"] == "3"


def test_estimate_json() -> None:
    document = estimate_json(
        input_path="a.mcap",
        output_path="a.mclass.mcap",
        model_name="mclass.yaml",
        used=7,
        skipped={"no pose": int(np.int64(2))},
        objects=[estimate()],
        class_names=CLASS_NAMES,
        frame="odom",
        damage=["the end is missing"],
    )
    assert document["input"] == "a.mcap"
    assert document["output"] == "a.mclass.mcap"
    assert document["model"] == "mclass.yaml"
    assert document["measurements"] == {"used": 7, "skipped": {"no pose": 2}}
    assert document["objects"] == objects_json([estimate()], CLASS_NAMES, "odom")["objects"]
    assert document["damage"] == ["the end is missing"]
    json.dumps(document, allow_nan=False)


class TestObjectsText:
    def test_two_objects(self) -> None:
        known = estimate(
            "o12",
            probabilities=(0.0, 0.25, 0.75),
            class_index=1,
            position=(-12.0, 0.5),
            position_std=(0.0, 0.0),
            modes=(mode(3.0, 1.0, 4.5),),
            measurements=3,
        )
        assert objects_text([estimate(), known], CLASS_NAMES, "odom", UNICODE).split("\n") == [
            "2 objects, frame odom",
            "",
            "id   class             P  position [m]    orientation [deg]    n",
            "o1   books        0.8494  x 4.00 ± 0.05   257.8 ± 9.1 (75 %)  12",
            "     background   0.1506  y -2.50 ± 0.06  77.5 ± 12.0 (25 %)",
            "     parts       1.8e-05",
            "o12  parts        0.7500  x -12.00        3.0 ± 4.5 (100 %)    3",
            "     books        0.2500  y 0.50",
            "     background   0.0000",
        ]

    def test_on_narrow_terminals_orientation_stands_below(self) -> None:
        lines = objects_text([estimate()], CLASS_NAMES, "odom", Terminal(width=50)).split("\n")
        assert lines[2:] == [
            "id  class             P  pose [m, deg]        n",
            "o1  books        0.8494  x 4.00 ± 0.05       12",
            "    background   0.1506  y -2.50 ± 0.06",
            "    parts       1.8e-05  257.8 ± 9.1 (75 %)",
            "                         77.5 ± 12.0 (25 %)",
        ]

    def test_tie_and_background_are_said(self) -> None:
        tied = estimate(probabilities=(0.5, 0.25, 0.25), tie=(0, 1))
        lines = objects_text([tied], CLASS_NAMES, "odom", ASCII).split("\n")
        assert lines[3].startswith("o1  = books ")
        assert lines[5].startswith("    = parts ")
        assert lines[6:] == [
            "",
            "o1: books and parts are equally probable (=), a tie; position and orientation",
            "  are those given books.",
            "o1: background (nothing there), P 0.5000, is more probable than any class.",
        ]

    def test_labels_that_no_class_explains(self) -> None:
        """No class is named, no tie claimed, no orientation made up."""
        lost = estimate(
            probabilities=(1.0, 0.0, 0.0), tie=(0, 1), modes=(mode(0.0, 1.0, 360 / 12**0.5),)
        )
        lines = objects_text([lost], CLASS_NAMES, "odom", UNICODE).split("\n")
        assert lines[3].split()[:3] == ["o1", "background", "1.0000"]
        assert " ".join(lines[3:5]).count("unknown") == 1
        remark = " ".join(lines[5:])
        assert "o1: no class explains these labels" in remark
        assert "equally probable" not in remark
        assert objects_json([lost], CLASS_NAMES, "odom")["objects"][0]["unexplained"] is True
        assert "unexplained" not in objects_json([estimate()], CLASS_NAMES, "odom")["objects"][0]
        text = cell_text(cell(probabilities=(1.0, 0.0, 0.0)), CLASS_NAMES, "odom", UNICODE)
        assert "No class explains these labels." in text
        assert "a tie" not in text

    def test_no_tie_no_remark(self) -> None:
        assert "=" not in objects_text([estimate()], CLASS_NAMES, "odom", UNICODE)

    def test_objects_come_in_natural_order(self) -> None:
        ids = ["o10", "b", "o2", "o1", "o02", "9" * 5000]
        objects = [estimate(name) for name in ids]
        document = objects_json(objects, CLASS_NAMES, "odom")
        order = ["9" * 5000, "b", "o1", "o02", "o2", "o10"]
        assert [entry["id"] for entry in document["objects"]] == order
        text = objects_text(objects, CLASS_NAMES, "odom", UNICODE)
        shown = re.findall(r"^(b|o\d+) ", text, re.MULTILINE)
        assert shown == order[1:]

    def test_no_objects(self) -> None:
        assert objects_text([], CLASS_NAMES, "odom", UNICODE).startswith("No objects")

    def test_a_long_id_is_shown_whole(self) -> None:
        name = "a3f9c2e0-1111-4222-8333-abcdefabcdef"
        lines = objects_text([estimate(name)], CLASS_NAMES, "odom", UNICODE).split("\n")
        assert lines[3] == name
        assert " ".join(lines[4].split()) == "books 0.8494 x 4.00 ± 0.05 257.8 ± 9.1 (75 %) 12"

    def test_many_classes_and_modes_are_summed_up(self) -> None:
        probabilities = (0.02, *([0.05] * 17), 0.13)
        modes = tuple(mode(60.0 * k, 1 / 6, 5.0) for k in range(6))
        crowded = estimate(probabilities=probabilities, class_index=17, modes=modes)
        names = [f"class_{k}" for k in range(18)]
        lines = objects_text([crowded], names, "odom", UNICODE).split("\n")
        assert lines[3].split()[1:3] == ["class_17", "0.1300"]
        assert lines[8].split() == ["+", "14", "more", "0.6700"]
        assert lines[7].endswith("+ 2 more (33 %)")

    def test_flat_orientation(self) -> None:
        for modes in ((), (mode(0.0, 1.0, 360 / 12**0.5),)):
            text = objects_text([estimate(modes=modes)], CLASS_NAMES, "odom", UNICODE)
            assert "any (flat)" in text
            assert "103.9" not in text

    def test_nothing_foreign_controls_the_terminal(self) -> None:
        evil = "\x1b]0;owned\x07\r\n\u202e\ud800"
        text = objects_text([estimate(evil)], (evil, "b"), evil, UNICODE)
        assert not set(text) & set("\x1b\x07\r\u202e\ud800")
        assert r"\x1b]0;owned\x07\r\n\u202e\ud800" in text
        text.encode("utf-8")

    def test_ascii_terminal_gets_ascii(self) -> None:
        text = objects_text([estimate("größe")], ("книга", "本"), "odom", ASCII)
        assert text.isascii()
        assert "+/-" in text
        assert r"gr\xf6\xdfe" in text

    def test_color_only_when_asked(self) -> None:
        colored = objects_text([estimate()], CLASS_NAMES, "odom", Terminal(color=True))
        assert "\x1b[1m" in colored
        plain = objects_text([estimate()], CLASS_NAMES, "odom", UNICODE)
        assert colored.replace("\x1b[1m", "").replace("\x1b[0m", "") == plain


class TestCellText:
    def test_in_full(self) -> None:
        lines = cell_text(cell(), CLASS_NAMES, "odom", Terminal()).split("\n")
        assert lines[:9] == [
            "row 3, column 7, center (2.75, 3.75) m in odom, size 0.5 m",
            "3 measurements, the last at 2023-11-14T22:13:20.123Z: books, parts",
            "",
            "class            P",
            "background  0.1250  █████",
            "books       0.7500  ██████████████████████████████",
            "parts       0.1250  █████",
            "",
            "orientation given books: peak 0.637 per rad at 90.0 deg",
        ]
        assert lines[-1] == "orientation given parts: flat, nothing is known"

    def test_density_chart(self) -> None:
        # Three columns a bin: the peak (90 deg) in column 6, half of it in columns 4 and 9.
        lines = cell_text(cell(), CLASS_NAMES, "odom", Terminal(width=28)).split("\n")
        ruler = lines.index("0     90    180   270   360")
        assert lines[ruler - 4 : ruler] == [
            "      █▃",
            "     ███▅",
            "    ██████▅▃",
            " ▃▅██████████▅▃",
        ]
        assert lines[ruler + 1] == "modes [deg]: 90.0 ± 26.0"

    def test_many_bins_keep_their_peak(self) -> None:
        density = np.zeros((2, 720))
        density[0, 719] = 720 / (2 * np.pi)
        report = cell(density=density, modes=((mode(359.5, 1.0, 0.1),), ()))
        lines = cell_text(report, CLASS_NAMES, "odom", UNICODE).split("\n")
        ruler = next(i for i, line in enumerate(lines) if line.startswith("0  "))
        # 359.5 degrees is nearer to the column of 360, which is that of 0, than to that of 355.
        assert lines[ruler - 4 : ruler] == ["█"] * 4

    def test_untouched(self) -> None:
        text = cell_text(cell(measurements=0, labels=()), CLASS_NAMES, "odom", UNICODE)
        assert "no measurement: this is the prior" in text

    def test_unknown_last_labels_are_not_made_up(self) -> None:
        lines = cell_text(cell(labels=()), CLASS_NAMES, "odom", UNICODE).split("\n")
        assert lines[1] == "3 measurements, the last at 2023-11-14T22:13:20.123Z"

    def test_object_belief_names_its_object(self) -> None:
        text = cell_text(cell(), CLASS_NAMES, "odom", UNICODE, object_id="o\n7")
        assert text.startswith("object o\\n7, row 3, column 7")

    def test_tie_is_said(self) -> None:
        tied = cell(probabilities=(0.2, 0.4000001, 0.3999999))
        text = cell_text(tied, CLASS_NAMES, "odom", UNICODE)
        assert "books and parts are equally probable, a tie." in text
        near = cell(probabilities=(0.2, 0.40001, 0.39999))
        assert "tie" not in cell_text(near, CLASS_NAMES, "odom", UNICODE)

    def test_many_classes_are_summed_up(self) -> None:
        count = 30
        probabilities = np.linspace(1.0, 2.0, count + 1)
        report = cell(
            density=np.full((count, 8), 0.5 / np.pi),
            probabilities=tuple(probabilities / probabilities.sum()),
            modes=((),) * count,
        )
        text = cell_text(report, [f"class_{k}" for k in range(count)], "odom", UNICODE)
        assert "+ 18 more" in text
        assert "26 less probable classes not drawn" in text
        assert "orientation given class_29: flat" in text

    def test_ascii_terminal_gets_ascii(self) -> None:
        assert cell_text(cell(), CLASS_NAMES, "odom", ASCII).isascii()


class TestHistoryText:
    def test_an_object(self) -> None:
        steps = [
            estimate(
                probabilities=(0.4231, 0.4244, 0.1525),
                measurements=1,
                modes=(mode(56.3, 0.5, 9), mode(236.3, 0.5, 9)),
            ),
            estimate(
                measurements=2,
                labels=("books", "parts"),
                stamp_ns=STAMP_NS + 1_500_000_000,
                modes=(mode(45.0, 1.0, 9),),
            ),
        ]
        assert history_text(steps, CLASS_NAMES, UNICODE).split("\n") == [
            "t = 0 at 2023-11-14T22:13:20.123Z",
            "",
            "n  t [s]  labels        background   books    parts  orientation [deg]",
            "1  0.000  books             0.4231  0.4244   0.1525  56.3 (50 %), 236.3 (50 %)",
            "2  1.500  books, parts      0.1506  0.8494  1.8e-05  45.0 (100 %)",
        ]

    def test_a_cell_shows_its_most_probable_class(self) -> None:
        steps = [cell(probabilities=(0.1, 0.2, 0.7), modes=((mode(5, 1, 1),), (mode(7, 1, 1),)))]
        last = history_text(steps, CLASS_NAMES, UNICODE).split("\n")[-1]
        assert " ".join(last.split()) == "3 0.000 books, parts 0.1000 0.7000 0.2000 7.0 (100 %)"

    def test_rounding_does_not_order_modes(self) -> None:
        one, other = mode(56.3, 0.5 - 1e-12, 9), mode(236.3, 0.5 + 1e-12, 9)
        text = history_text([estimate(modes=(other, one))], CLASS_NAMES, UNICODE)
        assert text.endswith("56.3 (50 %), 236.3 (50 %)")
        table_text = objects_text([estimate(modes=(other, one))], CLASS_NAMES, "odom", UNICODE)
        assert table_text.index("56.3 ±") < table_text.index("236.3 ±")

    def test_names_are_whole_where_there_is_room(self) -> None:
        names = ("coffee_machine_grinder", "x")
        lines = history_text([estimate(labels=("x",))], names, UNICODE).split("\n")
        assert names[0] in lines[2].split()
        assert max(map(len, lines)) <= 80

    def test_classes_that_do_not_fit_are_counted(self) -> None:
        names = [f"class_{k}" for k in range(5)]
        steps = [estimate(probabilities=(0.1, 0.1, 0.1, 0.1, 0.5, 0.1), class_index=3)]
        lines = history_text(steps, names, UNICODE).split("\n")
        assert "class_3" in lines[2]
        assert lines[-1] == "3 of 5 classes not shown"

    def test_empty(self) -> None:
        assert history_text([], CLASS_NAMES, UNICODE).startswith("No history")


def test_estimate_text() -> None:
    text = estimate_text(
        input_path="run\x1b.mcap",
        output_path="run.mclass.mcap",
        model_name="mclass.yaml",
        used=412,
        skipped={"score below 0.5": 9, "no pose near": 123},
        objects=[estimate()],
        class_names=CLASS_NAMES,
        frame="odom",
        damage=["the file ends early"],
        notes=["odometry from /odom"],
        terminal=UNICODE,
    )
    assert text.split("\n\n")[0].split("\n") == [
        r"input         run\x1b.mcap",
        "output        run.mclass.mcap",
        "model         mclass.yaml",
        "measurements  412 used, 132 skipped",
        "              123  no pose near",
        "                9  score below 0.5",
        "note          odometry from /odom",
        "damaged       the file ends early",
    ]
    assert text.endswith(objects_text([estimate()], CLASS_NAMES, "odom", UNICODE))


class TestLogText:
    FACTS = LogFacts(
        path="run\x07.mcap",
        size=1_234_567,
        profile="ros2",
        library="writer 1.0",
        start_ns=STAMP_NS,
        end_ns=STAMP_NS + 42_500_000_000,
        damage=("lost 1 chunk at byte 77: the checksum does not match",),
        remarks=("the summary was wrong",),
    )
    SURVEY = Survey(
        channels=(
            ChannelUse("/image", "Image", "cdr", 90, 2.25, "", False, "not a type that is read"),
            ChannelUse("/odom", "Odometry", "cdr", None, None, "pose", True, "Odometry"),
            ChannelUse("/seen", "Seen", "cdr", 1, 0.02, "detections", True, "fields by name"),
            ChannelUse("/audio", "Audio", "cdr", 7, 0.125, "", False, "not a type that is read"),
        ),
        detections=("/seen",),
        pose_topic="/odom",
        pose_kind="Odometry",
        world_frame="odom",
        pose_count=840,
        placed=8,
        sensors=(SensorUse("/seen", "eye", True, "/info", True, (640, 480), False, 9),),
        labels={"7": 5, "cat\n": 2},
        label_names={"7": "books"},
        unknown_labels={"cat\n": 2},
        together=(("7", "cat\n", 2),),
        looks=9,
        detection_count=7,
        ids=1,
        encoding="ros2",
        pose_problems={"stamps going backwards": 3},
        unreadable={"/odom": {"too short": 1}},
        notes=("one choice",),
        problem="no poses were recognised",
    )

    def test_in_full(self) -> None:
        assert log_text(self.FACTS, self.SURVEY, UNICODE).split("\n") == [
            r"log          run\x07.mcap, 1,234,567 bytes",
            "recorded     2023-11-14T22:13:20.123Z, 42.500 s, profile ros2, by writer 1.0",
            "used         detections on /seen: 7 in 9 messages, 1 object id",
            "used         poses from /odom (Odometry): 840 of an unnamed frame in odom,",
            "             covering 8 of 9 detection messages",
            "used         camera eye of /seen, 640 x 480 pixels, calibrated by /info, place",
            "             on the robot assumed",
            r"labels       7 (books) 5, cat\n 2 (not in the model)",
            r"together     7 and cat\n 2",
            "note         one choice",
            "note         the summary was wrong",
            "left out     3 stamps going backwards",
            "damaged      lost 1 chunk at byte 77: the checksum does not match",
            "problem      estimate would fail: no poses were recognised",
            "",
            "channels  messages     Hz  type",
            "used for pose (Odometry)",
            "  /odom          ?         Odometry",
            "used for detections (fields by name)",
            "  /seen          1         Seen",
            "not used: not a type that is read",
            "  /image        90   2.25  Image",
            "  /audio         7  0.125  Audio",
        ]

    def test_empty_log(self) -> None:
        facts = LogFacts("a.mcap", 0, "", "", None, None)
        lines = log_text(facts, Survey(channels=()), UNICODE).split("\n")
        assert lines == [
            "log          a.mcap, 0 bytes",
            "recorded     no messages",
            "",
            "no channels",
        ]

    def test_poses_from_transforms(self) -> None:
        chain = dataclasses.replace(
            self.SURVEY, pose_topic="", pose_kind="transforms", transform=("map", "base")
        )
        text = log_text(self.FACTS, chain, UNICODE)
        assert "poses from transforms (map to base): 840 of" in text

    def test_many_labels_are_counted(self) -> None:
        labels = {f"l{k}": 100 - k for k in range(25)}
        text = log_text(self.FACTS, dataclasses.replace(self.SURVEY, labels=labels), UNICODE)
        assert "l19 81, and 5 more" in " ".join(text.split())

    def test_nothing_is_too_wide_or_foreign(self) -> None:
        evil = "/very/long" * 20 + "\x1b[2J\u202e"
        row = ChannelUse(evil, evil, evil, 1, 1.0, evil, True, evil)
        text = log_text(
            self.FACTS, dataclasses.replace(self.SURVEY, channels=(row,), notes=(evil,)), ASCII
        )
        assert text.isascii()
        assert "\x1b" not in text
        for line in text.split("\n"):
            assert len(line) <= 80 or " " not in line.strip()

    def test_json(self) -> None:
        document = log_json(self.FACTS, self.SURVEY)
        document = json.loads(json.dumps(document, allow_nan=False))
        assert document["log"] == "run\x07.mcap"
        assert document["start_ns"] == str(STAMP_NS)
        assert document["channels"][0]["why"] == "not a type that is read"
        assert document["labels"] == {"7": 5, "cat\n": 2}
        assert document["unreadable"] == {"/odom": {"too short": 1}}
        assert document["damage"] == list(self.FACTS.damage)


class TestChecks:
    VIOLATION = Violation(
        class_name="c1",
        label="c2",
        true_label="c1",
        position=np.array([0.0, 1.625]),
        confusion_density=0.25,
        true_density=0.1,
        ratio=2.5,
        share=0.123,
        greatest_ratio=1e80,
    )

    def test_violation_in_the_models_unit(self) -> None:
        lines = check_text([self.VIOLATION], UNICODE, ("dm", 0.1)).split("\n")
        assert lines == [
            "Inequality (12) does not hold everywhere.",
            "From some places a confusing label is likelier than the class's own; there it",
            "misleads. Places matter where the class returns one of the two labels with at",
            "least 10 % of the peak density of its own.",
            "",
            "class c1: label c2 is likelier than c1 in 12 % of the places that matter",
            "  most at (0, 16.2) dm from the object, in its frame: 0.0025 against 0.001 per",
            "  dm², 2.5 times; anywhere up to over a million times",
        ]

    def test_ascii(self) -> None:
        assert check_text([self.VIOLATION], ASCII).isascii()

    def test_json_is_in_metres(self) -> None:
        assert check_json([self.VIOLATION]) == {
            "violations": [
                {
                    "class": "c1",
                    "label": "c2",
                    "true_label": "c1",
                    "position": [0.0, 1.625],
                    "confusion_density": 0.25,
                    "true_density": 0.1,
                    "ratio": 2.5,
                    "share": 0.123,
                    "greatest_ratio": 1e80,
                }
            ]
        }

    def test_nothing_to_report(self) -> None:
        assert check_text([], UNICODE).startswith("Inequality (12) holds")
        assert check_json([]) == {"violations": []}


@given(
    name=st.text(max_size=300),
    label=st.text(max_size=300),
    unicode=st.booleans(),
    width=st.integers(70, 120),
)
def test_text_keeps_to_the_width(name: str, label: str, unicode: bool, width: int) -> None:
    terminal = Terminal(width=width, unicode=unicode)
    names = (label, "parts")
    tied = estimate(name, probabilities=(0.5, 0.25, 0.25), tie=(0, 1), labels=(label,))
    texts = [
        objects_text([tied], names, "odom", terminal),
        cell_text(cell(labels=(label, name)), names, "odom", terminal),
    ]
    for line in "\n".join(texts).split("\n"):
        # A single word longer than the terminal is shortened, not wrapped.
        assert display_width(line) <= width or " " not in line.strip()
        assert unicode or line.isascii()
        assert line.isprintable()


class TestTerminal:
    @pytest.mark.parametrize(
        ("text", "unicode", "expected"),
        [
            ("plain text", True, "plain text"),
            ("", True, '""'),
            ("a\tb\x00\x7f\x9b", True, r"a\tb\x00\x7f\x9b"),
            ("back\\slash", True, r"back\\slash"),
            ("größe 本", True, "größe 本"),
            ("größe 本", False, r"gr\xf6\xdfe \u672c"),
            ("line\u2028sep", True, r"line\u2028sep"),
        ],
    )
    def test_clean(self, text: str, unicode: bool, expected: str) -> None:
        assert Terminal(unicode=unicode).clean(text) == expected

    def test_a_megabyte_is_shortened(self) -> None:
        text = Terminal().clean("head" + "\x00" * 10**6 + "tail", 40)
        assert text.startswith(r"head\x00\x00")
        assert text.endswith(r"\x00tail")
        assert display_width(text) == 40

    def test_shorten_counts_columns_not_characters(self) -> None:
        assert Terminal().shorten("本" * 10, 20) == "本" * 10
        assert Terminal().shorten("本" * 10, 11) == "本本本本…本"
        assert Terminal(unicode=False).shorten("abcdefghijklm", 10) == "abcde...lm"

    def test_display_width(self) -> None:
        assert display_width("e\u0301") == 1
        assert display_width("本a") == 3

    def test_profile_fills_from_below(self) -> None:
        values = np.array([0.0, 0.25, 1.0, 0.5, 0.0])
        assert Terminal().profile(values, 2) == ["  █", " ▄██"]
        assert Terminal(unicode=False).profile(values, 1) == [" :@="]
        assert Terminal().profile(np.zeros(3), 2) == ["", ""]

    @pytest.mark.parametrize(
        ("encoding", "is_terminal", "variables", "unicode", "color"),
        [
            ("utf-8", True, {}, True, True),
            ("UTF-8", True, {"NO_COLOR": "1"}, True, False),
            ("utf-8", True, {"NO_COLOR": ""}, True, True),
            ("utf-8", True, {"TERM": "dumb"}, True, False),
            ("utf-8", False, {}, True, False),
            ("iso-8859-1", True, {}, False, True),
            ("ascii", False, {}, False, False),
        ],
    )
    def test_of_a_stream(
        self,
        encoding: str,
        is_terminal: bool,
        variables: dict[str, str],
        unicode: bool,
        color: bool,
    ) -> None:
        class Stream(io.TextIOWrapper):
            def isatty(self) -> bool:
                return is_terminal

        terminal = Terminal.of(Stream(io.BytesIO(), encoding=encoding), variables)
        assert (terminal.unicode, terminal.color) == (unicode, color)
        assert is_terminal or terminal.width == 80

    def test_of_a_stream_without_encoding(self) -> None:
        assert Terminal.of(io.StringIO(), {}) == Terminal(unicode=False)


class TestLayout:
    def test_numbers_are_never_cut(self) -> None:
        lines = table(["a", "b"], [["x" * 50, "1" * 38]], "<>", Terminal(width=60), elastic=(0,))
        assert lines[1] == "x" * 13 + "…" + "x" * 6 + "  " + "1" * 38
        wide = table(["a", "b"], [["x" * 50, "1" * 70]], "<>", Terminal(width=60), elastic=(0,))
        assert wide[1].endswith("  " + "1" * 70)

    def test_cells_of_several_lines_and_spanning_rows(self) -> None:
        lines = table(["a", "bb"], [["all of it"], ["1\n2\n3", "x"]], ">>", Terminal())
        assert lines == ["a  bb", "all of it", "1   x", "2", "3"]

    def test_wrap_keeps_inner_and_leading_space(self) -> None:
        lines = wrap("  key   one two three", Terminal(width=14), " " * 8)
        assert lines == ["  key   one", "        two", "        three"]


class TestValues:
    @pytest.mark.parametrize(
        ("angle", "expected"), [(-1e-20, 0.0), (2 * math.pi, 0.0), (-math.pi / 2, 270.0)]
    )
    def test_degrees_stay_below_360(self, angle: float, expected: float) -> None:
        assert degrees(angle) == expected

    def test_rounding_does_not_reach_360(self) -> None:
        assert degrees_text(math.radians(359.97)) == "0.0"
        assert degrees_text(math.radians(359.94)) == "359.9"

    @pytest.mark.parametrize(
        ("value", "expected"),
        [(0.0, "0.0000"), (1.0, "1.0000"), (0.00005, "0.0001"), (1.8e-5, "1.8e-05")],
    )
    def test_probability(self, value: float, expected: str) -> None:
        assert probability_text(value) == expected

    @pytest.mark.parametrize(
        ("value", "expected"),
        [(0.0, "0 %"), (0.004, "<1 %"), (0.996, ">99 %"), (1.0, "100 %"), (0.5, "50 %")],
    )
    def test_share(self, value: float, expected: str) -> None:
        assert share_text(value) == expected

    def test_stamps(self) -> None:
        assert stamp_text(STAMP_NS) == "2023-11-14T22:13:20.123Z"
        assert stamp_text(12_345_000_000) == "12.345 s"
        assert stamp_text(2**63 - 1) == "2262-04-11T23:47:16.854Z"
        assert seconds_text(-1_500_000) == "-0.002"
        assert seconds_text(10**18 + 1) == "1000000000.000"
