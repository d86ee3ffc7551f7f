"""The posterior over the shortlist (eq. 4), with the optimal camera M* in place of M_i.

``P(X = X_i | x) ∝ exp(-‖M*_i(X_i) - x‖² / σ²)``. Residuals are measured in *standard pixels*, those
of a person shown at a fixed size (:data:`STANDARD_PX_PER_MM` at the person's depth), so that σ
means the same for a child far away and for a portrait. σ² is a sum: what the 2D is unsure of, per
joint, and what separates even the right exemplar from the person, a constant of the library. Both
are absolute: an exact hit divides by nothing, and a bad best match makes nobody look certain.
"""

from __future__ import annotations

import numpy as np

from app.lifting.geometry import Floats

STANDARD_PX_PER_MM = 0.25
"""Standard pixels a millimetre at the person's depth: 1.7 m of height are 425 standard pixels."""


def standard_px_per_unit(root_depth_mm: float) -> float:
    """Standard pixels in one normalised image unit for a person at this depth."""
    return STANDARD_PX_PER_MM * root_depth_mm


def shortlist_probabilities(
    residuals_px: Floats, weights: Floats, covariance_px2: Floats, sigma_library_px: float
) -> Floats:
    """Eq. 4 over a shortlist.

    Written as a Gaussian, ``exp(-½ Σ_j w_j r_jᵀ (C_j + σ_library² I)⁻¹ r_j)``: the paper's σ² is
    twice the variance.

    Args:
        residuals_px: (k, J, 2) projection by M* minus observation, standard pixels.
        weights: (J,) confidences, 0 = missing.
        covariance_px2: (J, 2, 2) of the observation, standard pixels².
        sigma_library_px: standard deviation of a residual coordinate of the right exemplar seen
            without noise.

    Returns:
        (k,) probabilities, summing to 1.

    """
    total = covariance_px2 + sigma_library_px**2 * np.eye(2)
    determinant = total[:, 0, 0] * total[:, 1, 1] - total[:, 0, 1] * total[:, 1, 0]
    x, y = residuals_px[..., 0], residuals_px[..., 1]
    squared = (
        total[:, 1, 1] * x**2 - (total[:, 0, 1] + total[:, 1, 0]) * x * y + total[:, 0, 0] * y**2
    ) / determinant
    log_likelihood = -0.5 * (weights * squared).sum(-1)
    unnormalised: Floats = np.exp(log_likelihood - log_likelihood.max())
    probabilities: Floats = unnormalised / unnormalised.sum()
    return probabilities
