"""Inequality (12): where it is looked at, and what is reported."""

from __future__ import annotations

import math

import numpy as np
import pytest
from models import mixture_of

from mclass.checks import MATTERS, find_violations
from mclass.classes import ClassModel, LabelLikelihood


def model_of(own: LabelLikelihood, other: LabelLikelihood) -> ClassModel:
    """One class ``a`` that also returns the label ``b``."""
    priors = np.log([0.5, 0.5])
    return ClassModel(("a",), ("a", "b"), priors, -3.0 * np.ones(2), {(0, 0): own, (0, 1): other})


def around_origin(variance: float, clutter: float = 0.0) -> LabelLikelihood:
    return LabelLikelihood(
        0.5, mixture_of([1.0], [[0.0, 0.0]], [variance * np.eye(2)]), clutter=clutter
    )


def test_a_wider_confusion_by_hand() -> None:
    """The ratio is e^(d²/4) / 2; it is above 1 from d² = 4 ln 2 on, and matters up to 4 ln 5."""
    (found,) = find_violations(model_of(around_origin(1.0), around_origin(2.0)), 0.0, 5.0)
    assert (found.class_name, found.label, found.true_label) == ("a", "b", "a")
    inner, outer = 4.0 * math.log(2.0), 4.0 * math.log(0.5 / MATTERS)
    assert found.share == pytest.approx((outer - inner) / outer, abs=0.005)
    assert found.greatest_ratio == pytest.approx(2.5, rel=0.01)
    # The excess e^(-u) / 2 - e^(-2u) with u = d²/4 is greatest at u = ln 4.
    assert np.hypot(*found.position) == pytest.approx(math.sqrt(4.0 * math.log(4.0)), rel=1e-3)
    assert found.ratio == pytest.approx(2.0, rel=1e-3)
    assert found.confusion_density == pytest.approx(0.5 / (4.0 * math.pi) / 4.0, rel=1e-3)


def test_clutter_far_out_does_not_matter() -> None:
    """Beyond all viewpoints clutter exceeds any Gaussian; there nothing is returned anyway."""
    own = around_origin(1.0)
    assert find_violations(model_of(own, around_origin(1.0)), 0.0, 8.0) == ()
    rare = LabelLikelihood(0.1, own.mixture, clutter=0.01 * MATTERS)
    assert find_violations(model_of(own, rare), 0.0, 8.0) == ()
    # As dense as a tenth of the peak, it does.
    dense = LabelLikelihood(0.1, own.mixture, clutter=1.1 * MATTERS * 0.5 / (2.0 * math.pi))
    (found,) = find_violations(model_of(own, dense), 0.0, 8.0)
    assert found.share > 0.5


def test_the_worst_place_matters_and_lies_between_the_ranges() -> None:
    (found,) = find_violations(model_of(around_origin(1.0), around_origin(2.0)), 2.45, 8.0)
    assert np.hypot(*found.position) == pytest.approx(2.45, rel=1e-3)
    assert found.ratio <= found.greatest_ratio * 1.02
