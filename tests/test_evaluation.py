"""Scores worked out by hand, truth files, and the command on a simulated log."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.special import i0

import mclass
from mclass.commands.cli import main
from mclass.errors import ConfigError, LogError
from mclass.evaluation.density import JointDensity, joint_density
from mclass.evaluation.outputs import score_output
from mclass.evaluation.scores import MAX_LOG_LOSS, LogScore, assign, score_log
from mclass.evaluation.summary import METRICS, evaluate
from mclass.evaluation.truth import Truth, load_truth, parse_truth
from mclass.footprint import Grid
from mclass.results import BeliefBlock, ObjectEstimate, OrientationMode
from mclass.simulation.scenario_file import load_scenario
from mclass.simulation.world import simulate
from mclass.simulation.write import write_log
from mclass.text.evaluations import evaluation_text
from mclass.text.terminal import Terminal

ROOT = Path(__file__).parent.parent
CLASSES = ("cup", "mug")
SQUARE = 2.0 * np.pi / 4.0
"""Width of a bin of a circle in four."""


def estimate(
    key: str = "a",
    *,
    named: int = 0,
    probabilities: tuple[float, ...] = (0.1, 0.7, 0.2),
    position: tuple[float, float] = (0.0, 0.0),
    turned: float = 0.0,
    modes: tuple[tuple[float, float], ...] = ((0.0, 1.0),),
    tie: tuple[int, ...] = (),
) -> ObjectEstimate:
    poses = np.array([[*position, turned]] * len(CLASSES))
    return ObjectEstimate(
        object_id=key,
        stamp_ns=0,
        log_time_ns=0,
        labels=(),
        measurements=1,
        class_probabilities=np.array(probabilities),
        class_index=named,
        tie=tie,
        position=np.array(position),
        position_std=np.zeros(2),
        class_poses=poses,
        modes=tuple(OrientationMode(angle, mass, 0.1) for angle, mass in modes),
        joint_map=(named, *position, turned),
    )


def truth(*objects: tuple[str, str, float, float, float], symmetry: int = 1) -> Truth:
    return Truth(
        tuple(key for key, *_ in objects),
        tuple(name for _, name, *_ in objects),
        np.array([pose for _, _, *pose in objects], dtype=float).reshape(-1, 3),
        np.full(len(objects), symmetry),
    )


def square_density() -> JointDensity:
    """Cup: half of the mass at 90°, a quarter at 0°, an eighth each at 180° and 270°."""
    shares = np.array([[0.25, 0.5, 0.125, 0.125], [0.25, 0.25, 0.25, 0.25]])
    return JointDensity(np.log([0.1, 0.7, 0.2]), np.log(shares / SQUARE))


class TestJointDensity:
    def test_likelihood_is_class_times_orientation_per_radian(self) -> None:
        density = square_density()
        expected = math.log(0.7 * 0.5 / (math.pi / 2.0))
        assert density.log_likelihood(0, math.pi / 2.0) == pytest.approx(expected)
        assert density.log_likelihood(0, math.pi / 2.0 - 4.0 * math.pi) == pytest.approx(expected)

    def test_between_samples_the_logarithm_is_linear(self) -> None:
        half = 0.5 * (math.log(0.125) + math.log(0.25)) - math.log(SQUARE)
        expected = math.log(0.7) + half
        assert square_density().log_likelihood(0, 1.75 * math.pi) == pytest.approx(expected)

    @pytest.mark.parametrize(
        ("angle_deg", "level"), [(90.0, 0.0), (0.0, 0.5), (180.0, 0.75), (270.0, 0.875)]
    )
    def test_level_is_the_mass_of_what_is_denser(self, angle_deg: float, level: float) -> None:
        # 180° and 270° are equally dense: the smaller angle goes first.
        assert square_density().level(0, math.radians(angle_deg)) == pytest.approx(level)

    def test_flat_density_covers_as_often_as_it_should(self) -> None:
        angles = 2.0 * np.pi * (np.arange(1000) + 0.3) / 1000
        flat = JointDensity(np.log([0.1, 0.7, 0.2]), np.full((2, 720), -math.log(2.0 * math.pi)))
        levels = np.array([flat.level(1, float(angle)) for angle in angles])
        assert np.mean(levels <= 0.9) == pytest.approx(0.9, abs=0.003)

    def test_cells_are_weighed_by_their_mass(self) -> None:
        grid = Grid((0.0, 0.0), 1.0, 1, 2)
        bins = 24
        # A von Mises density around 90°.
        peaked = 2.0 * np.sin(2.0 * np.pi * np.arange(bins) / bins) - np.log(2.0 * np.pi * i0(2.0))
        flat = np.full(bins, -math.log(2.0 * math.pi))
        classes = np.array([[0.0, 0.5, 0.5], [0.5, 0.25, 0.25]])
        blocks = [
            BeliefBlock(
                object_id="a",
                grid=grid,
                stamp_ns=0,
                log_time_ns=0,
                block=cell,
                blocks=2,
                cells=np.array([cell]),
                log_cell_mass=np.log([mass]),
                log_class_probability=np.log(np.maximum(classes[[cell]], 1e-300)),
                log_density=np.array([[curve, flat]], dtype=np.float32),
                measurements=np.ones(1, dtype=np.int64),
            )
            for cell, mass, curve in ((0, 0.25, peaked), (1, 0.75, flat))
        ]
        density = joint_density(blocks)
        assert np.exp(density.log_class) == pytest.approx([0.375, 0.3125, 0.3125])
        step = 2.0 * np.pi / density.log_density.shape[1]
        assert np.exp(density.log_density).sum(axis=1) * step == pytest.approx([1.0, 1.0])
        # Far from the peak: 0.25 * 0.5 of the one and 0.75 * 0.25 of the other.
        value = 0.25 * 0.5 * math.exp(peaked[18]) + 0.75 * 0.25 / (2.0 * math.pi)
        assert density.log_likelihood(0, 1.5 * math.pi) == pytest.approx(math.log(value), abs=1e-4)
        assert density.log_likelihood(1, 1.0) == pytest.approx(
            math.log(0.3125 / (2.0 * math.pi)), abs=1e-6
        )


class TestMatching:
    def test_least_total_distance_not_nearest_first(self) -> None:
        # Nearest first would take (0, 1) and leave the others 3 m apart.
        positions = np.array([[0.0, 0.0], [2.0, 0.0]])
        true = np.array([[-1.5, 0.0], [0.9, 0.0]])
        assert assign(positions, true, gate=2.0) == [(0, 0), (1, 1)]

    def test_gate_frees_what_is_too_far(self) -> None:
        positions = np.array([[0.0, 0.0], [5.0, 5.0]])
        true = np.array([[0.0, 0.5], [5.0, 6.5]])
        assert assign(positions, true, gate=1.0) == [(0, 0)]

    def test_missed_and_invented(self) -> None:
        estimates = [
            estimate("a", position=(0.0, 0.1)),
            estimate("b", position=(9.0, 9.0)),
            estimate("c", position=(5.0, 5.0), probabilities=(0.8, 0.1, 0.1)),
        ]
        densities = {one.object_id: square_density() for one in estimates}
        score = score_log(
            "log",
            estimates,
            densities,
            CLASSES,
            truth(("x", "cup", 0, 0, 0), ("y", "mug", 3, 3, 0)),
        )
        assert [one.true_id for one in score.objects] == ["x"]
        assert score.missed == ("y",)
        assert score.invented == ("b",)  # c is most probably nothing

    def test_by_id(self) -> None:
        estimates = [estimate("x", position=(7.0, 0.0))]
        densities = {"x": square_density()}
        score = score_log(
            "log", estimates, densities, CLASSES, truth(("x", "cup", 3, 3, 0)), match="id"
        )
        assert score.objects[0].position_error == pytest.approx(5.0)


class TestObjectScore:
    def test_by_hand(self) -> None:
        score = score_log(
            "log",
            [
                estimate(
                    position=(0.3, 0.4),
                    turned=math.radians(350.0),
                    modes=((math.radians(350.0), 0.9), (math.radians(100.0), 0.1)),
                )
            ],
            {"a": square_density()},
            CLASSES,
            truth(("x", "cup", 0.0, 0.0, math.pi / 2.0), symmetry=2),
        ).objects[0]
        assert score.correct == 1.0
        assert score.confidence == 0.7
        assert math.degrees(score.orientation_error) == pytest.approx(100.0)
        assert math.degrees(score.symmetric_error) == pytest.approx(80.0)
        assert math.degrees(score.mode_error) == pytest.approx(10.0)
        assert score.position_error == pytest.approx(0.5)
        assert score.log_loss == pytest.approx(-math.log(0.7 * 0.5 / (math.pi / 2.0)))
        assert score.brier == pytest.approx(0.1**2 + 0.3**2 + 0.2**2)
        assert score.level == 0.0

    def test_tie_counts_its_share(self) -> None:
        tied = estimate(tie=(0, 1), probabilities=(0.0, 0.5, 0.5))
        score = score_log(
            "log", [tied], {"a": square_density()}, CLASSES, truth(("x", "mug", 0, 0, 0))
        )
        assert score.objects[0].correct == 0.5

    def test_class_that_the_model_does_not_know(self) -> None:
        score = score_log(
            "log", [estimate()], {"a": square_density()}, CLASSES, truth(("x", "vase", 0, 0, 0))
        ).objects[0]
        assert score.correct == 0.0
        assert score.log_loss == MAX_LOG_LOSS
        assert score.level == 1.0


class TestSummary:
    @staticmethod
    def log(name: str, *turns_deg: float) -> LogScore:
        estimates = [
            estimate(str(i), turned=math.radians(turn), position=(5.0 * i, 0.0))
            for i, turn in enumerate(turns_deg)
        ]
        objects = [
            (str(i), "cup" if i else "mug", 5.0 * i, 0.0, 0.0) for i in range(len(turns_deg))
        ]
        return score_log(
            name,
            estimates,
            {one.object_id: square_density() for one in estimates},
            CLASSES,
            truth(*objects),
        )

    def test_figures_by_hand(self) -> None:
        evaluation = evaluate([self.log("one", 10.0, 20.0, 60.0)])
        values = {name: figure.value for name, figure in evaluation.figures.items()}
        assert values["class_accuracy"] == pytest.approx(2.0 / 3.0)
        assert values["orientation_error_deg"] == pytest.approx(20.0)
        assert values["orientation_error_90_deg"] == pytest.approx(52.0)
        # All three say 0.7, two are right.
        assert values["calibration_error"] == pytest.approx(0.7 - 2.0 / 3.0)
        # At 0°: of the mug's flat density the first angle, of the cup's the second densest.
        assert values["coverage_50"] == 1.0
        assert values["matched"] == 3.0
        assert evaluation.confusion == {("mug", "cup"): 1, ("cup", "cup"): 2}
        assert all(figure.low is None for figure in evaluation.figures.values())

    def test_bootstrap_takes_whole_logs(self) -> None:
        logs = [self.log("wrong", 10.0), self.log("two", 10.0, 20.0), self.log("more", 5.0, 5.0)]
        figure = evaluate(logs).figures["class_accuracy"]
        assert figure.value == pytest.approx(2.0 / 5.0)
        # The first log alone has no right class, the others half each.
        assert figure.low == 0.0
        assert figure.high == 0.5
        assert evaluate(logs).figures == evaluate(logs).figures

    @pytest.mark.parametrize("width", [80, 60])
    def test_text_cuts_nothing(self, width: int) -> None:
        evaluation = evaluate([self.log("a_rather_long_name.mclass.mcap", 10.0, 170.0)] * 2)
        text = evaluation_text(evaluation, [], Terminal(width=width))
        assert "…" not in text
        words = " ".join(text.split())
        for name, metric in METRICS.items():
            assert name in words
            assert metric.meaning in words
        assert "a_rather_long_name.mclass.mcap" in words
        assert max(map(len, text.split("\n"))) <= width

    def test_nothing_matched(self) -> None:
        evaluation = evaluate([LogScore("none", (), ("x",), ())])
        assert evaluation.figures["class_accuracy"].value is None
        assert evaluation.figures["missed"].value == 1.0


class TestTruthFiles:
    def test_units_and_symmetry(self) -> None:
        text = """
        units: {x: dm, y: m, phi: rad}
        symmetry: {cup: 4}
        objects:
          - {id: a, class: cup, x: 10, y: -2, phi: 1.5}
          - {id: b, class: mug, x: 0, y: 0, phi: 0, against_wall: true}
        """
        found = parse_truth(text.encode(), "truth.yaml")
        assert found.object_ids == ("a", "b")
        assert found.poses == pytest.approx(np.array([[1.0, -2.0, 1.5], [0.0, 0.0, 0.0]]))
        assert found.symmetry.tolist() == [4, 1]

    def test_json_as_simulate_writes_it(self, tmp_path: Path) -> None:
        document = {
            "name": "n",
            "frame": "odom",
            "units": {"x": "m", "y": "m", "phi": "deg"},
            "classes": ["cup"],
            "objects": [
                {"id": "a", "class": "cup", "x": 4.0, "y": 2.0, "phi": 255.0, "against_wall": False}
            ],
            "camera_mount": {"x": 0.1, "yaw_deg": 0.0},
        }
        path = tmp_path / "truth.json"
        path.write_text(json.dumps(document, indent=1))
        assert load_truth(path).poses[0] == pytest.approx([4.0, 2.0, math.radians(255.0)])

    @pytest.mark.parametrize(
        ("text", "said"),
        [
            ("objects: 3", "objects: must be a list"),
            ("{}", "objects: missing"),
            ("objects: [{id: a, class: c, x: 0, y: 0}]", "phi: missing"),
            ("objects: [{id: a, class: c, x: .nan, y: 0, phi: 0}]", "objects[0].x"),
            ("{objects: [], units: {x: mile}}", "units.x: must be one of m, dm"),
            ("{objects: [], symmetry: {c: 0}}", "symmetry.c"),
            (
                "objects: [{id: a, class: c, x: 0, y: 0, phi: 0}, "
                "{id: a, class: c, x: 0, y: 0, phi: 0}]",
                "given twice",
            ),
        ],
    )
    def test_faults_are_named(self, text: str, said: str) -> None:
        with pytest.raises(ConfigError) as caught:
            parse_truth(text.encode(), "truth.yaml")
        assert said in str(caught.value)


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An estimate of the paper's experiment, simulated."""
    folder = tmp_path_factory.mktemp("evaluation")
    drive = simulate(load_scenario(ROOT / "configs" / "scenarios" / "cas_lab.yaml"))
    write_log(drive, folder / "lab.mcap")
    found = CliRunner().invoke(main, ["estimate", str(folder / "lab.mcap")])
    assert found.exit_code == 0, found.output
    return folder / "lab.mclass.mcap"


class TestCommand:
    @staticmethod
    def run(*arguments: str | Path) -> Any:
        return CliRunner().invoke(main, ["evaluate", *map(str, arguments)])

    def test_truth_comes_with_a_simulated_log(self, output: Path) -> None:
        scored = score_output(output, None).score
        assert [one.true_id for one in scored.objects] == ["o1", "o2", "o3"]
        assert scored.missed == scored.invented == ()
        # Section V: 257.7° for 255°, 315.1° for 315°.
        assert math.degrees(scored.objects[0].orientation_error) == pytest.approx(2.7, abs=0.1)
        assert math.degrees(scored.objects[1].orientation_error) == pytest.approx(0.1, abs=0.1)

    def test_text(self, output: Path) -> None:
        result = self.run(output, output)
        assert result.exit_code == 0, result.output
        assert "2 logs, 6 objects matched" in result.stdout
        assert max(map(len, result.stdout.splitlines())) <= 80

    def test_json_rules_and_junit(self, output: Path, tmp_path: Path) -> None:
        junit = tmp_path / "out.xml"
        result = self.run(
            output, "--format", "json", "--junit", junit,
            "--fail-on", "orientation_error_deg > 90", "--fail-on", "matched >= 100 %",
        )  # fmt: skip
        assert result.exit_code == 4
        document = json.loads(result.stdout)
        assert document["figures"]["matched"]["value"] == 3.0
        assert document["failures"] == ["matched is 100 % (rule: matched >= 100 %)"]
        suite = ElementTree.parse(junit).getroot()
        assert suite.attrib["tests"] == "2"
        assert suite.attrib["failures"] == "1"

    def test_same_from_python(self, output: Path, tmp_path: Path) -> None:
        shown = json.loads(self.run(output, output, "--format", "json").stdout)
        found = mclass.evaluate([output, str(output)])
        for name, figure in found.figures.items():
            assert figure.value == shown["figures"][name]["value"], name
        assert found.damage == ()
        path = tmp_path / "truth.yaml"
        path.write_text("objects: [{id: o1, class: physics_books, x: 40, y: 20, phi: 300}]")
        by_id = mclass.evaluate([output], path, match="id").figures
        # Turned by 300° - 257.7°, and at (4, 2) m.
        assert by_id["orientation_error_deg"].value == pytest.approx(42.26, abs=0.05)
        assert by_id["position_error"].value == pytest.approx(math.hypot(36, 18), abs=0.01)
        with pytest.raises(mclass.UsageError, match="nothing to evaluate"):
            mclass.evaluate([])

    def test_other_truth_is_missed(self, output: Path, tmp_path: Path) -> None:
        path = tmp_path / "truth.yaml"
        path.write_text("objects: [{id: far, class: physics_books, x: 90, y: 0, phi: 0}]")
        result = self.run(output, "--truth", path)
        assert result.exit_code == 0
        assert "missed far" in result.stdout
        assert "invented" in result.stdout

    def test_log_without_truth(self, tmp_path: Path) -> None:
        with pytest.raises(LogError, match=r"no attachment 'truth\.json'"):
            score_output(estimated_without_truth(tmp_path), None)

    def test_unknown_figure(self, output: Path) -> None:
        result = self.run(output, "--fail-on", "acuracy < 1")
        assert result.exit_code == 2
        assert "class_accuracy" in result.stderr


def estimated_without_truth(folder: Path) -> Path:
    """Results in a log of their own, to which nobody attached a truth."""
    from mclass.config.model_file import load_model  # noqa: PLC0415
    from mclass.logs.writer import LogWriter  # noqa: PLC0415 - used once
    from mclass.outputs.channels import OutputChannels  # noqa: PLC0415

    path = folder / "bare.mcap"
    model = load_model(ROOT / "configs" / "boxes.yaml")
    with LogWriter(path, source=None, profile="ros2", overwrite=False) as writer:
        channels = OutputChannels(writer, "ros2", "odom", model)
        channels.write_objects([], 1, 1)
        channels.write_header(1, input_hash="sha256:0", settings={})
    return path
