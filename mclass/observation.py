"""What one look at a cell says about class and orientation, as a sum of terms.

Evidence is additive in logarithms, label by label, whatever combinations of labels a log
holds. A `Term` is one summand: a function of the sensor's place seen from the object, for each
class. Two observation models are made of terms:

* `paper_terms`: densities of returned labels (paper eqs. 10, 13, 15 and 17).
* `robust_terms`: every label is a yes or no in every look, silence included. A look adds
  the base term (nothing returned) and, for every label returned, that label's odds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from mclass.classes import ClassModel, LabelLikelihood
from mclass.records import FloatArray, IntArray

_LEAST = 1e-6
_MOST = 1.0 - 1e-3
"""Bounds on the probability that a label is returned: no single look may decide for good."""

_CLIMB_STEPS = 100


class Term(Protocol):
    """One summand of the log likelihood.

    Attributes:
        index: Place among the observation model's terms.
        classes: Classes whose value depends on the view, (k,).
        background: Value given the background.
        elsewhere: Value given any class not in ``classes``.
        likelihoods: The mixtures involved: their widths tell how fine the term varies.
    """

    @property
    def index(self) -> int:  # noqa: D102 - see the class
        ...

    @property
    def classes(self) -> IntArray:  # noqa: D102
        ...

    @property
    def background(self) -> float:  # noqa: D102
        ...

    @property
    def elsewhere(self) -> float:  # noqa: D102
        ...

    @property
    def likelihoods(self) -> Sequence[LabelLikelihood]:  # noqa: D102
        ...

    def log_likelihood(
        self,
        views: FloatArray,
        bearings: FloatArray | None = None,
        position_covariances: FloatArray | None = None,
    ) -> FloatArray:
        """Value for each class in ``classes``.

        Args:
            views: Sensor positions in the object's frame [m], (..., 2).
            bearings: Bearings of the object from the sensor's heading [rad], (...).
            position_covariances: Of the views [m²] in the object's frame, (..., 2, 2).

        Returns:
            Natural logarithms, (k, ...).
        """
        ...


def has_bearing(term: Term) -> bool:
    """Whether a term depends on the object's bearing from the sensor's heading."""
    return any(entry.mixture.has_bearing for entry in term.likelihoods)


@dataclass(frozen=True)
class DensityTerm:
    """Log density of one returned label (paper eqs. 10, 13 and 15)."""

    index: int
    classes: IntArray
    likelihoods: Sequence[LabelLikelihood]
    background: float
    elsewhere: float = -np.inf

    def log_likelihood(
        self,
        views: FloatArray,
        bearings: FloatArray | None = None,
        position_covariances: FloatArray | None = None,
    ) -> FloatArray:
        """See `Term`."""
        values = [
            entry.log_likelihood(views, bearings, position_covariances)
            for entry in self.likelihoods
        ]
        return np.stack(values)


def paper_terms(model: ClassModel) -> tuple[Term, ...]:
    """One term per label of the model: the plain observation model of the paper."""
    return tuple(
        DensityTerm(
            index=label,
            classes=np.array(classes, dtype=np.int64),
            likelihoods=[model.likelihoods[c, label] for c in classes],
            background=float(model.background_log_likelihood[label]),
        )
        for label, classes in _classes_by_label(model)
    )


def _classes_by_label(model: ClassModel) -> list[tuple[int, list[int]]]:
    """For each label the classes that can return it."""
    return [
        (label, [c for c in range(len(model.class_names)) if (c, label) in model.likelihoods])
        for label in range(len(model.label_names))
    ]


@dataclass(frozen=True)
class Recognition:
    """How a detector's densities become probabilities.

    Attributes:
        best: Probability that the best label is returned from the best viewpoint (p_max).
        false_alarm: Probability that a label is returned for no reason, per look (f).
    """

    best: float
    false_alarm: float

    def probability(self, log_share: FloatArray) -> FloatArray:
        """P(label returned) where a density is ``exp(log_share)`` of its class's peak."""
        share = np.exp(np.minimum(log_share, 0.0))
        value = self.false_alarm + (1.0 - self.false_alarm) * self.best * share
        return np.clip(value, _LEAST, _MOST)

    @property
    def background(self) -> float:
        """P(label returned) where there is no object."""
        return float(np.clip(self.false_alarm, _LEAST, _MOST))


@dataclass(frozen=True)
class OddsTerm:
    """Log odds of one label that was returned: log P − log(1 − P)."""

    index: int
    classes: IntArray
    likelihoods: Sequence[LabelLikelihood]
    log_peaks: FloatArray
    recognition: Recognition

    @property
    def background(self) -> float:
        """A false alarm's odds."""
        return float(_log_odds(np.asarray(self.recognition.background)))

    @property
    def elsewhere(self) -> float:
        """A class that never returns the label does so by false alarm."""
        return self.background

    def log_likelihood(
        self,
        views: FloatArray,
        bearings: FloatArray | None = None,
        position_covariances: FloatArray | None = None,
    ) -> FloatArray:
        """See `Term`."""
        values = [
            _log_odds(
                self.recognition.probability(
                    entry.log_likelihood(views, bearings, position_covariances) - peak
                )
            )
            for entry, peak in zip(self.likelihoods, self.log_peaks, strict=True)
        ]
        return np.stack(values)


@dataclass(frozen=True)
class SilenceTerm:
    """Log probability that a look returns nothing: the sum of log(1 − P) over all labels.

    ``owners[j]`` is the position in ``classes`` of the class of ``likelihoods[j]``.
    """

    index: int
    classes: IntArray
    likelihoods: Sequence[LabelLikelihood]
    owners: IntArray
    log_peaks: FloatArray
    n_labels: int
    recognition: Recognition

    @property
    def background(self) -> float:
        """No label by false alarm."""
        return self.n_labels * float(np.log1p(-self.recognition.background))

    @property
    def elsewhere(self) -> float:
        """A class without any label."""
        return self.background

    def log_likelihood(
        self,
        views: FloatArray,
        bearings: FloatArray | None = None,
        position_covariances: FloatArray | None = None,
    ) -> FloatArray:
        """See `Term`."""
        one = float(np.log1p(-self.recognition.background))
        total = np.full((len(self.classes), *views.shape[:-1]), self.background)
        for owner, entry, peak in zip(self.owners, self.likelihoods, self.log_peaks, strict=True):
            density = entry.log_likelihood(views, bearings, position_covariances)
            total[owner] += np.log1p(-self.recognition.probability(density - peak)) - one
        return total


def robust_terms(model: ClassModel, recognition: Recognition) -> tuple[Term, ...]:
    """One odds term per label, then the silence term that every look adds."""
    peaks = np.array([_log_peak(model, c) for c in range(len(model.class_names))])
    terms: list[Term] = [
        OddsTerm(
            index=label,
            classes=np.array(classes, dtype=np.int64),
            likelihoods=[model.likelihoods[c, label] for c in classes],
            log_peaks=peaks[classes],
            recognition=recognition,
        )
        for label, classes in _classes_by_label(model)
    ]
    keys = sorted(model.likelihoods)
    classes = sorted({c for c, _ in keys})
    terms.append(
        SilenceTerm(
            index=len(terms),
            classes=np.array(classes, dtype=np.int64),
            likelihoods=[model.likelihoods[key] for key in keys],
            owners=np.array([classes.index(c) for c, _ in keys], dtype=np.int64),
            log_peaks=peaks[[c for c, _ in keys]],
            n_labels=len(model.label_names),
            recognition=recognition,
        )
    )
    return tuple(terms)


def _log_odds(probability: FloatArray) -> FloatArray:
    return np.asarray(np.log(probability) - np.log1p(-probability))


def _log_peak(model: ClassModel, class_index: int) -> float:
    """Greatest log density of any label of a class over all views (s_k)."""
    best = -np.inf
    for (owner, _), entry in model.likelihoods.items():
        if owner == class_index:
            best = max(best, _mixture_peak(entry))
    return best


def _mixture_peak(entry: LabelLikelihood) -> float:
    """Greatest log likelihood of a label: climbed by mean shift from every component's mean."""
    mixture = entry.mixture
    precisions = np.linalg.inv(mixture.covariances)
    views = mixture.means.copy()
    bearings = None
    if mixture.has_bearing:
        bearings = np.where(np.isfinite(mixture.bearing_variances), mixture.bearing_means, 0.0)
    best = entry.log_likelihood(views, bearings)
    for _ in range(_CLIMB_STEPS):
        offsets = views[:, None, :] - mixture.means[None, :, :]
        squared = np.einsum("imx,mxy,imy->im", offsets, precisions, offsets)
        log_weights = np.log(mixture.weights) - 0.5 * (
            squared + np.log(np.linalg.det(mixture.covariances))
        )
        weights = np.exp(log_weights - log_weights.max(axis=1, keepdims=True))
        matrices = np.einsum("im,mxy->ixy", weights, precisions)
        targets = np.einsum("im,mxy,my->ix", weights, precisions, mixture.means)
        views = np.linalg.solve(matrices, targets[..., None])[..., 0]
    return float(np.maximum(best, entry.log_likelihood(views, bearings)).max())
