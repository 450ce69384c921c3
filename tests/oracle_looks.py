"""The robust observation model by brute force: each label is a separate yes or no at every look."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from oracle import Sighting, label_likelihood, log_label_likelihood, wrapped
from scipy.optimize import minimize

from mclass.classes import ClassModel
from mclass.records import FloatArray


def peak_density(model: ClassModel, class_index: int) -> float:
    """s_k: the greatest p(label | class, viewpoint) over labels and viewpoints.

    Found by climbing from every viewpoint's mean, without trusting that a mixture peaks there.
    """
    best = -math.inf
    labels = [label for (k, label) in model.likelihoods if k == class_index]
    for label in labels:
        mixture = model.likelihoods[class_index, label].mixture

        def loss(view: FloatArray, label: int = label) -> float:
            bearing = view[2] if len(view) == 3 else 0.0
            sighting = Sighting((), view[:2], math.atan2(-view[1], -view[0]) - bearing)
            pair = (class_index, label)
            return -float(log_label_likelihood(model, pair, sighting, np.zeros(2), 0.0))

        for m in range(len(mixture.weights)):
            turned = np.isfinite(mixture.bearing_variances).any()
            start = np.array([*mixture.means[m], mixture.bearing_means[m]][: 3 if turned else 2])
            simplex = start + 0.1 * np.eye(len(start) + 1, len(start), -1)
            found = minimize(
                loss,
                start,
                method="Nelder-Mead",
                options={"xatol": 1e-5, "fatol": 1e-10, "initial_simplex": simplex},
            )
            best = max(best, -float(found.fun), -loss(start))
    return math.exp(best)


def look_log_probability(
    model: ClassModel,
    class_index: int | None,
    sighting: Sighting,
    object_xy: FloatArray,
    phi: FloatArray,
    *,
    detection_probability: float = 0.95,
    false_alarm: float = 0.01,
    peak: float | None = None,
) -> FloatArray:
    """Log P(look | class, viewpoint): each of the model's labels is a separate yes or no.

    ``class_index`` None is the background; an empty label set is a look that returned nothing;
    ``peak`` is `peak_density` if already known. Shape of ``phi``.
    """
    total = np.zeros(np.shape(phi))
    if class_index is not None and peak is None:
        peak = peak_density(model, class_index)
    for label in range(len(model.label_names)):
        if class_index is None or peak is None:
            probability = np.full(np.shape(phi), false_alarm)
        else:
            density = label_likelihood(model, (class_index, label), sighting, object_xy, phi)
            hit = detection_probability * density / peak
            probability = false_alarm + (1.0 - false_alarm) * hit
        probability = np.clip(probability, 1e-6, 1.0 - 1e-3)
        total += np.log(probability if label in sighting.labels else 1.0 - probability)
    return total


def look_weights(
    seen: Sequence[Sighting], object_xy: FloatArray, range_scale: float, direction_scale: float
) -> FloatArray:
    """How much each look counts beside its neighbours in range and direction, (looks,)."""
    offsets = [s.sensor_xy - object_xy for s in seen]
    ranges = [math.hypot(*offset) for offset in offsets]
    directions = [math.atan2(offset[1], offset[0]) for offset in offsets]
    weights = np.empty(len(seen))
    for i in range(len(seen)):
        crowd = 0.0
        for j in range(len(seen)):
            apart = (ranges[i] - ranges[j]) / range_scale
            turned = wrapped(directions[i] - directions[j]) / direction_scale
            crowd += math.exp(-0.5 * (apart**2 + turned**2))
        weights[i] = 1.0 / crowd
    return weights
