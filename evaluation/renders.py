"""The whole pipeline on rendered people with exact truth: photo in, 2D and 3D errors out.

    python -m evaluation.renders --data DIR [--own-boxes]

``--data`` has the JPEGs and a ``ground_truth.json`` as in ``tests/data/renders``. The service's own
settings (POSEMATCH_*) choose model and library. The true focal length is given.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from app.engine import load_engine
from app.lifting.types import LiftedPerson
from app.pipeline import PhotoQuery, SeenPerson
from app.settings import load_settings
from evaluation.metrics import (
    Floats,
    root_centred_error_mm,
    similarity_error_mm,
)
from library_store.skeleton import LIMB_JOINTS
from models.pck import correct_keypoints

LIMBS = list(LIMB_JOINTS)


def nearest(people: tuple[SeenPerson, ...], truth_px: Floats) -> SeenPerson | None:
    """The answered person whose joints lie nearest to the truth, None when nobody is near."""
    extent = float(np.ptp(truth_px, axis=0).max())
    best, least = None, 0.5 * extent
    for person in people:
        distance = float(np.linalg.norm(person.joints_px.mean(0) - truth_px.mean(0)))
        if distance < least:
            best, least = person, distance
    return best


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--own-boxes", action="store_true", help="detect, instead of the true box")
    args = parser.parse_args()
    pipeline = load_engine(load_settings()).pipeline
    records = json.loads((args.data / "ground_truth.json").read_text())["images"]

    print("| image | people | PCK@0.2, 12 limb joints | PA mm, 12 | root-relative mm, 14 |")
    print("|---|---|---|---|---|")
    near, similar, centred = [], [], []
    for record in records:
        truth_px = np.asarray(record["joints_2d_px"], np.float64)
        truth_mm = np.asarray(record["joints_3d_mm"], np.float64)
        low = truth_px.min(0)
        box = None if args.own_boxes else (*low, *(truth_px.max(0) - low))
        query = PhotoQuery(focal_length_px=float(record["K"][0][0]), box_px=box)
        result = pipeline.estimate((args.data / record["file"]).read_bytes(), query)
        person = nearest(result.people, truth_px)
        if person is None or not isinstance(person.lifted, LiftedPerson):
            near.append(np.zeros(len(LIMBS), bool))
            print(f"| {record['file']} | {len(result.people)} | not found | - | - |")
            continue
        answer = person.lifted.joints_3d_mm
        near.append(correct_keypoints(person.joints_px, truth_px)[LIMBS])
        similar.append(float(similarity_error_mm(answer[LIMBS], truth_mm[LIMBS]).mean()))
        centred.append(float(root_centred_error_mm(answer, truth_mm).mean()))
        print(
            f"| {record['file']} | {len(result.people)} | {100 * near[-1].mean():.0f} "
            f"| {similar[-1]:.0f} | {centred[-1]:.0f} |"
        )
    print(
        f"| **mean ({len(similar)} of {len(records)} lifted)** | | **{100 * np.mean(near):.1f}** "
        f"| **{np.mean(similar):.0f}** | **{np.mean(centred):.0f}** |"
    )
    print(f"| median | | | {np.median(similar):.0f} | {np.median(centred):.0f} |")


if __name__ == "__main__":
    main()
