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


def up_to_y(up: str) -> Float:
    """The rotation (3, 3) that takes the axis ``up``, one of "+X", "-X" ... "Z", to +Y.

    Raises ``ValueError`` for anything else.
    """
    sign, letter = up[:-1], up[-1:].upper()
    if sign not in ("", "+", "-") or letter not in ("X", "Y", "Z"):
        raise ValueError(f"{up!r} is not an axis such as +Z")
    if letter == "Y" and sign != "-":
        return np.eye(3)
    y = np.zeros(3)
    y["XYZ".index(letter)] = -1.0 if sign == "-" else 1.0
    x = np.array([0.0, 1.0, 0.0]) if letter == "X" else np.array([1.0, 0.0, 0.0])
    return np.stack([x, y, np.cross(x, y)])
