from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose
from scipy.stats import multivariate_normal

from library_store.mixture import GaussianMixture
from library_store.mixture_fit import FitSettings, density_weights, fit_mixture


def two_gaussians() -> GaussianMixture:
    return GaussianMixture(
        weights=np.array([0.25, 0.75]),
        means=np.array([[-3.0, 0.0], [2.0, 1.0]]),
        factors=np.array([[[1.0, 0.0], [0.4, 0.3]], [[0.5, 0.0], [-0.2, 0.8]]]),
    )


def draw(mixture: GaussianMixture, n: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    return mixture.draw(rng.choice(2, size=n, p=mixture.weights), rng)


def test_log_probability_against_scipy() -> None:
    mixture = two_gaussians()
    samples = draw(mixture, 50)
    expected = [
        np.log(weight) + multivariate_normal(mean, factor @ factor.T).logpdf(samples)
        for weight, mean, factor in zip(
            mixture.weights, mixture.means, mixture.factors, strict=True
        )
    ]
    assert_allclose(mixture.joint_log_probability(samples), np.stack(expected, axis=1))


def test_a_fit_finds_the_mixture_again() -> None:
    truth = two_gaussians()
    samples = draw(truth, 4000)
    heard: list[float] = []
    settings = FitSettings(n_components=2, n_iterations=40, shrinkage=0.0, floor=1e-3)
    fitted, responsibilities = fit_mixture(
        samples,
        np.ones(len(samples)),
        settings,
        np.random.default_rng(1),
        lambda _iteration, value: heard.append(value),
    )
    order = np.argsort(fitted.means[:, 0])
    assert_allclose(fitted.weights[order], truth.weights, atol=0.03)
    assert_allclose(fitted.means[order], truth.means, atol=0.1)
    covariances = fitted.factors @ np.swapaxes(fitted.factors, 1, 2)
    expected = truth.factors @ np.swapaxes(truth.factors, 1, 2)
    assert_allclose(covariances[order], expected, atol=0.1)
    assert_allclose(responsibilities.sum(axis=1), 1.0)
    assert np.all(np.diff(heard) > -1e-6), "expectation-maximisation never gets worse"


def test_sample_weights_count_like_copies() -> None:
    samples = draw(two_gaussians(), 600)
    weights = np.where(samples[:, 0] > 0, 2.0, 1.0)
    settings = FitSettings(n_components=1, n_iterations=2, shrinkage=0.0, floor=0.0)
    weighted, _ = fit_mixture(samples, weights, settings, np.random.default_rng(0), lambda *_: None)
    copies = np.repeat(samples, weights.astype(int), axis=0)
    assert_allclose(weighted.means[0], copies.mean(axis=0))
    factor = weighted.factors[0]
    assert_allclose(factor @ factor.T, np.cov(copies, rowvar=False, bias=True), rtol=1e-6)


def test_crowds_weigh_less() -> None:
    crowd, loner = np.zeros((99, 3)), np.full((1, 3), 5.0)
    samples = np.concatenate([crowd, loner])
    assert_allclose(density_weights(samples, 0.5, 0.0), 1.0)
    flat = density_weights(samples, 0.5, 1.0)
    assert_allclose(flat[:99].sum(), flat[99])
