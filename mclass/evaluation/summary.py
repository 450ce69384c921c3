"""Scores of many logs in a few figures, with bootstrap intervals."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mclass.evaluation.scores import LogScore
from mclass.records import FloatArray, IntArray
from mclass.rules import Metric, Quantity

LEVELS = (0.5, 0.9, 0.99)
"""Of the highest-density regions whose coverage is told."""

_CONFIDENCE_BINS = 10
_RESAMPLES = 1000
_INTERVAL = (2.5, 97.5)


@dataclass(frozen=True)
class Figure:
    """One figure over all objects of all logs.

    Attributes:
        value: None when there is nothing to measure.
        low: Lower end of its 95 % bootstrap interval over logs; None with fewer than two logs.
        high: Upper end.
    """

    value: float | None
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class Evaluation:
    """Everything that is told about some logs.

    Attributes:
        logs: Scores, log by log.
        figures: By name, in the order of `METRICS`.
        confusion: Number of objects by true class and class named; of a tie, the one named.
        damage: Sentences on what of the outputs could not be read.
    """

    logs: tuple[LogScore, ...]
    figures: Mapping[str, Figure]
    confusion: Mapping[tuple[str, str], int]
    damage: tuple[str, ...] = ()


METRICS: Mapping[str, Metric] = {
    "class_accuracy": Metric("share", "right class named"),
    "orientation_error_deg": Metric("number", "highest mode, median"),
    "orientation_error_90_deg": Metric("number", "90th percentile of it"),
    "symmetric_error_deg": Metric("number", "up to symmetry, median"),
    "symmetric_error_90_deg": Metric("number", "90th percentile of it"),
    "mode_error_deg": Metric("number", "nearest mode, median"),
    "position_error": Metric("number", "mean distance [m]"),
    "log_loss": Metric("number", "-log P(class, phi) [/rad]"),
    "brier": Metric("number", "of class probabilities"),
    "calibration_error": Metric("number", "of P(named class)"),
    "coverage_50": Metric("share", "phi in the 50 % region"),
    "coverage_90": Metric("share", "phi in the 90 % region"),
    "coverage_99": Metric("share", "phi in the 99 % region"),
    "matched": Metric("count", "objects found"),
    "missed": Metric("count", "objects not found"),
    "invented": Metric("count", "estimates of nothing real"),
}
"""Every figure, by the name that rules use."""


def evaluate(logs: Sequence[LogScore], *, seed: int = 0) -> Evaluation:
    """Figures over all objects of some logs.

    Intervals are percentiles over resamples of whole logs, as objects of one log share its
    errors.

    Args:
        logs: Scores, log by log.
        seed: Of the resampling.
    """
    tables = [_table(log) for log in logs]
    counts = np.array([[len(log.missed), len(log.invented)] for log in logs]).reshape(-1, 2)
    values = _figures(_joined(tables), counts.sum(axis=0))
    figures = {name: Figure(value) for name, value in values.items()}
    if len(logs) > 1:
        rng = np.random.default_rng(seed)
        resampled = [
            _figures(_joined([tables[i] for i in drawn]), counts[drawn].sum(axis=0))
            for drawn in rng.integers(0, len(logs), (_RESAMPLES, len(logs)))
        ]
        for name, value in values.items():
            found = [sample[name] for sample in resampled]
            ends = [one for one in found if one is not None]
            if value is not None and ends:
                low, high = np.percentile(ends, _INTERVAL)
                figures[name] = Figure(value, float(low), float(high))
    confusion: dict[tuple[str, str], int] = {}
    for log in logs:
        for score in log.objects:
            key = score.true_class, score.named_class
            confusion[key] = confusion.get(key, 0) + 1
    return Evaluation(tuple(logs), figures, confusion)


def quantities(evaluation: Evaluation) -> dict[str, Quantity]:
    """The figures as rules take them: counts are shares of all objects, true and invented."""
    values = {name: figure.value for name, figure in evaluation.figures.items()}
    counts = [name for name, metric in METRICS.items() if metric.kind == "count"]
    whole = sum(values[name] or 0.0 for name in counts)
    return {
        name: Quantity(value, whole if name in counts else None) for name, value in values.items()
    }


_COLUMNS = (
    "correct",
    "confidence",
    "orientation_error",
    "symmetric_error",
    "mode_error",
    "position_error",
    "log_loss",
    "brier",
    "level",
)


def _table(log: LogScore) -> FloatArray:
    """What figures are made of, (objects, columns)."""
    rows = [[getattr(score, column) for column in _COLUMNS] for score in log.objects]
    return np.array(rows).reshape(-1, len(_COLUMNS))


def _joined(tables: Sequence[FloatArray]) -> FloatArray:
    return np.concatenate([np.zeros((0, len(_COLUMNS))), *tables])


def _figures(table: FloatArray, counts: IntArray) -> dict[str, float | None]:
    """Every metric's value, None where no object was matched; ``counts``: missed, invented."""
    values: dict[str, float | None] = dict.fromkeys(METRICS)
    if len(table):
        column = dict(zip(_COLUMNS, table.T, strict=True))
        for error in ("orientation_error", "symmetric_error", "mode_error"):
            values[f"{error}_deg"] = math.degrees(np.median(column[error]))
        for error in ("orientation_error", "symmetric_error"):
            values[f"{error}_90_deg"] = math.degrees(np.percentile(column[error], 90.0))
        values["class_accuracy"] = float(column["correct"].mean())
        for name in ("position_error", "log_loss", "brier"):
            values[name] = float(column[name].mean())
        values["calibration_error"] = _calibration_error(column["confidence"], column["correct"])
        for level in LEVELS:
            values[f"coverage_{round(100 * level)}"] = float((column["level"] <= level).mean())
    values |= {
        "matched": float(len(table)),
        "missed": float(counts[0]),
        "invented": float(counts[1]),
    }
    return values


def _calibration_error(confidence: FloatArray, correct: FloatArray) -> float:
    """Mean gap of confidence and accuracy over bins of confidence, by their share of objects."""
    bins = np.minimum((confidence * _CONFIDENCE_BINS).astype(np.int64), _CONFIDENCE_BINS - 1)
    gaps = np.bincount(bins, weights=confidence - correct, minlength=_CONFIDENCE_BINS)
    return float(np.abs(gaps).sum() / len(confidence))
