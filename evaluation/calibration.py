"""Fit the lifter's calibration constants, and check them on people they were not fitted on.

    python -m evaluation.calibration --library DIR --data heldout.npz [--check LIBRARY other.npz]

Constants are fitted on the even-numbered people of ``--data`` at all its noise levels together and
checked on the odd-numbered ones and on ``--check``; the libraries must not hold these people.
Prints ``SigmaCalibration`` for ``app.lifting.calibration``, how often candidates of a given
``probability`` are truly the nearest, and with ``--search`` what σ(library) of eq. 4 is best for
``LiftingSettings``.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from app.lifting.calibration import FUSION_SIGMA, SigmaCalibration
from app.lifting.lifter import Lifter, LiftingSettings
from evaluation.lifting import Lifted, lift_all
from evaluation.metrics import Floats, rigid_error_mm, root_centred_error_mm
from evaluation.networks import SHIPPED, add_network_option, network_of
from evaluation.protocols import LiftingSet, clean, load_lifting_set
from library_store.arguments import integer
from library_store.library import Library, load
from library_store.skeleton import LSP14
from models.pose_lifter import PoseLifter

COVERAGE = 0.68
LIBRARY_SIGMAS_PX = (10.0, 15.0, 20.0, 30.0, 40.0, 55.0, 80.0)
STATED_FLOOR_PX = 0.5
PROBABILITY_EDGES = (0.0, 0.02, 0.04, 0.06, 0.08, 0.12, 1.0)
NOISE_MM_PER_PX = (0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 13.0, 16.0, 20.0, 30.0)
LEVEL_TOLERANCE = 0.045
"""How far the coverage of one noise level may be off, on the people fitted on."""


@dataclass(frozen=True)
class Served:
    """A library and the network beside it, if any."""

    library: Library
    network: PoseLifter | None

    @classmethod
    def of(cls, directory: Path, card: str) -> Served:
        """Load them."""
        library = load(directory)
        return cls(library, network_of(card, library))

    def lifter(self, settings: LiftingSettings) -> Lifter:
        """A lifter of both."""
        return Lifter(self.library, settings, self.network)


@dataclass(frozen=True)
class Errors:
    """Posterior spread and root-relative error, each (N, 14) mm; noise found, (N,) standard px."""

    spread_mm: Floats
    error_mm: Floats
    noise_px: Floats

    def split(self) -> tuple[Errors, Errors]:
        """Even-numbered and odd-numbered people."""
        return (
            Errors(self.spread_mm[::2], self.error_mm[::2], self.noise_px[::2]),
            Errors(self.spread_mm[1::2], self.error_mm[1::2], self.noise_px[1::2]),
        )


def fit_sigma(levels: Sequence[Errors]) -> SigmaCalibration:
    """Factors that give each joint 68% coverage over all noise levels together.

    Of the values for the noise the sharpest that covers every level about equally well, else the
    one that covers them most equally. Sharpness is the pinball loss of the 68% quantile, the proper
    score for that radius.
    """
    everybody = pooled(levels)
    best: tuple[tuple[float, float], SigmaCalibration] | None = None
    for noise in NOISE_MM_PER_PX:
        plain = SigmaCalibration((1.0,) * everybody.error_mm.shape[1], noise)
        ratio = everybody.error_mm / plain(everybody.spread_mm, everybody.noise_px)
        factors = np.quantile(ratio, COVERAGE, axis=0)
        candidate = SigmaCalibration(tuple(round(float(f), 3) for f in factors), noise)
        excess = everybody.error_mm - candidate(everybody.spread_mm, everybody.noise_px)
        loss = float(np.maximum(COVERAGE * excess, (COVERAGE - 1.0) * excess).mean())
        uneven = max(abs(coverage(candidate, level) - COVERAGE) for level in levels)
        score = (max(uneven, LEVEL_TOLERANCE), loss)
        if best is None or score < best[0]:
            best = score, candidate
    assert best is not None
    return best[1]


def coverage(calibration: SigmaCalibration, errors: Errors) -> float:
    """Share of errors within the radius."""
    return float((errors.error_mm <= calibration(errors.spread_mm, errors.noise_px)).mean())


def collect_errors(served: Served, data: LiftingSet, settings: LiftingSettings) -> list[Errors]:
    """Spread and error of the fused answer at every noise level."""
    raw = replace(settings, sigma=SigmaCalibration((1.0,) * LSP14.n_joints, 0.0))
    collected = []
    for points in data.joints_2d_px.values():
        lifted = lift_all(served.lifter(raw), clean(points), data.intrinsics, "fusion")
        assert lifted.sigma_mm is not None
        error = root_centred_error_mm(lifted.joints_mm, data.joints_3d_mm)
        noise = [person.noise_px for person in lifted.people if person.noise_px is not None]
        collected.append(Errors(lifted.sigma_mm, error, np.array(noise)))
    return collected


def log_score(lifted: Lifted, truth: Floats) -> Floats:
    """Log probability given to the candidate that is truly nearest (P1), per person."""
    scores = []
    for person, pose in zip(lifted.people, truth, strict=True):
        joints = np.stack([candidate.joints_mm for candidate in person.candidates])
        nearest = int(np.argmin(rigid_error_mm(joints, pose[None]).mean(1)))
        scores.append(np.log(max(person.candidates[nearest].probability, 1e-300)))
    return np.array(scores)


def report_probability(label: str, lifted: Lifted, truth: Floats) -> None:
    """Print, by ``probability``, the share of candidates that are truly nearest (P1), and the ECE.

    The expected calibration error is the mean distance of the two, weighted by what candidates of
    that probability claim or take of the nearest ones.
    """
    claimed, nearest = [], []
    for person, pose in zip(lifted.people, truth, strict=True):
        joints = np.stack([candidate.joints_mm for candidate in person.candidates])
        best = int(np.argmin(rigid_error_mm(joints, pose[None]).mean(1)))
        claimed.append([candidate.probability for candidate in person.candidates])
        nearest.append(np.arange(len(joints)) == best)
    probability, hit = np.concatenate(claimed), np.concatenate(nearest)
    cell = np.digitize(probability, PROBABILITY_EDGES[1:-1])
    rows, gap = [], 0.0
    for number in range(len(PROBABILITY_EDGES) - 1):
        of = cell == number
        if of.any():
            rows.append(f"{probability[of].mean():.3f} -> {hit[of].mean():.3f} ({of.sum()})")
            gap += abs(float(probability[of].sum()) - float(hit[of].sum())) / len(truth)
    print(f"{label}: claimed -> nearest (candidates): {', '.join(rows)}; error {gap:.3f}")


def mean_log_score(
    served: Served, data: LiftingSet, settings: LiftingSettings, *, stated: bool
) -> Floats:
    """Mean of :func:`log_score` over people, by noise level."""
    lifter = served.lifter(settings)
    means = []
    for noise, points in data.joints_2d_px.items():
        sigma = max(float(noise), STATED_FLOOR_PX) if stated else None
        observations = list(clean(points).observations(sigma))
        answers = lifter.lift(observations, data.intrinsics, n_candidates=settings.shortlist)
        lifted = Lifted.of(answers, cpu_ms=0.0)
        means.append(log_score(lifted, data.joints_3d_mm).mean())
    return np.array(means)


def pooled(parts: Sequence[Errors]) -> Errors:
    """All noise levels as one sample."""
    return Errors(
        np.concatenate([part.spread_mm for part in parts]),
        np.concatenate([part.error_mm for part in parts]),
        np.concatenate([part.noise_px for part in parts]),
    )


def report_coverage(label: str, calibration: SigmaCalibration, parts: Sequence[Errors]) -> None:
    """Print coverage by noise level, and the rank correlation of sigma with error by person."""
    for level, part in enumerate(parts):
        sigma = calibration(part.spread_mm, part.noise_px)
        ranks = np.array([np.argsort(np.argsort(v.mean(1))) for v in (sigma, part.error_mm)])
        print(
            f"{label}, noise level {level}: covers {coverage(calibration, part):.1%}, "
            f"sigma {sigma.mean():.0f} mm, Spearman {np.corrcoef(ranks)[0, 1]:.2f}"
        )


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line: see the module."""
    parser = argparse.ArgumentParser(prog="evaluation.calibration", description=__doc__)
    parser.add_argument("--library", type=Path, required=True)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument(
        "--check",
        type=Path,
        nargs=2,
        metavar=("LIBRARY", "DATA"),
        action="append",
        default=[],
        help="another library, with the shipped network, and set to check on",
    )
    parser.add_argument("--search", action="store_true", help="try other values of eq. 4's sigma")
    parser.add_argument(
        "--people", type=integer(1), default=None, help="only the first N of each set"
    )
    add_network_option(parser)
    chosen = parser.parse_args(arguments)
    served, settings = Served.of(chosen.library, chosen.network), LiftingSettings()
    data = load_lifting_set(chosen.data).first(chosen.people)

    halves = [errors.split() for errors in collect_errors(served, data, settings)]
    calibration = fit_sigma([half[0] for half in halves])
    # Of the joints here none is doubted or missing: what that adds others fit.
    print(
        replace(
            FUSION_SIGMA, factors=calibration.factors, noise_mm_per_px=calibration.noise_mm_per_px
        )
    )
    report_coverage("fitted half", calibration, [half[0] for half in halves])
    report_coverage("other half", calibration, [half[1] for half in halves])
    _check_probability(served, data.half(1), settings)
    for directory, path in chosen.check:
        other = Served.of(directory, SHIPPED)
        elsewhere = load_lifting_set(path).first(chosen.people)
        report_coverage(elsewhere.name, calibration, collect_errors(other, elsewhere, settings))
        _check_probability(other, elsewhere, settings)
    if chosen.search:
        _search(served, data, settings)


def _check_probability(served: Served, data: LiftingSet, settings: LiftingSettings) -> None:
    lifter = served.lifter(settings)
    for noise, points in data.joints_2d_px.items():
        observations = list(clean(points).observations())
        answers = lifter.lift(observations, data.intrinsics, n_candidates=settings.shortlist)
        lifted = Lifted.of(answers, cpu_ms=0.0)
        report_probability(f"{data.name}, {noise} px", lifted, data.joints_3d_mm)


def _search(served: Served, data: LiftingSet, settings: LiftingSettings) -> None:
    fit, check = data.half(0), data.half(1)
    for stated in (True, False):
        print("2D noise stated:" if stated else "2D noise unknown:")
        for sigma in LIBRARY_SIGMAS_PX:
            one = replace(settings, sigma_library_px=sigma, sigma_2d_px=0.0)
            scores = [mean_log_score(served, half, one, stated=stated) for half in (fit, check)]
            by_noise = " ".join(f"{score:.3f}" for score in scores[0])
            print(
                f"  sigma {sigma:g}: log P of the nearest candidate {scores[0].mean():.3f} "
                f"(by noise {by_noise}), other half {scores[1].mean():.3f}"
            )


if __name__ == "__main__":
    main()
