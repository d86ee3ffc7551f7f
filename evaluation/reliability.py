"""Where lifting can be relied on: what its own uncertainty is worth, hard cases, spoilt joints.

    python -m evaluation.reliability --library DIR --data eval_a.npz --data eval_b.npz

Four tables a set, of the default method:

* **Rejection**: the mean error when the fifth of the people with the largest mean ``sigma_mm`` is
  left out, beside an oracle's that leaves out those with the largest error.
* **Hypotheses**: the error of the answer, of the best exemplar, and of the best of the candidates.
* **Cases**, told by the truth: how the trunk lies in the picture, whether people turn their back,
  how many limbs are foreshortened; and the whole set rolled by 90° and 180°.
* **Spoilt joints**: one limb joint missing, or moved by half a torso, against the same people and
  joints unspoilt.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from app.lifting.lifter import Lifter
from evaluation.lifting import Lifted, lift_all
from evaluation.metrics import (
    Floats,
    rigid_error_mm,
    root,
    root_centred_error_mm,
    similarity_error_mm,
)
from evaluation.networks import add_network_option, network_of
from evaluation.protocols import LiftingSet, clean, load_lifting_set, one_corrupted, one_missing
from library_store.arguments import integer
from library_store.library import load
from library_store.skeleton import L_HIP, LSP14, NECK, R_HIP

REJECTED = 0.2
LIMBS = tuple(
    (LSP14.index(f"{side}_{start}"), LSP14.index(f"{side}_{end}"))
    for side in ("r", "l")
    for start, end in (
        ("shoulder", "elbow"),
        ("elbow", "wrist"),
        ("hip", "knee"),
        ("knee", "ankle"),
    )
)
FORESHORTENED_DEG = 25.0
"""A limb nearer than this to its line of sight shows less than 42% of its length."""
ROLLS_DEG = (90.0, 180.0)
CANDIDATES = (1, 3, 5, 10)
ERRORS = {"P1": rigid_error_mm, "P2": root_centred_error_mm, "PA": similarity_error_mm}

Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Rejection:
    """Mean errors in mm: of all, without the least certain, without the truly worst."""

    everybody: float
    kept: float
    oracle: float

    @property
    def share(self) -> float:
        """Of the oracle's cut, how much the method's own uncertainty achieves; nan of no cut."""
        cut = self.everybody - self.oracle
        return (self.everybody - self.kept) / cut if cut > 0 else float("nan")


def rejection(error_mm: Floats, sigma_mm: Floats, rejected: float = REJECTED) -> Rejection:
    """Leave out the share ``rejected`` of people by uncertainty, and by error; both (N,)."""
    kept = len(error_mm) - round(rejected * len(error_mm))
    by_sigma = np.argsort(sigma_mm, kind="stable")[:kept]
    return Rejection(
        everybody=float(error_mm.mean()),
        kept=float(error_mm[by_sigma].mean()),
        oracle=float(np.sort(error_mm)[:kept].mean()),
    )


def cases(joints_mm: Floats) -> dict[str, Mask]:
    """Which of the people (N, 14, 3), camera frame, are of which case; cases overlap."""
    trunk = joints_mm[:, NECK] - root(joints_mm)[:, 0]
    # In the picture, 0° is upright; y points down.
    lean_deg = np.degrees(np.abs(np.arctan2(trunk[:, 0], -trunk[:, 1])))
    depth_deg = np.degrees(np.arcsin(np.abs(trunk[:, 2]) / np.linalg.norm(trunk, axis=1)))
    across = joints_mm[:, L_HIP] - joints_mm[:, R_HIP]
    facing = np.cross(across, trunk)
    away = facing[:, 2] / np.linalg.norm(facing, axis=1)
    starts, ends = np.array(LIMBS).T
    limb = joints_mm[:, ends] - joints_mm[:, starts]
    sight = 0.5 * (joints_mm[:, ends] + joints_mm[:, starts])
    cosine = np.abs((limb * sight).sum(-1)) / (
        np.linalg.norm(limb, axis=-1) * np.linalg.norm(sight, axis=-1)
    )
    short = (cosine > np.cos(np.radians(FORESHORTENED_DEG))).sum(1)
    return {
        "everybody": np.ones(len(joints_mm), dtype=bool),
        "front view (within 60°)": away < -0.5,
        "side view": np.abs(away) <= 0.5,
        "back view (within 60°)": away > 0.5,
        "trunk leans 45 to 90° in the picture": (lean_deg > 45) & (lean_deg <= 90),
        "head below the hips": lean_deg > 90,
        "trunk over 45° towards or away": depth_deg > 45,
        "no limb foreshortened": short == 0,
        "two limbs foreshortened or more": short >= 2,
    }


def rolled(data: LiftingSet, angle_deg: float) -> LiftingSet:
    """The set seen by a camera that is rolled about its axis (principal point at (0, 0))."""
    angle = np.radians(angle_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    joints = data.joints_3d_mm.copy()
    joints[..., :2] = joints[..., :2] @ turn.T
    points = {noise: seen @ turn.T for noise, seen in data.joints_2d_px.items()}
    return LiftingSet(f"{data.name} rolled by {angle_deg:g}°", joints, points, data.intrinsics)


def _lift(lifter: Lifter, data: LiftingSet, noise: int) -> Lifted:
    people = list(clean(data.joints_2d_px[noise]).observations())
    answers = lifter.lift(people, data.intrinsics, n_candidates=max(CANDIDATES))
    return Lifted.of(answers, cpu_ms=0.0)


def print_rejection(data: LiftingSet, answers: dict[int, Lifted]) -> None:
    """The first table."""
    print("\n| noise px | error | everybody | least certain 20% out | oracle | share of its cut |")
    print("|---|---|---|---|---|---|")
    for noise, lifted in answers.items():
        assert lifted.sigma_mm is not None
        for name, measure in ERRORS.items():
            error = measure(lifted.joints_mm, data.joints_3d_mm).mean(1)
            found = rejection(error, lifted.sigma_mm.mean(1))
            print(
                f"| {noise} | {name} | {found.everybody:.1f} | {found.kept:.1f} "
                f"| {found.oracle:.1f} | {found.share:.0%} |"
            )


def print_hypotheses(data: LiftingSet, answers: dict[int, Lifted]) -> None:
    """The second table."""
    columns = " | ".join(f"best of {n}" if n > 1 else "exemplar" for n in CANDIDATES)
    print(f"\n| noise px | P1 of the answer | {columns} |")
    print("|---" * (2 + len(CANDIDATES)) + "|")
    for noise, lifted in answers.items():
        answer = rigid_error_mm(lifted.joints_mm, data.joints_3d_mm).mean()
        each = np.stack(
            [
                rigid_error_mm(np.stack([one.joints_mm for one in person.candidates]), pose).mean(1)
                for person, pose in zip(lifted.people, data.joints_3d_mm[:, None], strict=True)
            ]
        )
        best = " | ".join(f"{each[:, :n].min(1).mean():.1f}" for n in CANDIDATES)
        print(f"| {noise} | {answer:.1f} | {best} |")


def print_cases(lifter: Lifter, data: LiftingSet, answers: dict[int, Lifted]) -> None:
    """The third table."""
    print("\n| case | people | noise px | P1 | PA | sigma_mm, mean |")
    print("|---|---|---|---|---|---|")
    for name, chosen in cases(data.joints_3d_mm).items():
        for noise, lifted in answers.items():
            if chosen.any():
                print(_case_row(name, noise, lifted, data.joints_3d_mm, chosen))
    for noise, lifted in answers.items():
        warned = np.array(["ambiguous_depth" in person.warnings for person in lifted.people])
        for name, chosen in (("warned of ambiguous_depth", warned), ("not warned", ~warned)):
            if chosen.any():
                print(_case_row(name, noise, lifted, data.joints_3d_mm, chosen))
    for angle_deg in ROLLS_DEG:
        turned = rolled(data, angle_deg)
        noise = min(turned.joints_2d_px)
        everybody = np.ones(len(turned.joints_3d_mm), dtype=bool)
        lifted = _lift(lifter, turned, noise)
        name = f"everybody, camera rolled by {angle_deg:g}°"
        print(_case_row(name, noise, lifted, turned.joints_3d_mm, everybody))


def _case_row(name: str, noise: int, lifted: Lifted, truth: Floats, chosen: Mask) -> str:
    assert lifted.sigma_mm is not None
    poses, truth = lifted.joints_mm[chosen], truth[chosen]
    return (
        f"| {name} | {len(truth)} | {noise} | {rigid_error_mm(poses, truth).mean():.1f} "
        f"| {similarity_error_mm(poses, truth).mean():.1f} "
        f"| {lifted.sigma_mm[chosen].mean():.0f} |"
    )


def print_spoilt(lifter: Lifter, data: LiftingSet, answers: dict[int, Lifted]) -> None:
    """The fourth table: ratios of mean root-relative errors to those of the unspoilt people."""
    print(
        "\n| 2D | noise px | the spoilt joint, mm | to unspoilt | the other 13, mm | to unspoilt |"
    )
    print("|---|---|---|---|---|---|")
    for label, spoil in (("missing", one_missing), ("moved by half a torso", one_corrupted)):
        for noise, lifted in answers.items():
            spoilt = spoil(data.joints_2d_px[noise])
            answer = lift_all(lifter, spoilt, data.intrinsics, "fusion")
            row = np.arange(len(spoilt.joint))
            numbers = []
            for one in (answer, lifted):
                error = root_centred_error_mm(one.joints_mm, data.joints_3d_mm)
                at = error[row, spoilt.joint]
                numbers.append((at.mean(), (error.sum(1) - at).mean() / (error.shape[1] - 1)))
            (joint, others), (joint_before, others_before) = numbers
            print(
                f"| {label} | {noise} | {joint:.1f} | {joint / joint_before:.2f} "
                f"| {others:.1f} | {others / others_before:.2f} |"
            )


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line: see the module."""
    parser = argparse.ArgumentParser(prog="evaluation.reliability", description=__doc__)
    parser.add_argument("--library", type=Path, required=True, help="library directory")
    parser.add_argument(
        "--data", type=Path, action="append", required=True, help=".npz, repeatable"
    )
    parser.add_argument(
        "--people", type=integer(1), default=None, help="only the first N of each set"
    )
    add_network_option(parser)
    chosen = parser.parse_args(arguments)
    library = load(chosen.library)
    lifter = Lifter(library, network=network_of(chosen.network, library))
    for path in chosen.data:
        data = load_lifting_set(path).first(chosen.people)
        print(f"\n## {data.name}: {len(data.joints_3d_mm)} people")
        answers = {noise: _lift(lifter, data, noise) for noise in data.joints_2d_px}
        print_rejection(data, answers)
        print_hypotheses(data, answers)
        print_cases(lifter, data, answers)
        print_spoilt(lifter, data, answers)


if __name__ == "__main__":
    main()
