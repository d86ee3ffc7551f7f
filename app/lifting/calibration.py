"""From the spread of the fused posterior to a radius one can rely on.

Per joint, ``sigma_mm = factor_j · sqrt(spread² + (noise_mm_per_px · ν)²)``, with ν the noise found
in the 2D joints, is the radius that held 68% of the root-relative errors of people the library was
not fitted on; ``evaluation.calibration`` refits it.

What the constants here rest on: 750 people of five mocap subjects, all joints seen, at 0, 5 and 10
px of noise together, lifted with a library and a lifting network fitted without these subjects. On
750 other people *of the same five subjects* the radius covers 72%, 66% and 67% at the three noise
levels. It knows nothing of body size, which a photo does not show, and covers less of people of
another build (docs/accuracy.md). Without the network (``POSEMATCH_LIFTER=off``) it was not
calibrated; nor for a given subject height, which scales the radius with the answer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from app.lifting.geometry import Floats


@dataclass(frozen=True)
class SigmaCalibration:
    """``factors`` (14,) and ``noise_mm_per_px``: see the module."""

    factors: tuple[float, ...]
    noise_mm_per_px: float

    def __call__(self, spread_mm: Floats, noise_px: Floats | float) -> Floats:
        """Posterior spread (..., 14) mm and noise (...) standard px -> 68% radius (..., 14) mm."""
        noise_mm = self.noise_mm_per_px * np.asarray(noise_px)[..., None]
        return np.array(self.factors) * np.sqrt(spread_mm**2 + noise_mm**2)


FUSION_SIGMA = SigmaCalibration(
    factors=(
        1.084, 1.15, 1.046, 1.281, 1.266, 1.072, 1.148,
        1.211, 0.678, 1.107, 1.111, 0.677, 1.061, 1.083,
    ),
    noise_mm_per_px=4.0,
)  # fmt: skip
