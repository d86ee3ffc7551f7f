"""Percentage of correct keypoints: when a 2D joint counts as found."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from library_store.skeleton import L_HIP, L_SHOULDER, R_HIP, R_SHOULDER


def torso_px(joints: NDArray[np.floating]) -> NDArray[np.float64]:
    """The longer of the two shoulder-to-opposite-hip diagonals of (..., 14, 2): (...)."""
    right = np.linalg.norm(joints[..., R_SHOULDER, :] - joints[..., L_HIP, :], axis=-1)
    left = np.linalg.norm(joints[..., L_SHOULDER, :] - joints[..., R_HIP, :], axis=-1)
    longer: NDArray[np.float64] = np.maximum(right, left)
    return longer


def correct_keypoints(
    predicted: NDArray[np.floating], truth: NDArray[np.floating], threshold: float = 0.2
) -> NDArray[np.bool_]:
    """Which of (..., 14, 2) lie within ``threshold`` torso lengths of the truth: (..., 14)."""
    error = np.linalg.norm(predicted - truth, axis=-1)
    within: NDArray[np.bool_] = error <= threshold * torso_px(truth)[..., None]
    return within
