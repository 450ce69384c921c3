"""From the names a detector uses to the labels of the model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mclass.logs.detections import Detections, as_names, encode_texts
from mclass.logs.families import LABEL_NAME_FIELDS
from mclass.logs.tables import Table
from mclass.model import Model
from mclass.records import BoolArray, FloatArray, IntArray

NO_LABEL = "no label"
UNKNOWN_LABEL = "label not in the model"
BAD_SCORE = "score not finite"


@dataclass(frozen=True)
class KnownLabels:
    """Labels that count, and why detections without any do not.

    Attributes:
        detections: Detection of each label, non-decreasing, (k,).
        labels: Index into the model's label names, (k,).
        scores: (k,).
        reasons: Why a detection may have no label that counts; the first, empty, if it has one.
        reason_index: Index into them for each detection, (n,).
        unknown: How often each name came that the model lacks.
    """

    detections: IntArray
    labels: IntArray
    scores: FloatArray
    reasons: tuple[str, ...]
    reason_index: IntArray
    unknown: Mapping[str, int]


def numbered_names(table: Table) -> dict[str, str]:
    """Names by number from a ``LabelInfo`` channel."""
    number, name = LABEL_NAME_FIELDS
    numbers = as_names(table.values(number)).tolist()
    return dict(zip(numbers, table.values(name).tolist(), strict=True))


def known_labels(found: Detections, model: Model, numbered: Mapping[str, str]) -> KnownLabels:
    """Translate, gate by score, and sort out what the model does not know.

    A name is looked up in the model file's ``labels``, in the log's own list of numbered
    names, then in both, one after the other.

    Args:
        found: What the detectors returned.
        model: Its label names, ``log.labels`` and ``log.min_score``.
        numbered: Names by number, from the log.
    """
    names, codes = encode_texts(found.labels)
    labels = translate_labels(names, model, numbered)[codes]
    named = labels >= 0
    finite = np.isfinite(found.scores)
    with np.errstate(invalid="ignore"):
        good = named & finite & (found.scores >= model.log.min_score)
    low = f"score below {model.log.min_score:g}"
    reasons = ("", NO_LABEL, UNKNOWN_LABEL, BAD_SCORE, low)
    reason = np.full(len(found), 1)
    reason[found.label_detection] = 2
    reason[found.label_detection[named]] = 3
    reason[found.label_detection[named & finite]] = 4
    reason[found.label_detection[good]] = 0
    counts = np.bincount(codes[~named], minlength=len(names))
    unknown = {name: int(count) for name, count in zip(names, counts, strict=True) if count}
    return KnownLabels(
        found.label_detection[good], labels[good], found.scores[good], reasons, reason, unknown
    )


def merge_labels(
    rows: IntArray, labels: IntArray, scores: FloatArray, n_rows: int
) -> tuple[IntArray, IntArray, FloatArray]:
    """Label sets of rows: each label once, with its best score.

    Args:
        rows: Row of each label, any order, (k,).
        labels: (k,).
        scores: (k,).
        n_rows: Number of rows.

    Returns:
        Offsets (n_rows + 1,), labels increasing within each row, scores.
    """
    order = np.lexsort((-scores, labels, rows))
    rows, labels, scores = rows[order], labels[order], scores[order]
    first: BoolArray = np.ones(len(rows), bool)
    first[1:] = (rows[1:] != rows[:-1]) | (labels[1:] != labels[:-1])
    rows = rows[first]
    offsets = np.searchsorted(rows, np.arange(n_rows + 1))
    return offsets, labels[first], scores[first]


def translate_labels(names: Sequence[str], model: Model, numbered: Mapping[str, str]) -> IntArray:
    """Index of the model's label for each of a detector's names, -1 for none."""
    index = {name: position for position, name in enumerate(model.classes.label_names)}
    chosen = model.log.labels
    result = np.full(len(names), -1)
    for row, name in enumerate(names):
        named = numbered.get(name, name)
        for candidate in (chosen.get(name), chosen.get(named), named, name):
            if candidate is not None and candidate in index:
                result[row] = index[candidate]
                break
    return result
