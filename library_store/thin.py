"""Thinning: of poses that are nearly the same, one is enough.

A greedy cover: poses are gone through in an order, and one is kept unless a kept one is within the
radius. So every pose is within the radius of a kept one, and no two kept ones are. The distance of
two poses is the root mean square distance of their joints.

The order is that of the poses' projection on their direction of greatest spread. Two poses are
never nearer than their projections, so only the kept ones of the last stretch of it are looked at:
a million poses take minutes on one core. Products in single precision decide where they are clear;
near the radius the distance is taken anew in double precision, so that the result does not depend
on the machine's arithmetic.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Poses = NDArray[np.float32]
Rows = NDArray[np.int64]

_BLOCK = 512
_BAND = 0.01
"""Squared distances this near to the radius' square, relatively, are taken in double precision."""
_ROUNDING = 1e-6
"""And so are those that single precision may get wrong, relative to the poses' squared lengths."""


def greedy_cover(
    poses: Poses, radius_mm: float, progress: Callable[[float], None] | None = None
) -> Rows:
    """Rows, ascending, of the poses (n, 14, 3) mm that are kept; the others are near one of them.

    ``progress`` hears the fraction done.
    """
    n, joints = len(poses), poses.shape[1]
    flat = poses.reshape(n, -1) - poses[: 1 << 16].mean(axis=0).reshape(-1)
    key = np.round(flat @ _spread_direction(flat), 3)
    order = np.argsort(key, kind="stable")
    flat, key = np.ascontiguousarray(flat[order]), key[order]
    limit = joints * radius_mm**2
    reach = float(np.sqrt(limit)) + 0.01
    kept = np.empty(n, dtype=np.int64)
    n_kept = 0
    for start in range(0, n, _BLOCK):
        rows = np.arange(start, min(start + _BLOCK, n))
        first = int(np.searchsorted(key[kept[:n_kept]], key[start] - reach))
        rows = rows[~_covered(flat, rows, kept[first:n_kept], limit)]
        rows = rows[_cover_among(flat, rows, limit)]
        kept[n_kept : n_kept + len(rows)] = rows
        n_kept += len(rows)
        if progress is not None:
            progress(min(start + _BLOCK, n) / n)
    return np.sort(order[kept[:n_kept]])


def _spread_direction(flat: Poses) -> Poses:
    """The unit direction of greatest spread, coarse enough to come out the same everywhere."""
    some = flat[:: max(1, len(flat) // 20_000)].astype(np.float64)
    _, vectors = np.linalg.eigh(some.T @ some)
    main = vectors[:, -1] * np.sign(vectors[np.abs(vectors[:, -1]).argmax(), -1])
    rounded = np.round(main, 3)
    direction: Poses = (rounded / np.linalg.norm(rounded)).astype(np.float32)
    return direction


def _covered(flat: Poses, rows: Rows, kept: Rows, limit: float) -> NDArray[np.bool_]:
    """Whether each of ``rows`` is within the limit of one of ``kept``."""
    covered = np.zeros(len(rows), dtype=np.bool_)
    for start in range(0, len(kept), 8 * _BLOCK):
        some = kept[start : start + 8 * _BLOCK]
        covered |= _near(flat, rows, some, limit).any(axis=1)
    return covered


def _cover_among(flat: Poses, rows: Rows, limit: float) -> NDArray[np.bool_]:
    """The greedy cover of ``rows`` alone, in their order."""
    near = _near(flat, rows, rows, limit)
    alive = np.ones(len(rows), dtype=np.bool_)
    for i in range(len(rows)):
        if alive[i]:
            alive[i + 1 :] &= ~near[i, i + 1 :]
    return alive


def _near(flat: Poses, rows: Rows, others: Rows, limit: float) -> NDArray[np.bool_]:
    """(rows, others): whether their squared distance is within the limit."""
    a, b = flat[rows], flat[others]
    squares_a, squares_b = (a * a).sum(axis=1), (b * b).sum(axis=1)
    squared = a @ b.T
    squared *= -2.0
    squared += squares_a[:, None]
    squared += squares_b
    near: NDArray[np.bool_] = squared <= limit
    band = _BAND * limit + _ROUNDING * float(squares_a.max(initial=0) + squares_b.max(initial=0))
    unclear = np.argwhere(np.abs(squared - limit) <= band)
    if len(unclear):
        i, j = unclear.T
        gap = a[i].astype(np.float64) - b[j]
        near[i, j] = np.einsum("nd,nd->n", gap, gap) <= limit
    return near
