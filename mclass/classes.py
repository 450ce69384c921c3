"""The class model: what the recogniser returns for each class, and from where.

Paper section III.A. Everything here is in metres, whatever unit the model file used:
a density in 1/dm² is 100 times as many 1/m², and the background's constant scales with it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mclass.errors import ModelError
from mclass.records import FloatArray
from mclass.viewpoints import ViewpointMixture

BACKGROUND = "background"
"""Name of c_0, "nothing here", beside the class names."""


@dataclass(frozen=True)
class LabelLikelihood:
    """p(label | class, orientation, position) for one pair (paper eqs. 10 and 13).

    Attributes:
        probability: P(label | class).
        mixture: Its viewpoints.
        clutter: Density [1/m²] at which the label comes from anywhere; 0 for none.
    """

    probability: float
    mixture: ViewpointMixture
    clutter: float = 0.0

    def log_likelihood(
        self,
        views: FloatArray,
        bearings: FloatArray | None = None,
        position_covariances: FloatArray | None = None,
    ) -> FloatArray:
        """Log likelihood of the label for views as in `ViewpointMixture.log_density`."""
        density = self.mixture.log_density(views, bearings, position_covariances)
        value: FloatArray = np.log(self.probability) + density
        return np.logaddexp(value, np.log(self.clutter)) if self.clutter > 0.0 else value


@dataclass(frozen=True)
class ClassModel:
    """All classes, all labels, the background.

    Attributes:
        class_names: c_1..c_n, without the background.
        label_names: Labels that the recogniser may return.
        log_priors: Background first, then the classes; normalised, (1 + n,).
        background_log_likelihood: Log of the constant (15), (27) of each label [1/m²], (l,).
        likelihoods: By (class index, label index); an absent pair cannot happen.
    """

    class_names: tuple[str, ...]
    label_names: tuple[str, ...]
    log_priors: FloatArray
    background_log_likelihood: FloatArray
    likelihoods: Mapping[tuple[int, int], LabelLikelihood]

    def __post_init__(self) -> None:
        if not self.class_names:
            raise ModelError("the model has no classes")
        if self.log_priors.shape != (1 + len(self.class_names),):
            raise ModelError(
                f"{len(self.class_names)} classes need one prior each and the background's"
            )

    @property
    def has_bearing(self) -> bool:
        """Whether any likelihood depends on the bearing."""
        return any(entry.mixture.has_bearing for entry in self.likelihoods.values())
