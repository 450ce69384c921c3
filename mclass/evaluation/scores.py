"""One log's estimates against its truth, object by object."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import linear_sum_assignment

from mclass.evaluation.density import JointDensity
from mclass.evaluation.truth import Truth
from mclass.geometry import wrap_angle
from mclass.records import FloatArray
from mclass.results import ObjectEstimate

MAX_LOG_LOSS = 100.0
"""Greatest negative log-likelihood of one object: one impossibility leaves a mean readable."""

_LEAST_MODE = 0.05
"""Lighter modes do not count as answers to where an object faces."""

_FAR = 1e6


@dataclass(frozen=True)
class ObjectScore:
    """One true object and the estimate of it; angles in radians, lengths in metres.

    Attributes:
        true_id: Of the true object.
        estimate_id: Of the estimate.
        true_class: Name.
        named_class: Name of the class estimated.
        correct: 1 if it is the true one; of a tie, its share.
        confidence: P(named class).
        orientation_error: Of the highest mode given the named class, 0..pi.
        symmetric_error: The same up to the true class's symmetry.
        mode_error: Of the nearest of the modes that hold at least 5 %.
        position_error: Distance.
        log_loss: −log P(true class) p(true orientation | true class) [per rad].
        brier: Sum over classes and background of (P − truth)².
        level: Mass of the smallest highest-density region of orientation, given the true
            class, that holds the true orientation.
    """

    true_id: str
    estimate_id: str
    true_class: str
    named_class: str
    correct: float
    confidence: float
    orientation_error: float
    symmetric_error: float
    mode_error: float
    position_error: float
    log_loss: float
    brier: float
    level: float


@dataclass(frozen=True)
class LogScore:
    """All of one log.

    Attributes:
        name: Of the log.
        objects: Matched ones, in the order of the truth.
        missed: Ids of true objects without an estimate.
        invented: Ids of estimates without a true object; not those most probably nothing.
    """

    name: str
    objects: tuple[ObjectScore, ...]
    missed: tuple[str, ...]
    invented: tuple[str, ...]


def score_log(
    name: str,
    estimates: Sequence[ObjectEstimate],
    densities: Mapping[str, JointDensity],
    class_names: Sequence[str],
    truth: Truth,
    *,
    match: Literal["position", "id"] = "position",
    gate: float = 1.0,
) -> LogScore:
    """Match a log's estimates with its true objects and score each pair.

    Args:
        name: Of the log.
        estimates: Latest of each object.
        densities: Belief over class and orientation, by object id.
        class_names: Of the estimates, without the background.
        truth: What really stood where.
        match: By position: the assignment with the least total distance; or by equal ids.
        gate: Greatest distance of a match by position [m].
    """
    if match == "id":
        rows = {estimate.object_id: row for row, estimate in enumerate(estimates)}
        pairs = [(rows[key], o) for o, key in enumerate(truth.object_ids) if key in rows]
    else:
        positions = np.array([estimate.position for estimate in estimates]).reshape(-1, 2)
        pairs = assign(positions, truth.poses[:, :2], gate)
    matched = {row for row, _ in pairs}
    seen = {o for _, o in pairs}
    return LogScore(
        name=name,
        objects=tuple(
            score_object(estimates[row], densities[estimates[row].object_id], class_names, truth, o)
            for row, o in sorted(pairs, key=lambda pair: pair[1])
        ),
        missed=tuple(key for o, key in enumerate(truth.object_ids) if o not in seen),
        invented=tuple(
            estimate.object_id
            for row, estimate in enumerate(estimates)
            if row not in matched and estimate.class_probabilities[0] < 0.5
        ),
    )


def assign(positions: FloatArray, true_positions: FloatArray, gate: float) -> list[tuple[int, int]]:
    """As many pairs within the gate as possible, and of these the least total distance.

    Args:
        positions: Estimated [m], (e, 2).
        true_positions: [m], (o, 2).
        gate: Greatest distance of a pair [m].

    Returns:
        Rows of estimates and of true objects.
    """
    distances = np.linalg.norm(positions[:, None] - true_positions[None], axis=-1)
    within = distances <= gate
    costs = np.where(within, distances / max(gate, 1e-9), _FAR)
    rows, columns = linear_sum_assignment(costs)
    return [(int(r), int(c)) for r, c in zip(rows, columns, strict=True) if within[r, c]]


def score_object(
    estimate: ObjectEstimate,
    density: JointDensity,
    class_names: Sequence[str],
    truth: Truth,
    index: int,
) -> ObjectScore:
    """Score one estimate against true object ``index``."""
    true_class = truth.class_names[index]
    orientation = float(truth.poses[index, 2])
    known = true_class in class_names
    class_index = list(class_names).index(true_class) if known else -1
    answers = estimate.tie or (estimate.class_index,)
    target = np.zeros(1 + len(class_names))
    target[1 + class_index if known else 0] = 1.0
    named = float(estimate.class_poses[estimate.class_index, 2])
    modes = [mode.orientation for mode in estimate.modes if mode.mass >= _LEAST_MODE]
    log_loss = -density.log_likelihood(class_index, orientation) if known else MAX_LOG_LOSS
    return ObjectScore(
        true_id=truth.object_ids[index],
        estimate_id=estimate.object_id,
        true_class=true_class,
        named_class=class_names[estimate.class_index],
        correct=1.0 / len(answers) if class_index in answers else 0.0,
        confidence=float(estimate.class_probabilities[1 + estimate.class_index]),
        orientation_error=_angle_between(named, orientation),
        symmetric_error=_angle_between(named, orientation, int(truth.symmetry[index])),
        mode_error=min(_angle_between(mode, orientation) for mode in [*modes, named]),
        position_error=float(np.hypot(*(estimate.position - truth.poses[index, :2]))),
        log_loss=min(log_loss, MAX_LOG_LOSS),
        brier=float(((estimate.class_probabilities - target) ** 2).sum()),
        level=density.level(class_index, orientation) if known else 1.0,
    )


def _angle_between(one: float, other: float, order: int = 1) -> float:
    """Size of the angle between two orientations, of which ``order`` look alike [rad]."""
    return float(np.abs(wrap_angle(order * (one - other)))) / order
