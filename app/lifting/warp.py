"""Warped exemplars (eq. 6): the exemplar's depths behind the observed 2D joints.

Everything is in the camera frame of the view the exemplar was resectioned in; image coordinates are
normalised (focal length 1, principal point (0, 0)). The soft warp, which trusts each joint only as
far as its noise allows, is part of the update in ``app.lifting.fusion``.
"""

from __future__ import annotations

import numpy as np

from app.lifting.geometry import Floats, Mask, lift_to_depth


def warp_weak_perspective(exemplar_mm: Floats, points: Floats, present: Mask) -> Floats:
    """The paper's warp: ``X* = [s x, s y, Z]`` with ``s = mean(Z) / f``.

    The mean depth is that of the exemplar placed by M*: the library camera's own distance would
    give the wrong scale whenever the person stands at another.

    Args:
        exemplar_mm: (..., J, 3) placed by M*.
        points: (..., J, 2) observed, normalised (so f = 1).
        present: (..., J) True where observed; elsewhere the exemplar's own joint is kept.

    Returns:
        (..., J, 3) mm.

    """
    depth = exemplar_mm[..., 2]
    scale = depth.mean(-1)[..., None, None]
    warped = np.concatenate([scale * points, depth[..., None]], axis=-1)
    return np.where(present[..., None], warped, exemplar_mm)


def warp_perspective(exemplar_mm: Floats, points: Floats, present: Mask) -> Floats:
    """Every observed joint on its own ray at the exemplar's depth: reprojects exactly.

    Arguments and result as :func:`warp_weak_perspective`.
    """
    warped = lift_to_depth(points, exemplar_mm[..., 2])
    return np.where(present[..., None], warped, exemplar_mm)
