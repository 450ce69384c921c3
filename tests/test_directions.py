"""Arcs of several detections of one thing, as one."""

from __future__ import annotations

import math

import numpy as np

from mclass.logs.directions import hull


def test_arcs_of_a_row_are_joined() -> None:
    directions = np.array(
        [[0.1, 0.7], [2.9, 3.1], [math.nan, math.nan], [0.3, 0.9], [3.05, -3.0], [1.1, 1.3]]
    )
    rows = np.array([2, 0, 1, 2, 0, 4])
    found = hull(directions, rows, 5)
    np.testing.assert_allclose(found[0], [2.9, -3.0], atol=1e-12)
    np.testing.assert_allclose(found[2], [0.1, 0.9], atol=1e-12)
    assert np.isnan(found[[1, 3]]).all()
    np.testing.assert_array_equal(found[4], [1.1, 1.3])


def test_an_arc_alone_stays_as_it_is_to_the_last_bit() -> None:
    right = np.linspace(-3.1, 3.1, 500)
    directions = np.stack([right, right + 0.037], axis=1)
    directions[directions > math.pi] -= 2.0 * math.pi
    np.testing.assert_array_equal(hull(directions, np.arange(500), 500), directions)
