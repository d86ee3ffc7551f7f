import numpy as np
import pytest

from app.lifting.geometry import (
    centre_view,
    lift_to_depth,
    normalised_projection,
    project,
    rotation_onto_axis,
)
from library_store.skeleton import HEAD_TOP, L_HIP, L_SHOULDER, NECK, R_HIP, R_SHOULDER
from library_store.upright import MOST_LEAN, lean_rad

RNG = np.random.default_rng(0)


def test_lifting_to_its_depth_undoes_projection() -> None:
    points = RNG.normal(size=(50, 14, 3)) * 500 + [0, 0, 4000]
    principal = np.array([319.5, 239.5])
    pixels = project(points, 900.0, principal)
    lifted = lift_to_depth((pixels - principal) / 900.0, points[..., 2])
    np.testing.assert_allclose(lifted, points)


@pytest.mark.parametrize("direction", [[0.0, 0.0, 1.0], [0.7, -0.2, 1.0], [-3.0, 2.0, 0.01]])
def test_rotation_onto_axis_is_a_rotation_onto_the_axis(direction: list[float]) -> None:
    rotation = rotation_onto_axis(np.array(direction))
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    turned = rotation @ direction
    np.testing.assert_allclose(turned[:2], 0.0, atol=1e-12)
    assert turned[2] > 0


def test_centred_view_is_what_a_turned_camera_sees() -> None:
    points = RNG.normal(size=(14, 3)) * 400 + [2500, -700, 4000]
    principal = np.array([320.0, 240.0])
    view = centre_view(project(points, 800.0, principal), np.ones(14), None, 800.0, principal)
    turned = points @ view.rotation.T
    np.testing.assert_allclose(normalised_projection(turned), view.points, atol=1e-12)
    np.testing.assert_allclose(view.to_photo(turned), points, atol=1e-9)
    assert np.abs(view.points.mean(0)).max() < 0.03


def standing() -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """(14, 2) pixels, y down."""
    points = RNG.normal(size=(14, 2)) * 60
    points[[HEAD_TOP, NECK, R_SHOULDER, L_SHOULDER]] = [
        [2, -170],
        [0, -120],
        [-40, -100],
        [40, -99],
    ]
    points[[R_HIP, L_HIP]] = [[-25, 0], [25, 1]]
    return points


def leaning(
    points: np.ndarray[tuple[int, int], np.dtype[np.float64]], angle: float
) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    cos, sin = np.cos(angle), np.sin(angle)
    turned: np.ndarray[tuple[int, int], np.dtype[np.float64]] = points @ [[cos, sin], [-sin, cos]]
    return turned


def test_who_lies_is_seen_upright_whatever_the_cameras_roll() -> None:
    person, weights, origin = standing(), np.ones(14), np.zeros(2)
    upright = centre_view(person, weights, None, 800.0, origin)
    covariance = np.broadcast_to(np.diag([4.0, 1.0]), (14, 2, 2))
    for angle in (0.7, -1.6, 3.1):
        lying = leaning(person, angle)
        view = centre_view(lying, weights, covariance, 800.0, origin)
        assert lean_rad(view.points, weights > 0) == pytest.approx(0.0, abs=0.01)
        again = centre_view(leaning(lying, 1.0), weights, None, 800.0, origin)
        if abs(np.angle(np.exp(1j * (angle + 1.0)))) > MOST_LEAN:
            np.testing.assert_allclose(again.points, view.points, atol=1e-9)
        np.testing.assert_allclose(view.rotation @ view.rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(view.rotation) == pytest.approx(1.0)
        # What was uncertain along the photo's rows is so along what they have become.
        assert view.covariance is not None
        row = view.rotation[:2, 0] / np.linalg.norm(view.rotation[:2, 0])
        ratio = (row @ view.covariance[0] @ row) / np.trace(view.covariance[0])
        assert ratio == pytest.approx(0.8, abs=0.03)
    slightly = centre_view(leaning(person, 0.9 * MOST_LEAN), weights, None, 800.0, origin)
    assert abs(lean_rad(slightly.points, weights > 0)) > 0.8 * MOST_LEAN
    assert np.abs(upright.points - slightly.points).max() > 0.01


def test_missing_joints_do_not_move_the_view() -> None:
    pixels = RNG.normal(size=(14, 2)) * 100 + 500
    weights = np.ones(14)
    weights[3] = 0.0
    elsewhere = pixels.copy()
    elsewhere[3] = np.nan
    views = [centre_view(p, weights, None, 800.0, np.zeros(2)) for p in (pixels, elsewhere)]
    np.testing.assert_array_equal(views[0].points, views[1].points)


def test_the_covariance_of_a_missing_joint_is_not_looked_at() -> None:
    pixels, weights = RNG.normal(size=(14, 2)) * 100 + 500, np.ones(14)
    covariance = np.tile(4.0 * np.eye(2), (14, 1, 1))
    weights[3], covariance[3] = 0.0, np.nan
    view = centre_view(pixels, weights, covariance, 800.0, np.zeros(2))
    assert view.covariance is not None
    assert np.isfinite(view.covariance).all()
    np.testing.assert_array_equal(view.covariance[3], 0.0)


def test_covariance_is_carried_to_the_centred_view() -> None:
    pixels = RNG.normal(size=(14, 2)) * 80 + [900, -300]
    covariance = np.broadcast_to(np.array([[9.0, 2.0], [2.0, 4.0]]), (14, 2, 2))
    principal = np.zeros(2)
    view = centre_view(pixels, np.ones(14), covariance, 700.0, principal)
    assert view.covariance is not None
    noise = RNG.multivariate_normal([0, 0], covariance[0], size=(20_000,))
    moved = np.concatenate([(pixels[5] + noise) / 700.0, np.ones((len(noise), 1))], axis=1)
    turned = moved @ view.rotation.T
    measured = np.cov((turned[:, :2] / turned[:, 2:]).T)
    np.testing.assert_allclose(view.covariance[5], measured, rtol=0.06, atol=1e-7)
