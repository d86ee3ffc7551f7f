"""How deep joints lie in photos, by a teacher: ``python -m models.training.depth_teacher --help``.

Rendered people have their depths; photos have none, and a network that has only seen rendered ones
reads photos worse. BlazePose heavy says where 33 landmarks are in metres (its fourth output): for
the people of a set of crops, on a view turned upright by their trunk, the depths of the twelve limb
joints are kept where it puts the joint about where the label is.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from library_store.skeleton import LSP14
from models.training.dataset import MP33_LIMBS, TORSO, LabelledCrop, load
from models.training.teachers import BlazePose, circle

Floats = NDArray[np.float64]

AGREED = 0.25
"""Distance of the teacher's joint from the label's over the trunk's length, at most."""
SURE = 0.5
"""Least presence that the teacher gives to the person."""


def depths_px(crop: LabelledCrop, teacher: BlazePose) -> NDArray[np.float32]:
    """Depths (14,) less the hips', in the crop's pixels; nan where they are not to be trusted."""
    unknown = np.full(LSP14.n_joints, np.nan, np.float32)
    if not crop.has_torso:
        return unknown
    about = circle(crop.joints_px, crop.weight > 0)
    if about is None:
        return unknown
    seen = teacher.person(crop.image, *about)
    limbs = list(MP33_LIMBS)
    apart = np.linalg.norm(seen.landmarks_px[limbs] - crop.joints_px[2:], axis=1)
    shoulders, hips = (crop.joints_px[list(pair)].mean(0) for pair in (TORSO[:2], TORSO[2:]))
    length = np.linalg.norm(shoulders - hips)
    agreed = (apart < AGREED * length) & (crop.weight[2:] > 0) & (seen.score > SURE)
    unknown[2:] = np.where(agreed, seen.depths_px[limbs], np.nan)
    return unknown


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", type=Path, nargs="+", required=True, help="tars of crops")
    parser.add_argument("--teacher", type=Path, required=True, help="folder with blazepose_*.onnx")
    parser.add_argument("--out", type=Path, required=True, help="folder for a NAME.npz per set")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    teacher = BlazePose(args.teacher)
    args.out.mkdir(parents=True, exist_ok=True)
    for path in args.sets:
        crops = load(path)
        console = Console(stderr=True)
        found = [depths_px(crop, teacher) for crop in track(crops, path.name, console=console)]
        depths = np.stack(found)
        np.savez_compressed(
            args.out / f"{path.stem}.npz", image=[crop.name for crop in crops], depths_px=depths
        )
        print(f"{path.name}: {np.isfinite(depths[:, 2:]).mean():.0%} of limb joints have a depth")


if __name__ == "__main__":
    main()
