"""Looks from one place share one vote: the lattice against counting every pair."""

from __future__ import annotations

import math

import numpy as np
import pytest
from oracle import Sighting
from oracle_looks import look_weights

from mclass.correlation import shared_votes
from mclass.records import FloatArray

WIDTHS = (0.3, 0.12)


def scattered(seed: int) -> tuple[FloatArray, FloatArray]:
    """Ranges and directions: half of the looks crowd about one place, across the angle pi."""
    rng = np.random.default_rng(seed)
    ranges, directions = rng.uniform(0.1, 3.0, 80), rng.uniform(-math.pi, math.pi, 80)
    ranges[:40] = 1.5 + 0.2 * rng.standard_normal(40)
    directions[:40] = math.pi + 0.1 * rng.standard_normal(40)
    return ranges, directions


def lattice_weights(ranges: FloatArray, directions: FloatArray) -> FloatArray:
    """Weights at the second of three cells, between others that see little or nothing."""
    looked = np.zeros((3, len(ranges) + 1), dtype=bool)
    looked[0, 1], looked[1, 1:] = True, True
    every = np.tile([4.0, *ranges], (3, 1)), np.tile([4.0, *directions], (3, 1))
    weights = shared_votes(looked, every[0], every[1], *WIDTHS)
    np.testing.assert_array_equal(weights[~looked], 0.0)
    assert weights[0, 1] == pytest.approx(1.0, abs=1e-3)
    return weights[1, 1:]


@pytest.mark.parametrize("at_once", [7, 2**12])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_weights_match_counting_pairs(
    seed: int, at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mclass.correlation._LOOKS_AT_ONCE", at_once)
    ranges, directions = scattered(seed)
    cell = np.array([0.7, -1.9])
    places = cell + ranges[:, None] * np.stack([np.cos(directions), np.sin(directions)], axis=1)
    expected = look_weights([Sighting((), place, 0.0) for place in places], cell, *WIDTHS)
    np.testing.assert_allclose(lattice_weights(ranges, directions), expected, rtol=2e-4)


@pytest.mark.parametrize("turn", [0.3, math.pi / 2, 5.0, -700.1])
def test_turning_the_world_changes_no_weight(turn: float) -> None:
    ranges, directions = scattered(3)
    here, there = lattice_weights(ranges, directions), lattice_weights(ranges, directions + turn)
    tolerance = 1e-9 if turn == math.pi / 2 else 2e-4
    np.testing.assert_allclose(there, here, rtol=tolerance)


def test_a_look_on_its_own_counts_in_full() -> None:
    ranges, directions = np.array([0.5, 2.5]), np.array([1.0, 1.0])
    assert lattice_weights(ranges, directions) == pytest.approx([1.0, 1.0], abs=1e-3)
    assert lattice_weights(ranges, directions).max() <= 1.0


def test_ten_looks_from_one_place_share_one_vote() -> None:
    ten = np.full((1, 10), 1.234), np.full((1, 10), 0.77)
    weights = shared_votes(np.ones((1, 10), dtype=bool), *ten, *WIDTHS)
    assert weights == pytest.approx(np.full((1, 10), 0.1), rel=1e-3)
    # One more, a width farther away: the ten count exp(-1/2) each.
    eleven = np.append(ten[0], [[1.534]], axis=1), np.full((1, 11), 0.77)
    weights = shared_votes(np.ones((1, 11), dtype=bool), *eleven, *WIDTHS)
    assert weights[0, 10] == pytest.approx(1.0 / (1.0 + 10.0 * math.exp(-0.5)), rel=1e-3)
