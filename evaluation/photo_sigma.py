"""Does ``sigma_mm`` hold where a network found the joints? Fits what the confidence adds to it.

    python -m evaluation.photo_sigma --renders TAR --library DIR --network CARD

``--renders`` is a set of ``models.training.rendered`` whose poses neither the library nor the
lifting network know. The CPM of the service's settings (POSEMATCH_*) finds the joints by the true
box; they are lifted with the true focal length. ``person_doubt_mm`` and ``joint_doubt_mm`` of
``app.lifting.calibration`` are fitted on the even-numbered people, the other constants kept, and
checked on the odd-numbered ones, by how sure the network was.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path

import numpy as np

from app.engine import chosen_networks
from app.errors import PoseMatchError
from app.lifting.calibration import FUSION_SIGMA, SigmaCalibration
from app.lifting.lifter import Lifter, LiftingSettings
from app.lifting.types import Intrinsics, LiftedPerson, Observation
from app.settings import load_settings
from evaluation.calibration import COVERAGE, Served
from evaluation.metrics import Floats, root_centred_error_mm
from evaluation.networks import add_network_option
from evaluation.progress import followed
from evaluation.reliability import rejection
from library_store.skeleton import LSP14
from models.person_detector import PersonBox
from models.pose_estimator import PoseEstimator
from models.training.dataset import decode_members, read_annotations

DOUBTS_MM = tuple(100.0 * step for step in range(13))
NEAR = 0.01
BANDS = 5
"""Equal shares of the people, by how sure the network was of them."""


@dataclass(frozen=True)
class Seen:
    """One person as the network saw them, and the truth (14, 3) mm in the camera frame."""

    observation: Observation
    intrinsics: Intrinsics
    joints_mm: Floats


@dataclass(frozen=True)
class Answers:
    """Of N people: raw spread, error and confidence (N, 14), noise found (N,) standard px."""

    spread_mm: Floats
    error_mm: Floats
    confidence: Floats
    noise_px: Floats

    def part(self, people: slice) -> Answers:
        """Some of the people."""
        return Answers(
            self.spread_mm[people],
            self.error_mm[people],
            self.confidence[people],
            self.noise_px[people],
        )

    def sigma_mm(self, calibration: SigmaCalibration) -> Floats:
        """What ``calibration`` makes of it, (N, 14)."""
        return calibration(self.spread_mm, self.noise_px, self.confidence)

    def sureness(self) -> Floats:
        """Mean confidence of the joints that were lifted, (N,)."""
        sure: Floats = self.confidence.sum(1) / (self.confidence > 0).sum(1)
        return sure


@dataclass(frozen=True)
class _Raw(SigmaCalibration):
    """The spread itself; ``told`` keeps the confidences (14,) that a calibration is given.

    They are not the network's own: joints that contradict the others count as missing.
    """

    told: list[Floats] = field(default_factory=list)

    def __call__(
        self, spread_mm: Floats, noise_px: Floats | float, confidence: Floats | None = None
    ) -> Floats:
        assert confidence is not None
        self.told.append(confidence)
        return super().__call__(spread_mm, noise_px)


def find_joints(
    renders: Path, estimator: PoseEstimator, people: int | None = None
) -> Iterator[Seen]:
    """Every person of a rendered set, or the first so many, found by the true box."""
    images = decode_members(renders)
    for record in followed(read_annotations(renders)[:people], "joints"):
        if "joints_mm" not in record:
            raise SystemExit(f"{renders} has no 3D truth: render it anew")
        joints_px = np.array(record["joints_px"])
        (x, y), (width, height) = joints_px.min(0), np.ptp(joints_px, axis=0)
        box = PersonBox(x, y, width, height, score=1.0)
        (found,) = estimator.estimate(images[record["image"]], [box])
        centre_x, centre_y = record["principal_point_px"]
        yield Seen(
            Observation(found.positions_px, found.belief, found.covariance_px2, found.depths_px),
            Intrinsics(record["focal_length_px"], (centre_x, centre_y), "request"),
            np.array(record["joints_mm"]),
        )


def lift(people: Sequence[Seen], served: Served) -> Answers:
    """What is answered for those who can be lifted, before any calibration.

    ``PoseMatchError`` if nobody can.
    """
    raw = _Raw((1.0,) * LSP14.n_joints, 0.0)
    lifter: Lifter = served.lifter(replace(LiftingSettings(), sigma=raw))
    rows = []
    for person in people:
        (answer,) = lifter.lift([person.observation], person.intrinsics, n_candidates=1)
        if isinstance(answer, LiftedPerson):
            error = root_centred_error_mm(answer.joints_3d_mm[None], person.joints_mm[None])[0]
            rows.append((answer.sigma_mm, error, raw.told[-1], answer.noise_px))
    if not rows:
        raise PoseMatchError(f"nobody can be lifted, of {len(people)} people")
    spread, error, confidence, noise = (
        np.array(column, float) for column in zip(*rows, strict=True)
    )
    return Answers(spread, error, confidence, noise)


def fit_doubts(answers: Answers, calibration: SigmaCalibration) -> SigmaCalibration:
    """The two constants with the least pinball loss of the 68% quantile.

    Among those that cover that many errors, to a hundredth, if there are any: about its least the
    loss hardly tells 64% from 68.
    """

    def loss(candidate: SigmaCalibration) -> float:
        excess = answers.error_mm - answers.sigma_mm(candidate)
        return float(np.maximum(COVERAGE * excess, (COVERAGE - 1.0) * excess).mean())

    candidates = [
        replace(calibration, person_doubt_mm=person, joint_doubt_mm=joint)
        for person, joint in product(DOUBTS_MM, DOUBTS_MM)
    ]
    covering = [
        candidate
        for candidate in candidates
        if abs((answers.error_mm <= answers.sigma_mm(candidate)).mean() - COVERAGE) <= NEAR
    ]
    return min(covering or candidates, key=loss)


def report(label: str, answers: Answers, calibration: SigmaCalibration) -> str:
    """A row of the table: coverage of all, and by how sure the network was, surest first.

    Then the median radius (mm), and what it is worth for leaving people out: see
    ``evaluation.reliability``, here by P2.
    """
    within = answers.error_mm <= answers.sigma_mm(calibration)
    order = np.argsort(-answers.sureness(), kind="stable")
    bands = " | ".join(f"{within[band].mean():.0%}" for band in np.array_split(order, BANDS))
    error, sigma = answers.error_mm.mean(1), answers.sigma_mm(calibration).mean(1)
    return (
        f"| {label} | {within.mean():.1%} | {bands} | {np.median(sigma):.0f} "
        f"| {rejection(error, sigma).share:.0%} |"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line: see the module."""
    parser = argparse.ArgumentParser(prog="evaluation.photo_sigma", description=__doc__)
    parser.add_argument("--renders", type=Path, required=True)
    parser.add_argument("--library", type=Path, required=True)
    add_network_option(parser)
    chosen = parser.parse_args(arguments)
    served = Served.of(chosen.library, chosen.network)
    settings = load_settings()
    pose, _ = chosen_networks(settings)
    estimator = PoseEstimator(pose, weights_dir=settings.weights_dir, provider=settings.provider)
    people = list(find_joints(chosen.renders, estimator))
    answers = lift(people, served)
    if len(answers.error_mm) < 2 * BANDS:
        raise SystemExit(f"{chosen.renders}: {len(people)} people are too few to fit and to check")
    fitted, other = answers.part(slice(0, None, 2)), answers.part(slice(1, None, 2))
    calibration = fit_doubts(fitted, FUSION_SIGMA)
    alone = replace(FUSION_SIGMA, person_doubt_mm=0.0, joint_doubt_mm=0.0)
    print(f"{len(people)} people, {len(answers.error_mm)} lifted")
    print(f"person_doubt_mm={calibration.person_doubt_mm:g}")
    print(f"joint_doubt_mm={calibration.joint_doubt_mm:g}")
    print(
        "| sigma_mm | covers | the surest fifth | | | | the least sure | median | rejection, P2 |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    print(report("without doubts, other half", other, alone))
    print(report("fitted half", fitted, calibration))
    print(report("other half", other, calibration))
    print(report("other half, as served", other, FUSION_SIGMA))


if __name__ == "__main__":
    main()
