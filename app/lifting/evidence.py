"""How noisy the observed joints are, and whether one of them contradicts the others.

Both by the evidence of an *innovation* (observation minus what the local prior expects) under
``N(0, prior + ν² I)``: the noise ν² is weighed over a few levels, and leaving each joint out in
turn shows the one without which the rest make much more sense.
"""

from __future__ import annotations

import numpy as np

from app.lifting.geometry import Floats

OUTLIER_SIGMA_PX = 80.0
"""Spread of a joint that is simply elsewhere, standard pixels: half an arm's length."""


class Evidence:
    """Evidence of an innovation (2 n,) for every noise level (L,) at once.

    One eigendecomposition serves all levels, and the blocks of the precision give the evidence with
    any one joint left out (Schur complement). ``mean_noise_var`` is the posterior mean of ν²,
    ``mean_precision`` (2 n, 2 n) that of ``(prior + ν² I)⁻¹``.
    """

    def __init__(self, prior: Floats, innovation: Floats, noise_var: Floats) -> None:
        values, self._vectors = np.linalg.eigh(prior)
        total = np.maximum(values, 0.0) + noise_var[:, None]
        self._inverse = 1.0 / total
        self._rotated = innovation @ self._vectors
        log_evidence = -0.5 * (np.log(total) + self._rotated**2 * self._inverse).sum(1)
        log_evidence -= log_evidence.max()
        share = np.exp(log_evidence)
        self._log_share = log_evidence - np.log(share.sum())
        share /= share.sum()
        self.mean_noise_var = float(share @ noise_var)
        self.mean_precision: Floats = (self._vectors * (share @ self._inverse)) @ self._vectors.T

    def suspect(self, confidence: Floats, outlier_prior: float) -> int | None:
        """The joint (row of the seen ones) that is more probably elsewhere than noisy, if any.

        Compares "all joints are where they say" with "all but j, and j is anywhere within
        :data:`OUTLIER_SIGMA_PX`", each at its own noise level.
        """
        # The 2 x 2 blocks (a, b; b, c) of the precision, and the pull (p, q), at every level.
        x, y = self._vectors[0::2], self._vectors[1::2]
        a, b, c = self._inverse @ np.stack([x * x, x * y, y * y]).swapaxes(1, 2)
        pull = (self._rotated * self._inverse) @ self._vectors.T
        p, q = pull[:, 0::2], pull[:, 1::2]
        determinant = a * c - b * b
        # The residual about the prediction by the other joints is B⁻¹ times the pull.
        residual_x = (c * p - b * q) / determinant
        residual_y = (a * q - b * p) / determinant
        left_out = residual_x * p + residual_y * q
        # What the joint's own position would have cost as an outlier: a broad Gaussian about the
        # prediction by the others.
        elsewhere = (residual_x**2 + residual_y**2) * OUTLIER_SIGMA_PX**-2
        # Relative to the evidence of all joints, whose levels' shares sum to 1.
        without = 0.5 * (left_out - elsewhere - np.log(determinant)) + self._log_share[:, None]
        top = without.max(axis=0)
        wrong = np.minimum(np.maximum(1.0 - confidence, outlier_prior), 1.0 - outlier_prior)
        odds = np.log(np.exp(without - top).sum(axis=0)) + top
        odds += np.log(wrong / (1.0 - wrong)) - np.log(OUTLIER_SIGMA_PX**2)
        worst = int(np.argmax(odds))
        return worst if odds[worst] > 0 else None
