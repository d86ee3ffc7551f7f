"""From the spread of the fused posterior to a radius one can rely on.

Per joint, ``sigma_mm = factor_j · sqrt(spread² + floor²)`` is the radius that held 68% of the
root-relative errors of people the library was not fitted on; ``evaluation.calibration`` refits it.

What the constants here rest on: 750 people of five mocap subjects, all joints seen, at 0, 5 and 10
px of noise together, lifted with a library fitted without these subjects. On 750 other people *of
the same five subjects* the radius covers 73%, 67% and 65% at the three noise levels. On people of
another motion data set, who are of another build, it covers only 52%, 53% and 56%: the spread
knows nothing of body size, which a photo does not show. A given subject height scales the radius
with the answer but has not been calibrated for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from app.lifting.geometry import Floats


@dataclass(frozen=True)
class SigmaCalibration:
    """``factors`` (14,) and ``floor_mm``: see the module."""

    factors: tuple[float, ...]
    floor_mm: float

    def __call__(self, spread_mm: Floats) -> Floats:
        """(..., 14) posterior spread in mm -> (..., 14) 68% radius in mm."""
        return np.array(self.factors) * np.sqrt(spread_mm**2 + self.floor_mm**2)


FUSION_SIGMA = SigmaCalibration(
    factors=(
        1.005, 1.115, 1.118, 1.41, 1.37, 1.107, 1.232,
        1.274, 0.927, 1.175, 1.117, 0.927, 1.138, 1.107,
    ),
    floor_mm=0.0,
)  # fmt: skip
