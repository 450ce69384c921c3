"""Checks of a model that are not about its syntax: the paper's inequality (12)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mclass.classes import ClassModel, LabelLikelihood
from mclass.records import FloatArray

MATTERS = 0.1
"""A place matters where a label comes with at least this part of its class's peak density."""

_POINTS = 401
_POLISH_ROUNDS = 4


@dataclass(frozen=True)
class Violation:
    """Where a class is likelier to return a confusing label than its own (paper eq. 12).

    Attributes:
        class_name: The true class.
        label: The confusing label.
        true_label: The class's own label.
        position: Sensor position of the greatest excess, in the object's frame [m], (2,).
        confusion_density: Of the confusing label there [1/m²].
        true_density: Of the class's own label there [1/m²].
        ratio: The first over the second.
        share: Part of the places that matter in which (12) is violated, 0..1.
        greatest_ratio: Over all places that matter.
    """

    class_name: str
    label: str
    true_label: str
    position: FloatArray
    confusion_density: float
    true_density: float
    ratio: float
    share: float
    greatest_ratio: float


def find_violations(model: ClassModel, min_range: float, max_range: float) -> tuple[Violation, ...]:
    """Compare every confusion with the class's own label between two ranges [m] of the object.

    A class's own label is the one that bears its name, or else its most probable one. Far from
    all viewpoints next to nothing is returned, and a ratio of two tails or of clutter means
    nothing. So only places that matter are compared: where the class returns one of the two
    labels with at least a tenth of the greatest density with which it returns its own label
    anywhere between the ranges.
    """
    axis = np.linspace(-max_range, max_range, _POINTS)
    views = np.stack(np.meshgrid(axis, axis, indexing="xy"), axis=-1)
    ranges = np.hypot(views[..., 0], views[..., 1])
    views = views[(ranges >= min_range) & (ranges <= max_range)]
    found = []
    for index, name in enumerate(model.class_names):
        labels = [label for (owner, label) in model.likelihoods if owner == index]
        if not labels:
            continue
        own = max(
            labels,
            key=lambda label: (
                model.label_names[label] == name,
                model.likelihoods[index, label].probability,
            ),
        )
        true = model.likelihoods[index, own]
        for label in labels:
            if label == own:
                continue
            violation = _compare(model.likelihoods[index, label], true, views, axis[1] - axis[0])
            if violation is not None:
                position, share, greatest = violation
                confusion_density, true_density = (
                    float(np.exp(entry.log_likelihood(position)))
                    for entry in (model.likelihoods[index, label], true)
                )
                found.append(
                    Violation(
                        class_name=name,
                        label=model.label_names[label],
                        true_label=model.label_names[own],
                        position=position,
                        confusion_density=confusion_density,
                        true_density=true_density,
                        ratio=confusion_density / max(true_density, np.finfo(float).tiny),
                        share=share,
                        greatest_ratio=greatest,
                    )
                )
    return tuple(found)


def _compare(
    confusion: LabelLikelihood, true: LabelLikelihood, views: FloatArray, spacing: float
) -> tuple[FloatArray, float, float] | None:
    """Place of the greatest excess, share of the region and greatest ratio; None if it holds."""
    log_confusion, log_true = confusion.log_likelihood(views), true.log_likelihood(views)
    least = log_true.max() + np.log(MATTERS)
    matters = np.maximum(log_confusion, log_true) >= least
    # Rounding must not turn two equal likelihoods into a violation.
    violated = matters & (log_confusion > log_true + 1e-9)
    if not violated.any():
        return None
    excess = np.exp(log_confusion) - np.exp(log_true)
    best = views[np.argmax(np.where(violated, excess, -np.inf))]
    nearest, farthest = np.hypot(*views.T).min(), np.hypot(*views.T).max()
    for _ in range(_POLISH_ROUNDS):
        offsets = np.linspace(-spacing, spacing, 21)
        around = best + np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 2)
        inside = np.hypot(*around.T)
        around = around[(inside >= nearest) & (inside <= farthest)]
        near_confusion, near_true = confusion.log_likelihood(around), true.log_likelihood(around)
        counts = np.maximum(near_confusion, near_true) >= least
        gain = np.where(counts, np.exp(near_confusion) - np.exp(near_true), -np.inf)
        best = around[np.argmax(gain)]
        spacing /= 10.0
    greatest = float(np.exp(min((log_confusion - log_true)[matters].max(), 700.0)))
    return best, float(violated.sum() / matters.sum()), greatest
