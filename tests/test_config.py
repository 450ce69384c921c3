"""Model files: what is read, and how every fault is reported."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mclass.config import yaml_source
from mclass.config.find import MODEL_FILE_NAME, find_model
from mclass.config.model_file import load_model, parse_model
from mclass.errors import ConfigError, ConfigProblem
from mclass.model import ROBUST, FieldMapping, Model, TransformSource

VALID = """\
length_unit: dm
background: {prior: 2, likelihood: 0.001}
viewpoints:
  front: {position: [3, 10], covariance: [[12, 2], [2, 7]]}
  back: {position: [-1, -9], covariance: [4, 9], bearing: {mean: 0.5, variance: 0.25}}
classes:
  c1:
    prior: 3
    labels:
      c1: {probability: 0.6, views: {front: 0.3, back: 0.5}}
      logo: {probability: 0.4, views: [front, back], covariance: 20, clutter: 0.01}
  c2:
    labels:
      c2: {probability: 0.5, views: {back: 1}}
log:
  odometry: /odom
  detections: /detections
  min_score: 0.5
  labels: {"0": c1, "7": logo}
  max_gap: 0.25
grid:
  cell_size: 1
  orientation_bins: 72
  range: [2, 40]
inference: {preset: paper}
objects:
  o1: {position: [5, -6]}
"""


def faults(text: str | bytes) -> list[ConfigProblem]:
    with pytest.raises(ConfigError) as caught:
        parse_model(text, "model.yaml")
    assert caught.value.exit_code == 2
    return list(caught.value.problems)


def place_of_mark(text: str) -> tuple[str, int, int]:
    """A text without its one '§', and the line and column where that stood."""
    before, after = text.split("§")
    return before + after, before.count("\n") + 1, len(before) - before.rfind("\n")


def only_fault(marked: str) -> ConfigProblem:
    """The one fault of a text, which must be where its '§' stands."""
    text, line, column = place_of_mark(marked)
    (problem,) = faults(text)
    assert (problem.line, problem.column) == (line, column), str(problem)
    return problem


def edited(old: str, new: str) -> str:
    assert VALID.count(old) == 1, old
    return VALID.replace(old, new)


# What is read


def test_all_of_a_file_is_read_in_metres() -> None:
    model = parse_model(VALID, "lab.yaml")
    classes = model.classes
    assert (model.name, model.source, model.length_unit) == ("lab.yaml", VALID, "dm")
    assert classes.class_names == ("c1", "c2")
    assert classes.label_names == ("c1", "c2", "logo")
    np.testing.assert_allclose(np.exp(classes.log_priors), [2 / 6, 3 / 6, 1 / 6])
    np.testing.assert_allclose(classes.background_log_likelihood, np.log([0.1] * 3))
    assert set(classes.likelihoods) == {(0, 0), (0, 2), (1, 1)}
    own = classes.likelihoods[0, 0]
    assert (own.probability, own.clutter) == (0.6, 0.0)
    np.testing.assert_allclose(own.mixture.weights, [0.3, 0.5])
    np.testing.assert_allclose(own.mixture.means, [[0.3, 1.0], [-0.1, -0.9]])
    np.testing.assert_allclose(
        own.mixture.covariances, [[[0.12, 0.02], [0.02, 0.07]], [[0.04, 0], [0, 0.09]]]
    )
    np.testing.assert_allclose(own.mixture.bearing_means, [0.0, 0.5])
    np.testing.assert_allclose(own.mixture.bearing_variances, [np.inf, 0.25])
    logo = classes.likelihoods[0, 2]
    np.testing.assert_allclose(logo.mixture.weights, [0.5, 0.5])
    np.testing.assert_allclose(logo.mixture.covariances, [np.eye(2) * 0.2] * 2)
    assert logo.clutter == pytest.approx(1.0)
    assert model.log.odometry == FieldMapping("/odom")
    assert model.log.detections == (FieldMapping("/detections"),)
    assert (model.log.min_score, model.log.max_gap_ns) == (0.5, 250_000_000)
    assert model.log.labels == {"0": "c1", "7": "logo"}
    assert model.grid.cell_size == pytest.approx(0.1)
    assert (model.grid.min_range, model.grid.max_range) == pytest.approx((0.2, 4.0))
    assert model.objects["o1"] == pytest.approx((0.5, -0.6))


def test_what_may_be_left_out_has_stated_defaults() -> None:
    text = """
viewpoints: {v: {position: [1, 0], covariance: 1}}
classes: {a: {labels: {a: {probability: 1, views: [v]}}}}
log:
grid:
objects:
"""
    model = parse_model(text, "m")
    assert model.length_unit == "m"
    np.testing.assert_allclose(np.exp(model.classes.log_priors), [0.5, 0.5])
    # The paper's 0.001 per dm².
    np.testing.assert_allclose(np.exp(model.classes.background_log_likelihood), [0.1])
    assert (model.grid.cell_size, model.grid.orientation_bins) == (0.1, 72)
    assert model.grid.origin is None
    assert model.log.odometry is None
    assert model.log.detections == ()


def test_background_likelihood_by_label_keeps_the_default_for_others() -> None:
    text = edited("likelihood: 0.001", "likelihood: {logo: 0.02, c1: 1e-4}")
    classes = parse_model(text, "m").classes
    np.testing.assert_allclose(np.exp(classes.background_log_likelihood), [0.01, 0.1, 2.0])


def test_label_of_probability_zero_is_as_if_left_out() -> None:
    never = "c2: {probability: 0, views: [back]}"
    text = edited("      c1: {prob", f"      {never}\n      c1: {{prob")
    assert set(parse_model(text, "m").classes.likelihoods) == {(0, 0), (0, 2), (1, 1)}


def test_prior_zero_is_minus_infinity() -> None:
    priors = parse_model(edited("prior: 3", "prior: 0"), "m").classes.log_priors
    assert priors[1] == -math.inf
    np.testing.assert_allclose(np.exp(priors[[0, 2]]), [2 / 3, 1 / 3])


def test_bearing_in_degrees() -> None:
    text = edited("{mean: 0.5, variance: 0.25}", "{mean_deg: -90, std_deg: 30}")
    mixture = parse_model(text, "m").classes.likelihoods[1, 1].mixture
    np.testing.assert_allclose(mixture.bearing_means, [-math.pi / 2])
    np.testing.assert_allclose(mixture.bearing_variances, [(math.pi / 6) ** 2])


@pytest.mark.parametrize(
    ("odometry", "expected"),
    [
        ("odometry: /pose", FieldMapping("/pose")),
        ("odometry: {topic: /pose}", FieldMapping("/pose")),
        (
            "odometry: {topic: /p, x: pose.x, y: pose.y, heading: yaw}",
            FieldMapping("/p", {"x": "pose.x", "y": "pose.y", "heading": "yaw"}),
        ),
        ("tf: {parent: map, child: base_link}", TransformSource("map", "base_link")),
        ("odometry: {tf: {parent: map, child: cam}}", TransformSource("map", "cam")),
    ],
)
def test_sources_of_poses(odometry: str, expected: object) -> None:
    assert parse_model(edited("odometry: /odom", odometry), "m").log.odometry == expected


def test_sources_of_detections() -> None:
    sources = '[/a, {topic: /b, label: "boxes[].name", box: "boxes[].rect", box_format: corner}]'
    model = parse_model(edited("detections: /detections", f"detections: {sources}"), "m")
    fields = {"label": "boxes[].name", "box": "boxes[].rect"}
    assert model.log.detections == (FieldMapping("/a"), FieldMapping("/b", fields, "corner"))


def test_camera_is_in_pixels_metres_and_radians() -> None:
    camera = """\
camera_info: /info
  camera:
    {fx: 500, fy: 510, cx: 320, cy: 240, width: 640, height: 480, distortion: [0.1, -0.2],
     mount: {position: [1, -2, 3], rpy_deg: [0, 15, -90]}}
  odometry: /odom"""
    log = parse_model(edited("odometry: /odom", camera), "m").log
    assert log.camera is not None
    assert log.camera_info == "/info"
    assert log.camera.intrinsics == (500, 510, 320, 240)
    assert log.camera.image_size == (640, 480)
    assert log.camera.distortion == (0.1, -0.2)
    assert not log.camera.rectified
    assert log.camera.mount_xyz == pytest.approx((0.1, -0.2, 0.3))
    assert log.camera.mount_rpy == pytest.approx((0, math.pi / 12, -math.pi / 2))


def test_inference_changes_a_preset() -> None:
    assert parse_model(edited("{preset: paper}", "{preset: robust}"), "m").inference == ROBUST
    assert parse_model(edited("inference: {preset: paper}\n", ""), "m").inference == ROBUST
    keys = "{preset: robust, correlation: {range: 5, direction_deg: 90}, pointing_std_deg: 18}"
    expected = replace(ROBUST, correlation=(0.5, math.pi / 2), pointing_std=math.pi / 10)
    assert parse_model(edited("{preset: paper}", keys), "m").inference == expected
    keys = "{preset: robust, correlation: false, probabilities: true, silence: false}"
    expected = replace(ROBUST, correlation=None, silence=False)
    assert parse_model(edited("{preset: paper}", keys), "m").inference == expected


@pytest.mark.parametrize("number", ["1e-3", "0.001", "+.001", "1E-3", "1.e-3", "0.1e-2"])
def test_numbers_follow_yaml_1_2(number: str) -> None:
    text = edited("likelihood: 0.001", f"likelihood: {number}")
    expected = parse_model(VALID, "m").classes.background_log_likelihood
    np.testing.assert_allclose(parse_model(text, "m").classes.background_log_likelihood, expected)


def test_plain_aliases_repeat_a_value() -> None:
    text = edited("covariance: [[12, 2], [2, 7]]", "covariance: &wide [[12, 2], [2, 7]]")
    text = text.replace("covariance: [4, 9]", "covariance: *wide")
    mixture = parse_model(text, "m").classes.likelihoods[0, 0].mixture
    np.testing.assert_array_equal(mixture.covariances[0], mixture.covariances[1])


def test_quoted_names_may_be_what_yaml_reads_otherwise() -> None:
    text = VALID.replace("c2:", '"no":')
    assert parse_model(text, "m").classes.class_names == ("c1", "no")


# The unit does not matter


def lopsided(unit: str, metres: float) -> Model:
    """One model, written with lengths in any unit."""
    length, variance, density = 1 / metres, 1 / metres**2, metres**2
    return parse_model(
        f"""
length_unit: {unit}
background: {{likelihood: {0.03 * density}}}
viewpoints:
  a: {{position: [{0.4 * length}, {1.3 * length}], covariance: {0.3 * variance}}}
  b:
    position: [{-1.1 * length}, {0.2 * length}]
    covariance: [[{0.5 * variance}, {0.12 * variance}], [{0.12 * variance}, {0.2 * variance}]]
    bearing: {{mean: 0.3, variance: 0.6}}
classes:
  k:
    labels:
      k: {{probability: 0.7, views: {{a: 0.2, b: 0.7}}, clutter: {0.002 * density}}}
      x: {{probability: 0.2, views: [a], covariance: [{0.9 * variance}, {0.1 * variance}]}}
grid: {{cell_size: {0.1 * length}, range: [{0.3 * length}, {5 * length}],
        origin: [{-2 * length}, {3 * length}], size: [{4 * length}, {6 * length}]}}
objects: {{o: {{position: [{1.5 * length}, {-0.7 * length}]}}}}
""",
        unit,
    )


@pytest.mark.parametrize(("unit", "metres"), [("dm", 0.1), ("cm", 0.01), ("mm", 0.001)])
def test_unit_changes_no_density(unit: str, metres: float) -> None:
    in_metres, other = lopsided("m", 1.0), lopsided(unit, metres)
    views = np.array([[0.1, 0.9], [-2.3, 0.4], [3.0, -4.0]])
    bearings = np.array([0.1, -2.0, 3.0])
    for pair, entry in in_metres.classes.likelihoods.items():
        np.testing.assert_allclose(
            other.classes.likelihoods[pair].log_likelihood(views, bearings),
            entry.log_likelihood(views, bearings),
            rtol=1e-9,
        )
    np.testing.assert_allclose(
        other.classes.background_log_likelihood, in_metres.classes.background_log_likelihood
    )
    for attribute in ("cell_size", "min_range", "max_range", "origin", "size"):
        expected = pytest.approx(getattr(in_metres.grid, attribute))
        assert getattr(other.grid, attribute) == expected
    assert other.objects["o"] == pytest.approx((1.5, -0.7))


def test_density_by_hand() -> None:
    model = lopsided("cm", 0.01)
    # Label x, one Gaussian of variances 0.9 and 0.1 m² at (0.4, 1.3), seen from (0.1, 0.9).
    by_hand = 0.2 * math.exp(-0.5 * (0.09 / 0.9 + 0.16 / 0.1)) / (2 * math.pi * 0.3)
    value = model.classes.likelihoods[0, 1].log_likelihood(np.array([0.1, 0.9]))
    assert float(value) == pytest.approx(math.log(by_hand))


# Faults: each at its line and column


@pytest.mark.parametrize(
    ("old", "new", "key", "said"),
    [
        # keys
        ("length_unit: dm", "§lenght_unit: dm", "lenght_unit", "Did you mean 'length_unit'"),
        ("    prior: 3", "    §priro: 3", "classes.c1.priro", "Did you mean 'prior'"),
        ("prior: 2,", "prior: 2, §prior: 3,", "background.prior", "twice, first in line 2"),
        ("  c2:\n", "  §c1:\n", "classes.c1", "first in line 7"),
        ("{preset: paper}", "{§<<: {preset: paper}}", "inference.<<", "merge keys"),
        ("{preset: paper}", "{§[preset]: paper}", "inference", "key must be text"),
        ("preset: paper", "§preset:paper", "inference.preset:paper", "followed by a space"),
        ("  c2:\n", "  §no:\n", "classes.no", 'write "no" in quotes'),
        ("  c2:\n", "  §on:\n", "classes.on", 'write "on" in quotes'),
        ("  c2:\n", "  §0:\n", "classes.0", 'write "0" in quotes'),
        ("  c2:\n", "  §1e-3:\n", "classes.1e-3", 'write "1e-3" in quotes'),
        ("  c2:\n", "  §2020-01-01:\n", "classes.2020-01-01", "as a date"),
        ("  c2:\n", '  §"":\n', "classes.", "nothing but spaces"),
        ("  c2:\n", '  §"a\\tb":\n', "classes.a\\tb", "U+0009"),
        ("  c2:\n", "  §background:\n", "classes.background", "another one"),
        ('"0": c1', "§0: c1", "log.labels.0", 'write "0" in quotes'),
        ("  o1: {", "  §7: {", "objects.7", 'write "7" in quotes'),
        # types
        ("length_unit: dm", "length_unit: §km", "length_unit", "one of m, dm, cm, mm"),
        ("prior: 2", "prior: §two", "background.prior", "must be a number, not the text 'two'"),
        ("prior: 2", "prior: §'2'", "background.prior", "remove the quotes"),
        ("prior: 2", "prior: §[2]", "background.prior", "not a list of 1"),
        ("prior: 2", "prior: §{a: 2}", "background.prior", "not a section"),
        ("    prior: 3", "    prior: §1_000", "classes.c1.prior", "without leading zeros"),
        ("    prior: 3", "    prior: §010", "classes.c1.prior", "without leading zeros"),
        ("    prior: 3", "    prior: §3,5", "classes.c1.prior", "decimal point"),
        ("    prior: 3", "    prior: §.nan", "classes.c1.prior", "finite number"),
        ("    prior: 3", "    prior: §-.inf", "classes.c1.prior", "finite number"),
        ("    prior: 3", "    prior: §1e999", "classes.c1.prior", "at most 1e+15"),
        ("    prior: 3", "    prior:§", "classes.c1.prior", "no value"),
        ("cell_size: 1", "cell_size: §1 dm", "grid.cell_size", "leave out the unit"),
        ("background: {prior: 2, likelihood: 0.001}", "background: §7", "background", "section"),
        ("  c2:\n    labels:", "  c2: §[1]\n  c3:\n    labels:", "classes.c2", "not a list of 1"),
        ("odometry: /odom", "odometry: §7", "log.odometry", 'write "7" in quotes'),
        ("odometry: /odom", "odometry: §[/odom]", "log.odometry", "must be a section"),
        ("detections: /detections", "detections:§", "log.detections", "no value"),
        # ranges
        ("prior: 2", "prior: §-1", "background.prior", "at least 0, not -1"),
        ("likelihood: 0.001", "likelihood: §0", "background.likelihood", "greater than 0"),
        ("likelihood: 0.001", "likelihood: {§c9: 1}", "background.likelihood.c9", "unknown label"),
        (
            "probability: 0.5",
            "probability: §1.5",
            "classes.c2.labels.c2.probability",
            "at most 1, not 1.5",
        ),
        (
            "probability: 0.5",
            "probability: §-1e-9",
            "classes.c2.labels.c2.probability",
            "at least 0",
        ),
        ("clutter: 0.01", "clutter: §-1", "classes.c1.labels.logo.clutter", "at least 0"),
        (
            "probability: 0.4",
            "probability: §0",
            "classes.c1.labels.logo.probability",
            "beside clutter",
        ),
        ("position: [3, 10]", "position: §[3]", "viewpoints.front.position", "must be [x, y]"),
        ("[3, 10]", "[3, §x]", "viewpoints.front.position[1]", "must be a number"),
        ("[3, 10]", "[3, §1e9]", "viewpoints.front.position[1]", "at most 1e+08"),
        ("  max_gap: 0.25", "  max_gap: §0", "log.max_gap", "greater than 0"),
        ("orientation_bins: 72", "orientation_bins: §7", "grid.orientation_bins", "from 8 to"),
        ("orientation_bins: 72", "orientation_bins: §72.5", "grid.orientation_bins", "whole"),
        ("range: [2, 40]", "range: §[40, 2]", "grid.range", "minimum 40 must be less"),
        ("range: [2, 40]", "range: §[2, 2]", "grid.range", "must be less"),
        ("range: [2, 40]", "range: [§-1, 2]", "grid.range[0]", "at least 0"),
        ("cell_size: 1", "cell_size: §0", "grid.cell_size", "greater than 0"),
        ("preset: paper", "preset: §papre", "inference.preset", "Did you mean 'paper'"),
        ("preset: paper", "silence: §on", "inference.silence", "true or false, not the text 'on'"),
        ("{preset: paper}", "§{preset: paper, silence: true}", "inference", "set both or neither"),
        ("preset: paper", "correlation: §[1, 2]", "inference.correlation", "section"),
        # covariances
        (
            "[[12, 2], [2, 7]]",
            "§[[1, 2], [2, 1]]",
            "viewpoints.front.covariance",
            "smallest eigenvalue -1)",
        ),
        ("[[12, 2], [2, 7]]", "§[[1, 1], [1, 1]]", "viewpoints.front.covariance", "eigenvalue 0)"),
        ("[[12, 2], [2, 7]]", "§-3", "viewpoints.front.covariance", "smallest eigenvalue -3)"),
        ("[[12, 2], [2, 7]]", "§[4, -2]", "viewpoints.front.covariance", "eigenvalue -2)"),
        ("[[12, 2], [2, 7]]", "§[[12, 2], [3, 7]]", "viewpoints.front.covariance", "2 and 3"),
        ("[[12, 2], [2, 7]]", "§[1, 2, 3]", "viewpoints.front.covariance", "not 3 entries"),
        ("[[12, 2], [2, 7]]", "§[1, 1e-9]", "viewpoints.front.covariance", "nearly singular"),
        ("[[12, 2], [2, 7]]", "§1e-9", "viewpoints.front.covariance", "between 1e-08"),
        ("variance: 0.25", "variance: §500", "viewpoints.back.bearing.variance", "at most 100"),
        ("mean: 0.5", "mean: §45", "viewpoints.back.bearing.mean", "6.28"),
        ("mean: 0.5, ", "mean: 0.5, mean_deg: §3, ", "viewpoints.back.bearing.mean_deg", "remove"),
        ("{mean: 0.5, variance: 0.25}", "§{mean: 0}", "viewpoints.back.bearing", "needs variance"),
        # references
        (
            "{front: 0.3, back: 0.5}",
            "{§fornt: 0.3, back: 0.5}",
            "classes.c1.labels.c1.views.fornt",
            "Did you mean 'front'",
        ),
        ("[front, back]", "[front, §side]", "classes.c1.labels.logo.views[1]", "'side'"),
        ("[front, back]", "§[back, back]", "classes.c1.labels.logo.views", "twice"),
        ("[front, back]", "§[]", "classes.c1.labels.logo.views", "names no viewpoint"),
        ("front: 0.3,", "front: §0,", "classes.c1.labels.c1.views.front", "greater than 0"),
        ('"7": logo', '"7": §lgo', "log.labels.7", "Did you mean 'logo'"),
        # log
        (
            "odometry: /odom",
            "odometry: /odom\n  tf: §{parent: a, child: b}",
            "log.tf",
            "remove odometry or tf",
        ),
        ("odometry: /odom", "odometry: §{topic: /p, x: a}", "log.odometry", "not for y"),
        ("odometry: /odom", "odometry: {topic: /p, x: §a..b, y: c}", "log.odometry.x", "path"),
        (
            "detections: /detections",
            "detections: [§{topic: /d, id: a}]",
            "log.detections[0]",
            "label",
        ),
        ("odometry: /odom", "camera: §{fx: 1, fy: 1, cx: 2}", "log.camera", "add cy"),
        (
            "odometry: /odom",
            "camera: {distortion: §[1, 2, 3, 4, 5, 6]}",
            "log.camera.distortion",
            "at most 5 coefficients, not 6",
        ),
        (
            "odometry: /odom",
            "camera: {distortion: §[0.1], rectified: true}",
            "log.camera.distortion",
            "rectified images have no distortion left",
        ),
        # grid
        (
            "  range: [2, 40]",
            "  origin: [0, 0]\n  size: §[1e6, 1e6]",
            "grid.size",
            "1e+12 cells x 2 classes x 72 bins x 4 bytes = 576,000 GB, more than 64 GB",
        ),
        ("  range: [2, 40]", "  range: §[2, 1e6]", "grid.range", "more than 64 GB"),
    ],
)
def test_fault_is_placed_and_explained(old: str, new: str, key: str, said: str) -> None:
    problem = only_fault(edited(old, new))
    assert problem.key == key
    assert said in problem.message
    assert str(problem).startswith(f"model.yaml:{problem.line}:{problem.column}: {key}: ")


@pytest.mark.parametrize(
    ("old", "new", "place", "said"),
    [
        ("viewpoints:", "views:", (1, 1, "viewpoints"), "missing"),
        ("probability: 0.6, ", "", (10, 7, "classes.c1.labels.c1.probability"), "missing"),
        ("position: [3, 10], ", "", (4, 3, "viewpoints.front.position"), "missing"),
        ("  o1: {position: [5, -6]}", "  o1:", (27, 3, "objects.o1.position"), "missing"),
        ("odometry: /odom", "odometry: {x: a, y: b}", (16, 3, "log.odometry.topic"), "missing"),
        ("  range: [2, 40]", "  size: [10, 10]", (21, 1, "grid"), "add origin"),
        ("probability: 0.5,", "probability: 0,", (13, 5, "classes.c2.labels"), "above 0"),
    ],
)
def test_what_is_missing_is_placed_where_it_belongs(
    old: str, new: str, place: tuple[int, int, str], said: str
) -> None:
    problem = faults(edited(old, new))[0]
    assert (problem.line, problem.column, problem.key) == place
    assert said in problem.message


def test_all_priors_zero() -> None:
    text = edited("prior: 3", "prior: 0").replace("  c2:\n", "  c2:\n    prior: 0\n")
    (problem,) = faults(text)
    assert (problem.line, problem.key) == (6, "classes")
    assert "prior 0" in problem.message


def test_every_fault_is_reported_in_file_order() -> None:
    text = """\
length_unit: km
background: {prior: x, likelihood: -1}
viewpoints:
  v: {position: [1], covariance: -1}
  w: {position: [1, 2], covariance: 1}
classes:
  a:
    prior: -1
    labels:
      a: {probability: 2, views: [v, u]}
      b: {probability: 0.1, views: {w: -1}, clutter: -1}
log: {odometry: 5, labels: {"x": c}}
grid: {cell_size: -1, range: [2, 1], size: [1, 1]}
inference: {preset: best}
objects: {o: {position: here}}
"""
    places = [(problem.line, problem.column) for problem in faults(text)]
    assert places == sorted(places)
    assert places == [
        (1, 14),
        *((2, 21), (2, 36)),
        *((4, 17), (4, 34)),
        *((8, 12), (10, 24), (10, 38), (11, 40), (11, 54)),
        *((12, 17), (12, 34)),
        *((13, 7), (13, 19), (13, 30)),
        (14, 21),
        (15, 25),
    ]


def test_problems_are_counted_out_at_a_limit() -> None:
    problems = faults("\n".join(f"key{i}: 1" for i in range(1000)))
    assert len(problems) == yaml_source.MAX_PROBLEMS + 1
    assert "not checked" in problems[-1].message


# Text that is not a YAML document of ours


@pytest.mark.parametrize(
    ("marked", "said"),
    [
        ("§", "empty"),
        ("§# only a comment\n", "empty"),
        ("§- a\n- b\n", "section of keys and values"),
        ("§just text", "section of keys and values"),
        ("grid:\n§\tcell_size: 1\n", "tab"),
        ("grid: {cell_size: 1\ninference§: {}\n", "not valid YAML"),
        ("a: b§: c\n", "quote text that holds ': '"),
        (VALID + "§---\na: 1\n", "second document"),
        (VALID + "§---\n", "second document"),
        ("grid: §*nothing\n", "undefined alias"),
        ("grid: &g {size: §*g}\n", "inside what it stands for"),
        ("grid: {size: §\x07}\n", "U+0007"),
        ('grid: {size: "\\U§FFFFFFFF"}\n', "out of range"),
        (f"%YAML 1.§{'1' * 5000}\n--- {{}}\n", "out of range"),
    ],
)
def test_wrong_yaml_is_placed(marked: str, said: str) -> None:
    assert said in only_fault(marked).message


def test_tags_are_never_acted_on(tmp_path: Path) -> None:
    touched = tmp_path / "touched"
    tag = f'!!python/object/apply:os.system ["touch {touched}"]'
    text, line, column = place_of_mark(edited("{position: [5, -6]}", f"§{tag}"))
    problem = faults(text)[0]
    assert (problem.line, problem.column) == (line, column)
    assert "!!python/object/apply:os.system" in problem.message
    assert not touched.exists()


def test_unknown_tag_of_a_value() -> None:
    assert "!mine" in only_fault(edited("prior: 2", "prior: §!mine 2")).message


def test_byte_order_mark_is_passed_over() -> None:
    assert parse_model(b"\xef\xbb\xbf" + VALID.encode(), "m").source == VALID
    assert parse_model("\ufeff" + VALID, "m").classes.class_names == ("c1", "c2")


def test_bytes_that_are_not_utf8_are_placed() -> None:
    for prefix in (b"", b"\xef\xbb\xbf"):
        (problem,) = faults(prefix + "# ä\nlength_unit: \n".encode()[:-1] + b"\xff\n")
        assert (problem.line, problem.column) == (2, 14)
        assert "0xff is not UTF-8" in problem.message
    (problem,) = faults(VALID.encode("utf-16"))
    assert "UTF-16" in problem.message


# Bounded time and memory


def bomb(levels: int) -> str:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, levels)]
    return "\n".join(lines)


@pytest.mark.parametrize(
    "text",
    [
        bomb(5),
        bomb(60),
        "[" * 300_000,
        "{" * 300_000,
        "[\n" * 150_000,
        "- " * 400_000,
        "? " * 400_000,
        "a: {" * 200_000,
        "".join(" " * n + "a:\n" for n in range(1300)),
        "k: [" + "[]," * 30_000,
        "x: 'y" + "\n" * 200_000,
        "- &a\n" * 150_000,
        "classes: {" + ", ".join(f"c{n}: 0" for n in range(10_000)) + "}",
        "classes: {" + ", ".join(f"c{n}: {{labels: {{l{n}: 0}}}}" for n in range(2_000)) + "}",
        "viewpoints: {v: {position: [0, 0], covariance: 1" + "0" * 900_000 + "}}",
        "a" * 900_000 + ": 1",
    ],
    ids=lambda text: repr(text[:8]),
)
def test_explosive_files_are_refused_quickly(text: str) -> None:
    started = time.perf_counter()
    problems = faults(text)
    assert time.perf_counter() - started < 20.0  # seconds where a naive loader takes years
    assert problems[0].line > 0


def test_alias_bomb_is_placed_at_the_alias_that_exceeds() -> None:
    problem = faults(bomb(60))[0]
    # a0 to a3 hold 11 + 111 + 1,111 + 11,111 values; the fourth level exceeds the limit.
    assert problem.line == 5
    assert "50,000" in problem.message


def test_deep_nesting_is_placed() -> None:
    problem = faults("grid: " + "[" * 1000)[0]
    assert (problem.line, problem.column) == (1, 7 + yaml_source.MAX_DEPTH - 1)
    assert "32 levels" in problem.message


def test_large_files_are_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "large.yaml"
    with path.open("wb") as stream:
        stream.truncate(100_000_000_000)  # sparse
    with pytest.raises(ConfigError, match="larger than 1,000,000 bytes"):
        load_model(path)
    with pytest.raises(ConfigError, match="larger than"):
        parse_model("#" * 2_000_000, "m")
    with pytest.raises(ConfigError, match="larger than"):
        parse_model(b"#" * 2_000_000, "m")


# Files


def test_load_model_names_the_file(tmp_path: Path) -> None:
    path = tmp_path / "lab.yaml"
    path.write_text(VALID, encoding="utf-8")
    assert load_model(path).name == "lab.yaml"
    path.write_text(edited("prior: 2", "prior: x"), encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_model(str(path))
    assert caught.value.problems[0].path == str(path)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    loop = tmp_path / "loop.yaml"
    loop.symlink_to(loop)
    for path, said in [
        (tmp_path, "folder"),
        (tmp_path / "none.yaml", "no such file"),
        (tmp_path / "none.yaml" / "x", "no such file"),
        (loop, "cannot be read"),
        (Path("nul\0.yaml"), "cannot be read"),
    ]:
        with pytest.raises(ConfigError, match=said):
            load_model(path)


def test_model_is_found_beside_the_log_then_here_then_inside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    here.mkdir()
    there.mkdir()
    monkeypatch.chdir(here)
    log = there / "run.mcap"
    with pytest.raises(ConfigError, match="mclass init"):
        find_model(log)
    assert find_model(log, VALID.encode()).name == f"run.mcap#{MODEL_FILE_NAME}"
    (here / MODEL_FILE_NAME).write_text(edited("length_unit: dm", "length_unit: m"))
    assert find_model(log, VALID).length_unit == "m"
    (there / MODEL_FILE_NAME).write_text(edited("length_unit: dm", "length_unit: cm"))
    assert find_model(log, VALID).length_unit == "cm"
    (there / MODEL_FILE_NAME).write_text("wrong")
    with pytest.raises(ConfigError):
        find_model(log, VALID)


# Whatever comes in


def only_config_errors(text: str | bytes) -> None:
    """Parse; whatever is accepted must give finite densities, and messages must be printable."""
    try:
        model = parse_model(text, "m")
    except ConfigError as error:
        str(error).encode()
        return
    assert np.all(np.isfinite(model.classes.background_log_likelihood))
    for entry in model.classes.likelihoods.values():
        assert np.isfinite(entry.log_likelihood(np.array([0.3, -0.2])))


@settings(deadline=None)
@given(st.binary(max_size=300))
def test_random_bytes(data: bytes) -> None:
    only_config_errors(data)


@settings(deadline=None)
@given(st.text(st.characters(), max_size=200))
def test_random_text(text: str) -> None:
    only_config_errors(text)


@settings(deadline=None)
@given(st.text("{}[]:,-?&*!|>'\"%@` \n\tab01.<~#", max_size=80))
def test_random_yaml_punctuation(text: str) -> None:
    only_config_errors(text)


_FRAGMENTS = ["", " ", "\n", "[", "}", ": ", "{", "&a ", "*a", "!!int ", "null", "1e9", "-1", "''"]
_FRAGMENTS += [
    "1e-300",
    "no",
    "- ",
    "? ",
    "| ",
    "#",
    "[1, 2]",
    "{front: 1}",
    "\t",
    "0",
    "'a'",
    "<<: ",
]


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_mutated_models(data: st.DataObject) -> None:
    text = VALID
    for _ in range(data.draw(st.integers(1, 3))):
        start = data.draw(st.integers(0, len(text)))
        length = data.draw(st.integers(0, 12))
        text = text[:start] + data.draw(st.sampled_from(_FRAGMENTS)) + text[start + length :]
    only_config_errors(text)
