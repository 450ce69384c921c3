"""Pictures of logs and of evaluations."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from matplotlib.collections import LineCollection, QuadMesh
from matplotlib.figure import Figure

from mclass.commands.cli import main
from mclass.evaluation.scores import LogScore, ObjectScore
from mclass.evaluation.summary import Evaluation, evaluate
from mclass.logs.reader import LogReader
from mclass.logs.survey import Survey, survey
from mclass.plot import evaluation_figure, log_figure, save_figure
from mclass.plot.evaluation import wilson_interval

LAB = Path(__file__).parents[1] / "sample_logs/cas_lab.mcap"


def score(true: str, named: str, confidence: float, level: float = 0.5) -> ObjectScore:
    """One object; what pictures do not show is zero."""
    zeros = dict.fromkeys(
        ("orientation_error", "symmetric_error", "mode_error", "position_error"), 0.0
    )
    return ObjectScore(
        "o",
        "o",
        true,
        named,
        correct=float(true == named),
        confidence=confidence,
        log_loss=0.0,
        brier=0.0,
        level=level,
        **zeros,
    )


def evaluation(*objects: ObjectScore, missed: tuple[str, ...] = ()) -> Evaluation:
    return evaluate([LogScore("log", objects, missed, ())])


def texts(figure: Figure, index: int) -> list[str]:
    return [text.get_text() for text in figure.axes[index].texts]


class TestEvaluationFigure:
    def test_reliability_is_right_against_confident(self) -> None:
        # One bin holds 0.62 and 0.66, one of which is right; another holds 0.95.
        figure = evaluation_figure(
            evaluation(score("a", "a", 0.62), score("a", "b", 0.66), score("b", "b", 0.95))
        )
        (bars,) = figure.axes[0].containers
        points = np.asarray(bars[0].get_xydata())
        np.testing.assert_allclose(points, [[0.64, 0.5], [0.95, 1.0]])
        assert texts(figure, 0) == ["2", "1"]

    def test_coverage_counts_regions_that_hold_the_truth(self) -> None:
        levels = (0.9, 0.2, 0.4, 0.4)
        figure = evaluation_figure(evaluation(*(score("a", "a", 0.5, level=x) for x in levels)))
        line = figure.axes[1].lines[1]
        x, y = np.asarray(line.get_xdata()), np.asarray(line.get_ydata())
        shares = [float(y[np.searchsorted(x, at, side="right") - 1]) for at in (0.1, 0.3, 0.5, 1.0)]
        assert shares == [0.0, 0.25, 0.75, 1.0]

    def test_confusion_has_true_classes_in_rows(self) -> None:
        objects = [score("c10", "c9", 0.5)] * 3 + [score("c9", "c9", 0.5)]
        figure = evaluation_figure(evaluation(*objects))
        axes = figure.axes[2]
        assert [label.get_text() for label in axes.get_yticklabels()] == ["c9", "c10"]
        (image,) = axes.get_images()
        np.testing.assert_allclose(np.asarray(image.get_array()), [[1.0, 0.0], [1.0, 0.0]])
        assert texts(figure, 2) == ["1", "3"]

    def test_what_was_missed_is_said(self) -> None:
        figure = evaluation_figure(evaluation(score("a", "a", 0.5), missed=("x", "y")))
        assert figure.get_suptitle() == "1 object of 1 log, 2 missed"

    def test_nothing_matched(self) -> None:
        figure = evaluation_figure(evaluation(missed=("x",)))
        assert texts(figure, 1) == ["no object was matched"]

    def test_wilson_interval_by_hand(self) -> None:
        # Of 10 with share 0.5: centre 0.5, half width 1.96 sqrt(0.025 + 0.009604) / 1.38416.
        low, high = wilson_interval(np.array([0.5]), np.array([10]))
        assert (low[0], high[0]) == pytest.approx((0.23659, 0.76341), abs=1e-5)
        # Nine of nine may still come from a share of 0.7.
        low, high = wilson_interval(np.array([1.0]), np.array([9]))
        assert (low[0], high[0]) == pytest.approx((0.70085, 1.0), abs=1e-5)

    def test_hostile_names_and_many_classes(self, tmp_path: Path) -> None:
        names = ["$\\frac$", "", "本" * 90, *(f"c{k}" for k in range(40))]
        figure = evaluation_figure(evaluation(*(score(name, name, 0.5) for name in names)))
        save_figure(figure, tmp_path / "out.png")
        assert "(18 classes not drawn)" in figure.axes[2].get_title(loc="left")


class TestLogFigure:
    @pytest.fixture
    def lab(self) -> Survey:
        with LogReader.open(LAB) as reader:
            return survey(reader)

    def test_track_and_places_of_detections(self, lab: Survey) -> None:
        where = log_figure(lab).axes[0]
        assert where.get_aspect() == 1.0
        track = np.asarray(where.lines[0].get_xydata())
        assert len(track) == lab.pose_count
        np.testing.assert_allclose(track[0], [0.0, 0.0], atol=1e-9)
        places = np.asarray(where.lines[2].get_xydata())
        assert len(places) == lab.looks == 5
        # Each is a place of the track.
        gaps = np.linalg.norm(track[:, None] - places[None], axis=-1).min(axis=0)
        assert gaps.max() < 0.05

    def test_a_row_a_label(self, lab: Survey) -> None:
        when = log_figure(lab).axes[1]
        rows = [label.get_text() for label in when.get_yticklabels()]
        assert rows == ["robot_parts  4", "physics_books  3"]
        lines = [c for c in when.collections if isinstance(c, LineCollection)]
        times = [[segment[0][0] for segment in c.get_segments()] for c in lines]
        assert lab.course is not None
        start = lab.course.track.stamps_ns[0]
        seconds = (lab.course.looks_ns - start) / 1e9
        # The second look at o1 and the first at o2 returned both labels.
        np.testing.assert_allclose(times[0], seconds[[0, 1, 2, 4]])
        np.testing.assert_allclose(times[1], seconds[[0, 3, 4]])

    def test_frames_without_pose_are_shown(self, lab: Survey) -> None:
        assert lab.course is not None
        values: dict[str, Any] = {**vars(lab.course), "covered": np.array([True] * 4 + [False])}
        when = log_figure(Survey(**{**vars(lab), "course": type(lab.course)(**values)})).axes[1]
        assert when.get_yticklabels()[-1].get_text() == "frames without pose  1"

    def test_an_empty_log(self) -> None:
        assert log_figure(Survey(channels=())).get_suptitle() == "no poses and no detections"

    def test_without_poses(self, lab: Survey) -> None:
        assert lab.course is not None
        track = lab.course.track
        bare = type(track)("", "", track.stamps_ns[:0], track.poses_world_child[:0])
        values: dict[str, Any] = {
            **vars(lab.course),
            "track": bare,
            "covered": np.zeros(5, dtype=bool),
        }
        figure = log_figure(Survey(**{**vars(lab), "course": type(lab.course)(**values)}))
        assert texts(figure, 0) == ["no poses"]
        assert not [c for c in figure.axes[1].collections if isinstance(c, QuadMesh)]


@pytest.mark.parametrize("arguments", [["inspect", "log", str(LAB)]])
def test_commands_draw(arguments: list[str], tmp_path: Path) -> None:
    target = tmp_path / "figure.svg"
    done = CliRunner().invoke(main, [*arguments, "--plot", str(target)])
    assert done.exit_code == 0, done.output
    assert target.read_text("utf-8").startswith("<?xml")


def test_evaluate_draws(tmp_path: Path) -> None:
    out, target = tmp_path / "out.mcap", tmp_path / "figure.svg"
    runner = CliRunner()
    assert runner.invoke(main, ["estimate", str(LAB), "-o", str(out)]).exit_code == 0
    done = runner.invoke(main, ["evaluate", str(out), "--plot", str(target)])
    assert done.exit_code == 0, done.output
    assert target.read_text("utf-8").startswith("<?xml")


def test_the_survey_as_json_is_without_columns() -> None:
    done = CliRunner().invoke(main, ["inspect", "log", str(LAB), "--format", "json"])
    assert done.exit_code == 0
    assert '"course"' not in done.stdout


def test_fuse_draws_what_it_joined(tmp_path: Path) -> None:
    runner = CliRunner()
    parts = []
    for bound in ("-S", "-E"):
        parts.append(str(tmp_path / f"{bound[1]}.mcap"))
        arguments = ["estimate", str(LAB), bound, "+25s", "-o", parts[-1]]
        assert runner.invoke(main, arguments).exit_code == 0
    whole, target = tmp_path / "map.mcap", tmp_path / "map.svg"
    done = runner.invoke(main, ["fuse", *parts, "-o", str(whole), "--plot", str(target)])
    assert done.exit_code == 0, done.output
    assert target.read_text("utf-8").startswith("<?xml")


@pytest.mark.slow
def test_the_papers_figures(tmp_path: Path) -> None:
    found = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    figures = LAB.parents[1] / "docs/figures"
    subprocess.run([figures, tmp_path, "svg"], check=True, env={**os.environ, "PATH": found})
    numbers = [path.stem.removeprefix("figure").lstrip("s_") for path in tmp_path.iterdir()]
    assert sorted(numbers) == ["1", "10", "11", "12", "2", "3", "4_5_6", "8", "9"]
