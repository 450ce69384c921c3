"""Many batches of messages become one table, in their order."""

from __future__ import annotations

import numpy as np
import pytest

from mclass.logs.decode import Column
from mclass.logs.tables import _joined, _Part, _tidied


@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 64, 150])
def test_parts_are_joined_in_their_order(count: int) -> None:
    parts: list[_Part] = []
    for number in range(count):
        row = np.arange(3 * number, 3 * number + 3)
        # Lists of one and of two values in turn.
        offsets = np.array([0, 1, 3, 4])
        values = {"x": Column(row * 0.5), "list[]": Column(np.full(4, number), (offsets,))}
        parts = _tidied([*parts, _Part(row, values)])
        assert len(parts) <= 3 * 7
    whole = _joined(["x", "list[]"], parts)
    np.testing.assert_array_equal(whole.log_times_ns, np.arange(3 * count))
    np.testing.assert_array_equal(whole.columns["x"].values, 0.5 * np.arange(3 * count))
    np.testing.assert_array_equal(whole.columns["list[]"].values, np.repeat(np.arange(count), 4))
    sizes = np.diff(whole.columns["list[]"].offsets[0])
    np.testing.assert_array_equal(sizes, np.tile([1, 2, 1], count))
    assert whole.batches == count
