"""Camera resectioning (eq. 5): the camera M* that best explains 2D joints by a given exemplar.

``M* = argmin_M Σ_j w_j ||M(X_j) - x_j||²`` over rotation and translation, the focal length being
known. Solved by Levenberg-Marquardt with the analytic Jacobian for any number of (joints, exemplar)
pairs at once, starting from the exemplar's library camera M_i.

All image coordinates here are normalised (focal length 1, principal point (0, 0)), all lengths mm,
``X_camera = rotation @ X_exemplar + translation``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from app.lifting.geometry import Floats, normalised_projection

_INITIAL_DAMPING = 1e-4
_NEAREST_TO_EXTENT = 1.05
"""The root stays at least this many times the exemplar's forward extent away from the camera."""


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


def initial_translation(rotated_mm: Floats, targets: Floats, weights: Floats) -> Floats:
    """Translation that projects already rotated points onto the targets, by linear least squares.

    ``x (Z + t_z) = X + t_x`` (and the same for y) is linear in t: scaled projection made exact for
    perspective. Weighted normal equations, solved in closed form.

    Args:
        rotated_mm: (..., J, 3) ``R @ X``, about the root.
        targets: (..., J, 2) normalised image coordinates.
        weights: (..., J), not all 0.

    Returns:
        (..., 3) mm, in front of the camera also when the joints say nothing about depth.

    """
    total = weights.sum(-1)
    shift = targets * rotated_mm[..., 2:] - rotated_mm[..., :2]
    mean_target = (weights[..., None] * targets).sum(-2) / total[..., None]
    mean_shift = (weights[..., None] * shift).sum(-2) / total[..., None]
    spread = weights[..., None] * (targets - mean_target[..., None, :])
    # The first two unknowns eliminated: t_xy = mean(shift) + mean(x) t_z.
    moment = (spread * targets).sum((-1, -2))
    depth = -(spread * shift).sum((-1, -2)) / np.maximum(moment, 1e-12)
    depth = np.maximum(depth, _nearest_depth(rotated_mm))
    return np.concatenate([mean_shift + mean_target * depth[..., None], depth[..., None]], axis=-1)


def resect(
    exemplars_mm: Floats,
    rotations: Floats,
    targets: Floats,
    weights: Floats,
    *,
    iterations: int = 6,
    robust_scale: Floats | float | None = None,
) -> Cameras:
    """Solve eq. 5 for a batch.

    Args:
        exemplars_mm: (..., J, 3) exemplar frame, about the root.
        rotations: (..., 3, 3) of the library cameras M_i, where the search starts.
        targets: (..., J, 2) observed joints, normalised image coordinates; broadcasts.
        weights: (..., J) in [0, 1], 0 = missing; broadcasts.
        iterations: Levenberg-Marquardt steps; each costs one Jacobian.
        robust_scale: None for least squares; else the residual (normalised image coordinates) at
            which a joint's pull is halved (Cauchy weights, re-evaluated at every step).

    Returns:
        The cameras; a step that would raise the cost is not taken.

    """
    lead = exemplars_mm.shape[:-2]
    joints = exemplars_mm.shape[-2]
    shape = (-1, joints)
    points = exemplars_mm.reshape(*shape, 3)
    observed = np.broadcast_to(targets, (*lead, joints, 2)).reshape(*shape, 2)
    base_weights = np.broadcast_to(weights, (*lead, joints)).reshape(shape)
    rotation = rotations.reshape(-1, 3, 3)
    rotated = points @ np.swapaxes(rotation, 1, 2)
    translation = initial_translation(rotated, observed, base_weights)
    damping = np.full(len(points), _INITIAL_DAMPING)
    residuals = normalised_projection(rotated + translation[:, None]) - observed
    for _ in range(iterations):
        weight = base_weights
        if robust_scale is not None:
            # IRLS: the weight of this step is held while the step is judged.
            weight = base_weights / (1.0 + (residuals**2).sum(-1) / robust_scale**2)
        cost = (weight[..., None] * residuals**2).sum((1, 2))
        jacobian = projection_jacobian(rotated, translation)
        step = _damped_step(jacobian, residuals, weight, damping)
        new_rotation = rotation_exponential(step[:, :3]) @ rotation
        new_rotated = points @ np.swapaxes(new_rotation, 1, 2)
        new_translation = translation + step[:, 3:]
        ahead = new_translation[:, 2] >= _nearest_depth(new_rotated)
        new_translation[~ahead] = translation[~ahead]
        new_residuals = normalised_projection(new_rotated + new_translation[:, None]) - observed
        new_cost = (weight[..., None] * new_residuals**2).sum((1, 2))
        better = ahead & (new_cost <= cost)
        damping = np.where(better, damping * 0.1, damping * 10.0)
        keep = better[:, None, None]
        rotation = np.where(keep, new_rotation, rotation)
        rotated = np.where(keep, new_rotated, rotated)
        residuals = np.where(keep, new_residuals, residuals)
        translation = np.where(better[:, None], new_translation, translation)
    return Cameras(
        rotation.reshape(*lead, 3, 3),
        translation.reshape(*lead, 3),
        (rotated + translation[:, None]).reshape(*lead, joints, 3),
        residuals.reshape(*lead, joints, 2),
    )


def projection_jacobian(rotated_mm: Floats, translation_mm: Floats) -> Floats:
    """Derivative of the normalised projection by the camera.

    The camera moves as ``exp([ω]×) R, t + τ``.

    Args:
        rotated_mm: (B, J, 3) ``R @ X``.
        translation_mm: (B, 3).

    Returns:
        (B, 6, 2, J): by (ω, τ), of (x, y).

    """
    px, py, pz = rotated_mm[..., 0], rotated_mm[..., 1], rotated_mm[..., 2]
    inverse = 1.0 / (pz + translation_mm[:, 2:])
    x = (px + translation_mm[:, 0:1]) * inverse
    y = (py + translation_mm[:, 1:2]) * inverse
    jacobian = np.empty((len(rotated_mm), 6, 2, rotated_mm.shape[1]))
    jacobian[:, 0, 0] = -x * py
    jacobian[:, 0, 1] = -pz - y * py
    jacobian[:, 1, 0] = pz + x * px
    jacobian[:, 1, 1] = y * px
    jacobian[:, 2, 0] = -py
    jacobian[:, 2, 1] = px
    jacobian[:, 3, 0] = 1.0
    jacobian[:, 3, 1] = 0.0
    jacobian[:, 4, 0] = 0.0
    jacobian[:, 4, 1] = 1.0
    jacobian[:, 5, 0] = -x
    jacobian[:, 5, 1] = -y
    jacobian *= inverse[:, None, None]
    return jacobian


def rotation_exponential(omega: Floats) -> Floats:
    """Rotation matrices (B, 3, 3) of rotation vectors (B, 3), by Rodrigues' formula."""
    angle = np.sqrt((omega**2).sum(-1))
    safe = np.maximum(angle, 1e-8)
    first = np.where(angle > 1e-8, np.sin(safe) / safe, 1.0)
    second = np.where(angle > 1e-8, (1.0 - np.cos(safe)) / safe**2, 0.5)
    skew = np.zeros((len(omega), 3, 3))
    skew[:, 0, 1], skew[:, 0, 2], skew[:, 1, 2] = -omega[:, 2], omega[:, 1], -omega[:, 0]
    skew -= np.swapaxes(skew, 1, 2)
    return np.eye(3) + first[:, None, None] * skew + second[:, None, None] * (skew @ skew)


def _damped_step(jacobian: Floats, residuals: Floats, weights: Floats, damping: Floats) -> Floats:
    """Solve (JᵀWJ + λ diag) δ = -JᵀWr for the batch; returns (B, 6)."""
    batch = len(jacobian)
    weighted = (jacobian * weights[:, None, None, :]).reshape(batch, 6, -1)
    normal = weighted @ np.swapaxes(jacobian.reshape(batch, 6, -1), 1, 2)
    gradient = weighted @ np.swapaxes(residuals, 1, 2).reshape(batch, -1, 1)
    diagonal = np.arange(6)
    curvature: Floats = normal[:, diagonal, diagonal]
    # The floor keeps the system solvable when the joints leave a direction undetermined.
    floor = 1e-12 * curvature.max(1, keepdims=True) * _UNIT_BALANCE + 1e-300
    normal[:, diagonal, diagonal] = curvature * (1.0 + damping[:, None]) + floor
    return np.asarray(-np.linalg.solve(normal, gradient)[..., 0], dtype=np.float64)


_UNIT_BALANCE = np.array([1.0, 1.0, 1.0, 1e-6, 1e-6, 1e-6])
"""Radians against millimetres: a radian moves a joint by about a metre."""


def _nearest_depth(rotated_mm: Floats) -> Floats:
    """Least root depth at which every joint is in front of the camera, with some margin."""
    extent: Floats = _NEAREST_TO_EXTENT * np.maximum(-rotated_mm[..., 2].min(-1), 50.0)
    return extent
