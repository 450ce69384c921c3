from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from models import lopsided_model, mixture_of, toy_model
from oracle import Sighting, log_set_likelihood, rotation
from oracle_looks import look_log_probability, peak_density
from strategies import class_models, poses

from mclass.classes import ClassModel, LabelLikelihood
from mclass.observation import Recognition, has_bearing, paper_terms, robust_terms
from mclass.records import FloatArray

RECOGNITION = Recognition(best=0.95, false_alarm=0.01)


def place(sensor: FloatArray, item: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The sensor in the object's frame, and the object's bearing from its heading."""
    view = rotation(float(item[2])).T @ (sensor[:2] - item[:2])
    azimuth = math.atan2(item[1] - sensor[1], item[0] - sensor[0])
    return view, np.array(azimuth - sensor[2])


@given(st.data(), class_models(bearing=True), poses(2.0), poses(2.0))
@settings(deadline=None, max_examples=40)
def test_paper_terms_match_oracle(
    data: st.DataObject, model: ClassModel, sensor: FloatArray, item: FloatArray
) -> None:
    label = data.draw(st.sampled_from(range(len(model.label_names))))
    term = paper_terms(model)[label]
    view, bearing = place(sensor, item)
    sighting = Sighting((label,), sensor[:2], float(sensor[2]))
    values = dict(zip(term.classes.tolist(), term.log_likelihood(view, bearing), strict=True))
    for k in range(len(model.class_names)):
        expected = log_set_likelihood(model, k, sighting, item[:2], item[2])
        np.testing.assert_allclose(values.get(k, term.elsewhere), expected, rtol=1e-9, atol=1e-9)
    assert term.background == model.background_log_likelihood[label]


def look(model: ClassModel, labels: set[int], view: FloatArray, bearing: FloatArray) -> FloatArray:
    """Log probability of a look from the robust terms: the background's, then each class's."""
    terms = robust_terms(model, RECOGNITION)
    total = np.zeros(1 + len(model.class_names))
    for term in [*(terms[label] for label in sorted(labels)), terms[-1]]:
        values = np.full(len(model.class_names), term.elsewhere)
        values[term.classes] = term.log_likelihood(view, bearing)
        total += [term.background, *values]
    return total


@given(st.data(), class_models(), poses(2.0), poses(2.0))
@settings(deadline=None, max_examples=10)
def test_robust_terms_match_oracle(
    data: st.DataObject, model: ClassModel, sensor: FloatArray, item: FloatArray
) -> None:
    labels = data.draw(st.sets(st.sampled_from(range(len(model.label_names)))))
    value = look(model, labels, *place(sensor, item))
    sighting = Sighting(tuple(labels), sensor[:2], float(sensor[2]))
    expected = [
        look_log_probability(model, k, sighting, item[:2], item[2])
        for k in [None, *range(len(model.class_names))]
    ]
    np.testing.assert_allclose(value, expected, rtol=0, atol=1e-5)


def test_robust_look_by_hand() -> None:
    # From the toy model's front peak its own label has the peak density, the other half of it.
    view, bearing = np.array([0.0, 10.0]), np.array(0.0)
    hit, confused = 0.01 + 0.99 * 0.95, 0.01 + 0.99 * 0.95 * 0.5
    np.testing.assert_allclose(
        look(toy_model(), {0}, view, bearing),
        [
            math.log(0.01) + math.log(0.99),
            math.log(hit) + math.log(1 - confused),
            math.log(1 - hit) + math.log(confused),
        ],
        rtol=1e-6,
    )
    silent = look(toy_model(), set(), view, bearing)
    assert silent[1] == pytest.approx(math.log(1 - hit) + math.log(1 - confused), rel=1e-6)


def test_probabilities_stay_within_bounds() -> None:
    # A perfect detector without false alarms: yet no look is certain.
    model = toy_model()
    terms = robust_terms(model, Recognition(best=1.0, false_alarm=0.0))
    far, near = np.array([0.0, 1000.0]), np.array([0.0, 10.0])
    least, most = 1e-6, 1.0 - 1e-3
    assert float(terms[0].log_likelihood(near)[0]) == pytest.approx(
        math.log(most / (1.0 - most)), rel=1e-9
    )
    assert float(terms[0].log_likelihood(far)[0]) == pytest.approx(
        math.log(least / (1.0 - least)), rel=1e-9
    )
    assert terms[0].background == pytest.approx(math.log(least / (1.0 - least)), rel=1e-9)


def test_peak_between_viewpoints() -> None:
    # Two overlapping components: the mixture's peak is at neither mean.
    entry = LabelLikelihood(
        1.0,
        mixture_of(
            [0.5, 0.4], [[0.0, 1.0], [0.5, 1.1]], [np.eye(2) * 0.2, [[0.3, 0.1], [0.1, 0.2]]]
        ),
    )
    model = ClassModel(("c",), ("a",), np.log([0.5, 0.5]), np.log([0.1]), {(0, 0): entry})
    axis = np.linspace(-1.0, 2.0, 1201)
    views = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
    highest = float(entry.log_likelihood(views).max())
    assert highest > float(entry.log_likelihood(entry.mixture.means).max()) + 0.01
    assert math.log(peak_density(model, 0)) == pytest.approx(highest, abs=1e-5)
    best = robust_terms(model, RECOGNITION)[0].log_likelihood(views).max()
    probability = 0.01 + 0.99 * 0.95
    assert float(best) == pytest.approx(math.log(probability / (1 - probability)), abs=1e-4)


def test_has_bearing() -> None:
    terms = paper_terms(lopsided_model())
    assert [has_bearing(term) for term in terms] == [False, True]
