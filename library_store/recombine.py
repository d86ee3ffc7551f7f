"""New poses from old: the legs of one person under the upper body of another.

Head, trunk and arms of one pose are put on the hips of another so that both agree on the pelvis
frame (:mod:`library_store.anatomy`), the upper body first brought to the proportions of the legs'
person. Gravity is the legs'. Either part may be mirrored. What no body can do is left out: limits
(:mod:`library_store.limits`) are learned from the captured poses themselves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from library_store.anatomy import Float, frame_of
from library_store.limits import Limits
from library_store.proportions import draw_factors, resize
from library_store.skeleton import L_HIP, LSP14, NECK, R_HIP

_LEGS = tuple(range(R_HIP, L_HIP + 3))
_UPPER = tuple(range(R_HIP))
_ROUNDS = 50
_SPARE = 1.5  # how many more are drawn than wanted, since limits refuse some


@dataclass(frozen=True)
class Recombined:
    """``poses`` (n, 14, 3) mm; ``rows`` (n, 2), which poses gave legs and upper body; ``mirrored``
    (n, 2) bool, whether they were mirrored first.
    """  # noqa: D205

    poses: Float
    rows: NDArray[np.int64]
    mirrored: NDArray[np.bool_]


def mirror(poses: Float) -> Float:
    """The mirror images of poses (n, 14, 3) that face +Z."""
    mirrored: Float = poses[:, LSP14.mirror] * np.array([-1.0, 1.0, 1.0])
    return mirrored


def join(legs: Float, upper: Float, factors: Float) -> Float:
    """Legs of poses (n, 14, 3) under the upper bodies of others, both root-centred.

    ``factors`` (n, 8): the lengths of the legs' person over those of the upper body's.
    """
    upper = resize(upper, factors)

    def pelvis(poses: Float) -> Float:
        return frame_of(poses[:, L_HIP] - poses[:, R_HIP], poses[:, NECK], keep="x")

    turns = np.einsum("nji,njk->nik", pelvis(legs), pelvis(upper))
    joined = legs.copy()
    joined[:, _UPPER] = np.einsum("nij,nkj->nki", turns, upper[:, _UPPER])
    return joined


def recombine(
    poses: NDArray[np.float32],
    lengths: Float,
    n: int,
    rng: np.random.Generator,
    *,
    limits: Limits,
    may_mirror: bool,
    stature_sd: float,
    bone_sd: float,
) -> Recombined:
    """Draw ``n`` recombined poses of people of other proportions.

    ``poses`` (N, 14, 3) are captured ones, ``lengths`` (N, 8) the usual lengths of the people they
    show. The same generator state gives the same result. Raises ``ValueError`` if the limits refuse
    nearly everything.
    """
    found: list[Recombined] = []
    missing = n
    for _ in range(_ROUNDS):
        m = int(_SPARE * missing) + 8
        rows = rng.integers(0, len(poses), (m, 2))
        mirrored = rng.random((m, 2)) < (0.5 if may_mirror else 0.0)
        people = draw_factors(m, rng, stature_sd=stature_sd, bone_sd=bone_sd)
        legs, upper = (
            np.where(flip[:, None, None], mirror(own), own)
            for own, flip in zip(
                poses[rows].astype(np.float64).swapaxes(0, 1), mirrored.T, strict=True
            )
        )
        joined = resize(join(legs, upper, lengths[rows[:, 0]] / lengths[rows[:, 1]]), people)
        possible = np.flatnonzero(limits.allow(joined))[:missing]
        found.append(Recombined(joined[possible], rows[possible], mirrored[possible]))
        missing -= len(possible)
        if not missing:
            return Recombined(
                poses=np.concatenate([some.poses for some in found]),
                rows=np.concatenate([some.rows for some in found]),
                mirrored=np.concatenate([some.mirrored for some in found]),
            )
    raise ValueError("the limits of the body refuse nearly every recombined pose")
