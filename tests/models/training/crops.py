"""Somebody who stands, as a labelled crop of one colour."""

import numpy as np

from library_store.skeleton import LSP14
from models.training.dataset import LabelledCrop

SIZE = (320, 256)
STANDING = {
    "head_top": (60, 10),
    "neck": (60, 26),
    "r_shoulder": (48, 32),
    "r_elbow": (42, 50),
    "r_wrist": (40, 66),
    "l_shoulder": (72, 32),
    "l_elbow": (78, 50),
    "l_wrist": (80, 66),
    "r_hip": (52, 66),
    "r_knee": (52, 88),
    "r_ankle": (52, 110),
    "l_hip": (68, 66),
    "l_knee": (68, 88),
    "l_ankle": (68, 110),
}


def standing(colour: int = 200) -> LabelledCrop:
    joints = np.array([STANDING[name] for name in LSP14.joint_names], np.float32)
    return LabelledCrop(
        name="x",
        group=0,
        image=np.full((120, 120, 3), colour, np.uint8),
        joints_px=joints,
        weight=np.ones(14, np.float32),
        visible=np.ones(14, np.float32),
        wild=False,
    )
