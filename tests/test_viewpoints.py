from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from models import lopsided_model, mixture_of
from oracle import Sighting, log_label_likelihood, rotation
from strategies import angles, class_models, covariances, floats, poses

from mclass.classes import ClassModel
from mclass.errors import ModelError
from mclass.viewpoints import ViewpointMixture, log_wrapped_gaussian


def test_density_by_hand() -> None:
    # Offset (-0.9, -1.2), determinant 0.085, squared (0.25*0.81 + 0.4*1.08 + 0.5*1.44)/0.085.
    # Mirroring x, y or the sign of the correlation each gives another number.
    mixture = mixture_of([0.7], [[0.9, -0.8]], [[[0.50, 0.20], [0.20, 0.25]]])
    squared = (0.25 * 0.81 - 2 * 0.20 * 1.08 + 0.5 * 1.44) / 0.085
    expected = math.log(0.7) - squared / 2 - math.log(2 * math.pi * math.sqrt(0.085))
    assert float(mixture.log_density(np.array([0.0, -2.0]))) == pytest.approx(expected, rel=1e-13)


@given(st.data(), class_models(bearing=True), poses(), poses())
@settings(max_examples=60, deadline=None)
def test_density_matches_oracle(
    data: st.DataObject, model: ClassModel, sensor: np.ndarray, item: np.ndarray
) -> None:
    pair = data.draw(st.sampled_from(sorted(model.likelihoods)))
    blur = data.draw(st.one_of(st.none(), covariances(1e-4, 0.3)))
    entry = model.likelihoods[pair]
    turn = rotation(-item[2])
    view = turn @ (sensor[:2] - item[:2])
    bearing = math.atan2(*(item[:2] - sensor[:2])[::-1]) - sensor[2]
    blur_world = None if blur is None else np.array(blur)
    blur_object = None if blur_world is None else turn @ blur_world @ turn.T
    value = entry.log_likelihood(view, np.array(bearing), blur_object)
    sighting = Sighting((), sensor[:2], sensor[2], position_covariance=blur_world)
    expected = log_label_likelihood(model, pair, sighting, item[:2], item[2])
    np.testing.assert_allclose(value, expected, rtol=1e-10, atol=1e-10)


def test_batches_keep_their_shape() -> None:
    mixture = lopsided_model().likelihoods[1, 1].mixture
    rng = np.random.default_rng(1)
    views, bearings = rng.normal(size=(3, 4, 2)), rng.normal(size=(3, 4))
    blurs = np.broadcast_to(np.eye(2) * 0.1, (3, 4, 2, 2))
    together = mixture.log_density(views, bearings, blurs)
    assert together.shape == (3, 4)
    alone = mixture.log_density(views[2, 1], bearings[2, 1], blurs[2, 1])
    assert together[2, 1] == pytest.approx(float(alone), rel=1e-14)


def test_integrates_to_its_weights() -> None:
    mixture = lopsided_model().likelihoods[0, 0].mixture
    axis = np.linspace(-6.0, 6.0, 241)
    views = np.stack(np.meshgrid(axis, axis), axis=-1)
    total = np.exp(mixture.log_density(views)).sum() * (axis[1] - axis[0]) ** 2
    assert total == pytest.approx(mixture.weights.sum(), rel=1e-9)


def test_integrates_to_its_weights_over_the_bearing_too() -> None:
    mixture = mixture_of(
        [0.6, 0.2], [[0.3, 0.8], [-0.5, 0.1]], [np.eye(2) * 0.2, np.eye(2) * 0.4],
        [(2.9, 1.5), (-1.0, 40.0)],
    )  # fmt: skip
    axis = np.linspace(-4.0, 4.0, 81)
    turn = 2 * math.pi * np.arange(64) / 64
    x, y, bearing = np.meshgrid(axis, axis, turn, indexing="ij")
    density = np.exp(mixture.log_density(np.stack([x, y], axis=-1), bearing))
    total = density.sum() * (axis[1] - axis[0]) ** 2 * (turn[1] - turn[0])
    assert total == pytest.approx(0.8, rel=1e-8)


def test_position_covariance_is_a_convolution() -> None:
    mixture = lopsided_model().likelihoods[0, 0].mixture
    blur = np.array([[0.09, 0.05], [0.05, 0.06]])
    # Where the sensor may really be: a Gaussian about the view, summed on its own fine lattice.
    axis = np.linspace(-7.0, 7.0, 141)
    root = np.linalg.cholesky(blur)
    unit = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
    masses = np.exp(-0.5 * (unit**2).sum(axis=-1))
    masses /= masses.sum()
    for view in ([0.5, 0.7], [-1.0, 1.5], [2.0, -0.5]):
        spread = np.array(view) + unit @ root.T
        expected = (masses * np.exp(mixture.log_density(spread))).sum()
        value = math.exp(float(mixture.log_density(np.array(view), None, blur)))
        assert value == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("variance", [0.02, 0.3, math.pi / 4, 2.5, 12.0, 400.0])
def test_wrapped_gaussian_equals_its_fourier_series(variance: float) -> None:
    difference = np.linspace(-20.0, 20.0, 173)
    order = np.arange(1, 80)
    waves = np.exp(-0.5 * variance * order**2) * np.cos(difference[:, None] * order)
    expected = (1.0 + 2.0 * waves.sum(axis=1)) / (2.0 * math.pi)
    value = np.exp(log_wrapped_gaussian(difference, variance))
    np.testing.assert_allclose(value, expected, rtol=1e-9, atol=1e-13)


@given(angles(), floats(0.01, 100.0), st.integers(-3, 3))
def test_wrapped_gaussian_ignores_windings(angle: float, variance: float, turns: int) -> None:
    once = log_wrapped_gaussian(np.array(angle), variance)
    wound = log_wrapped_gaussian(np.array(angle + 2 * math.pi * turns), variance)
    np.testing.assert_allclose(wound, once, rtol=1e-9, atol=1e-9)


def test_far_tails_stay_finite_and_ordered() -> None:
    mixture = mixture_of([0.5, 0.5], [[0.0, 1.0], [0.0, -1.0]], [np.eye(2) * 0.1] * 2)
    distances = np.array([16.0, 50.0, 300.0, 1e4])
    views = np.stack([np.zeros(4), distances], axis=-1)
    values = mixture.log_density(views)
    # The nearer viewpoint alone: the other's share is less than e^-1000 of it.
    expected = math.log(0.5) - (distances - 1.0) ** 2 / 0.2 - math.log(2 * math.pi * 0.1)
    assert expected[0] < -1000.0
    np.testing.assert_allclose(values, expected, rtol=1e-12)
    assert np.all(np.diff(values) < 0.0)


def test_narrow_bearing_tail() -> None:
    narrow = log_wrapped_gaussian(np.array([0.0, 1.0, math.pi]), 1e-4)
    peak = -0.5 * math.log(2 * math.pi * 1e-4)
    expected = [peak, peak - 5000.0, peak - math.pi**2 / 2e-4 + math.log(2.0)]
    np.testing.assert_allclose(narrow, expected, rtol=1e-12)


@pytest.mark.parametrize("bearing", [None, (0.4, 0.3)])
def test_length_unit_only_adds_a_constant(bearing: tuple[float, float] | None) -> None:
    rng = np.random.default_rng(3)
    blur = np.array([[0.09, 0.05], [0.05, 0.06]])
    metres = mixture_of([0.7], [[0.9, -0.8]], [[[0.50, -0.20], [-0.20, 0.25]]], [bearing])
    decimetres = mixture_of([0.7], [[9, -8]], [[[50, -20], [-20, 25]]], [bearing])
    views, bearings = rng.normal(size=(20, 2)), rng.normal(size=20)
    shifted = decimetres.log_density(10 * views, bearings, 100 * blur) + math.log(100.0)
    np.testing.assert_allclose(metres.log_density(views, bearings, blur), shifted, rtol=1e-12)


def test_has_bearing() -> None:
    assert lopsided_model().likelihoods[1, 1].mixture.has_bearing
    assert not lopsided_model().likelihoods[0, 1].mixture.has_bearing


def test_missing_bearings_are_zero() -> None:
    mixture = lopsided_model().likelihoods[1, 1].mixture
    views = np.array([[0.2, -1.0], [0.3, 0.3]])
    np.testing.assert_array_equal(
        mixture.log_density(views), mixture.log_density(views, np.zeros(2))
    )


@pytest.mark.parametrize(
    "covariance", [[[1.0, 2.0], [2.0, 1.0]], [[1.0, 0.0], [0.0, -1.0]], [[1.0, 1.0], [1.0, 1.0]]]
)
def test_impossible_covariance(covariance: list[list[float]]) -> None:
    with pytest.raises(ModelError, match="positive definite"):
        mixture_of([1.0], [[0.0, 1.0]], [covariance])


def test_shapes_that_disagree() -> None:
    with pytest.raises(ModelError, match="2 viewpoints"):
        ViewpointMixture(
            np.ones(2), np.zeros((1, 2)), np.eye(2)[None], np.zeros(2), np.full(2, math.inf)
        )
