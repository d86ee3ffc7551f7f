"""A pose taken apart: directions of the bones in the frames of the body, and bone lengths.

**Frames.** The pelvis frame has x from the right to the left hip, y towards the neck (made
perpendicular to x) and z = x × y, the way the person faces. The chest frame has y from the root
(the hip midpoint) to the neck, x along the shoulders (made perpendicular to y), z = x × y.

**Legs** (15 numbers): the unit directions of right thigh, right shank, left thigh and left shank in
the pelvis frame, and the direction of "up" (against gravity) in the pelvis frame, which is how the
body is oriented.

**Upper body** (23 numbers): lateral lean of the trunk (the x of its direction in the pelvis frame),
stretch (its length over the person's usual one), twist of the chest about the trunk (radians), the
places of the shoulders seen from the neck in the chest frame, in units of the person's shoulder
length (right x, right y, left x, left y, their common z), the unit directions of right upper arm,
right forearm, left upper arm and left forearm, and that of the head, all in the chest frame.

**Proportions** (8 numbers): lengths in mm, in the order of ``LENGTHS``, equal on both sides.

Mirroring a person is a signed permutation of each part, so left and right come out alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from library_store.skeleton import (
    HEAD_TOP,
    L_ANKLE,
    L_ELBOW,
    L_HIP,
    L_KNEE,
    L_SHOULDER,
    L_WRIST,
    LSP14,
    NECK,
    R_ANKLE,
    R_ELBOW,
    R_HIP,
    R_KNEE,
    R_SHOULDER,
    R_WRIST,
)

Float = NDArray[np.float64]

LENGTHS = ("trunk", "hips", "shoulder", "head", "upper_arm", "forearm", "thigh", "shank")
"""Root to neck, hip to hip, neck to shoulder, neck to head top, and the four limb bones."""

N_LEGS, N_LENGTHS = 15, len(LENGTHS)
"""Numbers that describe the legs of a pose (:class:`BodyParts`), and a skeleton's lengths."""

_LIMBS = (
    (R_SHOULDER, R_ELBOW, R_WRIST),
    (L_SHOULDER, L_ELBOW, L_WRIST),
    (R_HIP, R_KNEE, R_ANKLE),
    (L_HIP, L_KNEE, L_ANKLE),
)
_VECTOR = (-1.0, 1.0, 1.0)
_LEGS_ORDER = np.r_[6:12, 0:6, 12:15]
_LEGS_SIGN = np.array(_VECTOR * 5)
_UPPER_ORDER = np.r_[0:3, 5, 6, 3, 4, 7, 14:20, 8:14, 20:23]
_UPPER_SIGN = np.array((-1.0, 1.0, -1.0, -1.0, 1.0, -1.0, 1.0, 1.0, *(_VECTOR * 5)))


@dataclass(frozen=True)
class BodyParts:
    """Poses taken apart: ``legs`` (n, 15) and ``upper`` (n, 23), both float64."""

    legs: Float
    upper: Float


def mirror_legs(legs: Float) -> Float:
    """The legs (..., 15) of the mirrored person."""
    mirrored: Float = legs[..., _LEGS_ORDER] * _LEGS_SIGN
    return mirrored


def mirror_upper(upper: Float) -> Float:
    """The upper bodies (..., 23) of the mirrored person."""
    mirrored: Float = upper[..., _UPPER_ORDER] * _UPPER_SIGN
    return mirrored


def unit(vectors: Float) -> Float:
    """Vectors (..., 3) scaled to length 1."""
    scaled: Float = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return scaled


def frame_of(x_hint: Float, y_hint: Float, *, keep: str) -> Float:
    """Right-handed frames (..., 3, 3), rows x, y, z, from two directions of which one is kept."""
    if keep == "x":
        x = unit(x_hint)
        y = unit(y_hint - (y_hint * x).sum(-1, keepdims=True) * x)
    else:
        y = unit(y_hint)
        x = unit(x_hint - (x_hint * y).sum(-1, keepdims=True) * y)
    return np.stack([x, y, np.cross(x, y)], axis=-2)


def root_of(poses: Float) -> Float:
    """Hip midpoints (..., 3) of poses (..., 14, 3)."""
    return 0.5 * (poses[..., R_HIP, :] + poses[..., L_HIP, :])


def measure_lengths(poses: Float) -> Float:
    """The eight lengths of poses (..., 14, 3), averaged over the sides: (..., 8)."""

    def bone(a: int, b: int) -> Float:
        length: Float = np.linalg.norm(poses[..., a, :] - poses[..., b, :], axis=-1)
        return length

    def both(*pairs: tuple[int, int]) -> Float:
        mean: Float = np.mean([bone(a, b) for a, b in pairs], axis=0)
        return mean

    trunk = np.linalg.norm(poses[..., NECK, :] - root_of(poses), axis=-1)
    return np.stack(
        [
            trunk,
            bone(R_HIP, L_HIP),
            both((NECK, R_SHOULDER), (NECK, L_SHOULDER)),
            bone(NECK, HEAD_TOP),
            both((R_SHOULDER, R_ELBOW), (L_SHOULDER, L_ELBOW)),
            both((R_ELBOW, R_WRIST), (L_ELBOW, L_WRIST)),
            both((R_HIP, R_KNEE), (L_HIP, L_KNEE)),
            both((R_KNEE, R_ANKLE), (L_KNEE, L_ANKLE)),
        ],
        axis=-1,
    )


def encode(poses_mm: Float, lengths_mm: Float) -> BodyParts:
    """Take poses (n, 14, 3), Y up, of people of the usual lengths (n, 8) apart."""
    root = root_of(poses_mm)
    trunk = poses_mm[:, NECK] - root
    hips = poses_mm[:, L_HIP] - poses_mm[:, R_HIP]
    pelvis = frame_of(hips, trunk, keep="x")
    chest = frame_of(poses_mm[:, L_SHOULDER] - poses_mm[:, R_SHOULDER], trunk, keep="y")

    def seen(frame: Float, vectors: Float) -> Float:
        coordinates: Float = np.einsum("nij,nj->ni", frame, vectors)
        return coordinates

    def bone(frame: Float, a: int, b: int) -> Float:
        return seen(frame, unit(poses_mm[:, b] - poses_mm[:, a]))

    leg_bones = [bone(pelvis, *pair) for limb in _LIMBS[2:] for pair in pairwise(limb)]
    up = pelvis[:, :, 1]
    lean = seen(pelvis, unit(trunk))[:, 0]
    level = _level_frame(lean)
    shoulder_line = seen(pelvis, chest[:, 0])
    twist = np.arctan2(
        -(shoulder_line * level[:, 2]).sum(-1), (shoulder_line * level[:, 0]).sum(-1)
    )
    stretch = np.linalg.norm(trunk, axis=-1) / lengths_mm[:, 0]
    right = seen(chest, poses_mm[:, R_SHOULDER] - poses_mm[:, NECK]) / lengths_mm[:, 2:3]
    left = seen(chest, poses_mm[:, L_SHOULDER] - poses_mm[:, NECK]) / lengths_mm[:, 2:3]
    arm_bones = [bone(chest, *pair) for limb in _LIMBS[:2] for pair in pairwise(limb)]
    upper = np.column_stack(
        [lean, stretch, twist, right[:, :2], left, *arm_bones, bone(chest, NECK, HEAD_TOP)]
    )
    return BodyParts(legs=np.column_stack([*leg_bones, up]), upper=upper)


def decode(parts: BodyParts, lengths_mm: Float) -> Float:
    """Put people together: parts of n people and their lengths (n, 8) to poses (n, 14, 3) mm.

    The poses are root-centred with Y up, heading roughly along +Z. Directions are made unit first,
    so limb bones have exactly the lengths asked for.
    """
    n = len(lengths_mm)
    legs, upper = parts.legs, parts.upper
    trunk, hips, shoulder, head, *limb_bones = (lengths_mm[:, i, None] for i in range(N_LENGTHS))
    upper_arm, forearm, thigh, shank = limb_bones
    poses = np.zeros((n, LSP14.n_joints, 3))

    # In the pelvis frame first.
    level = _level_frame(upper[:, 0])
    cos_t, sin_t = np.cos(upper[:, 2:3]), np.sin(upper[:, 2:3])
    chest_x = cos_t * level[:, 0] - sin_t * level[:, 2]
    chest = np.stack([chest_x, level[:, 1], np.cross(chest_x, level[:, 1])], axis=1)

    def placed(vectors: Float) -> Float:
        turned: Float = np.einsum("nij,ni->nj", chest, vectors)
        return turned

    poses[:, R_HIP, 0], poses[:, L_HIP, 0] = -0.5 * hips[:, 0], 0.5 * hips[:, 0]
    poses[:, NECK] = trunk * upper[:, 1:2] * level[:, 1]
    right = upper[:, [3, 4, 7]]
    poses[:, R_SHOULDER] = poses[:, NECK] + placed(shoulder * right)
    poses[:, L_SHOULDER] = poses[:, NECK] + placed(shoulder * upper[:, 5:8])
    poses[:, HEAD_TOP] = poses[:, NECK] + placed(head * unit(upper[:, 20:23]))
    for (start, middle, end), at in zip(_LIMBS[:2], (8, 14), strict=True):
        poses[:, middle] = poses[:, start] + placed(upper_arm * unit(upper[:, at : at + 3]))
        poses[:, end] = poses[:, middle] + placed(forearm * unit(upper[:, at + 3 : at + 6]))
    for (start, middle, end), at in zip(_LIMBS[2:], (0, 6), strict=True):
        poses[:, middle] = poses[:, start] + thigh * unit(legs[:, at : at + 3])
        poses[:, end] = poses[:, middle] + shank * unit(legs[:, at + 3 : at + 6])
    upright: Float = np.einsum("nij,nkj->nki", _upright(unit(legs[:, 12:15])), poses)
    return upright


def _level_frame(lean: Float) -> Float:
    """Frames (n, 3, 3), rows x, y, z: the pelvis frame rolled about z until y is the trunk."""
    sine = np.clip(lean, -0.99, 0.99)
    cosine, zero = np.sqrt(1.0 - sine**2), np.zeros_like(sine)
    return np.stack(
        [
            np.stack([cosine, -sine, zero], axis=-1),
            np.stack([sine, cosine, zero], axis=-1),
            np.stack([zero, zero, np.ones_like(sine)], axis=-1),
        ],
        axis=-2,
    )


def _upright(up: Float) -> Float:
    """Rotations (n, 3, 3) that take unit vectors ``up`` (n, 3) to +Y and keep z as far ahead."""
    # Rows are the exemplar's axes in the pelvis frame; forward is replaced by the trunk's own
    # direction where the person faces straight up or down.
    ahead = np.zeros_like(up)
    lying = np.abs(up[:, 2]) > 0.95
    ahead[:, 2] = np.where(lying, 0.0, 1.0)
    ahead[:, 1] = np.where(lying, 1.0, 0.0)
    z = unit(ahead - (ahead * up).sum(-1, keepdims=True) * up)
    return np.stack([np.cross(up, z), up, z], axis=-2)
