"""The oracle against the paper's own examples and against numbers worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from models import lopsided_model, measurements_of, toy_model
from oracle import (
    Reach,
    Sighting,
    belief_at,
    cell_belief,
    footprint_holds,
    in_cone,
    label_likelihood,
    log_label_likelihood,
    modes_of,
    object_belief,
    orientations,
    rotation,
    segment_crosses_box,
    sightings,
)
from oracle_looks import look_log_probability, look_weights, peak_density

from mclass.footprint import Grid

CENTER = np.array([5.0, 5.0])
TOY_VIEWS = [[2.0, -10.0], [-2.0, -10.0], [0.0, 10.0]]
TOY_LABELS = [(0,), (0,), (0, 1)]


def facing(sensor_xy: np.ndarray, object_xy: np.ndarray) -> float:
    """Heading of a sensor that looks straight at the object."""
    return math.atan2(*(object_xy - sensor_xy)[::-1])


def toy_sightings(count: int) -> list[Sighting]:
    seen = []
    for view, labels in zip(TOY_VIEWS[:count], TOY_LABELS[:count], strict=True):
        sensor = rotation(math.radians(45.0)) @ np.array(view) + CENTER
        seen.append(Sighting(labels, sensor, facing(sensor, CENTER)))
    return seen


@pytest.mark.parametrize(
    ("confusion", "bearing", "time", "expected", "tolerance"),
    [
        (20.0, None, 1, [0.42313, 0.42443, 0.15244], 6e-6),
        (20.0, None, 2, [0.30207, 0.57330, 0.12463], 6e-6),
        (20.0, None, 3, [0.150597, 0.849385, 1.80773e-5], 6e-7),
        (10.0, None, 1, [0.39926, 0.40049, 0.20025], 6e-6),
        (10.0, math.pi / 4, 1, [0.5962, 0.2692, 0.1346], 6e-5),
        # As the paper prints them, which differ from the exact integral by up to 4e-4.
        (20.0, None, 1, [0.4231, 0.4244, 0.1524], 1e-4),
        (20.0, None, 2, [0.3019, 0.5735, 0.1247], 2.5e-4),
        (20.0, None, 3, [0.1502, 0.8498, 1.8e-5], 4.5e-4),
    ],
)
def test_toy_example(
    confusion: float, bearing: float | None, time: int, expected: list[float], tolerance: float
) -> None:
    model = toy_model(confusion_variance=confusion, bearing_variance=bearing)
    belief = belief_at(model, toy_sightings(time), CENTER)
    np.testing.assert_allclose(belief.class_probabilities, expected, rtol=0, atol=tolerance)
    assert belief.class_probabilities.sum() == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(("time", "angles"), [(1, [56.3, 236.3]), (2, [45.0, 225.0]), (3, [45.0])])
def test_toy_modes(time: int, angles: list[float]) -> None:
    belief = belief_at(toy_model(), toy_sightings(time), CENTER)
    found = [mode for mode in belief.modes(0) if mode.mass > 1e-2]
    assert sorted(math.degrees(m.angle) for m in found) == pytest.approx(angles, abs=0.05)
    assert sum(mode.mass for mode in belief.modes(0)) == pytest.approx(1.0, abs=1e-12)


def test_third_background_probability_relative() -> None:
    third = belief_at(toy_model(), toy_sightings(3), CENTER).class_probabilities
    assert third[2] == pytest.approx(1.80773e-5, rel=5e-6)


def seen_from(direction_deg: float, distance: float, labels: tuple[int, ...]) -> Sighting:
    """A sighting of an object at the origin from a world direction."""
    angle = math.radians(direction_deg)
    sensor = distance * np.array([math.cos(angle), math.sin(angle)])
    return Sighting(labels, sensor, facing(sensor, np.zeros(2)))


def test_experiment_second_object() -> None:
    first = seen_from(47.0, 12.0, (0, 1))
    belief = belief_at(toy_model(), [first], np.zeros(2))
    np.testing.assert_allclose(belief.class_probabilities[1:], 0.2626, atol=6e-5)
    for k in range(2):
        assert math.degrees(belief.modes(k)[0].angle) == pytest.approx(317.0, abs=0.05)
    belief = belief_at(toy_model(), [first, seen_from(222.0, 11.0, (1,))], np.zeros(2))
    assert belief.class_probabilities[2] == pytest.approx(0.6154, abs=6e-5)
    assert math.degrees(belief.modes(1)[0].angle) == pytest.approx(315.1, abs=0.06)


@pytest.mark.parametrize(
    ("direction", "distance", "label", "angles"),
    [(93.0, 12.0, 1, [3.0, 183.0]), (147.0, 9.0, 0, [57.0, 237.0])],
)
def test_experiment_two_modes(
    direction: float, distance: float, label: int, angles: list[float]
) -> None:
    belief = belief_at(toy_model(), [seen_from(direction, distance, (label,))], np.zeros(2))
    modes = belief.modes(label)
    assert len(modes) == 2
    assert sorted(math.degrees(mode.angle) for mode in modes) == pytest.approx(angles, abs=1e-3)
    assert modes[0].mass == pytest.approx(0.5, abs=1e-6)


def test_experiment_first_object_becomes_unique() -> None:
    seen = [seen_from(147.0, 9.0, (0,)), seen_from(0.0, 10.0, (0, 1))]
    modes = [m for m in belief_at(toy_model(), seen, np.zeros(2)).modes(0) if m.mass > 1e-2]
    assert [math.degrees(mode.angle) for mode in modes] == pytest.approx([257.7], abs=0.06)


def test_label_likelihood_by_hand() -> None:
    # A robot 2 m east of an object that faces north is at (0, -2) in the object's frame.
    # Label b of class three: 0.7 * 0.7 * N((0, -2); (0.9, -0.8), [[.5, -.2], [-.2, .25]]) + 0.01,
    # offset (-0.9, -1.2), determinant 0.085,
    # squared (0.25 * 0.81 + 2 * 0.2 * 1.08 + 0.5 * 1.44) / 0.085 = 1.3545 / 0.085.
    expected = 0.49 * math.exp(-0.5 * 1.3545 / 0.085) / (2 * math.pi * math.sqrt(0.085)) + 0.01
    value = label_likelihood(
        lopsided_model(),
        (2, 1),
        Sighting((), np.array([5.0, 1.0]), 0.3),
        np.array([3.0, 1.0]),
        math.pi / 2,
    )
    assert float(value) == pytest.approx(expected, rel=1e-12)


def test_bearing_by_hand() -> None:
    # Label b of class two, seen from its first viewpoint's mean: the object is due north of the
    # sensor and the sensor heads 0.7 rad right of that, so the bearing is +0.7.
    model = lopsided_model()
    sensor = np.array([0.2, -1.3])
    toward = math.atan2(1.3, -0.2)
    value = label_likelihood(model, (1, 1), Sighting((), sensor, toward - 0.7), np.zeros(2), 0.0)
    planar = 1.0 / (2 * math.pi * math.sqrt(0.085))
    bearing = sum(
        math.exp(-((0.4 - 2 * math.pi * k) ** 2) / (2 * 0.5)) for k in (-1, 0, 1)
    ) / math.sqrt(2 * math.pi * 0.5)
    determinant = 0.15 * 0.40 - 0.05**2
    dx, dy = 1.6, -1.6
    squared = (0.40 * dx * dx - 2 * 0.05 * dx * dy + 0.15 * dy * dy) / determinant
    other = 0.2 * math.exp(-0.5 * squared) / (2 * math.pi * math.sqrt(determinant))
    assert float(value) == pytest.approx(0.5 * (planar * bearing + other), rel=1e-9)


def test_absent_label_is_impossible() -> None:
    value = log_label_likelihood(
        lopsided_model(), (2, 0), Sighting((), np.ones(2), 0.0), np.zeros(2), 0.0
    )
    assert value == -math.inf


def test_repeated_label_counts_once() -> None:
    model = lopsided_model()
    once = belief_at(model, [seen_from(20.0, 1.0, (1,))], np.zeros(2), bins=90)
    twice = belief_at(model, [seen_from(20.0, 1.0, (1, 1))], np.zeros(2), bins=90)
    np.testing.assert_array_equal(once.class_probabilities, twice.class_probabilities)


def test_cone_by_hand() -> None:
    right, left = math.radians(350.0), math.radians(20.0)
    cone = Sighting((), np.array([1.0, 1.0]), 0.0, right, left)
    rest = Sighting((), np.array([1.0, 1.0]), 0.0, left, right)
    reach = Reach(0.5, 2.0)
    assert in_cone(np.array([3.0, 1.0]), cone, reach)
    assert not in_cone(np.array([3.01, 1.0]), cone, reach)
    assert not in_cone(np.array([1.4, 1.0]), cone, reach)
    assert in_cone(np.array([2.0, 1.3]), cone, reach)
    assert not in_cone(np.array([2.0, 0.7]), cone, reach)
    assert in_cone(np.array([2.0, 0.7]), rest, reach)
    assert not in_cone(np.array([2.0, 1.3]), rest, reach)


def test_ray_by_hand() -> None:
    # From (0.5, 0.5) due east from 1 to 3 m: columns 1 to 3 of row 0.
    grid = Grid((0.0, 0.0), 1.0, 3, 6)
    east = Sighting((0,), np.array([0.5, 0.5]), 0.0, 0.0, 0.0)
    assert [c for c in range(18) if footprint_holds(grid, c, east, Reach(1.0, 3.0))] == [1, 2, 3]
    # From (0.5, 0.4) with slope 1/3 the ray enters row 1 at x = 2.3; 4 m along it ends at x = 4.29.
    slope = math.atan2(1.0, 3.0)
    rising = Sighting((0,), np.array([0.5, 0.4]), 0.0, slope - 0.1, slope + 0.1)
    reach = Reach(0.0, 4.0, "ray")
    crossed = [c for c in range(18) if footprint_holds(grid, c, rising, reach)]
    assert crossed == [0, 1, 2, 8, 9, 10]


def test_segment_misses_box_beside_it() -> None:
    low, high = np.array([1.0, 1.0]), np.array([2.0, 2.0])
    assert segment_crosses_box(np.zeros(2), np.array([1.5, 1.5]), low, high)
    assert not segment_crosses_box(np.zeros(2), np.array([0.9, 0.9]), low, high)
    assert not segment_crosses_box(np.zeros(2), np.array([3.0, 1.2]), low, high)
    assert segment_crosses_box(np.array([0.0, 1.5]), np.array([3.0, 1.5]), low, high)
    assert not segment_crosses_box(np.array([0.0, 2.5]), np.array([3.0, 2.5]), low, high)


def test_cell_uses_only_sightings_that_point_at_it() -> None:
    model = lopsided_model()
    measurements = measurements_of(
        [[0, 0, 0.1], [0, 0, 0.2], [2, 0, 1.0]],
        [(0,), (1,), (0, 1)],
        [[-0.2, 0.2], [1.0, 1.4], [2.6, 3.8]],
    )
    seen = sightings(measurements)
    grid = Grid((0.5, -0.5), 1.0, 1, 1)
    belief = cell_belief(model, seen, grid, 0, Reach(0.2, 4.0), bins=180)
    expected = belief_at(model, [seen[0], seen[2]], np.array([1.0, 0.0]), bins=180)
    np.testing.assert_array_equal(belief.class_probabilities, expected.class_probabilities)


def test_object_belief_of_one_cell_is_belief_at_it() -> None:
    model = lopsided_model()
    seen = sightings(
        measurements_of([[0, 0, 0.1], [2, 0.4, 2]], [(0,), (1,)], [[-0.2, 0.2], [3, 4]])
    )
    grid = Grid((0.5, -0.5), 1.0, 1, 1)
    belief = object_belief(model, seen, grid, Reach(0.2, 4.0), outside_probability=1e-9, bins=180)
    expected = belief_at(model, seen, np.array([1.0, 0.0]), bins=180)
    assert belief.cells == [0]
    np.testing.assert_allclose(belief.class_probabilities, expected.class_probabilities, rtol=1e-12)


def test_object_belief_charges_cells_outside() -> None:
    model = lopsided_model()
    measurements = measurements_of([[0, 0, 0], [0, 0, 0]], [(0,), (1,)], [[-0.2, 0.2], [-0.2, 1.2]])
    grid = Grid((0.9, -0.1), 0.2, 4, 1)
    free, charged = (
        object_belief(
            model,
            sightings(measurements),
            grid,
            Reach(0.2, 4.0),
            outside_probability=outside,
            bins=90,
        )
        for outside in (1.0, 1e-3)
    )
    # Cell 1 is at atan2(0.2, 1) = 0.197 rad, inside both; cells 2 and 3 are outside the first.
    ratio = charged.cell_masses / free.cell_masses
    np.testing.assert_allclose(ratio / ratio[0], [1.0, 1.0, 1e-3, 1e-3], rtol=1e-9)


def test_modes_of_two_unequal_bumps() -> None:
    phi = orientations(1440)
    bumps = [
        weight * np.exp((np.cos(phi - center) - 1.0) / std**2) / std
        for weight, center, std in [(0.7, 0.05, 0.1), (0.3, 3.0, 0.2)]
    ]
    density = np.sum(bumps, axis=0)
    density /= density.mean() * 2 * math.pi
    first, second = modes_of(density)
    # A von Mises lobe of concentration 1/std² is Gaussian of that std to a few parts in a hundred.
    assert first.angle == pytest.approx(0.05, abs=1e-4)
    assert first.mass == pytest.approx(0.7, abs=5e-3)
    assert first.std == pytest.approx(0.1, rel=1e-2)
    assert second.angle == pytest.approx(3.0, abs=1e-4)
    assert second.std == pytest.approx(0.2, rel=3e-2)


def test_look_probability_by_hand() -> None:
    # Seen from the front peak of the toy model, far from every other viewpoint: both labels have
    # their greatest density there, own 1/10 and confused 1/20 of the same constant.
    model = toy_model()
    assert peak_density(model, 0) == pytest.approx(0.2495 / (2 * math.pi * 10), rel=1e-6)
    view = Sighting((0,), np.array([0.0, 10.0]), 0.0)
    value = look_log_probability(model, 0, view, np.zeros(2), np.array(0.0))
    hit, confused = 0.01 + 0.99 * 0.95, 0.01 + 0.99 * 0.95 * 0.5
    assert float(value) == pytest.approx(math.log(hit) + math.log(1 - confused), abs=1e-6)
    nothing = Sighting((), np.array([0.0, 10.0]), 0.0)
    silent = look_log_probability(model, None, nothing, np.zeros(2), np.zeros(3))
    np.testing.assert_allclose(silent, 2 * math.log(0.99), rtol=1e-12)


def test_look_weights_share_one_vote() -> None:
    seen = [seen_from(10.0, 1.0, (0,))] * 4 + [seen_from(190.0, 1.0, (0,))]
    weights = look_weights(seen, np.zeros(2), 0.3, 0.15)
    np.testing.assert_allclose(weights, [0.25, 0.25, 0.25, 0.25, 1.0], rtol=1e-12)
