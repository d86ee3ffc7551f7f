"""People who overlap: how often somebody is given the limbs of the one beside them.

    python -m evaluation.overlap --data DIR --reference DIR [--pairs 300] [--seed 0]

Held-out people of ``lspet_val.tar`` and ``photos_*.tar``, two at a time: one is cut out along the
limbs and set before another, of about the same size, so that their boxes overlap. Every network of
``evaluation.pose2d`` gets each of the two by the true square; ours both at once, as in the service
(models/rivals.py), and each alone. A limb joint that can be seen counts as *exchanged* when it is
put within a fifth of the torso of the other one's joint of that kind, left or right, and is further
than that from the own one.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from evaluation.metrics import Floats
from evaluation.pose2d import (
    Estimate,
    held_out_photos,
    networks,
    pose_estimator,
    true_square,
)
from evaluation.progress import followed
from library_store.arguments import SEED, integer
from library_store.skeleton import LIMB_JOINTS, LSP14
from models.pck import correct_keypoints, torso_px
from models.training.cutout import over, place, silhouette, whole
from models.training.dataset import LabelledCrop, load

COVERED = 0.3
"""Share of the one in front at a joint from which the one behind cannot show it."""
NEAR = 0.2
"""Torso lengths within which a joint counts as found, as in PCK@0.2."""
LEAST_WEIGHT = 0.6
"""Teachers' labels that are less sure than that are no truth to count by."""


@dataclass(frozen=True)
class Pair:
    """Two people in one picture: behind and in front; ``seen`` (2, 14) bool, by joint."""

    people: tuple[LabelledCrop, LabelledCrop]
    seen: NDArray[np.bool_]


def pair(behind: LabelledCrop, front: LabelledCrop, rng: np.random.Generator) -> Pair:
    """Set ``front`` before ``behind``, a little to the side, at about the same size."""
    centre, extent = behind.extent_px
    rim = round(0.6 * extent)
    image = cv2.copyMakeBorder(behind.image, rim, rim, rim, rim, cv2.BORDER_REPLICATE)
    behind_px = behind.joints_px + np.float32(rim)
    own_centre, own_extent = front.extent_px
    scale = extent / own_extent * float(np.exp(rng.normal(0, 0.1)))
    width = (np.ptp(behind.joints_px[:, 0]) + scale * np.ptp(front.joints_px[:, 0])) / 2
    aside = rng.choice([-1, 1]) * rng.uniform(0.35, 0.8) * width
    target = centre + rim + np.array([aside, rng.normal(0, 0.06) * extent])
    size = (image.shape[1], image.shape[0])
    shift = (target - own_centre * scale).astype(np.float64)
    placed, matrix = place(front.image, size, scale, shift, False, np.zeros(3))
    mask, _ = place(silhouette(front), size, scale, shift, False, np.zeros(3))
    both = over(image, placed, mask)
    front_px = front.joints_px @ matrix[:, :2].T + matrix[:, 2]

    def uncovered(joints_px: NDArray[np.float32], cover: NDArray[np.float32]) -> NDArray[np.bool_]:
        at = np.rint(joints_px).astype(int)
        x, y = np.clip(at, 0, np.array(size) - 1).T
        shown: NDArray[np.bool_] = np.all((at >= 0) & (at < size), axis=1)
        shown &= cover[y, x] < COVERED
        return shown

    people = (
        replace(behind, image=both, joints_px=behind_px),
        replace(front, image=both, joints_px=front_px.astype(np.float32)),
    )
    seen = [uncovered(behind_px, mask), uncovered(people[1].joints_px, np.zeros_like(mask))]
    return Pair(people, np.stack(seen))


@dataclass(frozen=True)
class Score:
    """Per cent of the limb joints that can be seen: right, and given to the other one."""

    right: float
    exchanged: float


EstimateBoth = Callable[[Pair], list[Floats]]


def alone(estimate: Estimate) -> EstimateBoth:
    """A network that looks at each of the two as if there were nobody else."""
    return lambda two: [estimate(person) for person in two.people]


def together(name: str, weights: Path | None) -> EstimateBoth:
    """Our network as the service runs it: all people of a photo at once."""
    estimator = pose_estimator(name, weights)

    def estimate(two: Pair) -> list[Floats]:
        boxes = [true_square(person) for person in two.people]
        return [found.positions_px for found in estimator.estimate(two.people[0].image, boxes)]

    return estimate


def score(estimate: EstimateBoth, pairs: list[Pair], label: str) -> Score:
    """Run a network over both people of each pair."""
    found: list[Floats] = []
    truth, other, seen = [], [], []
    for two in followed(pairs, label):
        found += estimate(two)
        for i, person in enumerate(two.people):
            truth.append(person.joints_px)
            other.append(two.people[1 - i].joints_px)
            seen.append(two.seen[i] & (person.weight >= LEAST_WEIGHT))
    return counted(np.array(found), np.array(truth), np.array(other), np.array(seen))


def counted(found: Floats, truth: Floats, other: Floats, seen: NDArray[np.bool_]) -> Score:
    """Score of joints (N, 14, 2) px against the own and the other person's; ``seen`` (N, 14)."""
    limbs = list(LIMB_JOINTS)
    right = correct_keypoints(found, truth, NEAR)
    tolerance = NEAR * torso_px(truth)[:, None]
    theirs = np.minimum(
        np.linalg.norm(found - other, axis=-1),
        np.linalg.norm(found - other[:, list(LSP14.mirror)], axis=-1),
    )
    exchanged = ~right & (theirs < tolerance)
    counts = seen[:, limbs]
    return Score(
        100 * float(right[:, limbs][counts].mean()), 100 * float(exchanged[:, limbs][counts].mean())
    )


def pairs_of(crops: list[LabelledCrop], n: int, rng: np.random.Generator) -> list[Pair]:
    """``n`` pairs of people whose joints are all known."""
    chosen = [crop for crop in crops if whole(crop)]
    at = [rng.choice(len(chosen), 2, replace=False) for _ in range(n)]
    return [pair(chosen[a], chosen[b], rng) for a, b in at]


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--reference", type=Path, required=True)
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--name", default="cpm-int8")
    parser.add_argument("--pairs", type=integer(1), default=300, help="of each set")
    parser.add_argument("--seed", type=SEED, default=0)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    rng = np.random.default_rng(args.seed)
    sets = {
        "lspet_val": load(args.data / "lspet_val.tar"),
        "held-out photos": held_out_photos(args.data),
    }
    print("| set | network | right, % | exchanged, % |\n|---|---|---|---|")
    for title, crops in sets.items():
        pairs = pairs_of(crops, args.pairs, rng)
        every = {"ours": together(args.name, args.weights)}
        for name, estimate in networks(args.name, args.weights, args.reference).items():
            every["ours, each alone" if name == "ours" else name] = alone(estimate)
        for name, estimate_both in every.items():
            result = score(estimate_both, pairs, f"{title}: {name}")
            print(f"| {title} | {name} | {result.right:.1f} | {result.exchanged:.1f} |", flush=True)


if __name__ == "__main__":
    main()
