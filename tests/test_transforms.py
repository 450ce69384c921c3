"""Rigid motions in space: hand-computed turns, group laws, chains through a tree."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mclass import transforms
from mclass.errors import ModelError
from mclass.records import FloatArray
from mclass.transforms import Link, Transforms, TransformTree

HALF = np.sqrt(0.5)
QUARTER_TURN = np.array([0.0, 0.0, HALF, HALF])
SECOND = 1_000_000_000

finite = st.floats(-50.0, 50.0)
angle = st.floats(-3.1, 3.1)


def transform_from(values: list[float]) -> Transforms:
    translation = np.array([values[:3]])
    return Transforms(translation, transforms.from_roll_pitch_yaw(np.array([values[3:]])))


rigid = st.tuples(finite, finite, finite, angle, angle, angle).map(
    lambda v: transform_from(list(v))
)


def test_a_quarter_turn_to_the_left_takes_forward_to_left() -> None:
    turned = transforms.rotate(QUARTER_TURN, np.array([1.0, 0.0, 0.5]))
    np.testing.assert_allclose(turned, [0.0, 1.0, 0.5], atol=1e-15)


def test_the_optical_axis_looks_forward_with_x_to_the_right_and_y_down() -> None:
    axes = transforms.rotate(transforms.OPTICAL_ROTATION, np.eye(3))
    np.testing.assert_allclose(axes, [[0, -1, 0], [0, 0, -1], [1, 0, 0]], atol=1e-15)


def test_roll_pitch_yaw_are_about_fixed_axes_in_this_order() -> None:
    quaternion = transforms.from_roll_pitch_yaw(np.array([np.pi / 2, 0.0, np.pi / 2]))
    # Rolled first: y goes up; then yawed: forward goes left, up stays.
    np.testing.assert_allclose(
        transforms.rotate(quaternion, np.array([0.0, 1.0, 0.0])), [0, 0, 1], atol=1e-15
    )
    np.testing.assert_allclose(
        transforms.rotate(quaternion, np.array([1.0, 0.0, 0.0])), [0, 1, 0], atol=1e-15
    )


def test_a_positive_pitch_looks_down() -> None:
    quaternion = transforms.from_roll_pitch_yaw(np.array([0.0, 0.3, 0.0]))
    forward = transforms.rotate(quaternion, np.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(forward, [np.cos(0.3), 0.0, -np.sin(0.3)], atol=1e-15)


def test_the_product_turns_by_the_second_factor_first() -> None:
    roll = transforms.from_roll_pitch_yaw(np.array([0.4, 0.0, 0.0]))
    yaw = transforms.from_roll_pitch_yaw(np.array([0.0, 0.0, 1.1]))
    both = transforms.from_roll_pitch_yaw(np.array([0.4, 0.0, 1.1]))
    np.testing.assert_allclose(transforms.multiply(yaw, roll), both, atol=1e-15)


@given(angle, st.floats(-1.5, 1.5), angle)
def test_heading_is_the_yaw_of_the_full_rotation(roll: float, pitch: float, yaw: float) -> None:
    quaternion = transforms.from_roll_pitch_yaw(np.array([roll, pitch, yaw]))
    assert transforms.headings(quaternion) == pytest.approx(yaw, abs=1e-9)
    level = transforms.from_heading(np.array(yaw))
    assert transforms.headings(level) == pytest.approx(yaw, abs=1e-12)


def test_heading_of_a_robot_that_looks_straight_up_comes_from_its_left_side() -> None:
    quaternion = transforms.from_roll_pitch_yaw(np.array([0.0, -np.pi / 2, 0.7]))
    assert transforms.headings(quaternion) == pytest.approx(0.7, abs=1e-9)


def test_quaternions_that_mean_nothing_are_named() -> None:
    given_ = np.array(
        [[0, 0, 3, 3], [0, 0, 0, 0], [0, np.nan, 0, 1], [0, 0, np.inf, 1], [1e-9] * 4]
    )
    unit, valid = transforms.normalize_quaternions(given_)
    assert valid.tolist() == [True, False, False, False, True]
    np.testing.assert_allclose(unit[0], QUARTER_TURN)
    np.testing.assert_allclose(unit[4], [0.5] * 4)
    np.testing.assert_allclose(np.linalg.norm(unit, axis=1), 1.0)


@given(rigid, rigid, st.tuples(finite, finite, finite))
def test_composing_is_applying_one_after_the_other(
    a_b: Transforms, b_c: Transforms, point: tuple[float, float, float]
) -> None:
    points = np.array([point])
    together = transforms.transform_points(transforms.compose(a_b, b_c), points)
    one_by_one = transforms.transform_points(a_b, transforms.transform_points(b_c, points))
    np.testing.assert_allclose(together, one_by_one, atol=1e-9)
    back = transforms.transform_points(transforms.inverse(a_b), one_by_one)
    np.testing.assert_allclose(back, transforms.transform_points(b_c, points), atol=1e-9)


@given(angle, angle, st.floats(0.0, 1.0))
def test_slerp_about_one_axis_is_linear_in_the_shorter_angle(
    first: float, second: float, fraction: float
) -> None:
    difference = np.remainder(second - first + np.pi, 2 * np.pi) - np.pi
    if abs(abs(difference) - np.pi) < 1e-3:
        return  # both ways round are equally short
    between = transforms.slerp(
        transforms.from_heading(np.array([first])),
        transforms.from_heading(np.array([second])),
        np.array([fraction]),
    )
    expected = transforms.from_heading(np.array([first + fraction * difference]))
    assert abs(float(np.sum(between * expected))) == pytest.approx(1.0, abs=1e-12)


def test_slerp_keeps_tiny_turns() -> None:
    end = transforms.from_heading(np.array([2e-7]))
    middle = transforms.slerp(transforms.from_heading(np.array([0.0])), end, np.array([0.5]))
    assert transforms.headings(middle)[0] == pytest.approx(1e-7, rel=1e-9)


def test_times_are_covered_by_close_samples_and_held_at_the_ends() -> None:
    stamps = np.array([0, 10, 20, 100, 110])
    query = np.array([-7, -5, 0, 4, 60, 100, 115, 116])
    before, fraction, covered = transforms.bracket(stamps, query, 5)
    assert covered.tolist() == [False, True, True, False, False, True, True, False]
    _, _, wide = transforms.bracket(stamps, query, 10)
    assert wide.tolist() == [True, True, True, True, False, True, True, True]
    assert before[3] == 0
    assert fraction[3] == pytest.approx(0.4)
    assert fraction[[0, 7]].tolist() == [0.0, 1.0]


def _link(parent: str, child: str, xyz: FloatArray, yaw: float, *, static: bool = True) -> Link:
    heading = transforms.from_heading(np.array([yaw]))
    return Link(parent, child, np.array([0]), Transforms(np.array([xyz]), heading), static)


def test_a_chain_climbs_and_descends_the_tree() -> None:
    tree = TransformTree(
        [
            _link("base", "mast", np.array([1.0, 0.0, 2.0]), np.pi / 2),
            _link("mast", "camera", np.array([0.5, 0.0, 0.0]), 0.0),
            _link("base", "lidar", np.array([0.0, -3.0, 0.0]), 0.0),
        ]
    )
    found = tree.lookup("lidar", "camera", np.array([5, 6]), 0)
    assert found is not None
    chain, valid = found
    # The mast looks left of the base, so half a metre along it is half a metre to the left.
    np.testing.assert_allclose(chain.translations, [[1.0, 3.5, 2.0]] * 2, atol=1e-15)
    assert valid.all()
    assert tree.lookup("lidar", "nowhere", np.array([0]), 0) is None
    assert tree.ancestors("camera") == ["camera", "mast", "base"]
    assert "mast" in tree
    assert "nowhere" not in tree


def test_a_moving_link_is_interpolated_and_has_gaps() -> None:
    pan = Link(
        "base",
        "head",
        np.array([0, SECOND, 3 * SECOND]),
        Transforms(
            np.array([[0.0, 0, 1], [2.0, 0, 1], [2.0, 0, 1]]),
            transforms.from_heading(np.array([3.0, -3.0, 0.0])),
        ),
        static=False,
    )
    tree = TransformTree([pan, _link("head", "eye", np.array([1.0, 0.0, 0.0]), 0.0)])
    found = tree.lookup("base", "eye", np.array([SECOND // 2, 2 * SECOND]), SECOND)
    assert found is not None
    chain, valid = found
    assert valid.tolist() == [True, False]
    # Half way between 3 and -3 rad, the short way: looking back, so the eye is behind.
    np.testing.assert_allclose(chain.translations[0], [0.0, 0.0, 1.0], atol=1e-12)
    assert tree.path("base", "eye", static_only=True) is None
    assert tree.ancestors("eye", static_only=True) == ["eye", "head"]


def test_a_loop_of_links_ends() -> None:
    tree = TransformTree([_link("a", "b", np.zeros(3), 0.1), _link("b", "a", np.ones(3), 0.2)])
    assert tree.ancestors("a") in (["a"], ["a", "b"])
    found = tree.lookup("a", "b", np.array([0]), 0)
    assert found is not None
    assert transforms.headings(found[0].rotations_xyzw)[0] == pytest.approx(0.1)


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ModelError, match="need"):
        Transforms(np.zeros((2, 2)), np.zeros((2, 4)))
