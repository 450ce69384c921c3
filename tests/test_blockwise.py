"""Rows worked on block by block come out as if all at once."""

from __future__ import annotations

import numpy as np
import pytest

from mclass.blockwise import ROWS, blocks, blockwise
from mclass.logs.poses import is_positive_semidefinite
from mclass.records import FloatArray, IntArray


@pytest.mark.parametrize("count", [0, 1, 5, 6, 7])
def test_blocks_make_up_all_rows(count: int) -> None:
    parts = list(blocks(count, 3))
    assert [row for part in parts for row in range(part.start, part.stop)] == list(range(count))
    assert len(parts) == max(1, -(-count // 3))


@pytest.mark.parametrize("count", [0, 7, 2 * ROWS + 5])
def test_columns_are_joined(count: int) -> None:
    sizes = []

    def function(values: FloatArray, numbers: IntArray) -> tuple[FloatArray, IntArray]:
        sizes.append(len(values))
        return values[:, :2] * numbers[:, None], -numbers

    values, numbers = np.arange(3.0 * count).reshape(-1, 3), np.arange(count)
    products, negative = blockwise(function, values, numbers)
    np.testing.assert_array_equal(products, values[:, :2] * numbers[:, None])
    np.testing.assert_array_equal(negative, -numbers)
    assert max(sizes) <= ROWS
    assert products.shape == (count, 2)


def test_covariances_are_looked_at_one_by_one() -> None:
    matrices = np.tile(np.diag([1.0, 2.0, 0.5]), (ROWS + 3, 1, 1))
    matrices[ROWS + 1, 2, 2] = -1.0
    matrices[4, 0, 1] = 0.3
    wrong = np.flatnonzero(~is_positive_semidefinite(matrices))
    assert wrong.tolist() == [4, ROWS + 1]
