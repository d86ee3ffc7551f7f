"""Mocap poses onto the body: bone rotations from 14 joints, then linear blend skinning.

The 14 joints fix the directions of the limbs and the trunk. What they leave open (hands, feet, the
head's turn, the twist of straight arms, the spine's curve) is drawn at random within what people
do. Labels come from the posed skeleton itself, so an imperfect fit costs no accuracy.
"""

from __future__ import annotations

from dataclasses import dataclass

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
from models.training.rendering.body import LSP14_BONES, BodyModel, Floats, RestBody

Matrix = NDArray[np.float64]

NECK_SHIFT = 0.45
"""The label "neck" lies this far from the neck's bone towards the middle of the shoulders, where
photo labels and CMU's lower neck have it (0.11 of the trunk above the shoulders)."""

FINGERS = ("index", "middle", "ring", "pinky")


@dataclass(frozen=True)
class PosedBody:
    """A person in a pose, y up, metres: ``vertices`` (V, 3), ``joints`` (14, 3) in lsp14 order."""

    vertices: Floats
    joints: Floats


@dataclass(frozen=True)
class TrunkStats:
    """Mean directions in the trunk's frame over many poses: what counts as a neutral stance.

    ``head`` neck to head top, ``shoulder`` (2, 3) neck to the right and the left shoulder.
    """

    head: Matrix
    shoulder: Matrix

    @classmethod
    def of(cls, poses: NDArray[np.float32]) -> TrunkStats:
        """From poses (N, 14, 3)."""
        frames = np.stack([_chest_frame(p) for p in poses.astype(float)])

        def mean(joint: int) -> Matrix:
            v = poses[:, joint].astype(float) - poses[:, NECK]
            local = np.einsum("nji,nj->ni", frames, v / np.linalg.norm(v, axis=1, keepdims=True))
            return _unit(local.mean(0))

        return cls(mean(HEAD_TOP), np.stack([mean(R_SHOULDER), mean(L_SHOULDER)]))


def _unit(v: Matrix) -> Matrix:
    result: Matrix = v / max(float(np.linalg.norm(v)), 1e-9)
    return result


def turn(axis: Matrix, angle_rad: float) -> Matrix:
    """Rotation about an axis, (3, 3)."""
    x, y, z = _unit(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    result: Matrix = np.eye(3) + np.sin(angle_rad) * k + (1 - np.cos(angle_rad)) * (k @ k)
    return result


def _swing(a: Matrix, b: Matrix) -> Matrix:
    """The smallest rotation that takes direction a to b."""
    a, b = _unit(a), _unit(b)
    axis = np.cross(a, b)
    sin = float(np.linalg.norm(axis))
    if sin < 1e-6:
        side = np.cross(a, [1.0, 0, 0] if abs(a[0]) < 0.9 else [0, 1.0, 0])
        return np.eye(3) if a @ b > 0 else turn(side, np.pi)
    return turn(axis, float(np.arctan2(sin, a @ b)))


def _frame(first: Matrix, second: Matrix) -> Matrix:
    """Columns: first, second made orthogonal to it, their cross product."""
    x = _unit(first)
    y = _unit(second - (second @ x) * x)
    return np.stack([x, y, np.cross(x, y)], 1)


def _chest_frame(p: Matrix) -> Matrix:
    """Columns x to the left, y up the trunk, z out of the chest."""
    up = p[NECK] - (p[R_HIP] + p[L_HIP]) / 2
    yxz = _frame(up, p[L_SHOULDER] - p[R_SHOULDER])
    return np.stack([yxz[:, 1], yxz[:, 0], -yxz[:, 2]], 1)


def pelvis_frame(p: Matrix) -> Matrix:
    """Columns x to the left hip, y up the trunk, z forward, of joints (14, 3)."""
    up = p[NECK] - (p[R_HIP] + p[L_HIP]) / 2
    return _frame(p[L_HIP] - p[R_HIP], up)


def _part_way(a: Matrix, b: Matrix, share: float) -> Matrix:
    """Rotation between a and b."""
    delta = b @ a.T
    angle = float(np.arccos(np.clip((np.trace(delta) - 1) / 2, -1, 1)))
    axis = np.array(
        [delta[2, 1] - delta[1, 2], delta[0, 2] - delta[2, 0], delta[1, 0] - delta[0, 1]]
    )
    return turn(axis, share * angle) @ a if angle > 1e-4 else a


class Poser:
    """Poses rest bodies after mocap; ``stats`` from the mocap set."""

    def __init__(self, model: BodyModel, stats: TrunkStats) -> None:
        self._model = model
        self._stats = stats

    def joints_of(self, vertices: Floats, bone_heads: Floats) -> Matrix:
        """The 14 labelled joints of a skeleton, (14, 3)."""
        rows = [self._model.index(b) for b in LSP14_BONES]
        joints = np.concatenate([vertices[[self._model.head_top]], bone_heads[rows]]).astype(float)
        shoulders = (joints[R_SHOULDER] + joints[L_SHOULDER]) / 2
        joints[NECK] += NECK_SHIFT * (shoulders - joints[NECK])
        return joints

    def pose(
        self, body: RestBody, target: NDArray[np.float32], rng: np.random.Generator
    ) -> PosedBody:
        """The body in the pose of ``target`` (14, 3), y up, any unit."""
        model = self._model
        rotations = self._rotations(body, target.astype(float), rng)
        heads = body.bone_heads.astype(float)
        placed = np.zeros_like(heads)
        for b, parent in enumerate(model.parent):
            placed[b] = (
                heads[b]
                if parent < 0
                else placed[parent] + rotations[parent] @ (heads[b] - heads[parent])
            )
        moves = np.concatenate(
            [rotations, (placed - np.einsum("bij,bj->bi", rotations, heads))[:, :, None]], 2
        ).astype(np.float32)
        blended = (model.weights @ moves.reshape(len(moves), 12)).reshape(-1, 3, 4)
        vertices = np.einsum("vij,vj->vi", blended[:, :, :3], body.vertices) + blended[:, :, 3]
        joints = self.joints_of(vertices, placed.astype(np.float32))
        return PosedBody(vertices.astype(np.float32), joints.astype(np.float32))

    def _rotations(self, body: RestBody, t: Matrix, rng: np.random.Generator) -> Matrix:
        rest = self.joints_of(body.vertices, body.bone_heads)
        by_name: dict[str, Matrix] = {}
        chest_frame = _chest_frame(t)
        chest = chest_frame @ _chest_frame(rest).T
        pelvis = pelvis_frame(t) @ pelvis_frame(rest).T
        bend = self._curl(t, rng)
        pelvis = turn(pelvis[:, 0], -bend) @ pelvis
        chest_bent = turn(chest[:, 0], bend) @ chest
        by_name["Root"] = by_name["pelvis"] = pelvis
        for bone, share in (("spine_01", 0.3), ("spine_02", 0.65), ("spine_03", 1.0)):
            by_name[bone] = _part_way(pelvis, chest_bent, share)

        def local_swing(neutral: Matrix, joint: int, gain: float) -> Matrix:
            seen = _unit(chest_frame.T @ (t[joint] - t[NECK]))
            return chest_frame @ _part_way(np.eye(3), _swing(neutral, seen), gain) @ chest_frame.T

        head = local_swing(self._stats.head, HEAD_TOP, 1.0) @ chest
        head = turn(head[:, 0], float(rng.normal(0.05, 0.15))) @ head
        yaw = float(np.clip(rng.normal(0, 0.4), -1.1, 1.1))
        by_name["head"] = turn(head[:, 1], yaw) @ head
        by_name["neck_01"] = _part_way(chest, by_name["head"], 0.45)
        for side, row in (("r", 0), ("l", 1)):
            joints = (R_SHOULDER, R_ELBOW, R_WRIST) if row == 0 else (L_SHOULDER, L_ELBOW, L_WRIST)
            clavicle = local_swing(self._stats.shoulder[row], joints[0], 0.9) @ chest
            by_name[f"clavicle_{side}"] = clavicle
            hinge = np.cross(rest[joints[1]] - rest[joints[0]], rest[joints[2]] - rest[joints[1]])
            upper, lower = _limb(rest, t, joints, clavicle, _unit(hinge))
            self._arm(by_name, body, side, upper, lower, t[joints[2]] - t[joints[1]], rng)
            joints = (R_HIP, R_KNEE, R_ANKLE) if row == 0 else (L_HIP, L_KNEE, L_ANKLE)
            by_name[f"thigh_{side}"], calf = _limb(rest, t, joints, pelvis, np.array([1.0, 0, 0]))
            by_name[f"calf_{side}"] = calf
            foot = self._foot(calf, t, joints[2], rng)
            by_name[f"foot_{side}"] = foot
            by_name[f"ball_{side}"] = turn(foot[:, 0], -float(rng.uniform(0, 0.3))) @ foot
        return np.stack([by_name[b] for b in self._model.bones])

    @staticmethod
    def _curl(t: Matrix, rng: np.random.Generator) -> float:
        """How far the back rounds: more when the thighs come up to the trunk."""
        up = _unit(t[NECK] - (t[R_HIP] + t[L_HIP]) / 2)
        thighs = (_unit(t[R_KNEE] - t[R_HIP]), _unit(t[L_KNEE] - t[L_HIP]))
        angles = [float(np.arccos(np.clip(up @ d, -1, 1))) for d in thighs]
        flexion = np.pi - sum(angles) / 2
        return 0.18 * max(flexion - 0.4, 0) + float(rng.normal(0, 0.06))

    def _arm(
        self,
        by_name: dict[str, Matrix],
        body: RestBody,
        side: str,
        upper: Matrix,
        lower: Matrix,
        forearm: Matrix,
        rng: np.random.Generator,
    ) -> None:
        """Pronation shared by forearm and hand, a bent wrist, fingers between flat and fist."""
        pronation = float(np.clip(rng.normal(0, 0.6), -1.3, 1.3))
        by_name[f"upperarm_{side}"] = upper
        by_name[f"lowerarm_{side}"] = turn(forearm, 0.4 * pronation) @ lower
        hand = turn(forearm, pronation) @ lower
        head_of = {
            f: body.bone_heads[self._model.index(f"{f}_01_{side}")].astype(float) for f in FINGERS
        }
        knuckles = _unit(head_of["pinky"] - head_of["index"])
        hand = turn(hand @ knuckles, float(rng.normal(0, 0.25))) @ hand
        by_name[f"hand_{side}"] = hand
        tip = body.bone_heads[self._model.index(f"middle_02_{side}")] - head_of["middle"]
        inwards = np.array([1.0 if side == "r" else -1.0, -1.0, 0])
        sign = np.sign(np.cross(knuckles, tip) @ inwards)
        fist = float(rng.beta(0.8, 1.2)) * 1.3
        for finger in (*FINGERS, "thumb"):
            rotation = hand
            for n in ("01", "02", "03"):
                share = 0.35 if finger == "thumb" else 1.0
                rotation = turn(rotation @ knuckles, sign * share * fist) @ rotation
                by_name[f"{finger}_{n}_{side}"] = rotation

    @staticmethod
    def _foot(calf: Matrix, t: Matrix, ankle: int, rng: np.random.Generator) -> Matrix:
        """Flat on the ground when this ankle is the lowest, hanging or stretched otherwise."""
        lowest = float(t[[R_ANKLE, L_ANKLE, R_KNEE, L_KNEE, R_WRIST, L_WRIST], 1].min())
        span = float(np.linalg.norm(t[R_HIP] - t[R_KNEE]))
        x, forward = calf[:, 0], calf[:, 2]
        if t[ankle, 1] < lowest + 0.25 * span and rng.random() < 0.9:
            pitch = float(np.clip(np.arcsin(np.clip(forward[1], -1, 1)), -0.5, 0.7))
        else:
            pitch = float(rng.uniform(-0.25, 0.9))
        return turn(x, pitch) @ turn(calf[:, 1], float(rng.normal(0, 0.15))) @ calf


def _limb(
    rest: Matrix,
    t: Matrix,
    joints: tuple[int, int, int],
    parent: Matrix,
    hinge_rest: Matrix,
) -> tuple[Matrix, Matrix]:
    """Rotations of the upper and the lower bone; a bent joint also fixes the upper bone's twist."""
    a, b, c = joints
    upper_rest, lower_rest = _unit(rest[b] - rest[a]), _unit(rest[c] - rest[b])
    upper, lower = _unit(t[b] - t[a]), _unit(t[c] - t[b])
    inherited = _swing(parent @ upper_rest, upper) @ parent @ hinge_rest
    hinge = np.cross(upper, lower) + 0.25 * inherited
    rotation = _frame(upper, hinge) @ _frame(upper_rest, hinge_rest).T
    return rotation, _swing(rotation @ lower_rest, lower) @ rotation


def mirrored(pose: NDArray[np.float32]) -> NDArray[np.float32]:
    """The pose in a mirror, (14, 3)."""
    result: NDArray[np.float32] = (pose * np.array([-1, 1, 1], np.float32))[list(LSP14.mirror)]
    return result
