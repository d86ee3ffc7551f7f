"""Camera resectioning (eq. 5): the camera M* that best explains 2D joints by a given exemplar.

``M* = argmin_M Σ_j w_j ||M(X_j) - x_j||²`` over rotation and translation, the focal length being
known. Solved by Levenberg-Marquardt with the analytic Jacobian for any number of (joints, exemplar)
pairs at once, starting from the exemplar's library camera M_i.

All image coordinates here are normalised (focal length 1, principal point (0, 0)), all lengths mm,
``X_camera = rotation @ X_exemplar + translation``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from app.lifting.compiled import compiled, pointer
from app.lifting.geometry import Floats

NEAREST_TO_EXTENT = 1.05
"""The root stays at least this many times the exemplar's forward extent away from the camera."""
LEAST_EXTENT_MM = 50.0
"""Of that extent itself."""


@dataclass(frozen=True)
class Cameras:
    """Resectioned cameras, leading shape (...).

    ``rotation`` (..., 3, 3); ``translation_mm`` (..., 3); ``points_mm`` (..., J, 3) the exemplars'
    joints in the camera frame; ``residuals`` (..., J, 2) projection minus observation, normalised
    image coordinates, unweighted.
    """

    rotation: Floats
    translation_mm: Floats
    points_mm: Floats
    residuals: Floats


def resect(
    exemplars_mm: Floats,
    rotations: Floats,
    targets: Floats,
    weights: Floats,
    *,
    iterations: int = 6,
) -> Cameras:
    """Solve eq. 5 for a batch.

    Args:
        exemplars_mm: (..., J, 3) exemplar frame, about the root.
        rotations: (..., 3, 3) of the library cameras M_i, where the search starts.
        targets: (..., J, 2) observed joints, normalised image coordinates; broadcasts.
        weights: (..., J) in [0, 1], 0 = missing; broadcasts.
        iterations: Levenberg-Marquardt steps; each costs one Jacobian.

    Returns:
        The cameras; a step that would raise the cost is not taken.

    """
    lead = exemplars_mm.shape[:-2]
    joints = exemplars_mm.shape[-2]
    points = np.ascontiguousarray(exemplars_mm, dtype=np.float64)
    start = np.ascontiguousarray(rotations, dtype=np.float64)
    shared = targets.ndim == 2 and weights.ndim == 1
    if not shared:
        targets = np.broadcast_to(targets, (*lead, joints, 2))
        weights = np.broadcast_to(weights, (*lead, joints))
    targets = np.ascontiguousarray(targets, dtype=np.float64)
    weights = np.ascontiguousarray(weights, dtype=np.float64)
    fits = targets.shape[-2:] == (joints, 2) and weights.shape[-1:] == (joints,)
    if start.shape != (*lead, 3, 3) or not fits:
        raise ValueError("exemplars, rotations, targets and weights do not belong together")
    rotation, translation = np.empty_like(start), np.empty((*lead, 3))
    placed, residuals = np.empty_like(points), np.empty((*lead, joints, 2))
    compiled().posematch_resect(
        math.prod(lead),
        joints,
        pointer(points),
        pointer(start),
        pointer(targets),
        pointer(weights),
        shared,
        iterations,
        NEAREST_TO_EXTENT,
        LEAST_EXTENT_MM,
        pointer(rotation),
        pointer(translation),
        pointer(placed),
        pointer(residuals),
    )
    return Cameras(rotation, translation, placed, residuals)
