"""Neck and head top from a face: the weights of ``library_store.conversion``, fitted and checked.

    python -m evaluation.conversion --data DIR

``--data`` has ``photos_a.tar`` and ``photos_b.tar``: people with 33 landmarks of one network and
the 14 joints of another. Used are those whose shoulders and hips agree within 0.2 torso lengths.
Fitted by iteratively reweighted least squares (the sum of distances), checked on other photos.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from evaluation.metrics import Floats
from library_store.conversion import (
    CONVERSIONS,
    HEAD_BY_EARS,
    HEAD_BY_EARS_AND_NOSE,
    HEAD_BY_NOSE,
    NECK_TO_EARS,
)
from library_store.skeleton import HEAD_TOP, NECK
from models.training.dataset import in_held_out_group, read_annotations

GIRDLES_IN_AGREEMENT = (0, 3, 6, 9)
MAX_DISAGREEMENT, MIN_CONFIDENCE = 0.2, 0.5
ROUNDS, LEAST_DISTANCE = 20, 0.02


def read_people(path: Path) -> tuple[Floats, Floats, np.ndarray]:
    """Landmarks (P, 33, 2), lsp14 joints (P, 14, 2), both in torso lengths; held out (P,) bool."""
    landmarks, joints, held_out = [], [], []
    names = CONVERSIONS["mediapipe33"].skeleton
    for record in read_annotations(path):
        agreement = [np.inf if v is None else v for v in record["agreement"]]
        sure = min(record["cpm_confidence"][:2]) >= MIN_CONFIDENCE
        agree = max(agreement[i] for i in GIRDLES_IN_AGREEMENT) <= MAX_DISAGREEMENT
        if record["squashed"] or not (sure and agree):
            continue
        points = np.asarray(record["mp33_px"], np.float64)
        torso = max(
            np.linalg.norm(points[names.index(a)] - points[names.index(b)])
            for a, b in (("left_shoulder", "right_hip"), ("right_shoulder", "left_hip"))
        )
        landmarks.append(points / torso)
        joints.append(np.asarray(record["cpm14_px"], np.float64) / torso)
        held_out.append(in_held_out_group(int(record["photo"])))
    return np.array(landmarks), np.array(joints), np.array(held_out)


def fit(features: Floats, target: Floats) -> Floats:
    """Weights (K,) of the offsets ``features`` (P, K, 2) whose sum is near ``target`` (P, 2)."""
    trust = np.ones(len(target))
    weights: Floats = np.zeros(features.shape[1])
    for _ in range(ROUNDS):
        root = np.sqrt(trust)
        design = (features * root[:, None, None]).transpose(0, 2, 1).reshape(-1, len(weights))
        aim = (target * root[:, None]).ravel()
        weights = np.asarray(np.linalg.lstsq(design, aim, rcond=None)[0], np.float64)
        trust = 1 / np.maximum(_distance(features, target, weights), LEAST_DISTANCE)
    return weights


def _distance(features: Floats, target: Floats, weights: Floats) -> Floats:
    distance: Floats = np.linalg.norm(np.einsum("pkd,k->pd", features, weights) - target, axis=1)
    return distance


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    args = parser.parse_args()
    people = [read_people(path) for path in sorted(args.data.glob("photos_[ab].tar"))]
    kept = [p for p in people if len(p[2])]
    if not kept:
        parser.error(f"--data {args.data} has no photos_a.tar or photos_b.tar with people to use")
    landmarks, joints, held_out = (np.concatenate(parts) for parts in zip(*kept, strict=True))
    index = CONVERSIONS["mediapipe33"].skeleton.index
    shoulders = landmarks[:, [index("left_shoulder"), index("right_shoulder")]].mean(1)
    ears = landmarks[:, [index("left_ear"), index("right_ear")]].mean(1) - shoulders
    nose = landmarks[:, index("nose")] - shoulders
    print(f"{(~held_out).sum()} people to fit, {held_out.sum()} held out\n")
    middle = np.linalg.norm(joints[held_out, NECK] - shoulders[held_out], axis=1)
    print(f"neck to the shoulders' midpoint: median {np.median(middle):.3f}\n")
    print("| joint | by | fitted | in use | held out: median, 90% (torso lengths) |")
    print("|---|---|---|---|---|")
    for joint, name, by, features, used in (
        (NECK, "neck", "ears", ears[:, None], (NECK_TO_EARS,)),
        (HEAD_TOP, "head top", "nose", nose[:, None], (HEAD_BY_NOSE,)),
        (HEAD_TOP, "head top", "ears", ears[:, None], (HEAD_BY_EARS,)),
        (HEAD_TOP, "head top", "ears, nose", np.stack([ears, nose], 1), HEAD_BY_EARS_AND_NOSE),
    ):
        target = joints[:, joint] - shoulders
        fitted = fit(features[~held_out], target[~held_out])
        off = _distance(features[held_out], target[held_out], np.asarray(used, np.float64))
        print(
            f"| {name} | {by} | {', '.join(f'{w:.3f}' for w in fitted) or '-'} "
            f"| {', '.join(f'{w:.3f}' for w in used) or '-'} "
            f"| {np.median(off):.3f}, {np.quantile(off, 0.9):.3f} |"
        )


if __name__ == "__main__":
    main()
