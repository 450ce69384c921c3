"""Which labels are returned: drawn from the model, or from a recogniser that is not the model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import expit, ndtr

from mclass.classes import ClassModel, LabelLikelihood
from mclass.errors import ModelError
from mclass.records import BoolArray, FloatArray
from mclass.simulation.scenario import Correlation, ModelDetector, Recogniser, Response, Scenario

_WAVES = 128
"""Random waves that make one correlated field."""


@dataclass(frozen=True)
class Looks:
    """Every object as seen from every frame.

    Attributes:
        views: Sensor position in the object's frame [m], (f, o, 2).
        bearings: Of the object from the sensor's heading [rad], (f, o).
        seen: Whether it is in the image, within range and not hidden, (f, o).
    """

    views: FloatArray
    bearings: FloatArray
    seen: BoolArray


def label_probabilities(scenario: Scenario, looks: Looks) -> FloatArray:
    """P(label returned | class, view) for every object, (f, o, labels)."""
    detector, labels = scenario.detector, scenario.label_names
    probabilities = np.zeros((*looks.seen.shape, len(labels)))
    for index, item in enumerate(scenario.objects):
        views, bearings = looks.views[:, index], looks.bearings[:, index]
        if isinstance(detector, Recogniser):
            for (class_name, label), responses in detector.responses.items():
                if class_name == item.class_name:
                    probabilities[:, index, labels.index(label)] = _response(
                        detector, responses, views
                    )
        elif isinstance(detector, ModelDetector):
            if scenario.model is None:
                raise ModelError("a detector that draws from the model needs a model")
            probabilities[:, index] = _model_probabilities(
                detector, scenario.model.classes, item.class_name, views, bearings
            )
    return probabilities


def _response(
    detector: Recogniser, responses: tuple[Response, ...], views: FloatArray
) -> FloatArray:
    """Chance of one label over views (n, 2): any of its sides, times the range's fading."""
    aspects = np.arctan2(views[:, 1], views[:, 0])
    ranges = np.hypot(views[:, 0], views[:, 1])
    silent = np.ones(len(views))
    for side in responses:
        away = np.abs(np.remainder(aspects - side.direction + np.pi, 2.0 * np.pi) - np.pi)
        if side.shape == "flat":
            # Four of these units take a logistic curve from 88 % to 12 %.
            lobe = expit(4.0 * (side.half_width - away) / side.edge)
        else:
            concentration = np.log(2.0) / (1.0 - np.cos(side.half_width))
            lobe = np.exp(concentration * (np.cos(away) - 1.0))
        silent *= 1.0 - side.peak * lobe
    fading = expit(4.0 * (ranges - detector.near) / detector.range_edge)
    fading *= expit(4.0 * (detector.far - ranges) / detector.range_edge)
    return np.asarray(fading * (1.0 - silent))


def _model_probabilities(
    detector: ModelDetector,
    classes: ClassModel,
    class_name: str,
    views: FloatArray,
    bearings: FloatArray,
) -> FloatArray:
    """Densities of the model scaled to chances, (n, labels)."""
    class_index = classes.class_names.index(class_name)
    entries = [
        (label, entry)
        for (owner, label), entry in classes.likelihoods.items()
        if owner == class_index
    ]
    best = max(_peak_log_likelihood(entry) for _, entry in entries)
    probabilities = np.full((len(views), len(classes.label_names)), detector.false_alarm)
    for label, entry in entries:
        scaled = np.exp(entry.log_likelihood(views, bearings) - best)
        probabilities[:, label] += (1.0 - detector.false_alarm) * detector.peak * scaled
    return np.asarray(np.minimum(probabilities, 1.0))


def _peak_log_likelihood(entry: LabelLikelihood) -> float:
    """Greatest log likelihood at the viewpoints and on the lines between each two of them.

    Where Gaussians overlap the peak lies between their means, else at one of them.
    """
    means = entry.mixture.means
    fractions = np.linspace(0.0, 1.0, 21)[:, None, None, None]
    lines = ((1.0 - fractions) * means[:, None] + fractions * means).reshape(-1, 2)
    bearings = np.full(len(lines), entry.mixture.bearing_means[0])
    return float(np.max(entry.log_likelihood(lines, bearings)))


def correlated_uniforms(
    views: FloatArray, correlation: Correlation, count: int, rng: np.random.Generator
) -> FloatArray:
    """Uniform variables that are alike for looks from nearly one viewpoint.

    Each is the rank of a Gaussian field over direction and range of view, with correlation
    exp(-1/2 [(Δdirection / length)² + (Δrange / length)²]): a sum of random waves, those over the
    direction with whole numbers of periods so that the circle closes.

    Args:
        views: Sensor positions in the object's frame [m], (n, 2).
        correlation: Lengths, and the share of variance that is not correlated.
        count: How many independent fields.
        rng: Source of the waves.

    Returns:
        (n, count), uniform on 0..1.
    """
    directions = np.arctan2(views[:, 1], views[:, 0])
    ranges = np.hypot(views[:, 0], views[:, 1])
    periods = np.arange(-1000, 1001)
    weights = np.exp(-0.5 * (periods * correlation.direction) ** 2)
    over_direction = rng.choice(periods, size=_WAVES, p=weights / weights.sum())
    over_range = rng.standard_normal(_WAVES) / correlation.distance
    phases = directions[:, None] * over_direction + ranges[:, None] * over_range
    cosine_parts = rng.standard_normal((_WAVES, count))
    sine_parts = rng.standard_normal((_WAVES, count))
    field = (np.cos(phases) @ cosine_parts + np.sin(phases) @ sine_parts) / np.sqrt(_WAVES)
    fresh = rng.standard_normal((len(views), count))
    share = correlation.independent
    return np.asarray(ndtr(np.sqrt(1.0 - share) * field + np.sqrt(share) * fresh))


def draw_labels(
    detector: ModelDetector | Recogniser,
    looks: Looks,
    probabilities: FloatArray,
    rng: np.random.Generator,
) -> BoolArray:
    """Which labels are returned for which object in which frame, (f, o, labels).

    Recognition, label flips and misses each have a correlated field of their own per object.
    """
    returned = np.zeros(probabilities.shape, dtype=bool)
    n_labels = probabilities.shape[2]
    errors = detector.errors
    for index, own_rng in enumerate(rng.spawn(probabilities.shape[1])):
        seen = np.flatnonzero(looks.seen[:, index])
        uniforms = correlated_uniforms(
            looks.views[seen, index], detector.correlation, 2 * n_labels + 1, own_rng
        )
        recognised = uniforms[:, :n_labels] < probabilities[seen, index]
        flipped = uniforms[:, n_labels : 2 * n_labels] < errors.label_noise
        reported = np.any(recognised, axis=1) & (uniforms[:, -1] >= errors.miss)
        returned[seen, index] = (recognised ^ flipped) & reported[:, None]
    return returned
