"""Errors of 3D poses, as the literature measures them.

All functions are vectorised over leading dimensions (...), take float arrays in mm and return
per-joint errors (..., J), so that means, medians and subsets of joints are the caller's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from library_store.skeleton import L_HIP, R_HIP

Floats = npt.NDArray[np.float64]


def rigid_error_mm(predicted: Floats, truth: Floats) -> Floats:
    """Protocol 1: joint errors after the best rigid alignment (rotation, translation; no scale)."""
    return _distance(align(predicted, truth, scale=False), truth)


def root_centred_error_mm(predicted: Floats, truth: Floats) -> Floats:
    """Protocol 2: joint errors with both poses moved to their hip midpoints; nothing else."""
    return _distance(predicted - root(predicted), truth - root(truth))


def similarity_error_mm(predicted: Floats, truth: Floats) -> Floats:
    """PA-MPJPE: joint errors after the best similarity (rotation, translation, scale)."""
    return _distance(align(predicted, truth, scale=True), truth)


def root(joints: Floats) -> Floats:
    """Hip midpoints (..., 1, D) of poses (..., 14, D)."""
    midpoint: Floats = 0.5 * (joints[..., R_HIP, :] + joints[..., L_HIP, :])[..., None, :]
    return midpoint


def align(points: Floats, reference: Floats, *, scale: bool) -> Floats:
    """Procrustes: ``points`` moved onto ``reference``, both (..., J, D), by least squares.

    Never reflects. With ``scale`` the size is fitted too. Kabsch 1976, Umeyama 1991.
    """
    centre = points.mean(-2, keepdims=True)
    reference_centre = reference.mean(-2, keepdims=True)
    a, b = points - centre, reference - reference_centre
    u, singular, vt = np.linalg.svd(np.swapaxes(a, -1, -2) @ b)
    sign = np.ones_like(singular)
    sign[..., -1] = np.where(np.linalg.det(u @ vt) < 0, -1.0, 1.0)
    rotation = (u * sign[..., None, :]) @ vt
    size = np.ones(singular.shape[:-1])
    if scale:
        size = (singular * sign).sum(-1) / np.maximum((a**2).sum((-1, -2)), 1e-12)
    moved: Floats = size[..., None, None] * (a @ rotation) + reference_centre
    return moved


@dataclass(frozen=True)
class Summary:
    """Mean and median over people of each protocol's mean joint error, mm."""

    p1_mean: float
    p1_median: float
    p2_mean: float
    p2_median: float
    pa_mean: float
    pa_median: float


def summarise(predicted: Floats, truth: Floats, joints: npt.ArrayLike | None = None) -> Summary:
    """All protocols over (N, 14, 3) poses; ``joints`` restricts what is averaged, not aligned."""
    chosen = slice(None) if joints is None else np.asarray(joints)
    numbers: list[float] = []
    for error in (rigid_error_mm, root_centred_error_mm, similarity_error_mm):
        per_person = error(predicted, truth)[:, chosen].mean(-1)
        numbers += [float(per_person.mean()), float(np.median(per_person))]
    return Summary(*numbers)


def _distance(a: Floats, b: Floats) -> Floats:
    norm: Floats = np.sqrt(((a - b) ** 2).sum(-1))
    return norm
