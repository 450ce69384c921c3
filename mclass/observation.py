"""What one measurement says about class and orientation, as a sum of terms.

The logarithm of a label set's likelihood is a sum over labels (paper eq. 17 in logarithms), so
evidence is made of one `Term` per label, whatever the labels' combinations in the log.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mclass.classes import ClassModel, LabelLikelihood
from mclass.records import FloatArray, IntArray


@dataclass(frozen=True)
class Term:
    """The log likelihood that one returned label adds (paper eqs. 10, 13 and 15).

    Attributes:
        label: Index into the model's label names.
        classes: Classes that can produce the label, (k,).
        likelihoods: Theirs, in the same order.
        background: What it adds to the background's log belief.
    """

    label: int
    classes: IntArray
    likelihoods: Sequence[LabelLikelihood]
    background: float

    @property
    def has_bearing(self) -> bool:
        """Whether the term depends on the object's bearing from the sensor's heading."""
        return any(entry.mixture.has_bearing for entry in self.likelihoods)

    def log_likelihood(
        self,
        views: FloatArray,
        bearings: FloatArray | None = None,
        position_covariances: FloatArray | None = None,
    ) -> FloatArray:
        """Log likelihood of the label for each class in ``classes``.

        Args:
            views: Sensor positions in the object's frame [m], (..., 2).
            bearings: Bearings of the object from the sensor's heading [rad], (...).
            position_covariances: Of the views [m²] in the object's frame, (..., 2, 2).

        Returns:
            (k, ...); a class that is not listed gets minus infinity.
        """
        return np.stack(
            [
                entry.log_likelihood(views, bearings, position_covariances)
                for entry in self.likelihoods
            ]
        )


def paper_terms(model: ClassModel) -> tuple[Term, ...]:
    """One term per label of the model: the plain observation model of the paper."""
    terms = []
    for label in range(len(model.label_names)):
        classes = [c for c in range(len(model.class_names)) if (c, label) in model.likelihoods]
        terms.append(
            Term(
                label=label,
                classes=np.array(classes, dtype=np.int64),
                likelihoods=tuple(model.likelihoods[c, label] for c in classes),
                background=float(model.background_log_likelihood[label]),
            )
        )
    return tuple(terms)
