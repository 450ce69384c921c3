"""The models we ship, the template that `init` writes, and the JSON Schema for editors."""

from __future__ import annotations

import copy
import json
import math
import re
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from mclass.config.model_file import load_model, parse_model
from mclass.config.template import TemplateFacts, model_template, quoted
from mclass.errors import ConfigError
from mclass.model import FieldMapping, Model, TransformSource

ROOT = Path(__file__).parent.parent
MODELS = sorted((ROOT / "configs").glob("*.yaml"))
SCHEMA = json.loads((ROOT / "schemas" / "model.schema.json").read_text(encoding="utf-8"))
VALIDATOR = jsonschema.Draft202012Validator(SCHEMA)

EVERY_KEY = """
length_unit: cm
background: {prior: 1, likelihood: {a: 0.1}}
viewpoints:
  v: {position: [1, 2], covariance: 3, bearing: {mean: 0, variance: 1}}
  w: {position: [1, 2], covariance: [3, 4], bearing: {mean_deg: 0, std_deg: 10}}
  u: {position: [1, 2], covariance: [[3, 1], [1, 4]]}
classes:
  a:
    prior: 1
    labels:
      a: {probability: 0.5, views: {v: 0.5}, covariance: 2, clutter: 0.1}
      b: {probability: 0.5, views: [u, w]}
log:
  odometry: {topic: /o, x: x, y: y, heading: h, stamp: t, frame: f}
  detections:
    - /d
    - {topic: /d, label: "b[].l", score: s, id: i, box: b, stamp: t, frame: f, box_format: center}
  camera_info: /c
  camera:
    {fx: 1, fy: 1, cx: 1, cy: 1, width: 2, height: 2, distortion_model: plumb_bob,
     distortion: [0.1], rectified: false, mount: {position: [0, 0, 1], rpy_deg: [0, 0, 90]}}
  min_score: 0.5
  labels: {"7": a}
  max_gap: 1
grid:
  {cell_size: 1, orientation_bins: 36, footprint: ray, range: [1, 2], origin: [0, 0],
   size: [5, 5]}
inference:
  {preset: robust, probabilities: true, detection_probability: 0.9, false_alarm: 0.02,
   silence: true, view_margin: 1, correlation: {range: 30, direction_deg: 9},
   pointing_std_deg: 3, outside_probability: 1e-6}
objects: {o: {position: [1, 2]}}
"""


class Yaml12Loader(yaml.SafeLoader):
    """Reads numbers as editors do, by YAML 1.2."""


Yaml12Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?$"),
    list("-+.0123456789"),
)


def as_editor_reads(text: str) -> Any:
    return yaml.load(text, Yaml12Loader)


# Shipped models


@pytest.mark.parametrize("path", MODELS, ids=lambda path: path.name)
def test_shipped_models_load_and_fit_the_schema(path: Path) -> None:
    assert load_model(path).name == path.name
    text = path.read_text(encoding="utf-8")
    VALIDATOR.validate(as_editor_reads(text))
    reference = text.splitlines()[0].removeprefix("# yaml-language-server: $schema=")
    assert (path.parent / reference).resolve() == ROOT / "schemas" / "model.schema.json"


def toy_class_probabilities(model: Model, steps: int, *, bearing: float = 0.0) -> list[float]:
    """P(c0), P(c1), P(c2) by direct integration over the orientation, paper section III.D."""
    (position,) = model.objects.values()
    orientations = np.linspace(0.0, 2.0 * math.pi, 3600, endpoint=False)
    true_orientation = math.radians(45)
    looks = [([2, -10], ["c1"]), ([-2, -10], ["c1"]), ([0, 10], ["c1", "c2"])]
    classes = model.classes
    log_belief = np.repeat(classes.log_priors[:, None], len(orientations), axis=1)
    for view, labels in looks[:steps]:
        c, s = math.cos(true_orientation), math.sin(true_orientation)
        x, y = (0.1 * value for value in view)  # dm
        sensor = np.array([c * x - s * y, s * x + c * y]) + position
        dx, dy = sensor - position
        cosines, sines = np.cos(orientations), np.sin(orientations)
        views = np.stack([cosines * dx + sines * dy, -sines * dx + cosines * dy], axis=-1)
        for name in labels:
            label = classes.label_names.index(name)
            log_belief[0] += classes.background_log_likelihood[label]
            for k in range(len(classes.class_names)):
                likelihood = classes.likelihoods[k, label]
                log_belief[1 + k] += likelihood.log_likelihood(
                    views, np.full(len(orientations), bearing)
                )
    masses = np.exp(log_belief).mean(axis=1)
    return list(masses / masses.sum())


def test_paper_toy_gives_the_published_numbers() -> None:
    model = load_model(ROOT / "configs" / "paper_toy.yaml")
    for steps, expected in [
        (1, (0.42313, 0.42443, 0.15244)),
        (2, (0.30207, 0.57330, 0.12463)),
        (3, (0.150597, 0.849385, 1.80773e-5)),
    ]:
        assert toy_class_probabilities(model, steps) == pytest.approx(expected, abs=6e-6)


def test_paper_as_printed_does_not() -> None:
    model = load_model(ROOT / "configs" / "paper_as_printed.yaml")
    expected = (0.5962, 0.2692, 0.1346)
    assert toy_class_probabilities(model, 1) == pytest.approx(expected, abs=6e-5)


def test_lab_has_the_likelihoods_of_the_toy() -> None:
    lab = load_model(ROOT / "configs" / "cas_lab.yaml").classes
    toy = load_model(ROOT / "configs" / "paper_toy.yaml").classes
    views = np.array([[0.3, -1.1], [0.8, 0.9]])
    assert lab.likelihoods.keys() == toy.likelihoods.keys()
    for pair, entry in toy.likelihoods.items():
        np.testing.assert_array_equal(
            lab.likelihoods[pair].log_likelihood(views), entry.log_likelihood(views)
        )
    np.testing.assert_array_equal(lab.background_log_likelihood, toy.background_log_likelihood)


# JSON Schema


def test_schema_is_a_schema_and_knows_every_key() -> None:
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    VALIDATOR.validate(as_editor_reads(EVERY_KEY))
    parse_model(EVERY_KEY, "m")


def sections(node: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths of all mappings whose keys are fixed."""
    named = {("viewpoints",), ("classes",), ("objects",), ("background", "likelihood")}
    named |= {
        ("log", "labels"),
        ("classes", "a", "labels"),
        ("classes", "a", "labels", "a", "views"),
    }
    if isinstance(node, list):
        return [found for i, child in enumerate(node) for found in sections(child, (*path, i))]
    if not isinstance(node, dict):
        return []
    below = [found for key, child in node.items() for found in sections(child, (*path, key))]
    return below if path in named else [path, *below]


EVERY_KEY_DOCUMENT = as_editor_reads(EVERY_KEY)
EVERY_SECTION = sections(EVERY_KEY_DOCUMENT)


@pytest.mark.parametrize("path", EVERY_SECTION, ids=str)
def test_unknown_keys_are_caught_by_schema_and_loader(path: tuple[Any, ...]) -> None:
    document = copy.deepcopy(EVERY_KEY_DOCUMENT)
    section = document
    for key in path:
        section = section[key]
    section["unheard_of"] = 1
    assert not VALIDATOR.is_valid(document)
    with pytest.raises(ConfigError) as caught:
        parse_model(yaml.safe_dump(document, sort_keys=False), "m")
    assert any(p.key.endswith("unheard_of") for p in caught.value.problems)


@settings(deadline=None, max_examples=120)
@given(st.data())
def test_schema_and_loader_agree_on_changed_values(data: st.DataObject) -> None:
    """What the schema refuses, the loader refuses; the loader also checks what no schema can."""
    document = copy.deepcopy(EVERY_KEY_DOCUMENT)
    path = data.draw(st.sampled_from(EVERY_SECTION))
    section = document
    for key in path:
        section = section[key]
    key = data.draw(st.sampled_from(sorted(section)))
    values: list[Any] = [-1, 0, 1, 7.5, "a", "x y", None, [], [1], [1, 2], [2, 1], [-1, 2], [[1]]]
    values += [{}, {"a": 1}, {"v": 1}, ["v"], ["v", "v"], True, {"topic": "/t"}, {"x": "y"}, 1e6]
    if data.draw(st.booleans()):
        section[key] = data.draw(st.sampled_from(values))
    else:
        del section[key]
    try:
        parse_model(yaml.safe_dump(document, sort_keys=False), "m")
    except ConfigError:
        return
    VALIDATOR.validate(document)


# The template


def test_shipped_template_is_what_init_writes() -> None:
    text = model_template(TemplateFacts(schema="../schemas/model.schema.json"))
    assert (ROOT / "configs" / "template.yaml").read_text(encoding="utf-8") == text


def test_template_of_a_log() -> None:
    facts = TemplateFacts(
        log_name="run\n1.mcap",
        odometry=FieldMapping("/odom"),
        detections=(FieldMapping("/d", {"label": "boxes[].name"}, "corner"), FieldMapping("/e e")),
        camera_info="/info",
        frame="odom",
        label_counts={"0": 5, "robot parts": 100, "no": 3, "background": 1, "a\nb": 2, "": 1},
        label_names={"0": "books"},
        together=(("0", "no", 1), ("robot parts", "books", 0), ("0", "0", 4)),
        notes=("two lines\nclasses: {}",),
    )
    text = model_template(facts)
    model = parse_model(text, "m")
    assert model.classes.class_names == ("robot parts", "books", "no")
    assert set(model.classes.likelihoods) == {
        *((0, 0), (0, 1), (1, 0), (1, 1), (1, 2), (2, 1), (2, 2))
    }
    assert model.log.odometry == facts.odometry
    assert model.log.detections == facts.detections
    assert model.log.camera_info == "/info"
    assert model.log.labels == {"0": "books", "robot parts": "robot parts", "no": "no"}
    assert '"no":  # seen 3 times' in text
    assert "clutter: 0.005}  # once" in text
    assert '"a\\nb"' not in text
    assert max(len(line) for line in text.splitlines()) <= 100


def test_template_keeps_the_most_frequent_classes() -> None:
    facts = TemplateFacts(label_counts={f"class{n}": n for n in range(100)})
    text = model_template(facts)
    names = parse_model(text, "m").classes.class_names
    assert (len(names), names[0], names[-1]) == (30, "class99", "class70")
    assert "class69, class68" in text
    assert "and 50 more" in text


def test_confusions_of_the_template_do_not_exceed_the_true_label() -> None:
    classes = parse_model(model_template(TemplateFacts()), "m").classes
    points = np.stack(np.meshgrid(np.linspace(-4, 4, 41), np.linspace(-4, 4, 41)), axis=-1)
    assert (0, 1) in classes.likelihoods
    for c, label in classes.likelihoods:
        confused = classes.likelihoods[c, label].log_likelihood(points)
        true = classes.likelihoods[label, label].log_likelihood(points)
        assert np.all(confused <= true + 1e-12)


@settings(deadline=None)
@given(st.text(max_size=300))
def test_quoting_is_reversible_wherever_text_is_printable(name: str) -> None:
    if name.isprintable():
        assert yaml.safe_load(quoted(name)) == name


_TEXT = st.text(max_size=20) | st.sampled_from(
    ["no", "0", "1e3", "a: b", "# c", "'", '"', "{", "x\n"]
)


@settings(deadline=None, max_examples=50)
@given(
    st.builds(
        TemplateFacts,
        log_name=_TEXT,
        schema=_TEXT,
        odometry=st.none()
        | st.builds(FieldMapping, _TEXT)
        | st.builds(TransformSource, _TEXT, _TEXT),
        detections=st.lists(st.builds(FieldMapping, _TEXT), max_size=3).map(tuple),
        camera_info=st.none() | _TEXT,
        frame=_TEXT,
        sensor_frame=_TEXT,
        label_counts=st.dictionaries(_TEXT, st.integers(1, 9), max_size=5),
        label_names=st.dictionaries(_TEXT, _TEXT, max_size=3),
        together=st.lists(st.tuples(_TEXT, _TEXT, st.integers(0, 9)), max_size=3).map(tuple),
        notes=st.lists(_TEXT, max_size=2).map(tuple),
    )
)
def test_any_template_loads(facts: TemplateFacts) -> None:
    parse_model(model_template(facts), "template.yaml")
