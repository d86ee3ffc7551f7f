"""Fitting a Gaussian mixture: weighted expectation-maximisation with shrunk covariances."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from library_store.mixture import Float, GaussianMixture


@dataclass(frozen=True)
class FitSettings:
    """How a mixture is fitted.

    ``shrinkage`` is the weight, in samples, of the mean within-component covariance in every
    component's; ``floor`` the least standard deviation along any direction.
    """

    n_components: int = 256
    n_iterations: int = 60
    shrinkage: float = 20.0
    floor: float = 0.02
    tolerance: float = 1e-4


def fit_mixture(
    samples: Float,
    sample_weights: Float,
    settings: FitSettings,
    rng: np.random.Generator,
    report: Callable[[int, float], None],
) -> tuple[GaussianMixture, Float]:
    """Fit a mixture to samples (n, D) of weights (n,); ``report(iteration, mean log p)``.

    Returns the mixture and the responsibilities (n, K) of its last expectation step.
    """
    n = len(samples)
    share = sample_weights / sample_weights.sum()
    responsibilities = _nearest_centres(samples, share, settings.n_components, rng)
    mixture = _maximise(samples, share * n, responsibilities, settings)
    before = -np.inf
    for iteration in range(settings.n_iterations):
        log_joint = mixture.joint_log_probability(samples)
        top = log_joint.max(axis=1, keepdims=True)
        log_total = top + np.log(np.exp(log_joint - top).sum(axis=1, keepdims=True))
        responsibilities = np.exp(log_joint - log_total)
        now = float(share @ log_total[:, 0])
        report(iteration, now)
        if now - before < settings.tolerance:
            break
        before = now
        mixture = _maximise(samples, share * n, responsibilities, settings)
    return mixture, responsibilities


def density_weights(samples: Float, radius: float, power: float) -> Float:
    """Weights (n,) that thin crowded regions of samples (n, D).

    A greedy cover puts a centre on every sample further than ``radius`` from all centres before it;
    a sample weighs (number of samples at its centre) ** -power: 0 keeps the crowd, 1 is as good as
    keeping one sample per centre.
    """
    centres = np.empty((0, samples.shape[1]))
    assigned = np.empty(len(samples), dtype=np.int64)
    for start in range(0, len(samples), 1024):
        block = samples[start : start + 1024]
        nearest, gap = _nearest(block, centres)
        fresh: list[int] = []
        for i in np.flatnonzero(gap > radius):
            if fresh:
                apart = np.linalg.norm(block[fresh] - block[i], axis=1)
                at = int(apart.argmin())
                if apart[at] <= radius:
                    nearest[i] = len(centres) + at
                    continue
            nearest[i] = len(centres) + len(fresh)
            fresh.append(int(i))
        centres = np.concatenate([centres, block[fresh]])
        assigned[start : start + 1024] = nearest
    crowd = np.bincount(assigned)[assigned].astype(np.float64)
    weights: Float = crowd**-power
    return weights


def _nearest(samples: Float, centres: Float) -> tuple[NDArray[np.int64], Float]:
    """Index of and distance to the nearest centre of each sample."""
    if not len(centres):
        return np.full(len(samples), -1, dtype=np.int64), np.full(len(samples), np.inf)
    squared = (
        (samples**2).sum(axis=1)[:, None] - 2.0 * samples @ centres.T + (centres**2).sum(axis=1)
    )
    index = squared.argmin(axis=1).astype(np.int64)
    return index, np.sqrt(np.maximum(squared[np.arange(len(samples)), index], 0.0))


def _nearest_centres(samples: Float, share: Float, k: int, rng: np.random.Generator) -> Float:
    """Hard responsibilities (n, k) after ten rounds of k-means from a weighted random start."""
    centres = samples[rng.choice(len(samples), size=k, replace=False, p=share)]
    one_hot = np.zeros((len(samples), k))
    for _ in range(10):
        index, _gap = _nearest(samples, centres)
        one_hot[:] = 0.0
        one_hot[np.arange(len(samples)), index] = 1.0
        mass = share @ one_hot
        moved = mass > 0
        centres[moved] = ((one_hot * share[:, None]).T @ samples)[moved] / mass[moved, None]
    return one_hot


def _maximise(
    samples: Float, weights: Float, responsibilities: Float, settings: FitSettings
) -> GaussianMixture:
    """Means, shrunk covariances and weights from responsibilities (n, K)."""
    k, d = responsibilities.shape[1], samples.shape[1]
    shares = responsibilities * weights[:, None]
    mass = shares.sum(axis=0) + 1e-9
    means = (shares.T @ samples) / mass[:, None]
    scatters = np.empty((k, d, d))
    for i in range(k):
        rows = np.flatnonzero(shares[:, i] > 1e-6)
        centred = samples[rows] - means[i]
        scatters[i] = (centred * shares[rows, i, None]).T @ centred
    pooled = scatters.sum(axis=0) / mass.sum()
    covariances = (scatters + settings.shrinkage * pooled) / (mass + settings.shrinkage)[
        :, None, None
    ]
    covariances += settings.floor**2 * np.eye(d)
    return GaussianMixture(
        weights=mass / mass.sum(), means=means, factors=np.linalg.cholesky(covariances)
    )
