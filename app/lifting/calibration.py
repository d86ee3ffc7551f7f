"""From the spread of the fused posterior to a radius one can rely on.

Per joint, ``sigma_mm = factor_j · sqrt((1 + m·s)²·(spread² + (a·ν)²) + (b·d)² + (c·d_j)²)`` with a,
b, c and m the constants ``noise_mm_per_px``, ``person_doubt_mm``, ``joint_doubt_mm`` and
``missing_doubt``; ν the noise found in the 2D joints; d_j = 1 - confidence, the chance that a seen
joint is elsewhere (0 for a missing one), d its mean over the seen joints, and s the share of the
joints that are missing. The spread answers for noise; a left leg taken for the right one is no
noise, and joints of exchanged sides fit a pose, of somebody who faces the other way. What tells of
it is the network's own confidence. Nor does the spread tell all of what is missing: neighbours by
the arms alone are more alike than the people who hold their arms like that.

Factors and a (``evaluation.calibration`` refits them): the radius held 68% of the root-relative
errors of 750 people of five mocap subjects, all joints seen and sure, at 0, 5 and 10 px of noise
together, lifted with a library and a lifting network fitted without these subjects. On 750 other
people *of the same five subjects* it covers 72%, 66% and 67% at the three noise levels. It knows
nothing of body size, which a photo does not show, and covers less of people of another build
(docs/accuracy.md). Without the network (``POSEMATCH_LIFTER=off``) it was not calibrated; nor for a
given subject height, which scales the radius with the answer.

b and c (``evaluation.photo_sigma``): 600 rendered people in poses of the same subjects, turned and
tumbled, their joints found by the shipped CPM. On 590 others it covers 66%; 39% without b and c.

m (``evaluation.missing_joints``): people of those five subjects without ankles, hips, legs, arms,
one side, and so on; without m the radius covers half of the errors of who is stated down to the
waist.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from app.lifting.geometry import Floats


@dataclass(frozen=True)
class SigmaCalibration:
    """``factors`` (14,) and the constants in mm: see the module."""

    factors: tuple[float, ...]
    noise_mm_per_px: float
    person_doubt_mm: float = 0.0
    joint_doubt_mm: float = 0.0
    missing_doubt: float = 0.0

    def __call__(
        self, spread_mm: Floats, noise_px: Floats | float, confidence: Floats | None = None
    ) -> Floats:
        """The 68% radius (..., 14) mm.

        Args:
            spread_mm: (..., 14) posterior spread.
            noise_px: (...) noise found, standard pixels.
            confidence: (..., 14) the chance that a joint is where it was seen, 0 for missing ones;
                None when all are sure.

        """
        noise_mm = self.noise_mm_per_px * np.asarray(noise_px)[..., None]
        variance = spread_mm**2 + noise_mm**2
        if confidence is not None:
            seen = confidence > 0
            growth = 1.0 + self.missing_doubt * (1.0 - seen.mean(-1, keepdims=True))
            doubt = np.where(seen, 1.0 - confidence, 0.0)
            of_person = doubt.sum(-1, keepdims=True) / np.maximum(seen.sum(-1, keepdims=True), 1)
            variance = growth**2 * variance + (self.person_doubt_mm * of_person) ** 2
            variance = variance + (self.joint_doubt_mm * doubt) ** 2
        return np.array(self.factors) * np.sqrt(variance)


FUSION_SIGMA = SigmaCalibration(
    factors=(
        1.084, 1.15, 1.046, 1.281, 1.266, 1.072, 1.148,
        1.211, 0.678, 1.107, 1.111, 0.677, 1.061, 1.083,
    ),
    noise_mm_per_px=4.0,
    person_doubt_mm=600.0,
    joint_doubt_mm=300.0,
    missing_doubt=0.6,
)  # fmt: skip
