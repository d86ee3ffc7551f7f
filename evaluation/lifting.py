"""Lifting alone: 3D errors from true 2D plus noise, the paper's method beside the default.

    python -m evaluation.lifting --library DIR --data eval_a.npz --data eval_b.npz

The library must not hold the people it is measured on: see its manifest.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from app.errors import PoseMatchError
from app.lifting.lifter import Lifter
from app.lifting.types import Intrinsics, LiftedPerson, Method, NotLiftable
from evaluation.metrics import Floats, Summary, root_centred_error_mm, summarise
from evaluation.networks import add_network_option, network_of
from evaluation.protocols import SPOILERS, LiftingSet, Spoilt, load_lifting_set
from library_store.arguments import integer
from library_store.library import load

METHODS: tuple[Method, ...] = ("paper", "fusion")


@dataclass(frozen=True)
class Lifted:
    """Answers for a set: (N, 14, 3) mm, (N, 14) mm or None, CPU-ms a person, and all details."""

    joints_mm: Floats
    sigma_mm: Floats | None
    cpu_ms: float
    people: tuple[LiftedPerson, ...]

    @staticmethod
    def of(answers: Sequence[LiftedPerson | NotLiftable], cpu_ms: float) -> Lifted:
        """Stack answers; ``PoseMatchError`` if somebody is not liftable.

        A mean over the others would be of easier people.
        """
        people = tuple(person for person in answers if isinstance(person, LiftedPerson))
        for number, answer in enumerate(answers):
            if isinstance(answer, NotLiftable):
                raise PoseMatchError(
                    f"{len(answers) - len(people)} of the set's {len(answers)} people cannot be "
                    f"lifted, the first number {number}: {answer.reason}"
                )
        sigmas = [person.sigma_mm for person in people if person.sigma_mm is not None]
        return Lifted(
            np.stack([person.joints_3d_mm for person in people]),
            np.stack(sigmas) if len(sigmas) == len(people) else None,
            cpu_ms,
            people,
        )


def lift_all(
    lifter: Lifter,
    spoilt: Spoilt,
    intrinsics: Intrinsics,
    method: Method,
    sigma_px: float | None = None,
) -> Lifted:
    """Lift every person of a set; ``PoseMatchError`` if one is not liftable."""
    observations = list(spoilt.observations(sigma_px))
    started = time.process_time()
    answers = lifter.lift(observations, intrinsics, method=method)
    cpu_ms = (time.process_time() - started) / max(len(observations), 1) * 1e3
    return Lifted.of(answers, cpu_ms)


def print_table(lifter: Lifter, data: LiftingSet, *, stated_noise: bool) -> None:
    """Print every method at every noise level, and the spoilt rows at each."""
    print(f"\n## {data.name}: {len(data.joints_3d_mm)} people, errors in mm, mean / median")
    print(
        "| 2D | noise px | method | P1 | P2 | PA | spoilt joint P2 | others P2 "
        "| sigma covers | CPU-ms |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    for label, spoil in SPOILERS.items():
        for noise, points in data.joints_2d_px.items():
            spoilt = spoil(points)
            for method in METHODS:
                sigma_px = float(noise) if stated_noise else None
                lifted = lift_all(lifter, spoilt, data.intrinsics, method, sigma_px)
                print(_row(label, noise, method, lifted, data.joints_3d_mm, spoilt))


def coverage(lifted: Lifted, truth: Floats) -> float | None:
    """Share of root-relative joint errors within sigma_mm, or None without a sigma."""
    if lifted.sigma_mm is None:
        return None
    error = root_centred_error_mm(lifted.joints_mm, truth)
    return float((error <= lifted.sigma_mm).mean())


def _row(
    label: str, noise: int, method: Method, lifted: Lifted, truth: Floats, spoilt: Spoilt
) -> str:
    summary: Summary = summarise(lifted.joints_mm, truth)
    spoilt_joint = others = "-"
    if (spoilt.joint >= 0).all():
        error = root_centred_error_mm(lifted.joints_mm, truth)
        at = np.arange(len(error))
        spoilt_joint = f"{error[at, spoilt.joint].mean():.1f}"
        others = f"{(error.sum(1) - error[at, spoilt.joint]).mean() / (error.shape[1] - 1):.1f}"
    share = coverage(lifted, truth)
    return (
        f"| {label} | {noise} | {method} | {summary.p1_mean:.1f} / {summary.p1_median:.1f} "
        f"| {summary.p2_mean:.1f} / {summary.p2_median:.1f} "
        f"| {summary.pa_mean:.1f} / {summary.pa_median:.1f} | {spoilt_joint} | {others} "
        f"| {'-' if share is None else f'{share:.0%}'} | {lifted.cpu_ms:.2f} |"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line: see the module."""
    parser = argparse.ArgumentParser(prog="evaluation.lifting", description=__doc__)
    parser.add_argument("--library", type=Path, required=True, help="library directory")
    parser.add_argument(
        "--data", type=Path, action="append", required=True, help=".npz, repeatable"
    )
    parser.add_argument(
        "--people", type=integer(1), default=None, help="only the first N of each set"
    )
    parser.add_argument(
        "--stated-noise",
        action="store_true",
        help="tell the lifter the 2D noise as a covariance, as the 2D network does",
    )
    add_network_option(parser)
    chosen = parser.parse_args(arguments)
    library = load(chosen.library)
    network = network_of(chosen.network, library)
    lifter = Lifter(library, network=network)
    beside = "matching alone"
    if network is not None:
        beside = f"network {network.card.name} {network.card.version}"
    print(
        f"library {library.manifest.name} {library.manifest.version}, {len(library)} exemplars; "
        f"fusion: {beside}"
    )
    for path in chosen.data:
        data = load_lifting_set(path).first(chosen.people)
        print_table(lifter, data, stated_noise=chosen.stated_noise)


if __name__ == "__main__":
    main()
