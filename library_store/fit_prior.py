"""Fit the pose prior on motion capture.

    python -m library_store.fit_prior --mocap cmu.npz --out library_store/prior_data

``--mocap`` is an .npz with ``positions`` (N, 14, 3) mm, Y up, joints in lsp14 order, ``clip`` (N,)
and per clip ``clip_subject``. Frames of a crowded region weigh less, so that hours of walking do
not drown the rest. Seeded; the same inputs, settings and BLAS give the same parameters.
"""

from __future__ import annotations

import argparse
import hashlib
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from library_store.anatomy import (
    LENGTHS,
    BodyParts,
    Float,
    encode,
    measure_lengths,
    root_of,
)
from library_store.limits import learn_limits
from library_store.mixture import GaussianMixture
from library_store.mixture_fit import FitSettings, density_weights, fit_mixture
from library_store.prior import PosePrior, PriorCard, save_prior


@dataclass(frozen=True)
class PriorSettings:
    """How the prior is fitted and composed; all of it goes into the card.

    ``cover_radius`` and ``cover_power`` thin crowded poses (:func:`density_weights`, in the units
    of a part's vector); ``limit_quantile`` is the share of frames each limit may refuse;
    ``proportion_spread`` scales the spread of lengths between the few subjects, below 1 because a
    good part of it is where the joints of each fitted skeleton were put.
    """

    seed: int = 0
    legs: FitSettings = field(default_factory=FitSettings)
    upper: FitSettings = field(default_factory=FitSettings)
    cover_radius: float = 0.3
    cover_power: float = 0.8
    limit_quantile: float = 0.001
    proportion_spread: float = 0.7
    coupling: float = 0.5
    lying: float = 0.05
    anyhow: float = 0.02


@dataclass(frozen=True)
class Mocap:
    """Frames (n, 14, 3) mm, Y up, root-centred, with the subject (n,) each belongs to."""

    poses_mm: Float
    subjects: NDArray[np.str_]


def read_mocap(path: Path, exclude_subjects: tuple[str, ...] = ()) -> Mocap:
    """Read ``path``, leaving out subjects by number ("35" leaves out "cmu_35")."""
    with np.load(path, allow_pickle=False) as data:
        poses = data["positions"].astype(np.float64)
        subjects = data["clip_subject"][data["clip"]]
    excluded = [f"cmu_{number}" for number in exclude_subjects]
    keep = np.isfinite(poses).all(axis=(1, 2)) & ~np.isin(subjects, excluded)
    poses = poses[keep]
    return Mocap(poses_mm=poses - root_of(poses)[:, None], subjects=subjects[keep])


def fit_prior(mocap: Mocap, settings: PriorSettings, card: dict[str, object]) -> PosePrior:
    """Fit all of the prior; prints its progress."""
    rng = np.random.default_rng(settings.seed)
    lengths, log_lengths = _fit_lengths(mocap, settings.proportion_spread)
    parts = encode(mocap.poses_mm, lengths)
    legs, with_legs = _fit_part("legs", parts.legs, settings, settings.legs, rng)
    upper, with_upper = _fit_part("upper", parts.upper, settings, settings.upper, rng)
    weights = density_weights(_both(parts), settings.cover_radius, settings.cover_power)
    together = (with_legs * weights[:, None]).T @ with_upper
    # A component of the legs that no frame claims goes with any upper body.
    together += 1e-6 * upper.weights
    notes = {**card, "settings": asdict(settings), "frames": len(mocap.poses_mm)}
    prior = PosePrior(
        legs=legs,
        upper=upper,
        partners=together / together.sum(axis=1, keepdims=True),
        log_lengths=log_lengths,
        limits=learn_limits(mocap.poses_mm, settings.limit_quantile),
        coupling=settings.coupling,
        lying=settings.lying,
        anyhow=settings.anyhow,
        card=PriorCard(
            name=str(card["name"]), version=str(card["version"]), licences=(), notes=notes
        ),
        sha256="",
    )
    notes["measured"] = {
        "mean_log_probability_legs": round(_mean_log_probability(legs, parts.legs), 3),
        "mean_log_probability_upper": round(_mean_log_probability(upper, parts.upper), 3),
        "samples_accepted": round(prior.acceptance(20_000, rng), 3),
    }
    return prior


def _mean_log_probability(mixture: GaussianMixture, samples: Float) -> float:
    """Mean log density of frames (n, D), crowds and all."""
    log_joint = mixture.joint_log_probability(samples)
    top = log_joint.max(axis=1)
    return float((top + np.log(np.exp(log_joint - top[:, None]).sum(axis=1))).mean())


def _both(parts: BodyParts) -> Float:
    return np.concatenate([parts.legs, parts.upper], axis=1)


def _fit_part(
    name: str,
    samples: Float,
    settings: PriorSettings,
    fit: FitSettings,
    rng: np.random.Generator,
) -> tuple[GaussianMixture, Float]:
    weights = density_weights(samples, settings.cover_radius, settings.cover_power)
    effective = weights.sum() ** 2 / (weights**2).sum()
    print(f"{name}: {len(samples)} frames, worth {effective:.0f}", flush=True)
    started = time.perf_counter()

    def report(iteration: int, log_probability: float) -> None:
        if iteration % 5 == 0:
            seconds = time.perf_counter() - started
            print(
                f"  {name} {iteration:3d}: mean log p {log_probability:8.4f}, {seconds:.0f} s",
                flush=True,
            )

    return fit_mixture(samples, weights, fit, rng, report)


def _fit_lengths(mocap: Mocap, spread: float) -> tuple[Float, GaussianMixture]:
    """Usual lengths (n, 8) mm of each frame's person, and the population of log lengths.

    Every subject counts once. With fewer than two dozen subjects the covariance is shrunk halfway
    to common size plus independent proportions, and the standard deviations scaled by ``spread``.
    """
    measured = measure_lengths(mocap.poses_mm)
    names, of_frame = np.unique(mocap.subjects, return_inverse=True)
    usual = np.stack([np.median(measured[of_frame == i], axis=0) for i in range(len(names))])
    logs = np.log(usual)
    mean = logs.mean(axis=0)
    size = (logs - mean).mean(axis=1, keepdims=True)
    covariance = np.cov(logs, rowvar=False)
    simple = float(size.var(ddof=1)) * np.ones_like(covariance)
    simple += np.diag((logs - mean - size).var(axis=0, ddof=1))
    covariance = spread**2 * 0.5 * (covariance + simple)
    factor = np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)
    for name, length, relative in zip(
        LENGTHS, np.exp(mean), np.sqrt(np.diag(covariance)), strict=True
    ):
        print(f"length {name}: {length:.0f} mm, spread {100 * relative:.1f}%", flush=True)
    population = GaussianMixture(weights=np.ones(1), means=mean[None], factors=factor[None])
    return usual[of_frame], population


def main() -> None:
    """The command line: fit, write ``<name>.npz`` and ``<name>.json``."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--mocap", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True, help="folder for the prior's two files")
    parser.add_argument("--name", default="cmu", help="the prior's name and file name")
    parser.add_argument("--exclude-subjects", default="", help="numbers, separated by commas")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    excluded = tuple(number for number in arguments.exclude_subjects.split(",") if number)
    command = "python -m library_store.fit_prior --mocap cmu.npz --out library_store/prior_data"
    if excluded:
        command += f" --exclude-subjects {','.join(excluded)}"
    card: dict[str, object] = {
        "name": arguments.name,
        "version": "1",
        "kind": "pose prior: Gaussian mixtures over body parts, orientation and limb proportions",
        "licences": [
            {
                "source": "CMU Graphics Lab Motion Capture Database, mocap.cs.cmu.edu",
                "licence": "free for all uses; the data itself may not be resold",
                "credit": (
                    "The data used in this project was obtained from mocap.cs.cmu.edu. "
                    "The database was created with funding from NSF EIA-0196217."
                ),
            }
        ],
        "excluded_subjects": list(excluded),
        "command": command,
        "mocap_sha256": hashlib.sha256(arguments.mocap.read_bytes()).hexdigest(),
    }
    mocap = read_mocap(arguments.mocap, excluded)
    prior = fit_prior(mocap, PriorSettings(seed=arguments.seed), card)
    path = arguments.out / f"{arguments.name}.npz"
    save_prior(prior, path)
    print(f"{path}: {path.stat().st_size / 1024:.0f} KiB")


if __name__ == "__main__":
    main()
