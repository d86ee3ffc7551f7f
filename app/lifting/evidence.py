"""How noisy the observed joints are, and whether one of them contradicts the others.

Both by the evidence of an *innovation* (observation minus what the local prior expects) under
``N(0, prior + ν² I)``: the noise ν² is weighed over a few levels, and leaving each joint out in
turn shows the one without which the rest make much more sense.
"""

from __future__ import annotations

import numpy as np

from app.lifting.compiled import compiled, pointer
from app.lifting.geometry import Floats

OUTLIER_SIGMA_PX = 80.0
"""Spread of a joint that is simply elsewhere, standard pixels: half an arm's length."""


class Evidence:
    """Evidence of an innovation (2 n,) for every noise level (L,) at once.

    The blocks of a level's precision give the evidence with any one joint left out (Schur
    complement). ``mean_noise_var`` is the posterior mean of ν², ``mean_precision`` (2 n, 2 n) that
    of ``(prior + ν² I)⁻¹``.
    """

    def __init__(self, prior: Floats, innovation: Floats, noise_var: Floats) -> None:
        size = len(innovation)
        if prior.shape != (size, size) or size % 2:
            raise ValueError("prior and innovation do not belong together")
        covariance = np.ascontiguousarray(prior, dtype=np.float64)
        seen = np.ascontiguousarray(innovation, dtype=np.float64)
        levels = np.ascontiguousarray(noise_var, dtype=np.float64)
        log_share = np.empty(len(levels))
        self._odds = np.empty(size // 2)
        self.mean_precision: Floats = np.empty((size, size))
        compiled().posematch_evidence(
            size,
            len(levels),
            pointer(covariance),
            pointer(seen),
            pointer(levels),
            OUTLIER_SIGMA_PX,
            pointer(log_share),
            pointer(self._odds),
            pointer(self.mean_precision),
        )
        self.mean_noise_var = float(np.exp(log_share) @ levels)

    def suspect(self, confidence: Floats, outlier_prior: float) -> int | None:
        """The joint (row of the seen ones) that is more probably elsewhere than noisy, if any.

        Compares "all joints are where they say" with "all but j, and j is anywhere within
        :data:`OUTLIER_SIGMA_PX`", each at its own noise level.
        """
        wrong = np.minimum(np.maximum(1.0 - confidence, outlier_prior), 1.0 - outlier_prior)
        odds = self._odds + np.log(wrong / (1.0 - wrong))
        worst = int(np.argmax(odds))
        return worst if odds[worst] > 0 else None
