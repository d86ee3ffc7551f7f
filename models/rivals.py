"""Whose joint is it: what the marginals of several people in a photo say of one another.

People who overlap are seen in each other's crops, and the network takes the neighbour's wrist for
that of the person it looks at. But one place shows one wrist, left or right, and of whoever it
belongs to the network is surer. With b_i the belief that person i shows the joint at all and q_i
how much of its marginal p_i lies near a place x of the photo (``pooled``: near in the measure of
the own crop, so that large and small people claim alike), the claims and the shares are

    c_i(x) = b_i q_i(x)        share_i(x) = c_i(x) / Σ_k c_k(x)

A marginal times the share is what is left to the person. It is done twice: who has lost a place no
longer claims it from anybody.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from library_store.skeleton import LSP14
from models.heatmaps import Floats, Maps, pooled

ROUNDS = 2
_MIRROR = np.array(LSP14.mirror)
_KIND, _KIND_OF = np.unique(np.minimum(np.arange(LSP14.n_joints), _MIRROR), return_inverse=True)
"""One joint of each kind, and each joint's kind: left and right are one."""
_TINY = np.float32(1e-12)


def shares(p: Maps, belief: Floats, scale: Floats, origin_px: Floats, stride_px: float) -> Maps:
    """The share of each place that is the person's own, (N, 14, h, h) in 0..1.

    Where crops do not meet it is 1.

    Args:
        p: (N, 14, h, h) marginals of people in one photo, each over the cells of its own crop.
        belief: (N, 14) in 0..1, that such a joint is there at all.
        scale: (N,) the photo's pixels in one of the crop's.
        origin_px: (N, 2) where in the photo the crop's first pixel lies.
        stride_px: the crop's pixels in a cell.

    """
    n, _, h, _ = p.shape
    # A cell's place in the photo: first + step * cell, x and y.
    step = scale * stride_px
    first = origin_px + scale[:, None] * (stride_px - 1) / 2
    ends = first + h * step[:, None]
    meet = (np.maximum(first[:, None], first) < np.minimum(ends[:, None], ends)).all(-1)
    mine, theirs = np.nonzero(meet & ~np.eye(n, dtype=bool))
    if not len(mine):
        return np.ones_like(p)
    offset = (first[mine] - first[theirs]) / step[theirs, None]
    onto = _bilinear(h, step[mine] / step[theirs], offset)
    near = np.asarray(belief, np.float32)[..., None, None] * pooled(p)
    # Rows first: one product each way serves all kinds.
    left, right = (near[:, side].swapaxes(1, 2) for side in (_KIND, _MIRROR[_KIND]))
    own = np.ones((), np.float32)
    for _ in range(ROUNDS):
        claims = np.maximum(left * own, right * own)
        everybody = claims.copy()
        for i, k, (across, down) in zip(mine, theirs, onto, strict=True):
            moved = (down @ claims[k].reshape(h, -1)).reshape(-1, h) @ across.T
            everybody[i] += moved.reshape(claims[k].shape)
        own = claims / np.maximum(everybody, _TINY)
    shared: Maps = own.swapaxes(1, 2)[:, _KIND_OF]
    return shared


def _bilinear(size: int, step: Floats, first: Floats) -> NDArray[np.float32]:
    """Rows that interpolate at ``first + step * row``, nothing beyond the ends.

    (P, A, size, size) of ``step`` (P,) and ``first`` (P, A), in cells.
    """
    row = np.arange(size)
    at = first[..., None] + step[:, None, None] * row
    return np.asarray(np.maximum(0.0, 1.0 - np.abs(at[..., None] - row)), np.float32)
