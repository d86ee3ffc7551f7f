import numpy as np
import pytest

from app.lifting.posterior import shortlist_probabilities

RNG = np.random.default_rng(3)
COVARIANCE = np.broadcast_to(9.0 * np.eye(2), (14, 2, 2))


def test_sums_to_one_and_orders_by_residual() -> None:
    residuals = RNG.normal(size=(30, 14, 2)) * np.linspace(1, 20, 30)[:, None, None]
    probabilities = shortlist_probabilities(residuals, np.ones(14), COVARIANCE, 4.0)
    assert probabilities.sum() == pytest.approx(1.0)
    order = np.argsort((residuals**2).sum((1, 2)))
    assert (np.diff(probabilities[order]) <= 0).all()


def test_is_equation_4() -> None:
    residuals = RNG.normal(size=(6, 14, 2)) * 3
    squared = (residuals**2).sum((1, 2))
    # The paper's sigma² is twice the variance, here 9 + 16.
    expected = np.exp(-squared / (2 * 25.0))
    probabilities = shortlist_probabilities(residuals, np.ones(14), COVARIANCE, 4.0)
    np.testing.assert_allclose(probabilities, expected / expected.sum())


def test_an_exact_hit_without_noise_is_finite() -> None:
    residuals = np.zeros((3, 14, 2))
    residuals[1:] = 500.0
    probabilities = shortlist_probabilities(residuals, np.ones(14), np.zeros((14, 2, 2)), 4.0)
    np.testing.assert_allclose(probabilities, [1, 0, 0])


def test_far_candidates_are_not_made_to_look_certain_by_being_relative() -> None:
    # All are far; the differences between them are within sigma.
    residuals = np.full((5, 14, 2), 40.0) + np.linspace(0, 0.05, 5)[:, None, None]
    probabilities = shortlist_probabilities(residuals, np.ones(14), COVARIANCE, 9.0)
    assert probabilities.max() < 0.3


def test_missing_joints_and_anisotropic_noise() -> None:
    covariance = np.broadcast_to(np.array([[400.0, 0.0], [0.0, 1.0]]), (14, 2, 2))
    residuals = np.zeros((3, 14, 2))
    residuals[0, :, 0] = 5.0
    residuals[1, :, 1] = 5.0
    residuals[2, 7] = 1e6
    weights = np.ones(14)
    weights[7] = 0.0
    probabilities = shortlist_probabilities(residuals, weights, covariance, 1.0)
    assert probabilities[2] > probabilities[0] > probabilities[1]


def test_noise_in_any_direction_is_measured_by_its_inverse() -> None:
    """Joints whose errors run along a slanting line, each along another."""
    factors = RNG.normal(size=(14, 2, 2))
    covariance = factors @ np.swapaxes(factors, 1, 2)
    residuals, weights = RNG.normal(size=(5, 14, 2)), RNG.uniform(size=14)
    inverse = np.linalg.inv(covariance + 0.5**2 * np.eye(2))
    squared = np.einsum("j,kja,jab,kjb->k", weights, residuals, inverse, residuals)
    expected = np.exp(-0.5 * squared)
    probabilities = shortlist_probabilities(residuals, weights, covariance, 0.5)
    np.testing.assert_allclose(probabilities, expected / expected.sum())
