"""A person made of boxes in the layout of MPFB's data folder, so that tests need no download."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

# Heads of the bones, middle and left; x to the person's left, y up, z forward, decimetres.
MIDDLE = {
    "Root": (0, 0, 0),
    "pelvis": (0, 0.3, 0),
    "spine_01": (0, 1, 0),
    "spine_02": (0, 2.2, 0),
    "spine_03": (0, 3.5, 0),
    "neck_01": (0, 5.9, 0),
    "head": (0, 6.6, 0.1),
}
LEFT = {
    "clavicle": (0.3, 5.3, 0),
    "upperarm": (1.8, 5.1, 0),
    "lowerarm": (3.8, 3.2, 0),
    "hand": (5.2, 1.9, 0.8),
    "thigh": (1, 0, 0),
    "calf": (1.3, -4.2, 0.1),
    "foot": (1.5, -8.3, -0.1),
    "ball": (1.5, -8.8, 1.2),
}
FINGERS = {"thumb": 0.6, "index": 0.4, "middle": 0.15, "ring": -0.1, "pinky": -0.3}
PARENT = {
    "pelvis": "Root",
    "spine_01": "pelvis",
    "spine_02": "spine_01",
    "spine_03": "spine_02",
    "neck_01": "spine_03",
    "head": "neck_01",
    "clavicle": "spine_03",
    "upperarm": "clavicle",
    "lowerarm": "upperarm",
    "hand": "lowerarm",
    "thigh": "pelvis",
    "calf": "thigh",
    "foot": "calf",
    "ball": "foot",
}
END = {"head": (0, 8.6, 0.1), "pelvis": (0, 1, 0), "ball": (1.5, -8.8, 2)}
RADIUS = {"pelvis": 1.3, "spine_01": 1.2, "spine_02": 1.3, "spine_03": 1.5, "head": 0.8}
MARKERS = {
    "shoulder": "upperarm",
    "elbow": "lowerarm",
    "hand": "hand",
    "upper-leg": "thigh",
    "knee": "calf",
    "ankle": "foot",
}
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
SIDES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))


def _bones() -> tuple[dict[str, tuple[float, ...]], dict[str, str]]:
    heads: dict[str, tuple[float, ...]] = dict(MIDDLE)
    parents = {b: PARENT.get(b, "") for b in MIDDLE}
    for side, sign in (("l", 1), ("r", -1)):
        for bone, (x, y, z) in LEFT.items():
            heads[f"{bone}_{side}"] = (sign * x, y, z)
            above = PARENT[bone]
            parents[f"{bone}_{side}"] = above if above in MIDDLE else f"{above}_{side}"
        x, y, z = LEFT["hand"]
        for finger, across in FINGERS.items():
            for n in (1, 2, 3):
                step = 0.5 + 0.3 * n
                at = (sign * (x + 0.7 * step), y - 0.7 * step, z + 0.2 * step + across)
                heads[f"{finger}_0{n}_{side}"] = at
                above = "hand" if n == 1 else f"{finger}_0{n - 1}"
                parents[f"{finger}_0{n}_{side}"] = f"{above}_{side}"
    return heads, parents


def write_box_body(folder: Path) -> Path:
    """Write the folder and return it."""
    heads, parents = _bones()
    lines: list[str] = []
    weights: dict[str, list[list[float]]] = {b: [] for b in heads}
    count = 0

    def box(group: str, bone: str, a: np.ndarray, b: np.ndarray, radius: float) -> None:
        nonlocal count
        lines.append(f"g {group}")
        low, high = np.minimum(a, b) - radius, np.maximum(a, b) + radius
        for corner in CORNERS:
            x, y, z = np.where(corner > 0, high, low)
            lines.append(f"v {x:.4f} {y:.4f} {z:.4f}")
        for side in SIDES:
            lines.append("f " + " ".join(f"{count + c + 1}/1" for c in side))
        weights[bone] += [[count + c, 1.0] for c in range(8)]
        count += 8

    rig: dict[str, dict[str, object]] = {}
    for bone, head in heads.items():
        at = np.array(head)
        name, _, side = bone.rpartition("_")
        child = next((c for c, p in parents.items() if p == bone), bone)
        end = np.array(heads[child])
        if bone in END or name in END:
            end = np.array(END.get(bone, END.get(name, (0, 0, 0))), float)
            end[0] *= -1 if side == "r" and name in END else 1
        box(f"joint-bone-{bone}", bone, at, at, 0.01)
        rig[bone] = {
            "head": {"strategy": "CUBE", "cube_name": f"joint-bone-{bone}"},
            "parent": parents[bone] or None,
        }
        if bone != "Root":
            box("body", bone, at, end, RADIUS.get(bone, 0.12 if "_0" in bone else 0.4))
    for side in "lr":
        for marker, bone in MARKERS.items():
            at = np.array(heads[f"{bone}_{side}"])
            box(f"joint-{side}-{marker}", f"{bone}_{side}", at, at, 0.01)
        eye = np.array([0.3 if side == "l" else -0.3, 7.6, 0.85])
        box(f"joint-{side}-eye", "head", eye, eye, 0.01)
        box(f"helper-{side}-eye", "head", eye, eye, 0.12)
    neck, mouth = np.array(heads["neck_01"]), np.array([0, 7.2, 0.9])
    box("joint-neck", "neck_01", neck, neck, 0.01)
    box("joint-mouth", "head", mouth, mouth, 0.01)
    for part in ("3dobjs", "rigs/standard"):
        (folder / part).mkdir(parents=True)
    (folder / "3dobjs/base.obj").write_text("\n".join(lines))
    (folder / "rigs/standard/rig.game_engine.json").write_text(json.dumps({"bones": rig}))
    (folder / "rigs/standard/weights.game_engine.json").write_text(json.dumps({"weights": weights}))
    return folder
