"""Measurements in one order, whatever order they come in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mclass.records import Frames, IntArray, LabelMeasurements


def measurements() -> LabelMeasurements:
    """Two frames; four rows of the first differ in labels, one score, or how many labels."""
    stamps = np.array([10, 20], dtype=np.int64)
    rows = 5
    return LabelMeasurements(
        frames=Frames(stamps, stamps, np.arange(6.0).reshape(2, 3), None, np.full((2, 2), np.nan)),
        frame_index=np.array([0, 0, 0, 0, 1]),
        directions=np.tile([0.1, 0.4], (rows, 1)),
        object_index=np.full(rows, -1),
        object_ids=(),
        label_offsets=np.array([0, 1, 2, 4, 5, 6]),
        labels=np.array([1, 1, 0, 1, 0, 0]),
        scores=np.array([0.9, 0.3, 0.5, 0.6, 0.9, 0.95]),
        label_names=("cup", "jug"),
    )


def taken(found: LabelMeasurements, order: IntArray) -> LabelMeasurements:
    """Its rows in another order."""
    spans = [np.arange(*found.label_offsets[row : row + 2]) for row in order]
    return replace(
        found,
        frame_index=found.frame_index[order],
        directions=found.directions[order],
        object_index=found.object_index[order],
        label_offsets=np.concatenate([[0], np.cumsum([len(span) for span in spans])]),
        labels=found.labels[np.concatenate(spans)],
        scores=found.scores[np.concatenate(spans)],
    )


@pytest.mark.parametrize(
    "order", [[0, 1, 2, 3, 4], [1, 0, 2, 3, 4], [3, 2, 1, 0, 4], [4, 2, 0, 3, 1]]
)
def test_rows_come_out_in_one_order(order: list[int]) -> None:
    wanted = measurements().in_canonical_order()
    found = taken(measurements(), np.array(order)).in_canonical_order()
    for name in ("frame_index", "label_offsets", "labels", "scores"):
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))


def test_what_is_in_order_is_not_copied() -> None:
    once = measurements().in_canonical_order()
    assert once.in_canonical_order() is once
