"""Camera resectioning (eq. 5): the camera M* that best explains 2D joints by a given exemplar.

``M* = argmin_M Σ_j w_j ||M(X_j) - x_j||²`` over rotation and translation, the focal length being
known. Solved by Levenberg-Marquardt with the analytic Jacobian for any number of (joints, exemplar)
pairs at once, starting from the exemplar's library camera M_i.

All image coordinates here are normalised (focal length 1, principal point (0, 0)), all lengths mm,
``X_camera = rotation @ X_exemplar + translation``.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from app.lifting.geometry import Floats

_NEAREST_TO_EXTENT = 1.05
"""The root stays at least this many times the exemplar's forward extent away from the camera."""
_LEAST_EXTENT_MM = 50.0
_COMPILED = Path(__file__).with_name("_resection.so")


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
        rotated_mm: (..., 3, J) ``R @ X``, about the root.
        targets: (..., J, 2) normalised image coordinates.
        weights: (..., J), not all 0.

    Returns:
        (..., 3) mm, in front of the camera also when the joints say nothing about depth.

    """
    share = weights / weights.sum(-1, keepdims=True)
    moment = share[..., None] * targets
    mean_target = moment.sum(-2)
    spread = moment - share[..., None] * mean_target[..., None, :]
    own = (spread * targets).sum(-1)
    # With shift = x Z - X all that is needed is linear in the points: mean(shift) and the
    # spread's moment with it.
    loads = np.zeros((*own.shape[:-1], 3, own.shape[-1], 3))
    loads[..., 0, :, 0] = loads[..., 1, :, 1] = -share
    loads[..., :2, :, 2] = -np.swapaxes(spread, -1, -2)
    loads[..., 2, :, :2] = moment
    loads[..., 2, :, 2] = own
    loads = loads.reshape(*loads.shape[:-3], -1, 3)
    flat = rotated_mm.reshape(*rotated_mm.shape[:-2], -1)
    shared = loads.ndim == 2
    moments = flat @ loads if shared else (flat[..., None, :] @ loads)[..., 0, :]
    # The first two unknowns eliminated: t_xy = mean(shift) + mean(x) t_z.
    depth = -moments[..., 2] / np.maximum(own.sum(-1), 1e-12)
    moments[..., 2] = np.maximum(depth, _nearest_depth(rotated_mm))
    moments[..., :2] += mean_target * moments[..., 2:]
    return moments


def resect(
    exemplars_mm: Floats,
    rotations: Floats,
    targets: Floats,
    weights: Floats,
    *,
    iterations: int = 6,
    robust_scale: float | None = None,
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
    points = np.ascontiguousarray(exemplars_mm, dtype=np.float64)
    rotation = np.array(rotations, dtype=np.float64, order="C")
    shared = targets.ndim == 2 and weights.ndim == 1
    if not shared:
        targets = np.broadcast_to(targets, (*lead, joints, 2))
        weights = np.broadcast_to(weights, (*lead, joints))
    targets = np.ascontiguousarray(targets, dtype=np.float64)
    weights = np.ascontiguousarray(weights, dtype=np.float64)
    fits = targets.shape[-2:] == (joints, 2) and weights.shape[-1:] == (joints,)
    if rotation.shape != (*lead, 3, 3) or not fits:
        raise ValueError("exemplars, rotations, targets and weights do not belong together")
    rotated = rotation @ np.swapaxes(points, -1, -2)
    translation = np.ascontiguousarray(initial_translation(rotated, targets, weights))
    placed, residuals = np.empty_like(points), np.empty((*lead, joints, 2))
    _compiled()(
        math.prod(lead),
        joints,
        points.ctypes.data,
        targets.ctypes.data,
        weights.ctypes.data,
        shared,
        iterations,
        robust_scale or 0.0,
        _NEAREST_TO_EXTENT,
        _LEAST_EXTENT_MM,
        rotation.ctypes.data,
        translation.ctypes.data,
        placed.ctypes.data,
        residuals.ctypes.data,
    )
    return Cameras(rotation, translation, placed, residuals)


@cache
def _compiled() -> Callable[..., None]:
    """The loop of resection.cpp. It runs without Python's lock."""
    try:
        loop = ctypes.CDLL(str(_COMPILED)).posematch_resect
    except OSError as error:
        raise ImportError(
            f"{_COMPILED} cannot be loaded ({error}); install posematch again: `scripts/setup`, "
            "or pip, compiles it"
        ) from error
    array, number, real = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double
    loop.argtypes = [
        *(number, number, array, array, array, ctypes.c_int, number, real, real, real),
        *(array, array, array, array),
    ]
    loop.restype = None
    resection: Callable[..., None] = loop
    return resection


def _nearest_depth(rotated_mm: Floats) -> Floats:
    """Least root depth at which every joint is in front of the camera, with some margin."""
    behind = np.maximum(-rotated_mm[..., 2, :].min(-1), _LEAST_EXTENT_MM)
    extent: Floats = _NEAREST_TO_EXTENT * behind
    return extent
