"""Hypothesis strategies: lopsided models, poses, grids, and what a detector saw from them."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import strategies as st
from models import measurements_of, mixture_of

from mclass.classes import ClassModel, LabelLikelihood
from mclass.footprint import Grid
from mclass.records import FloatArray, LabelMeasurements


def floats(low: float, high: float) -> st.SearchStrategy[float]:
    """Ordinary numbers of a range, without subnormals."""
    return st.floats(low, high, allow_nan=False, allow_subnormal=False)


def angles() -> st.SearchStrategy[float]:
    """Any direction, the wrap included."""
    return st.one_of(floats(-math.pi, math.pi), st.sampled_from([math.pi, -math.pi, 0.0]))


@st.composite
def covariances(draw: st.DrawFn, low: float = 0.08, high: float = 0.8) -> list[list[float]]:
    """Full 2x2 covariances of any direction, eigenvalues between the two [m²]."""
    small, large, turn = draw(floats(low, high)), draw(floats(low, high)), draw(angles())
    c, s = math.cos(turn), math.sin(turn)
    cross = (small - large) * c * s
    return [[small * c * c + large * s * s, cross], [cross, small * s * s + large * c * c]]


@st.composite
def label_likelihoods(draw: st.DrawFn, bearing: bool = False) -> LabelLikelihood:
    """One or two viewpoints up to 1.5 m away, half of them with clutter."""
    count = draw(st.integers(1, 2))
    place = st.tuples(floats(-1.5, 1.5), floats(-1.5, 1.5))
    term = st.one_of(st.none(), st.tuples(angles(), floats(0.1, 30.0)))
    return LabelLikelihood(
        probability=draw(floats(0.1, 1.0)),
        mixture=mixture_of(
            [draw(floats(0.1, 1.0)) for _ in range(count)],
            [list(draw(place)) for _ in range(count)],
            [draw(covariances()) for _ in range(count)],
            [draw(term) if bearing else None for _ in range(count)],
        ),
        clutter=draw(st.one_of(st.just(0.0), floats(1e-4, 0.02))),
    )


@st.composite
def class_models(draw: st.DrawFn, bearing: bool = False) -> ClassModel:
    """One to three classes and labels; class c always gives label c, others perhaps."""
    count = draw(st.integers(1, 3))
    likelihoods = {}
    for k in range(count):
        for label in range(count):
            if k == label or draw(st.booleans()):
                likelihoods[k, label] = draw(label_likelihoods(bearing))
    priors = np.array([draw(floats(0.05, 1.0)) for _ in range(count + 1)])
    backgrounds = np.array([draw(floats(0.01, 0.2)) for _ in range(count)])
    return ClassModel(
        class_names=tuple("ABC"[:count]),
        label_names=tuple("abc"[:count]),
        log_priors=np.log(priors / priors.sum()),
        background_log_likelihood=np.log(backgrounds),
        likelihoods=likelihoods,
    )


@st.composite
def poses(draw: st.DrawFn, reach: float = 10.0) -> FloatArray:
    """A pose (3,) within ``reach`` of the origin on either axis."""
    return np.array([draw(floats(-reach, reach)), draw(floats(-reach, reach)), draw(angles())])


@st.composite
def grids(draw: st.DrawFn, most: int = 8) -> Grid:
    """A few cells a side, somewhere near the origin."""
    return Grid(
        origin=(draw(floats(-3.0, 3.0)), draw(floats(-3.0, 3.0))),
        cell_size=draw(floats(0.1, 0.4)),
        rows=draw(st.integers(2, most)),
        columns=draw(st.integers(2, most)),
    )


@st.composite
def label_sets(draw: st.DrawFn, model: ClassModel) -> tuple[int, ...]:
    """Labels that one of the model's classes can give together."""
    k = draw(st.integers(0, len(model.class_names) - 1))
    possible = sorted(label for (owner, label) in model.likelihoods if owner == k)
    return tuple(sorted(draw(st.sets(st.sampled_from(possible), min_size=1))))


@st.composite
def label_measurements(
    draw: st.DrawFn, model: ClassModel, grid: Grid, most: int = 5, blurred: bool = False
) -> LabelMeasurements:
    """Sensors around a grid with boxes on some of its cells; all of one object, or of none.

    The first certainly holds the centre of a cell; about one in three of the others is a ray.
    """
    count = draw(st.integers(1, most))
    sensors, directions = [], []
    for i in range(count):
        cell = draw(st.integers(0, grid.rows * grid.columns - 1))
        azimuth, distance = draw(angles()), draw(floats(0.3, 2.5))
        x, y = grid.centers(np.array([cell]))[0]
        sensor = [x - distance * math.cos(azimuth), y - distance * math.sin(azimuth)]
        width, aside = draw(floats(0.05, 1.0)), 0.0
        if i > 0:
            width = draw(st.sampled_from([width, width, 0.0]))
            aside = draw(floats(-0.2, 0.2))
        middle = azimuth + aside
        sensors.append([*sensor, middle + draw(floats(-0.5, 0.5))])
        directions.append([middle - width / 2.0, middle + width / 2.0])
    blur = None
    if blurred:
        blur = np.zeros((count, 3, 3))
        for i in range(count):
            blur[i, :2, :2] = draw(covariances(0.001, 0.05))
            blur[i, 2, 2] = 0.01
    return measurements_of(
        sensors,
        [draw(label_sets(model)) for _ in range(count)],
        directions,
        objects=[draw(st.sampled_from([0, -1]))] * count,
        label_names=model.label_names,
        covariances=blur,
    )
