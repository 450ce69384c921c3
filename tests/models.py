"""Class models and measurements for tests, written down once."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from mclass.classes import ClassModel, LabelLikelihood
from mclass.records import FloatArray, Frames, LabelMeasurements
from mclass.viewpoints import ViewpointMixture


def mixture_of(
    weights: Sequence[float],
    means: Sequence[Sequence[float]],
    covariances: Sequence[Sequence[Sequence[float]] | FloatArray],
    bearings: Sequence[tuple[float, float] | None] | None = None,
) -> ViewpointMixture:
    """A mixture from lists; a bearing is (mean, variance) or None."""
    terms = [None] * len(weights) if bearings is None else bearings
    return ViewpointMixture(
        weights=np.array(weights, dtype=float),
        means=np.array(means, dtype=float).reshape(-1, 2),
        covariances=np.array(covariances, dtype=float).reshape(-1, 2, 2),
        bearing_means=np.array([0.0 if term is None else term[0] for term in terms]),
        bearing_variances=np.array([math.inf if term is None else term[1] for term in terms]),
    )


def toy_model(
    variance: float = 10.0,
    confusion_variance: float = 20.0,
    bearing_variance: float | None = None,
    unit: float = 1.0,
) -> ClassModel:
    """The paper's toy example (25)-(27); ``unit`` is how many of our lengths are in one of its."""
    bearing = None if bearing_variance is None else (0.0, bearing_variance)
    front, back = [0.0, 10.0 * unit], [0.0, -10.0 * unit]
    own = (np.eye(2) * variance * unit**2).tolist()
    shared = (np.eye(2) * confusion_variance * unit**2).tolist()
    likelihoods = {}
    for true_class in range(2):
        likelihoods[true_class, true_class] = LabelLikelihood(
            0.499, mixture_of([0.5, 0.5], [front, back], [own, own], [bearing, bearing])
        )
        likelihoods[true_class, 1 - true_class] = LabelLikelihood(
            0.499, mixture_of([0.5], [front], [shared], [bearing])
        )
    return ClassModel(
        class_names=("c1", "c2"),
        label_names=("c1", "c2"),
        log_priors=np.log(np.full(3, 1.0 / 3.0)),
        background_log_likelihood=np.log(np.full(2, 0.001 / unit**2)),
        likelihoods=likelihoods,
    )


def lopsided_model() -> ClassModel:
    """Three classes without any symmetry: full covariances, a bearing term, clutter, a gap.

    Class 2 never gives label "a". Lengths about a metre.
    """
    tall = [[0.30, 0.12], [0.12, 0.20]]
    flat = [[0.50, -0.20], [-0.20, 0.25]]
    slim = [[0.15, 0.05], [0.05, 0.40]]
    likelihoods = {
        (0, 0): LabelLikelihood(
            0.6, mixture_of([0.5, 0.3], [[1.2, 0.5], [-0.4, 1.1]], [tall, flat])
        ),
        (0, 1): LabelLikelihood(0.2, mixture_of([0.3], [[-0.4, 1.1]], [slim]), clutter=0.004),
        (1, 0): LabelLikelihood(
            0.3, mixture_of([0.4, 0.6], [[0.2, -1.3], [1.0, 0.9]], [slim, tall]), clutter=0.002
        ),
        (1, 1): LabelLikelihood(
            0.5,
            mixture_of([1.0, 0.2], [[0.2, -1.3], [-1.4, 0.3]], [flat, slim], [(0.3, 0.5), None]),
        ),
        (2, 1): LabelLikelihood(0.7, mixture_of([0.7], [[0.9, -0.8]], [flat]), clutter=0.01),
    }
    return ClassModel(
        class_names=("one", "two", "three"),
        label_names=("a", "b"),
        log_priors=np.log([0.4, 0.3, 0.2, 0.1]),
        background_log_likelihood=np.log([0.05, 0.02]),
        likelihoods=likelihoods,
    )


def measurements_of(
    poses: Sequence[Sequence[float]] | FloatArray,
    label_sets: Sequence[Sequence[int]],
    directions: Sequence[Sequence[float]] | FloatArray | None = None,
    *,
    objects: Sequence[int] | None = None,
    label_names: tuple[str, ...] = ("a", "b"),
    covariances: FloatArray | None = None,
) -> LabelMeasurements:
    """One frame and one row for every pose and label set, a tenth of a second apart."""
    count = len(label_sets)
    stamps = 1_700_000_000_000_000_000 + 100_000_000 * np.arange(count, dtype=np.int64)
    frames = Frames(
        stamps_ns=stamps,
        log_times_ns=stamps + 1_000_000,
        poses_world_sensor=np.array(poses, dtype=float).reshape(count, 3),
        covariances=covariances,
        view_directions=np.full((count, 2), math.nan),
    )
    object_index = np.array([-1] * count if objects is None else objects, dtype=np.int64)
    names = tuple(f"o{i}" for i in range(int(object_index.max(initial=-1)) + 1))
    edges = np.full((count, 2), math.nan) if directions is None else np.array(directions)
    return LabelMeasurements(
        frames=frames,
        frame_index=np.arange(count, dtype=np.int64),
        directions=edges.astype(float).reshape(count, 2),
        object_index=object_index,
        object_ids=names,
        label_offsets=np.cumsum([0, *map(len, label_sets)]).astype(np.int64),
        labels=np.array([label for labels in label_sets for label in labels], dtype=np.int64),
        scores=np.ones(sum(map(len, label_sets))),
        label_names=label_names,
    )


def permuted(measurements: LabelMeasurements, order: Sequence[int]) -> LabelMeasurements:
    """Some of the rows in another order of time; a frame for each."""
    spans = [
        np.arange(measurements.label_offsets[row], measurements.label_offsets[row + 1])
        for row in order
    ]
    taken = np.concatenate(spans) if spans else np.zeros(0, dtype=np.int64)
    rows = np.array(order, dtype=np.int64)
    old = measurements.frames
    seen_from = measurements.frame_index[rows]
    frames = Frames(
        stamps_ns=old.stamps_ns[: len(rows)],
        log_times_ns=old.log_times_ns[: len(rows)],
        poses_world_sensor=old.poses_world_sensor[seen_from],
        covariances=None if old.covariances is None else old.covariances[seen_from],
        view_directions=old.view_directions[seen_from],
    )
    return LabelMeasurements(
        frames=frames,
        frame_index=np.arange(len(rows), dtype=np.int64),
        directions=measurements.directions[rows],
        object_index=measurements.object_index[rows],
        object_ids=measurements.object_ids,
        label_offsets=np.cumsum([0, *map(len, spans)]).astype(np.int64),
        labels=measurements.labels[taken],
        scores=measurements.scores[taken],
        label_names=measurements.label_names,
    )


def scaled_model(model: ClassModel, factor: float) -> ClassModel:
    """The same model with every length ``factor`` times as many units."""
    area = factor**2
    likelihoods: Mapping[tuple[int, int], LabelLikelihood] = {
        pair: LabelLikelihood(
            entry.probability,
            ViewpointMixture(
                entry.mixture.weights,
                entry.mixture.means * factor,
                entry.mixture.covariances * area,
                entry.mixture.bearing_means,
                entry.mixture.bearing_variances,
            ),
            entry.clutter / area,
        )
        for pair, entry in model.likelihoods.items()
    }
    return ClassModel(
        model.class_names,
        model.label_names,
        model.log_priors,
        model.background_log_likelihood - math.log(area),
        likelihoods,
    )
