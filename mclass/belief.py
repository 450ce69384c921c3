"""Evidence to belief: class probabilities and orientation densities (paper eqs. 19 to 23)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mclass.evidence import Evidence
from mclass.logarithms import logsumexp
from mclass.orientation import log_mean_exp
from mclass.records import FloatArray

_NEGLIGIBLE = 60.0
"""A class so far below the best one is not refined between its bins."""


@dataclass(frozen=True)
class Posterior:
    """Belief of independent cells, each summing to 1 over background and classes.

    Attributes:
        log_class_probability: Background first, (m, 1 + n).
        log_density: Of the orientation given the class [1/rad], at the bins, normalised so
            that its sum over the bins times their width is 1, (m, n, bins).
        log_evidence: Log probability of the cell's measurements, prior included, (m,).
    """

    log_class_probability: FloatArray
    log_density: FloatArray
    log_evidence: FloatArray


def posterior(evidence: Evidence, log_priors: FloatArray, bins: int | None = None) -> Posterior:
    """Bayes' rule in logarithms, with the prior uniform over orientation (paper eq. 20).

    A class that is impossible keeps a uniform orientation density. A cell that nothing
    explains, the background included, keeps the prior; its ``log_evidence`` is minus infinity.

    Args:
        evidence: Of m cells.
        log_priors: Background first, normalised, (1 + n,).
        bins: Of the density, a divisor of the evidence's; the same when None.
    """
    peaks = np.concatenate([evidence.background[:, None], evidence.classes.max(axis=-1)], axis=1)
    peaks += log_priors
    rough = peaks < peaks.max(axis=1, keepdims=True) - _NEGLIGIBLE
    log_joint = np.concatenate(
        [evidence.background[:, None], log_mean_exp(evidence.classes, rough[:, 1:])], axis=1
    )
    log_joint += log_priors
    log_evidence = logsumexp(log_joint, axis=1)
    explained = np.isfinite(log_evidence)
    log_class = np.where(
        explained[:, None], log_joint - np.where(explained, log_evidence, 0.0)[:, None], log_priors
    )
    return Posterior(log_class, log_orientation_density(evidence.classes, bins), log_evidence)


def log_orientation_density(log_likelihood: FloatArray, bins: int | None = None) -> FloatArray:
    """Log density over orientation [1/rad] from log likelihoods at the bins.

    Args:
        log_likelihood: (..., bins).
        bins: Keep only so many of the bins, a divisor of theirs; all when None.
    """
    if bins is not None:
        log_likelihood = log_likelihood[..., :: log_likelihood.shape[-1] // bins]
    bins = log_likelihood.shape[-1]
    peak = log_likelihood.max(axis=-1, keepdims=True)
    possible = np.isfinite(peak)
    if possible.all():
        density = log_likelihood - peak
    else:
        density = np.where(possible, log_likelihood, 0.0) - np.where(possible, peak, 0.0)
    density -= np.log(np.exp(density).sum(axis=-1, keepdims=True)) + np.log(2.0 * np.pi / bins)
    return np.asarray(density)
