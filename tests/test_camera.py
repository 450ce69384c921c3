"""Pixels to rays to directions: independent forward models, hand-computed corners."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mclass import camera, transforms
from mclass.camera import Calibrations
from mclass.errors import ModelError
from mclass.records import FloatArray

INTRINSICS = np.array([[500.0, 400.0, 320.0, 230.0]])
PLUMB_BOB = np.array([[-0.3, 0.12, 0.001, -0.002, -0.03]])
RATIONAL = np.array([[0.5, -0.2, 0.0007, 0.0004, 0.01, 0.8, -0.1, 0.02]])
FISHEYE = np.array([[0.05, -0.01, 0.004, -0.001]])


def calibrations(model: str, coefficients: FloatArray) -> Calibrations:
    return Calibrations(model, INTRINSICS, coefficients, np.array([[640.0, 480.0]]))


def rays_of(model: str, coefficients: FloatArray, pixels: FloatArray) -> FloatArray:
    rows = np.zeros(len(pixels), np.int64)
    rays, valid = camera.pixel_rays(calibrations(model, coefficients), rows, pixels)
    assert valid.all()
    return rays


def opencv_pixel(ray: FloatArray, k: FloatArray) -> tuple[float, float]:
    """The published projection, written out once more for one ray."""
    k1, k2, p1, p2, k3, k4, k5, k6 = [*k, 0.0, 0.0, 0.0][:8]
    x, y = ray[0] / ray[2], ray[1] / ray[2]
    r2 = x**2 + y**2
    scale = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    xd = x * scale + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    yd = y * scale + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    return 500.0 * xd + 320.0, 400.0 * yd + 230.0


def test_a_pinhole_pixel_by_hand() -> None:
    rays = rays_of("", np.zeros((1, 0)), np.array([[320.0, 230.0], [820.0, 630.0]]))
    np.testing.assert_allclose(rays, [[0, 0, 1], np.ones(3) / np.sqrt(3)], atol=1e-15)


@pytest.mark.parametrize(
    ("model", "coefficients"), [("plumb_bob", PLUMB_BOB), ("rational_polynomial", RATIONAL)]
)
@given(x=st.floats(-0.8, 0.8), y=st.floats(-0.6, 0.6))
def test_brown_conrady_is_undone(model: str, coefficients: FloatArray, x: float, y: float) -> None:
    ray = np.array([x, y, 1.0])
    pixel = opencv_pixel(ray, coefficients[0])
    found = rays_of(model, coefficients, np.array([pixel]))[0]
    np.testing.assert_allclose(found, ray / np.linalg.norm(ray), atol=1e-10)


def test_thin_prism_terms_are_undone() -> None:
    coefficients = np.array([[0.1, 0, 0, 0, 0, 0.05, 0, 0, 0.002, -0.001, 0.003, 0.0005, 0, 0]])
    ideal = np.array([[0.4, -0.3], [0.0, 0.5]])
    r2 = np.sum(ideal**2, axis=1)
    moved = ideal * ((1 + 0.1 * r2) / (1 + 0.05 * r2))[:, None]
    moved[:, 0] += 0.002 * r2 - 0.001 * r2**2
    moved[:, 1] += 0.003 * r2 + 0.0005 * r2**2
    pixels = moved * [500.0, 400.0] + [320.0, 230.0]
    rays = rays_of("rational_polynomial", coefficients, pixels)
    np.testing.assert_allclose(rays[:, :2] / rays[:, 2:], ideal, atol=1e-10)


def test_a_tilted_sensor_is_refused() -> None:
    coefficients = np.zeros((1, 14))
    coefficients[0, 12] = 0.01
    with pytest.raises(ModelError, match="12"):
        rays_of("rational_polynomial", coefficients, np.array([[1.0, 1.0]]))


@pytest.mark.parametrize("model", ["equidistant", "fisheye", "kannala_brandt"])
@given(theta=st.floats(0.0, 1.9), around=st.floats(-np.pi, np.pi))
def test_a_fisheye_sees_behind_itself(model: str, theta: float, around: float) -> None:
    k1, k2, k3, k4 = FISHEYE[0]
    radius = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)
    pixel = [500 * radius * np.cos(around) + 320, 400 * radius * np.sin(around) + 230]
    found = rays_of(model, FISHEYE, np.array([pixel]))[0]
    expected = [np.sin(theta) * np.cos(around), np.sin(theta) * np.sin(around), np.cos(theta)]
    np.testing.assert_allclose(found, expected, atol=1e-10)


def test_pixels_that_no_ray_reaches_are_named() -> None:
    # With k1 = -0.3 alone the distorted radius r - 0.3 r³ never exceeds 0.7027.
    strong = calibrations("plumb_bob", np.array([[-0.3, 0, 0, 0, 0.0]]))
    pixels = np.array([[320 + 500 * 0.70, 230.0], [320 + 500 * 0.71, 230.0], [np.nan, 3.0]])
    _, valid = camera.pixel_rays(strong, np.zeros(3, np.int64), pixels)
    assert valid.tolist() == [True, False, False]
    bent = calibrations("fisheye", np.array([[-0.2, 0, 0, 0.0]]))
    top = np.sqrt(1 / 0.6) * (1 - 0.2 / 0.6)
    pixels = np.array([[320 + 500 * (top - 0.01), 230.0], [320 + 500 * (top + 0.01), 230.0]])
    _, valid = camera.pixel_rays(bent, np.zeros(2, np.int64), pixels)
    assert valid.tolist() == [True, False]


@settings(max_examples=200)
@example([0.0, 0.0, 0.0, 0.0, 0.0, -2.9999999999999996], 0.0, 0.5)  # steps onto a pole
@given(
    st.lists(st.floats(-3, 3), min_size=5, max_size=8), st.floats(-400, 1000), st.floats(-400, 900)
)
def test_whatever_the_coefficients_a_valid_ray_projects_to_its_pixel(
    k: list[float], u: float, v: float
) -> None:
    pixels = np.array([[u, v]])
    rays, valid = camera.pixel_rays(
        calibrations("rational_polynomial", np.array([k])), np.zeros(1, np.int64), pixels
    )
    assert np.isfinite(rays).all()
    if valid[0]:
        assert opencv_pixel(rays[0], np.array(k)) == pytest.approx((u, v), abs=1e-4)


def test_each_pixel_uses_its_own_calibration() -> None:
    two = Calibrations(
        "plumb_bob",
        np.array([[500.0, 500, 320, 240], [0.0, 500, 320, 240], [250.0, 500, 320, 240]]),
        np.zeros((3, 5)),
        np.full((3, 2), 640.0),
    )
    pixels = np.full((3, 2), [570.0, 240.0])
    rays, valid = camera.pixel_rays(two, np.array([2, 0, 1]), pixels)
    assert valid.tolist() == [True, True, False]
    np.testing.assert_allclose(rays[:2, 0] / rays[:2, 2], [1.0, 0.5])


def test_an_unknown_distortion_model_is_refused_by_name() -> None:
    with pytest.raises(ModelError, match="'magic'"):
        rays_of("magic", np.zeros((1, 5)), np.array([[1.0, 1.0]]))
    assert not camera.is_known_model("magic")
    assert camera.is_known_model("Plumb_Bob")


def test_a_camera_that_looks_down_sees_edges_further_apart_on_the_ground() -> None:
    pitched = transforms.from_roll_pitch_yaw(np.array([0.0, np.pi / 3, 0.5]))
    optical = transforms.multiply(pitched, transforms.OPTICAL_ROTATION)
    ray = np.array([-0.5, 0.0, 1.0])  # half a unit to the left of the axis
    azimuth, level = camera.ray_azimuths(optical, ray)
    # On the ground the axis is foreshortened to cos 60° = 1/2: a slope of 1/2 becomes 1.
    assert azimuth == pytest.approx(0.5 + np.pi / 4)
    assert level


def test_a_vertical_ray_has_no_direction() -> None:
    down = transforms.from_roll_pitch_yaw(np.array([0.0, np.pi / 2, 0.0]))
    optical = transforms.multiply(down, transforms.OPTICAL_ROTATION)
    _, level = camera.ray_azimuths(optical, np.array([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0]]))
    assert level.tolist() == [False, True]


def test_edges_are_ordered_around_the_centre() -> None:
    first = np.array([0.2, -0.2, 3.0, 0.5, 2.0])
    second = np.array([-0.2, 0.2, -3.0, 0.5, -2.0])
    center = np.array([0.0, 0.0, np.pi, 0.5, 0.0])
    expected = [[-0.2, 0.2], [-0.2, 0.2], [3.0, -3.0], [0.5, 0.5], [-2.0, 2.0]]
    np.testing.assert_array_equal(camera.order_edges(first, second, center), expected)
    rounded = camera.order_edges(np.array([0.5]), np.array([0.5]), np.array([0.5 - 1e-15]))
    np.testing.assert_array_equal(rounded, [[0.5, 0.5]])
