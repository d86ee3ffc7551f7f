"""Sheets of held-out photos with the 2D joints of ours and of the reference networks drawn in.

    python -m evaluation.pose2d_sheets --data DIR --reference DIR --out DIR [--people 200]

A table of distances cannot show whether labels or networks err; eyes can. Every sheet has ten
people side by side, a row for each network. Photos of unstated licence: to look at, not to publish.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

from evaluation.metrics import Floats
from evaluation.pose2d import SCALE, held_out_photos, networks
from evaluation.progress import followed
from library_store.arguments import SEED, integer
from library_store.sheet import draw_bone
from library_store.skeleton import LSP14
from models.training.augment import crop_matrix
from models.training.dataset import Image, LabelledCrop

CELL_PX, PEOPLE_A_SHEET = 152, 10


def drawn(crop: LabelledCrop, joints_px: Floats) -> Image:
    """The square that the networks saw, with a stick figure; joints that are nan are left out."""
    center, extent = crop.extent_px
    matrix = crop_matrix(center, SCALE * extent, 0.0, CELL_PX)
    cell = np.asarray(cv2.warpAffine(crop.image, matrix, (CELL_PX, CELL_PX)), np.uint8)
    at = joints_px @ matrix[:, :2].T + matrix[:, 2]
    for a, b in LSP14.edges:
        if np.isfinite(at[[a, b]]).all():
            draw_bone(cell, at[a], at[b], b, 2)
    return cell


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--reference", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--name", default="cpm-int8")
    parser.add_argument("--people", type=integer(1), default=200)
    parser.add_argument("--seed", type=SEED, default=0)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    crops = held_out_photos(args.data)
    order = np.random.default_rng(args.seed).permutation(len(crops))[: args.people]
    compared = networks(args.name, args.weights, args.reference)
    args.out.mkdir(parents=True, exist_ok=True)
    starts = range(0, len(order), PEOPLE_A_SHEET)
    for start in followed(starts, "sheets"):
        people = [crops[i] for i in order[start : start + PEOPLE_A_SHEET]]
        rows = [np.hstack([drawn(c, run(c)) for c in people]) for run in compared.values()]
        cv2.imwrite(str(args.out / f"sheet_{start // PEOPLE_A_SHEET:02d}.png"), np.vstack(rows))
    print(f"{len(starts)} sheets in {args.out}; rows: {', '.join(compared)}")


if __name__ == "__main__":
    main()
