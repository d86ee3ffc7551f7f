"""BVH files for tests: a chain of two joints, and the walk under names of other programs."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from library_store.anatomy import Float, root_of
from library_store.importers import Clip
from tests.library_store.importers.files import cmu_bvh, walk

CHAIN = """\
HIERARCHY
ROOT a
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Yrotation Xrotation Zrotation
  JOINT b
  {
    OFFSET 0 2 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 1 0 0
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.04
1 2 3 0 0 0 0 0 0
1 2 3 90 0 0 90 0 0
"""

LIMBS = ("Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot")
JAW = "JOINT Jaw\n{\nOFFSET 0 0.5 0.5\nCHANNELS 0\nEnd Site\n{\nOFFSET 0 0 1\n}\n}\n"


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def centred(clip: Clip) -> Float:
    positions = clip.positions_mm.astype(np.float64)
    return positions - root_of(positions)[:, None]


def scaled(text: str, factor: float) -> str:
    """A BVH file with all its offsets times ``factor``; how the root moves is left."""
    return re.sub(
        r"OFFSET (\S+) (\S+) ([^\s}]+)",
        lambda found: "OFFSET " + " ".join(f"{float(v) * factor:.9f}" for v in found.groups()),
        text,
    )


def renamed(pattern: str, limbs: tuple[str, ...], sides: tuple[str, str]) -> str:
    """The walk under other joint names; no thorax is lost, as far as names tell."""
    text = cmu_bvh(walk()).replace("Spine1", "Spine2").replace("Neck1", "Neck9")
    for side, other in zip(("Right", "Left"), sides, strict=True):
        for limb, new in zip(LIMBS, limbs, strict=True):
            name = pattern.format(side=other, limb=new)
            text = re.sub(rf"(ROOT|JOINT) {side}{limb}\b", rf"\1 {name}", text)
    return text
