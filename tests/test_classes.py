from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from models import lopsided_model, mixture_of, scaled_model, toy_model
from oracle import Sighting, belief_at, label_likelihood, rotation
from strategies import class_models, poses

from mclass.classes import ClassModel, LabelLikelihood
from mclass.errors import ModelError


@given(st.data(), class_models(), poses(3.0), poses(3.0))
@settings(max_examples=60, deadline=None)
def test_likelihood_matches_oracle(
    data: st.DataObject, model: ClassModel, sensor: np.ndarray, item: np.ndarray
) -> None:
    pair = data.draw(st.sampled_from(sorted(model.likelihoods)))
    view = rotation(item[2]).T @ (sensor[:2] - item[:2])
    value = np.exp(model.likelihoods[pair].log_likelihood(view))
    expected = label_likelihood(model, pair, Sighting((), sensor[:2], 0.0), item[:2], item[2])
    np.testing.assert_allclose(value, expected, rtol=1e-9)


def test_clutter_by_hand() -> None:
    # At the mean of a Gaussian with determinant 0.01 the density is 1/(0.2 pi).
    entry = LabelLikelihood(
        0.4, mixture_of([0.5], [[1.0, 0.0]], [[[0.1, 0.0], [0.0, 0.1]]]), clutter=0.03
    )
    at_mean = float(entry.log_likelihood(np.array([1.0, 0.0])))
    assert math.exp(at_mean) == pytest.approx(0.4 * 0.5 / (0.2 * math.pi) + 0.03, rel=1e-13)
    far = float(entry.log_likelihood(np.array([1000.0, 0.0])))
    assert far == pytest.approx(math.log(0.03), rel=1e-13)


def test_without_clutter_tails_go_on() -> None:
    entry = LabelLikelihood(0.4, mixture_of([1.0], [[0.0, 0.0]], [np.eye(2)]))
    far = float(entry.log_likelihood(np.array([100.0, 0.0])))
    assert far == pytest.approx(math.log(0.4) - 5000.0 - math.log(2 * math.pi), rel=1e-13)


@pytest.mark.parametrize("model", [toy_model(), lopsided_model()])
def test_length_unit_leaves_beliefs_alone(model: ClassModel) -> None:
    seen = [
        Sighting((1,), np.array([0.3, -1.6]), 1.2),
        Sighting((1,), np.array([1.6, 0.9]), 3.0),
    ]
    larger = [Sighting(s.labels, 10 * s.sensor_xy, s.sensor_heading) for s in seen]
    once = belief_at(model, seen, np.zeros(2), bins=90)
    again = belief_at(scaled_model(model, 10.0), larger, np.zeros(2), bins=90)
    np.testing.assert_allclose(again.class_probabilities, once.class_probabilities, rtol=1e-9)
    view = np.array([0.3, -1.6])
    for pair, entry in model.likelihoods.items():
        scaled = scaled_model(model, 10.0).likelihoods[pair]
        expected = entry.log_likelihood(view) - math.log(100.0)
        np.testing.assert_allclose(scaled.log_likelihood(10.0 * view), expected, rtol=1e-12)


def test_has_bearing() -> None:
    assert lopsided_model().has_bearing
    assert toy_model(bearing_variance=0.5).has_bearing
    assert not toy_model().has_bearing


def test_no_classes() -> None:
    with pytest.raises(ModelError, match="no classes"):
        ClassModel((), ("a",), np.zeros(1), np.zeros(1), {})


def test_priors_that_do_not_fit() -> None:
    with pytest.raises(ModelError, match="2 classes"):
        ClassModel(("one", "two"), ("a",), np.log([0.5, 0.5]), np.zeros(1), {})
