"""Whose labels have right and left exchanged: ``python -m models.training.side_doubts --help``.

People who label photos of sports confuse right and left of people seen from behind or head over
heels. A teacher that never saw these labels (BlazePose heavy) looks at every labelled crop, turned
upright by its labels; where it sees a half of the body the other way round, those labels are
doubted. Doubts are written beside the dataset, ``NAME.sides.json``, where training finds them
(``read_crops``); objective.py says what they do.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from library_store.skeleton import L_HIP, L_SHOULDER, LSP14, R_HIP, R_SHOULDER
from models.training.dataset import MP33_LIMBS, LabelledCrop, SideDoubt, load, sides_file
from models.training.teachers import BlazePose

HALVES = ((2, 3, 4), (8, 9, 10))
"""Right shoulder, elbow, wrist; right hip, knee, ankle."""
APART = 0.15
"""Of the person's extent: below, the two joints of a pair have no sides to tell."""
DECIDED = 0.5
"""The teacher sees a way round if its joints are so much nearer to the labels that way."""
AGAINST, UNDECIDED, FOR = -1, 0, 1
"""The teacher sees a half exchanged, cannot tell, sees it as labelled."""
DOUBT = {
    (AGAINST, AGAINST): 0.75,
    (AGAINST, UNDECIDED): 0.6,
    (UNDECIDED, AGAINST): 0.4,
    (AGAINST, FOR): 0.4,
    (UNDECIDED, UNDECIDED): 0.06,
    (UNDECIDED, FOR): 0.04,
    (FOR, UNDECIDED): 0.02,
    (FOR, AGAINST): 0.04,
    (FOR, FOR): 0.01,
}
"""How probably a half's labels are exchanged, by what the teacher sees of it and of the other half.
After the people of ``evaluation/lspet_sides.json`` and how often heavy is wrong about them."""


def doubts(crop: LabelledCrop, seen_px: NDArray[np.float64]) -> SideDoubt:
    """Of the upper and the lower half; ``seen_px`` (14, 2) is what the teacher sees."""
    _, extent = crop.extent_px
    found = []
    for half in HALVES:
        right = np.array(half)
        left = np.array([LSP14.mirror[j] for j in half])
        known = (crop.weight[right] > 0) & (crop.weight[left] > 0)
        gap = np.linalg.norm(crop.joints_px[right] - crop.joints_px[left], axis=1)
        pairs = known & (gap > APART * extent)
        both = np.concatenate([right[pairs], left[pairs]])
        other = np.concatenate([left[pairs], right[pairs]])
        as_labelled = _distance(seen_px, crop, both, both)
        exchanged = _distance(seen_px, crop, both, other)
        if not pairs.any():
            found.append(UNDECIDED)
        elif exchanged < DECIDED * as_labelled:
            found.append(AGAINST)
        elif as_labelled < DECIDED * exchanged:
            found.append(FOR)
        else:
            found.append(UNDECIDED)
    upper, lower = found
    return DOUBT[upper, lower], DOUBT[lower, upper]


def _distance(
    seen_px: NDArray[np.float64],
    crop: LabelledCrop,
    seen: NDArray[np.int64],
    labels: NDArray[np.int64],
) -> float:
    return float(np.linalg.norm(seen_px[seen] - crop.joints_px[labels], axis=1).sum())


def look(teacher: BlazePose, crop: LabelledCrop) -> NDArray[np.float64]:
    """The teacher's limbs, (14, 2) pixels of the crop, head top and neck nan."""
    centre, extent = (np.asarray(value, np.float64) for value in crop.extent_px)
    joints = crop.joints_px.astype(np.float64)
    up = joints[[R_SHOULDER, L_SHOULDER]].mean(0) - joints[[R_HIP, L_HIP]].mean(0)
    if not crop.has_torso or not np.linalg.norm(up) > 0:
        up = np.array([0.0, -1.0])
    reach = 0.5 * extent * up / np.linalg.norm(up)
    landmarks, _ = teacher.landmarks(crop.image, centre, centre + reach)
    seen = np.full((LSP14.n_joints, 2), np.nan)
    seen[2:] = landmarks[list(MP33_LIMBS)]
    return seen


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder with the datasets")
    parser.add_argument("--names", default="lspet_train_a,lspet_train_b", help='without ".tar"')
    parser.add_argument("--reference", type=Path, required=True, help="folder of blazepose_*.onnx")
    args = parser.parse_args()
    teacher = BlazePose(args.reference)
    console = Console(stderr=True)
    for name in args.names.split(","):
        crops = load(args.data / f"{name}.tar")
        told = {
            crop.name: doubts(crop, look(teacher, crop))
            for crop in track(crops, name, transient=True, console=console)
        }
        sides_file(args.data / f"{name}.tar").write_text(json.dumps(told))
        upper, lower = np.mean(list(told.values()), axis=0)
        print(f"{name}: {len(told)} people, doubts {upper:.3f} and {lower:.3f} on average")


if __name__ == "__main__":
    main()
