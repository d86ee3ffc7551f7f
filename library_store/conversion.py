"""Other people's skeletons: what they call their joints, and the way to and from lsp14.

Every lsp14 joint of a foreign skeleton is an affine combination of its joints (weights sum to 1),
so that a conversion commutes with moving, turning and scaling the points, in 2D as in 3D. Where
joints are missing, the next recipe that can do without them is used.

The limbs are the same joints in all of them. Neck and head top are not: skeletons of photos have
ears and a nose instead. Their weights were fitted on 3,005 people in photos that two networks
(33 landmarks; lsp14) agreed about; on 494 people of other photos the median distance is 0.034
torso lengths for the neck (0.111 for the midpoint of the shoulders) and 0.052 for the head top.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from library_store.skeleton import LSP14, Skeleton

Floats = npt.NDArray[np.float64]
Recipe = Mapping[str, float]
"""Weights of the joints of a skeleton, by name; they sum to 1."""

NECK_TO_EARS = 0.315
"""How far the neck lies on the way from between the shoulders to between the ears."""
HEAD_BY_EARS = 1.583
"""The same for the head top, when only the ears are known."""
HEAD_BY_EARS_AND_NOSE = (2.107, -0.570)
"""Weights of ears and nose, relative to the shoulders' midpoint: the head's tilt is in them."""
HEAD_BY_NOSE = 1.619
LEAST_CONFIDENCE = 0.2
"""Below it a joint is as good as missing: another option that is surer is used."""
GUESS = 0.5
"""Factor on the confidence of a joint that was found by a makeshift recipe (three times the error
of the one it stands in for)."""


@dataclass(frozen=True)
class Option:
    """One way to find a joint: weights by name, and a factor on the confidence."""

    weights: Recipe
    trust: float = 1.0


@dataclass(frozen=True)
class Conversion:
    """A foreign skeleton, and how each lsp14 joint comes from it (options, the best first).

    ``back`` has the foreign joints that lsp14 determines; the others (eyes, toes) it does not know.
    """

    skeleton: Skeleton
    options: Mapping[str, tuple[Option, ...]]
    back: Mapping[str, Recipe]

    def to_lsp14(self, points: Floats, confidence: Floats) -> tuple[Floats, Floats]:
        """(P, N, D) points, (P, N) confidence, 0 = missing -> (P, 14, D), (P, 14).

        A joint is as sure as the least sure of those that it comes from, by the first option that
        is sure enough, else by the surest; 0 when none applies (its coordinates are then 0).
        """
        people, dimensions = len(points), points.shape[2]
        out = np.zeros((people, LSP14.n_joints, dimensions))
        sure = np.zeros((people, LSP14.n_joints))
        for joint, name in enumerate(LSP14.joint_names):
            for option in self.options.get(name, ()):
                columns = [self.skeleton.index(source) for source in option.weights]
                weights = np.array(list(option.weights.values()))
                least = confidence[:, columns].min(axis=1) * option.trust
                use = (sure[:, joint] < LEAST_CONFIDENCE) & (least > sure[:, joint])
                out[use, joint] = np.einsum("pjd,j->pd", points[use][:, columns], weights)
                sure[use, joint] = least[use]
        return out, sure

    @property
    def from_lsp14(self) -> Floats:
        """(N, 14) weights of the lsp14 joints in each foreign joint; rows of nan where unknown."""
        matrix = np.full((self.skeleton.n_joints, LSP14.n_joints), np.nan)
        for name, recipe in self.back.items():
            row = self.skeleton.index(name)
            matrix[row] = 0
            for source, weight in recipe.items():
                matrix[row, LSP14.index(source)] = weight
        return matrix


def _skeleton(name: str, joints: str, edges: str) -> Skeleton:
    names = tuple(joints.split())
    pairs = tuple(tuple(edge.split("-")) for edge in edges.split())
    return Skeleton(
        name=name,
        joint_names=names,
        edges=tuple((names.index(a), names.index(b)) for a, b in pairs),
        mirror=tuple(names.index(_other_side(joint, names)) for joint in names),
    )


def _other_side(joint: str, names: tuple[str, ...]) -> str:
    for a, b in (("left", "right"), ("right", "left"), ("L", "R"), ("R", "L")):
        if joint.startswith(a) and b + joint.removeprefix(a) in names:
            return b + joint.removeprefix(a)
        # MediaPipe's mouth_left, mouth_right
        if joint.endswith("_" + a) and joint.removesuffix(a) + b in names:
            return joint.removesuffix(a) + b
    return joint


LIMBS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")


def _limbs(pattern: Mapping[str, str]) -> dict[str, str]:
    """lsp14 limb -> foreign joint; ``pattern`` has the foreign name of each limb, {} the side."""
    return {
        f"{side}_{limb}": pattern[limb].format(word)
        for side, word in (("r", pattern["right"]), ("l", pattern["left"]))
        for limb in LIMBS
    }


def _toward(shoulders: tuple[str, str], goals: Mapping[str, float]) -> Recipe:
    """Midpoint of the shoulders plus ``goals``' weights times the way to each of them."""
    rest = 1 - sum(goals.values())
    return {shoulders[0]: rest / 2, shoulders[1]: rest / 2, **goals}


def _head(
    shoulders: tuple[str, str], ears: tuple[str, str], nose: str
) -> dict[str, tuple[Option, ...]]:
    """Options for neck and head top; seen from the side, one ear stands for both.

    The nose beside one ear alone would take the head's turn for its tilt: 0.139 torso lengths off
    the head top where it turns aside, not 0.093 (medians of 144 of the 494).
    """
    either: tuple[dict[str, float], ...] = (
        {ears[0]: 0.5, ears[1]: 0.5},
        {ears[0]: 1.0},
        {ears[1]: 1.0},
    )
    by_ears, by_nose = HEAD_BY_EARS_AND_NOSE

    def scaled(factor: float, parts: Recipe) -> dict[str, float]:
        return {name: factor * share for name, share in parts.items()}

    return {
        "neck": (
            *(Option(_toward(shoulders, scaled(NECK_TO_EARS, parts))) for parts in either),
            Option(_toward(shoulders, {nose: NECK_TO_EARS})),
            Option(_toward(shoulders, {}), GUESS),
        ),
        "head_top": (
            Option(_toward(shoulders, {**scaled(by_ears, either[0]), nose: by_nose})),
            *(Option(_toward(shoulders, scaled(HEAD_BY_EARS, parts))) for parts in either),
            Option(_toward(shoulders, {nose: HEAD_BY_NOSE}), GUESS),
        ),
    }


def _same(limbs: Mapping[str, str]) -> dict[str, tuple[Option, ...]]:
    return {joint: (Option({foreign: 1.0}),) for joint, foreign in limbs.items()}


def _mirrored_edges(edges: str) -> str:
    """Edges of the left side, and the same of the right."""
    return f"{edges} {edges.replace('left', 'right')}"


_LEFT_RIGHT = {limb: f"{{}}_{limb}" for limb in LIMBS} | {"right": "right", "left": "left"}
_LIMB_EDGES = _mirrored_edges(
    "left_shoulder-left_elbow left_elbow-left_wrist left_shoulder-left_hip "
    "left_hip-left_knee left_knee-left_ankle"
)
_GIRDLES = "left_shoulder-right_shoulder left_hip-right_hip"
_SHOULDERS, _EARS = ("left_shoulder", "right_shoulder"), ("left_ear", "right_ear")


def _photo_skeleton(skeleton: Skeleton) -> Conversion:
    """A skeleton with COCO's names: limbs by name, neck and head top by shoulders and face."""
    limbs = _limbs(_LEFT_RIGHT)
    return Conversion(
        skeleton=skeleton,
        options=_same(limbs) | _head(_SHOULDERS, _EARS, "nose"),
        back={foreign: {joint: 1.0} for joint, foreign in limbs.items()},
    )


def _coco17() -> Conversion:
    """COCO keypoints (Lin et al. 2014), in the order of its annotation files."""
    names = (
        "nose left_eye right_eye left_ear right_ear left_shoulder right_shoulder left_elbow "
        "right_elbow left_wrist right_wrist left_hip right_hip left_knee right_knee left_ankle "
        "right_ankle"
    )
    face = _mirrored_edges("nose-left_eye left_eye-left_ear left_ear-left_shoulder")
    return _photo_skeleton(_skeleton("coco17", names, f"{face} {_GIRDLES} {_LIMB_EDGES}"))


def _mediapipe33() -> Conversion:
    """MediaPipe Pose's landmarks, in its order."""
    names = (
        "nose left_eye_inner left_eye left_eye_outer right_eye_inner right_eye right_eye_outer "
        "left_ear right_ear mouth_left mouth_right left_shoulder right_shoulder left_elbow "
        "right_elbow left_wrist right_wrist left_pinky right_pinky left_index right_index "
        "left_thumb right_thumb left_hip right_hip left_knee right_knee left_ankle right_ankle "
        "left_heel right_heel left_foot_index right_foot_index"
    )
    ends = _mirrored_edges(
        "nose-left_eye_inner left_eye_inner-left_eye left_eye-left_eye_outer "
        "left_eye_outer-left_ear left_wrist-left_pinky left_wrist-left_index "
        "left_wrist-left_thumb left_pinky-left_index left_ankle-left_heel "
        "left_heel-left_foot_index left_ankle-left_foot_index"
    )
    edges = f"{ends} mouth_left-mouth_right {_GIRDLES} {_LIMB_EDGES}"
    return _photo_skeleton(_skeleton("mediapipe33", names, edges))


def _openpose18() -> Conversion:
    """OpenPose's COCO model (Cao et al. 2017); its neck is the midpoint of the shoulders."""
    names = (
        "Nose Neck RShoulder RElbow RWrist LShoulder LElbow LWrist RHip RKnee RAnkle LHip LKnee "
        "LAnkle REye LEye REar LEar"
    )
    edges = "Nose-Neck " + " ".join(
        f"Neck-{s}Shoulder {s}Shoulder-{s}Elbow {s}Elbow-{s}Wrist Neck-{s}Hip {s}Hip-{s}Knee "
        f"{s}Knee-{s}Ankle Nose-{s}Eye {s}Eye-{s}Ear"
        for s in "RL"
    )
    limbs = _limbs({limb: f"{{}}{limb.title()}" for limb in LIMBS} | {"right": "R", "left": "L"})
    head = _head(("LShoulder", "RShoulder"), ("LEar", "REar"), "Nose")
    head["neck"] += (Option({"Neck": 1.0}, GUESS),)
    return Conversion(
        skeleton=_skeleton("openpose18", names, edges),
        options=_same(limbs) | head,
        back={foreign: {joint: 1.0} for joint, foreign in limbs.items()}
        | {"Neck": {"r_shoulder": 0.5, "l_shoulder": 0.5}},
    )


def _h36m17() -> Conversion:
    """Human3.6M's 17 joints in the order of its common npz form.

    The neck is its thorax, where the shoulders meet. Back from lsp14, the root is the midpoint of
    the hips; spine and neck base, which lsp14 lacks, are put halfway between their neighbours.
    """
    names = (
        "root right_hip right_knee right_foot left_hip left_knee left_foot spine thorax neck_base "
        "head left_shoulder left_elbow left_wrist right_shoulder right_elbow right_wrist"
    )
    sides = _mirrored_edges(
        "root-left_hip left_hip-left_knee left_knee-left_foot thorax-left_shoulder "
        "left_shoulder-left_elbow left_elbow-left_wrist"
    )
    limbs = _limbs(_LEFT_RIGHT | {"ankle": "{}_foot"})
    return Conversion(
        skeleton=_skeleton(
            "h36m17", names, f"root-spine spine-thorax thorax-neck_base neck_base-head {sides}"
        ),
        options=_same(limbs)
        | {"neck": (Option({"thorax": 1.0}),), "head_top": (Option({"head": 1.0}),)},
        back={foreign: {joint: 1.0} for joint, foreign in limbs.items()}
        | {
            "root": {"r_hip": 0.5, "l_hip": 0.5},
            "spine": {"r_hip": 0.25, "l_hip": 0.25, "neck": 0.5},
            "thorax": {"neck": 1.0},
            "neck_base": {"neck": 0.5, "head_top": 0.5},
            "head": {"head_top": 1.0},
        },
    )


def _lsp14() -> Conversion:
    itself = {name: name for name in LSP14.joint_names}
    return Conversion(LSP14, _same(itself), {name: {name: 1.0} for name in itself})


CONVERSIONS: Mapping[str, Conversion] = {
    conversion.skeleton.name: conversion
    for conversion in (_lsp14(), _coco17(), _h36m17(), _openpose18(), _mediapipe33())
}
"""By the skeleton's name."""
