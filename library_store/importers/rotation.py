"""Euler angles to matrices, for skeletons that store rotations."""

from __future__ import annotations

import numpy as np

from library_store.importers.clip import Float


def about_axis(axis: str, degrees: Float) -> Float:
    """Rotation matrices (..., 3, 3) about "x", "y" or "z" by angles (...) in degrees.

    Column vectors: ``matrix @ v`` turns v anticlockwise seen from the axis' tip.
    """
    radians = np.deg2rad(np.asarray(degrees, dtype=np.float64))
    cosine, sine = np.cos(radians), np.sin(radians)
    k = "xyz".index(axis)
    i, j = (k + 1) % 3, (k + 2) % 3
    matrix = np.zeros((*radians.shape, 3, 3))
    matrix[..., k, k] = 1.0
    matrix[..., i, i] = matrix[..., j, j] = cosine
    matrix[..., i, j], matrix[..., j, i] = -sine, sine
    return matrix


def euler(axes: str, degrees: Float) -> Float:
    """Products R_axes[0] @ R_axes[1] @ ... (..., 3, 3) of angles (..., len(axes)) in degrees."""
    degrees = np.asarray(degrees, dtype=np.float64)
    matrix = np.broadcast_to(np.eye(3), (*degrees.shape[:-1], 3, 3)).copy()
    for i, axis in enumerate(axes):
        matrix = matrix @ about_axis(axis, degrees[..., i])
    return matrix
