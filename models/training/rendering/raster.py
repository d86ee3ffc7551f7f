"""A z-buffer by dense points: every quad is sampled finer than a pixel, the nearest sample wins.

Quads of a person 200 px tall are a pixel or two wide, so that points are as good as filled faces
and need no loop over faces. Camera frame: x right, y down, z forward; metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models.training.rendering.body import Floats, Ints

_STEPS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 40, 64, 128)
_SAMPLES_PER_PX = 1.3


@dataclass(frozen=True)
class Pixels:
    """The covered pixels of an image, row by row: P of them.

    ``index`` (P,) flat pixel index; ``quad`` (P,) the face seen there and ``corner_weights``
    (P, 4) where on it; ``depth`` (size, size) metres, inf where nothing is.
    """

    index: Ints
    quad: Ints
    corner_weights: Floats
    depth: Floats


def rasterise(
    vertices: Floats, xy_px: Floats, quads: Ints, two_sided: NDArray[np.bool_], size: int
) -> Pixels:
    """What a camera sees of a mesh.

    ``vertices`` (V, 3) in the camera's frame, ``xy_px`` (V, 2) their projections (pixel centres at
    integers), ``quads`` (F, 4), ``two_sided`` (F,) faces that show their backs too.
    """
    corners = quads.T
    x, y = xy_px[:, 0][corners], xy_px[:, 1][corners]  # (4, F): long rows are fast to reduce
    z = vertices[:, 2][corners]
    area = (x[2] - x[0]) * (y[3] - y[1]) - (y[2] - y[0]) * (x[3] - x[1])
    low_x, high_x, low_y, high_y = x.min(0), x.max(0), y.min(0), y.max(0)
    seen = (two_sided | (area < 0)) & (z.min(0) > 0.05)
    seen &= (high_x > -0.5) & (low_x < size - 0.5) & (high_y > -0.5) & (low_y < size - 0.5)
    cut = (low_x < 0) | (low_y < 0) | (high_x > size - 1) | (high_y > size - 1)
    sides = np.abs(np.stack([x - np.roll(x, 1, 0), y - np.roll(y, 1, 0)])).max((0, 1))
    step = np.searchsorted(_STEPS, np.clip(sides * _SAMPLES_PER_PX, 1, _STEPS[-1]))
    pixel, depth, quad, sample = [], [], [], []
    grids = [_grid(n) for n in _STEPS]
    for i in np.unique(step[seen]):
        rows = np.flatnonzero(seen & (step == i))
        grid = grids[i]  # (n*n, 4)
        px = np.rint(x[:, rows].T @ grid.T).astype(np.int32)
        py = np.rint(y[:, rows].T @ grid.T).astype(np.int32)
        zs = z[:, rows].T @ grid.T
        which = np.broadcast_to(rows[:, None], px.shape)
        where = np.broadcast_to(np.arange(len(grid)), px.shape)
        flat = py * size + px
        if cut[rows].any():
            inside = (px >= 0) & (px < size) & (py >= 0) & (py < size)
            flat, zs, which, where = flat[inside], zs[inside], which[inside], where[inside]
        pixel.append(flat.ravel())
        depth.append(zs.ravel())
        quad.append(which.ravel())
        sample.append(where.ravel())
    buffer = np.full(size * size, np.inf, np.float32)
    winner = np.full(size * size, -1, np.int64)
    if pixel:
        pixels, depths = np.concatenate(pixel), np.concatenate(depth).astype(np.float32)
        np.minimum.at(buffer, pixels, depths)
        nearest = np.flatnonzero(depths <= buffer[pixels])
        winner[pixels[nearest]] = nearest
    index = np.flatnonzero(winner >= 0)
    faces = np.concatenate([np.zeros(0, np.int64), *quad])[winner[index]]
    samples = np.concatenate([np.zeros(0, np.int64), *sample])[winner[index]]
    weights = np.empty((len(index), 4), np.float32)
    for i in np.unique(step[faces]):
        mine = step[faces] == i
        weights[mine] = grids[i][samples[mine]]
    return Pixels(index, faces, weights, buffer.reshape(size, size))


def _grid(n: int) -> Floats:
    """Bilinear weights of n x n points inside a quad, (n*n, 4)."""
    u = (np.arange(n, dtype=np.float32) + 0.5) / n
    a, b = (g.ravel() for g in np.meshgrid(u, u))
    return np.stack([(1 - a) * (1 - b), a * (1 - b), a * b, (1 - a) * b], 1)


def normals(vertices: Floats, quads: Ints) -> Floats:
    """Unit vertex normals, (V, 3), area-weighted, pointing out of faces seen counter-clockwise."""
    corner = vertices[quads]
    face = np.cross(corner[:, 2] - corner[:, 0], corner[:, 3] - corner[:, 1])
    flat = quads.ravel()
    total = np.stack(
        [np.bincount(flat, np.repeat(face[:, k], 4), minlength=len(vertices)) for k in range(3)],
        1,
    )
    length = np.linalg.norm(total, axis=1, keepdims=True)
    result: Floats = (total / np.maximum(length, 1e-12)).astype(np.float32)
    return result
