"""Small motion capture files of one made-up person, in the layouts of the real ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from library_store.anatomy import Float, measure_lengths
from library_store.importers.rotation import euler
from library_store.prior import PosePrior
from library_store.proportions import resize

_ARM, _ARM_R = "180 -30 -90", "180 30 90"
_BONES = (
    # name, direction, length, axis, dof
    ("lhipjoint", "0.655637 -0.713449 0.247245", 2.52691, "0 0 0", ""),
    ("lfemur", "0.34202 -0.939693 0", 7.59371, "0 0 20", "rx ry rz"),
    ("ltibia", "0.34202 -0.939693 0", 7.28717, "0 0 20", "rx"),
    ("rhipjoint", "-0.645062 -0.722004 0.250209", 2.49697, "0 0 0", ""),
    ("rfemur", "-0.34202 -0.939693 0", 7.58734, "0 0 -20", "rx ry rz"),
    ("rtibia", "-0.34202 -0.939693 0", 7.21538, "0 0 -20", "rx"),
    ("lowerback", "0 1 0", 2.05943, "0 0 0", "rx ry rz"),
    ("upperback", "0 1 0", 2.06523, "0 0 0", "rx ry rz"),
    ("thorax", "0 1 0", 2.06523, "0 0 0", "rx ry rz"),
    ("lowerneck", "0 0.995459 0.0950816", 1.57426, "0 0 0", "rx ry rz"),
    ("upperneck", "0 0.997711 -0.0639762", 1.56399, "0 0 0", "rx ry rz"),
    ("head", "0 0.999444 -0.0323691", 1.6265, "0 0 0", "rx ry rz"),
    ("lclavicle", "0.967826 0.247107 -0.0474446", 3.6598, "0 0 0", "ry rz"),
    ("lhumerus", "1 0 0", 4.86513, _ARM, "rx ry rz"),
    ("lradius", "1 0 0", 3.35554, _ARM, "rx"),
    ("lwrist", "1 0 0", 1.67777, "0 90 90", "ry"),
    ("rclavicle", "-0.973174 0.211421 -0.0907389", 3.59444, "0 0 0", "ry rz"),
    ("rhumerus", "-1 0 0", 5.02649, _ARM_R, "rx ry rz"),
    ("rradius", "-1 0 0", 3.36431, _ARM_R, "rx"),
    ("rwrist", "-1 0 0", 1.682155, "0 -90 -90", "ry"),
)
_HIERARCHY = """\
    root lhipjoint rhipjoint lowerback
    lhipjoint lfemur
    lfemur ltibia
    rhipjoint rfemur
    rfemur rtibia
    lowerback upperback
    upperback thorax
    thorax lowerneck lclavicle rclavicle
    lowerneck upperneck
    upperneck head
    lclavicle lhumerus
    lhumerus lradius
    lradius lwrist
    rclavicle rhumerus
    rhumerus rradius
    rradius rwrist
"""
ASF = (
    """\
# AST/ASF file generated using VICON BodyLanguage
:version 1.10
:name VICON
:units
  mass 1.0
  length 0.45
  angle deg
:documentation
   .ast/.asf automatically generated from VICON data
:root
   order TX TY TZ RX RY RZ
   axis XYZ
   position 0 0 0
   orientation 0 0 0
:bonedata
"""
    + "".join(
        f"  begin\n     id {i}\n     name {name}\n     direction {direction}\n"
        f"     length {length}\n     axis {axis}  XYZ\n"
        + (f"    dof {dof}\n    limits (-160.0 20.0)\n           (-70.0 70.0)\n" if dof else "")
        + "  end\n"
        for i, (name, direction, length, axis, dof) in enumerate(_BONES, 1)
    )
    + f":hierarchy\n  begin\n{_HIERARCHY}  end\n"
)

Motion = dict[str, Float]


def walk(n_frames: int = 12) -> Motion:
    """Angles (F, dof) in degrees by bone, and the root's place and angles (F, 6)."""
    phase = np.linspace(0.0, 1.0, n_frames)[:, None]
    motion = {}
    for k, (name, _, _, _, dof) in enumerate(_BONES):
        if dof:
            wave = 12.0 * np.sin(phase + k + np.arange(len(dof.split())))
            bent = 25.0 if name.endswith(("tibia", "radius")) else 0.0
            motion[name] = np.round(wave + bent, 4)
    place = np.concatenate([phase, 17.0 + 0.1 * phase, -30.0 + 3.0 * phase], axis=1)
    motion["root"] = np.round(np.hstack([place, 5.0 * np.sin(phase + np.arange(3))]), 4)
    return motion


def amc(motion: Motion) -> str:
    lines = ["#!OML:ASF made-up.ASF", ":FULLY-SPECIFIED", ":DEGREES"]
    for frame in range(len(motion["root"])):
        lines.append(str(frame + 1))
        lines += [
            f"{n} " + " ".join(f"{v:.10g}" for v in rows[frame]) for n, rows in motion.items()
        ]
    return "\r\n".join(lines) + "\r\n"


# joint, parent, bone that ends there (None: coincides), bone whose rotation the joint has
_CGSPEED: tuple[tuple[str, str, str | None, str | None], ...] = (
    ("Hips", "", None, "root"),
    ("LHipJoint", "Hips", None, None),
    ("LeftUpLeg", "LHipJoint", "lhipjoint", "lfemur"),
    ("LeftLeg", "LeftUpLeg", "lfemur", "ltibia"),
    ("LeftFoot", "LeftLeg", "ltibia", None),
    ("RHipJoint", "Hips", None, None),
    ("RightUpLeg", "RHipJoint", "rhipjoint", "rfemur"),
    ("RightLeg", "RightUpLeg", "rfemur", "rtibia"),
    ("RightFoot", "RightLeg", "rtibia", None),
    ("LowerBack", "Hips", None, "lowerback"),
    ("Spine", "LowerBack", "lowerback", "upperback"),
    ("Spine1", "Spine", "upperback", "thorax"),
    ("Neck", "Spine1", None, "lowerneck"),
    ("Neck1", "Neck", "lowerneck", "upperneck"),
    ("Head", "Neck1", "upperneck", "head"),
    ("LeftShoulder", "Spine1", None, "lclavicle"),
    ("LeftArm", "LeftShoulder", "lclavicle", "lhumerus"),
    ("LeftForeArm", "LeftArm", "lhumerus", "lradius"),
    ("LeftHand", "LeftForeArm", "lradius", "lwrist"),
    ("LeftFingerBase", "LeftHand", None, None),
    ("RightShoulder", "Spine1", None, "rclavicle"),
    ("RightArm", "RightShoulder", "rclavicle", "rhumerus"),
    ("RightForeArm", "RightArm", "rhumerus", "rradius"),
    ("RightHand", "RightForeArm", "rradius", "rwrist"),
    ("RightFingerBase", "RightHand", None, None),
)
_MAX_NAMES = {
    **{f"{s}UpLeg": f"{s}Hip" for s in ("Left", "Right")},
    **{f"{s}Leg": f"{s}Knee" for s in ("Left", "Right")},
    **{f"{s}Foot": f"{s}Ankle" for s in ("Left", "Right")},
    **{f"{s}Shoulder": f"{s}Collar" for s in ("Left", "Right")},
    **{f"{s}Arm": f"{s}Shoulder" for s in ("Left", "Right")},
    **{f"{s}ForeArm": f"{s}Elbow" for s in ("Left", "Right")},
    **{f"{s}Hand": f"{s}Wrist" for s in ("Left", "Right")},
    "LowerBack": "lowerback",
    "Spine": "Chest",
    "Spine1": "Chest2",
    "Neck": "lowerneck",
    "Neck1": "Neck",
    "LeftFingerBase": "lhand",
    "RightFingerBase": "rhand",
}


def zyx_angles(matrix: Float) -> Float:
    """Angles (..., 3) in degrees with Rz Ry Rx = matrix (..., 3, 3)."""
    z = np.arctan2(matrix[..., 1, 0], matrix[..., 0, 0])
    y = np.arcsin(np.clip(-matrix[..., 2, 0], -1.0, 1.0))
    x = np.arctan2(matrix[..., 2, 1], matrix[..., 2, 2])
    angles: Float = np.rad2deg(np.stack([z, y, x], axis=-1))
    return angles


def cmu_bvh(motion: Motion, *, max_names: bool = False) -> str:
    """The motion as CMU's conversions write it: no thorax, no wrist bones; a T-pose first."""
    bones = {name: (d, length, axis, dof) for name, d, length, axis, dof in _BONES}
    children: dict[str, list[str]] = {}
    for joint, parent, _, _ in _CGSPEED:
        children.setdefault(parent, []).append(joint)
    rows = {joint: row for joint, *row in _CGSPEED}
    n_frames = len(motion["root"])
    columns: list[Float] = []

    def block(joint: str, depth: int) -> str:
        _, bone, turning = rows[joint]
        pad = "  " * depth
        name = _MAX_NAMES.get(joint, joint) if max_names else joint
        offset = np.zeros(3)
        if bone is not None:
            offset = np.array(bones[bone][0].split(), dtype=float) * bones[bone][1]
        angles = np.zeros((n_frames, 3))
        if joint == "Hips":
            columns.append(motion["root"][:, :3])
            angles = motion["root"][:, [5, 4, 3]]
        elif turning is not None:
            _, _, axis, dof = bones[turning]
            frame = euler("zyx", np.array(axis.split()[::-1], dtype=float))
            axes = "".join(d[1] for d in reversed(dof.split()))
            angles = zyx_angles(frame @ euler(axes, motion[turning][:, ::-1]) @ frame.T)
        columns.append(angles)
        place = "6 Xposition Yposition Zposition" if joint == "Hips" else "3"
        text = f"{pad}{'ROOT' if joint == 'Hips' else 'JOINT'} {name}\n{pad}{{\n"
        text += f"{pad}  OFFSET {offset[0]:.8f} {offset[1]:.8f} {offset[2]:.8f}\n"
        text += f"{pad}  CHANNELS {place} Zrotation Yrotation Xrotation\n"
        text += "".join(block(child, depth + 1) for child in children.get(joint, []))
        if joint not in children:
            tip = np.array([0.0, 0.999444, -0.0323691]) * 1.6265
            text += f"{pad}  End Site\n{pad}  {{\n{pad}    OFFSET {tip[0]} {tip[1]} {tip[2]}\n"
            text += f"{pad}  }}\n"
        return f"{text}{pad}}}\n"

    hierarchy = block("Hips", 0)
    values = np.hstack(columns)
    if not max_names:
        t_pose = np.zeros_like(values[:1])
        t_pose[:, :3] = values[:1, :3]
        values = np.vstack([t_pose, values])
    lines = "\n".join(" ".join(f"{v:.7f}" for v in row) for row in values)
    return f"HIERARCHY\n{hierarchy}MOTION\nFrames: {len(values)}\nFrame Time: .0083333\n{lines}\n"


def nested(path: Path, value: Any) -> Path:
    """An npz whose ``positions_3d`` is an object array that holds ``value``."""
    holder = np.empty((), dtype=object)
    holder[()] = value
    np.savez_compressed(path, positions_3d=holder)
    return path


ADULT_MM = np.array([520.0, 180.0, 180.0, 245.0, 290.0, 260.0, 410.0, 420.0])
"""Lengths of a person of whom no check has any doubt, in the order of ``anatomy.LENGTHS``."""


def people(n: int = 40, seed: int = 5) -> Float:
    """Poses (n, 14, 3) of one person in mm, Y up, moving smoothly."""
    drawn = PosePrior.load().sample(1, np.random.default_rng(seed))
    pose = resize(drawn, ADULT_MM / measure_lengths(drawn))[0]
    angles = np.zeros((n, 3))
    angles[:, 1] = np.linspace(0.0, 60.0, n)
    turned: Float = pose @ euler("zyx", angles).transpose(0, 2, 1)
    turned += np.array([0.0, 900.0, 0.0])
    return turned
