"""A Gaussian mixture with full covariances: drawing from it, and its likelihood."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


@dataclass(frozen=True)
class GaussianMixture:
    """K Gaussians in D dimensions.

    ``weights``: (K,), sum 1; ``means``: (K, D); ``factors``: (K, D, D), the lower Cholesky factors
    L of the covariances L L'.
    """

    weights: Float
    means: Float
    factors: Float

    @property
    def n_components(self) -> int:
        """K, the number of Gaussians."""
        return len(self.weights)

    def draw(self, components: NDArray[np.int64], rng: np.random.Generator) -> Float:
        """One sample from each of the given components (n,): (n, D)."""
        noise = rng.standard_normal((len(components), self.means.shape[1]))
        # einsum, not BLAS: the same bits whatever the number of threads.
        spread = np.einsum("nij,nj->ni", self.factors[components], noise)
        drawn: Float = self.means[components] + spread
        return drawn

    def joint_log_probability(self, samples: Float) -> Float:
        """log(weight_k N(x_n | k)) of samples (n, D): (n, K)."""
        dimensions = self.means.shape[1]
        result = np.empty((len(samples), self.n_components))
        for k, (mean, factor) in enumerate(zip(self.means, self.factors, strict=True)):
            whitened = (samples - mean) @ np.linalg.inv(factor).T
            log_volume = np.log(np.diagonal(factor)).sum()
            result[:, k] = -0.5 * np.einsum("nd,nd->n", whitened, whitened) - log_volume
        with np.errstate(divide="ignore"):
            result += np.log(self.weights) - 0.5 * dimensions * np.log(2.0 * np.pi)
        return result
