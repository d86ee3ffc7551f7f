"""Rotations to test with."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


def rotation_exponential(vectors: Floats) -> Floats:
    """Rotation matrices (B, 3, 3) of rotation vectors (B, 3): the exponentials of [v]×."""
    angles = np.linalg.norm(vectors, axis=1)[:, None, None]
    axes = vectors / np.maximum(angles[:, 0], 1e-300)
    cross = np.cross(np.eye(3), axes[:, None, :])
    rotation: Floats = np.eye(3) + np.sin(angles) * cross + (1 - np.cos(angles)) * (cross @ cross)
    return rotation
