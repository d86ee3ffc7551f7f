"""A contact sheet of a prior: a row of sampled people for each thing that is done to them.

They are as libraries have them, of even proportions.

python -m library_store.prior_sheet --out docs/images/prior.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from library_store.arguments import integer
from library_store.cameras import extrinsics
from library_store.prior import DEFAULT_PRIOR, KINDS, PosePrior
from library_store.sheet import BACKGROUND, TEXT, TILE_PX, draw_pose

Image = NDArray[np.uint8]

_LABEL_PX = 22
_VIEWS_DEG = (25.0, -60.0, 115.0)


def prior_sheet(prior: PosePrior, columns: int) -> Image:
    """A picture (H, W, 3) uint8 BGR: ``columns`` people of each of ``prior.KINDS``.

    Level cameras 8 degrees above, from three sides in turn. Raises ``ValueError`` when the prior
    makes fewer than ``columns`` people of a kind among 20,000.
    """
    drawn = prior.draw(20_000, np.random.default_rng(0), evened=True)
    rows = []
    for number, kind in enumerate(KINDS):
        poses = drawn.poses[drawn.kinds == number][:columns]
        if len(poses) < columns:
            raise ValueError(f"the prior makes only {len(poses)} of 20,000 people {kind}")
        views = np.resize(_VIEWS_DEG, columns)
        cameras = np.column_stack([views, np.tile((8.0, 0.0, 4500.0), (columns, 1))])
        rotations, translations = extrinsics(cameras, poses)
        seen = np.einsum("nij,nkj->nki", rotations, poses) + translations[:, None]
        rows += [_label(kind, columns), np.concatenate([_tile(pose) for pose in seen], axis=1)]
    return np.concatenate(rows)


def _tile(pose_mm: NDArray[np.float64]) -> Image:
    tile = np.full((TILE_PX, TILE_PX, 3), BACKGROUND, dtype=np.uint8)
    draw_pose(tile, pose_mm)
    return tile


def _label(text: str, columns: int) -> Image:
    label = np.full((_LABEL_PX, columns * TILE_PX, 3), BACKGROUND, dtype=np.uint8)
    cv2.putText(label, text, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.5, TEXT, 1, cv2.LINE_AA)
    return label


def main() -> None:
    """The command line: draw, shrink by half, write a PNG."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--prior", type=Path, default=DEFAULT_PRIOR)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--columns", type=integer(1), default=10)
    arguments = parser.parse_args()
    sheet = prior_sheet(PosePrior.load(arguments.prior), arguments.columns)
    half = cv2.resize(sheet, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    if not cv2.imwrite(str(arguments.out), half, [cv2.IMWRITE_PNG_COMPRESSION, 9]):
        raise SystemExit(f"{arguments.out} cannot be written")


if __name__ == "__main__":
    main()
