from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from oracle import TURN, rotation
from scipy.linalg import expm
from strategies import angles, floats, poses

from mclass.geometry import (
    compose,
    exp,
    integrate_twists,
    interpolate_poses,
    inverse,
    log,
    opening_angles,
    relative_pose,
    rotate,
    transform_points,
    wrap_angle,
)
from mclass.records import FloatArray

SECOND = 1_000_000_000


def matrix(pose: FloatArray) -> FloatArray:
    """The element X(psi, q) of SE(2) as a 3x3 matrix."""
    result = np.eye(3)
    result[:2, :2] = rotation(float(pose[2]))
    result[:2, 2] = pose[:2]
    return result


def assert_same_pose(actual: FloatArray, expected: FloatArray, atol: float = 1e-9) -> None:
    assert_allclose(actual[..., :2], expected[..., :2], rtol=0, atol=atol)
    turned = np.remainder(actual[..., 2] - expected[..., 2] + math.pi, TURN) - math.pi
    assert_allclose(turned, 0.0, atol=atol)


# --- By hand -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("angle", "expected"),
    [
        (0.0, 0.0),
        (math.pi, math.pi),
        (-math.pi, math.pi),
        (3 * math.pi / 2, -math.pi / 2),
        (-3 * math.pi / 2, math.pi / 2),
        (7.0, 7.0 - 2 * math.pi),
        (-7.0, 2 * math.pi - 7.0),
    ],
)
def test_wrap_angle(angle: float, expected: float) -> None:
    assert float(wrap_angle(angle)) == pytest.approx(expected, abs=1e-15)


def test_rotate_quarter_turn() -> None:
    assert_allclose(rotate(math.pi / 2, np.array([2.0, 1.0])), [-1.0, 2.0], atol=1e-15)


def test_transform_points() -> None:
    # A robot at (3, 1) heading north: a point 2 m ahead and 1 m to its left is at (2, 3).
    assert_allclose(
        transform_points(np.array([3.0, 1.0, math.pi / 2]), np.array([2.0, 1.0])), [2.0, 3.0]
    )


def test_compose() -> None:
    # 2 m ahead, 1 m to the left, turned 30° left, from (3, 1) heading north.
    start = np.array([3.0, 1.0, math.pi / 2])
    step = np.array([2.0, 1.0, math.pi / 6])
    assert_allclose(compose(start, step), [2.0, 3.0, 2 * math.pi / 3], atol=1e-15)


def test_compose_wraps_heading() -> None:
    turned = compose(np.array([0.0, 0.0, 3.0]), np.array([0.0, 0.0, 3.0]))
    assert float(turned[2]) == pytest.approx(6.0 - 2 * math.pi)


def test_robot_east_of_north_facing_object() -> None:
    # A robot 2 m east of an object that faces north sits at (0, -2) in the object's frame;
    # itself facing west, it is turned a quarter left of the object.
    item = np.array([3.0, 1.0, math.pi / 2])
    robot = np.array([5.0, 1.0, math.pi])
    assert_allclose(relative_pose(item, robot), [0.0, -2.0, math.pi / 2], atol=1e-15)


def test_inverse() -> None:
    # Seen from a robot at (3, 1) heading north, the origin is 1 m behind and 3 m to the left.
    assert_allclose(
        inverse(np.array([3.0, 1.0, math.pi / 2])), [-1.0, 3.0, -math.pi / 2], atol=1e-15
    )


def test_exp_quarter_arc() -> None:
    # A left turn of a quarter circle of radius 2 ends 2 m ahead and 2 m to the left.
    assert_allclose(exp(np.array([math.pi, 0.0, math.pi / 2])), [2.0, 2.0, math.pi / 2])
    assert_allclose(exp(np.array([math.pi, 0.0, -math.pi / 2])), [2.0, -2.0, -math.pi / 2])


def test_exp_sideways() -> None:
    # Sliding left while turning left: the circle's centre is behind.
    assert_allclose(exp(np.array([0.0, math.pi, math.pi / 2])), [-2.0, 2.0, math.pi / 2])


def test_exp_straight() -> None:
    assert_allclose(exp(np.array([1.5, -0.5, 0.0])), [1.5, -0.5, 0.0])


# --- Group axioms ------------------------------------------------------------------------------


@given(poses(), poses())
def test_compose_is_matrix_product(a: FloatArray, b: FloatArray) -> None:
    assert_allclose(matrix(compose(a, b)), matrix(a) @ matrix(b), atol=1e-12)


@given(poses(), poses(), poses())
def test_associative(a: FloatArray, b: FloatArray, c: FloatArray) -> None:
    assert_same_pose(compose(compose(a, b), c), compose(a, compose(b, c)))


@given(poses())
def test_identity(a: FloatArray) -> None:
    assert_same_pose(compose(np.zeros(3), a), a)
    assert_same_pose(compose(a, np.zeros(3)), a)


@given(poses())
def test_inverse_on_both_sides(a: FloatArray) -> None:
    assert_same_pose(compose(inverse(a), a), np.zeros(3))
    assert_same_pose(compose(a, inverse(a)), np.zeros(3))


@given(poses(), poses())
def test_relative_pose_undoes_compose(a: FloatArray, b: FloatArray) -> None:
    assert_same_pose(relative_pose(a, compose(a, b)), b)
    assert_same_pose(compose(a, relative_pose(a, b)), b)


@given(poses(), floats(-5.0, 5.0), floats(-5.0, 5.0))
def test_left_action(a: FloatArray, x: float, y: float) -> None:
    point = np.array([x, y])
    there = transform_points(a, point)
    assert_allclose(there, (matrix(a) @ [x, y, 1.0])[:2], atol=1e-12)
    assert_allclose(transform_points(inverse(a), there), point, atol=1e-12)


@given(poses(), poses(), poses(1e6))
def test_moving_the_world_keeps_relative_poses(
    a: FloatArray, b: FloatArray, world: FloatArray
) -> None:
    moved = relative_pose(compose(world, a), compose(world, b))
    assert_same_pose(moved, relative_pose(a, b), atol=2e-9)


def test_far_from_the_origin_nothing_is_lost() -> None:
    a, b = np.array([1e6, -1e6, 0.3]), np.array([1e6 + 0.25, -1e6 - 0.5, 1.3])
    expected = [*rotation(-0.3) @ [0.25, -0.5], 1.0]
    assert_allclose(relative_pose(a, b), expected, rtol=0, atol=1e-15)


@given(angles(), st.integers(-5, 5))
@example(-3.1415926535897927, 1)
def test_wrap_angle_range(angle: float, turns: int) -> None:
    value = float(wrap_angle(angle + TURN * turns))
    assert -math.pi < value <= math.pi
    assert math.cos(value - angle) == pytest.approx(1.0, abs=1e-12)


def test_batches_compose_row_by_row(rng: np.random.Generator) -> None:
    a, b = rng.normal(size=(4, 5, 3)), rng.normal(size=(4, 5, 3))
    both = compose(a, b)
    assert both.shape == (4, 5, 3)
    assert_allclose(both[2, 3], compose(a[2, 3], b[2, 3]), rtol=1e-15)
    assert_allclose(log(both)[1, 1], log(both[1, 1]), rtol=1e-15)


# --- Exponential and logarithm -----------------------------------------------------------------


@given(floats(-3.0, 3.0), floats(-3.0, 3.0), floats(-7.0, 7.0))
def test_exp_is_the_matrix_exponential(forward: float, left: float, turn: float) -> None:
    algebra = np.array([[0.0, -turn, forward], [turn, 0.0, left], [0.0, 0.0, 0.0]])
    assert_allclose(matrix(exp(np.array([forward, left, turn]))), expm(algebra), atol=1e-9)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize(
    "turn", [0.0, 1e-300, 1e-12, 1e-8, 9.99e-5, 1.01e-4, 1e-3, 0.5, 2.0, 3.0, math.pi - 1e-9]
)
def test_log_undoes_exp(turn: float, sign: float) -> None:
    twist = np.array([1.3, -0.4, sign * turn])
    assert_allclose(log(exp(twist)), twist, rtol=1e-11, atol=1e-15)


def test_log_at_half_a_turn() -> None:
    pose = np.array([0.0, 2.0, math.pi])
    # Half a circle of diameter 2 to the left: pi m forward.
    assert_allclose(log(pose), [math.pi, 0.0, math.pi], atol=1e-15)
    assert_same_pose(exp(log(pose)), pose)


@given(poses())
def test_exp_undoes_log(pose: FloatArray) -> None:
    assert_same_pose(exp(log(pose)), pose)


def test_exp_is_smooth_where_the_series_takes_over() -> None:
    turns = np.linspace(0.9e-4, 1.1e-4, 41)
    twists = np.stack([np.full(41, 1.0), np.full(41, -0.7), turns], axis=-1)
    exact = np.stack(
        [
            np.sin(turns) / turns + 0.7 * 2.0 * np.sin(turns / 2.0) ** 2 / turns,
            2.0 * np.sin(turns / 2.0) ** 2 / turns - 0.7 * np.sin(turns) / turns,
            turns,
        ],
        axis=-1,
    )
    below = turns < 1e-4
    assert_allclose(exp(twists[below]), exact[below], rtol=0, atol=1e-15)
    assert_allclose(exp(twists[~below]), exact[~below], rtol=0, atol=1e-12)


# --- Along time --------------------------------------------------------------------------------


def circle(seconds: FloatArray, speed: float = 0.6, turn: float = 0.8) -> FloatArray:
    """The closed-form arc that (4) gives for constant inputs, from the origin heading east."""
    radius, angle = speed / turn, turn * seconds
    return np.stack([radius * np.sin(angle), radius * (1.0 - np.cos(angle)), angle], axis=-1)


def test_interpolation_follows_the_arc() -> None:
    stamps = np.array([0, 2, 4, 6], dtype=np.int64) * SECOND
    query = np.array([5_500_000_000, 500_000_000, 2 * SECOND, 0, 6 * SECOND], dtype=np.int64)
    found = interpolate_poses(stamps, circle(stamps / SECOND), query)
    assert_same_pose(found, circle(query / SECOND), atol=1e-12)
    assert np.all(np.abs(found[:, 2]) <= math.pi)


def test_interpolation_takes_the_short_way_round() -> None:
    stamps = np.array([0, SECOND], dtype=np.int64)
    poses_world = np.array([[0.0, 0.0, math.radians(170.0)], [0.0, 0.0, math.radians(-170.0)]])
    found = interpolate_poses(stamps, poses_world, np.array([SECOND // 4]))
    assert math.degrees(found[0, 2]) == pytest.approx(175.0)


def test_interpolation_holds_the_ends() -> None:
    stamps = np.array([10, 20], dtype=np.int64)
    ends = np.array([[1.0, 2.0, 0.5], [3.0, 1.0, -0.5]])
    found = interpolate_poses(stamps, ends, np.array([-1000, 10, 20, 5000]))
    assert_same_pose(found, ends[[0, 0, 1, 1]], atol=1e-12)


def test_interpolation_of_a_single_pose() -> None:
    only = np.array([[1.0, 2.0, 0.5]])
    found = interpolate_poses(np.array([7]), only, np.array([0, 7, 99]))
    assert_same_pose(found, np.repeat(only, 3, axis=0))


def test_interpolation_keeps_nanoseconds_of_this_century() -> None:
    # A float64 of such a stamp has steps of 256 ns; here that would move the pose by a quarter.
    base = 1_700_000_000_123_456_789
    stamps = np.array([base, base + 1000], dtype=np.int64)
    ends = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    found = interpolate_poses(stamps, ends, np.array([base + 300]))
    assert found[0, 0] == pytest.approx(0.3, abs=1e-12)


@given(poses(), poses(), poses(), floats(0.0, 1.0))
def test_interpolation_does_not_depend_on_the_world(
    a: FloatArray, b: FloatArray, world: FloatArray, fraction: float
) -> None:
    if math.cos(a[2] - b[2]) < -0.999999:
        return  # half a turn may go either way round
    stamps = np.array([0, SECOND], dtype=np.int64)
    query = np.array([round(fraction * SECOND)])
    here = interpolate_poses(stamps, np.stack([a, b]), query)
    there = interpolate_poses(stamps, np.stack([compose(world, a), compose(world, b)]), query)
    assert_same_pose(there, compose(world, here), atol=1e-6)


def test_integration_of_constant_velocity_is_the_arc() -> None:
    stamps = np.array([0, 1, 3, 4, 9], dtype=np.int64) * (SECOND // 2)
    velocities = np.tile([0.6, 0.0, 0.8], (5, 1))
    assert_same_pose(integrate_twists(stamps, velocities), circle(stamps / SECOND), atol=1e-12)


def test_integration_from_a_start_pose() -> None:
    # 1 s forward at 2 m/s, then 1 s turning left on the spot, then 1 s sideways to the left.
    stamps = np.arange(4, dtype=np.int64) * SECOND
    velocities = np.array([[2.0, 0, 0], [0, 0, math.pi / 2], [0, 1.0, 0], [9.0, 9.0, 9.0]])
    start = np.array([1.0, 1.0, math.pi / 2])
    expected = [
        [1.0, 1.0, math.pi / 2],
        [1.0, 3.0, math.pi / 2],
        [1.0, 3.0, math.pi],
        [1.0, 2.0, math.pi],
    ]
    assert_same_pose(integrate_twists(stamps, velocities, start), np.array(expected), atol=1e-12)


def test_integration_matches_composing_steps(rng: np.random.Generator) -> None:
    stamps = np.cumsum(rng.integers(1, SECOND, size=12)).astype(np.int64)
    velocities = rng.normal(size=(12, 3)) * 3.0
    pose = np.array([0.3, -0.2, 2.0])
    expected = [matrix(pose)]
    for i, step in enumerate(np.diff(stamps) * 1e-9):
        forward, left, turn = velocities[i] * step
        algebra = np.array([[0.0, -turn, forward], [turn, 0.0, left], [0.0, 0.0, 0.0]])
        expected.append(expected[-1] @ expm(algebra))
    found = integrate_twists(stamps, velocities, pose)
    for actual, wanted in zip(found, expected, strict=True):
        assert_allclose(matrix(actual), wanted, atol=1e-9)


def test_openings_go_from_right_to_left() -> None:
    edges = np.array([[0.2, 0.5], [3.0, -3.0], [0.7, 0.7], [0.7, 0.7 - 1e-16], [-0.1, 0.1]])
    expected = [0.3, 2.0 * np.pi - 6.0, 0.0, 0.0, 0.2]
    assert_allclose(opening_angles(edges), expected, rtol=0, atol=1e-12)
    rounded = np.array([1.0, np.nextafter(1.0, 0.0)])
    assert opening_angles(rounded) == 0.0
