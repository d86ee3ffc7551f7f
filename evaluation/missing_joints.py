"""People not all of whose joints are stated: errors, what sigma_mm covers, and the fit of it.

    python -m evaluation.missing_joints --library DIR --data heldout.npz [--every 10]

The same people with all their joints, then without some, at every noise level of ``--data``; the
library and the network must not know them. *Covers* is the share of root-relative errors within
``sigma_mm``; *before*, without ``missing_doubt`` of ``app.lifting.calibration``.
That is fitted on the even-numbered people, the table is of the odd-numbered ones.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from app.lifting.calibration import FUSION_SIGMA, SigmaCalibration
from evaluation.calibration import COVERAGE, Served
from evaluation.networks import add_network_option
from evaluation.photo_sigma import Answers, Seen, lift
from evaluation.progress import followed
from evaluation.protocols import LiftingSet, clean, load_lifting_set
from library_store.arguments import integer
from library_store.skeleton import LSP14


def _joints(names: str, sides: str = "rl") -> tuple[int, ...]:
    """Joints of these ``sides`` by their names without them."""
    return tuple(LSP14.index(f"{side}_{name}") for name in names.split() for side in sides)


MISSING: dict[str, tuple[int, ...]] = {
    "nothing": (),
    "a wrist": _joints("wrist", "r"),
    "the head": (LSP14.index("head_top"), LSP14.index("neck")),
    "the ankles": _joints("ankle"),
    "a leg": _joints("knee ankle", "l"),
    "the hips": _joints("hip"),
    "the legs": _joints("knee ankle"),
    "the arms": _joints("elbow wrist"),
    "hips and legs": _joints("hip knee ankle"),
    "one side": _joints("shoulder elbow wrist hip knee ankle", "l"),
    "hips, legs and wrists": _joints("hip knee ankle wrist"),
}
DOUBTS = tuple(round(0.1 * tenths, 1) for tenths in range(16))
"""Of these the fit chooses."""


def without(data: LiftingSet, missing: tuple[int, ...]) -> list[Seen]:
    """Everybody at every noise level, one after the other, without these joints."""
    people = []
    for points in data.joints_2d_px.values():
        spoilt = clean(points)
        spoilt.confidence[:, list(missing)] = 0.0
        people += [
            Seen(observation, data.intrinsics, truth)
            for observation, truth in zip(spoilt.observations(), data.joints_3d_mm, strict=True)
        ]
    return people


def fit_missing(answers: Sequence[Answers], calibration: SigmaCalibration) -> SigmaCalibration:
    """The ``missing_doubt`` with the least pinball loss of the 68% quantile, over everybody."""

    def loss(candidate: SigmaCalibration) -> float:
        excess = np.concatenate([of.error_mm - of.sigma_mm(candidate) for of in answers])
        return float(np.maximum(COVERAGE * excess, (COVERAGE - 1.0) * excess).mean())

    return min((replace(calibration, missing_doubt=doubt) for doubt in DOUBTS), key=loss)


def row(label: str, answers: Answers, missing: tuple[int, ...], of: SigmaCalibration) -> str:
    """A line of the table: errors of the joints that are stated and of the others, and coverage."""
    gone = np.isin(np.arange(LSP14.n_joints), missing)
    within = answers.error_mm <= answers.sigma_mm(of)
    plain = answers.error_mm <= answers.sigma_mm(replace(of, missing_doubt=0.0))
    cells = [label, str(len(within))]
    for joints in (~gone, gone):
        if joints.any():
            cells += [
                f"{answers.error_mm[:, joints].mean():.0f}",
                f"{within[:, joints].mean():.0%}",
            ]
            cells.append(f"{plain[:, joints].mean():.0%}")
        else:
            cells += ["-"] * 3
    return f"| {' | '.join(cells)} |"


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line: see the module."""
    parser = argparse.ArgumentParser(prog="evaluation.missing_joints", description=__doc__)
    parser.add_argument("--library", type=Path, required=True)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument(
        "--every", type=integer(1), default=10, help="of the people, for time's sake"
    )
    add_network_option(parser)
    chosen = parser.parse_args(arguments)
    served = Served.of(chosen.library, chosen.network)
    data = load_lifting_set(chosen.data).every(chosen.every)
    levels = len(data.joints_2d_px)
    answers = {
        label: [lift(without(part, missing), served) for part in (data.half(0), data.half(1))]
        for label, missing in followed(list(MISSING.items()), "missing")
    }
    fitted = fit_missing([halves[0] for halves in answers.values()], FUSION_SIGMA)
    print(f"{len(data.joints_3d_mm)} people at {levels} noise levels")
    print(f"missing_doubt={fitted.missing_doubt:g}")
    print("| missing | lifted | stated: P2 | covers | before | missing: P2 | covers | before |")
    print("|---|---|---|---|---|---|---|---|")
    for label, (_, checked) in answers.items():
        print(row(label, checked, MISSING[label], FUSION_SIGMA))


if __name__ == "__main__":
    main()
