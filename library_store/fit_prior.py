"""Fit the pose prior on motion capture.

    python -m library_store.fit_prior --mocap cmu.npz --out library_store/prior_data

``--mocap`` is an .npz with ``positions`` (N, 14, 3) mm, Y up, joints in lsp14 order, ``clip`` (N,)
and per clip ``clip_subject``. Of poses that are nearly the same one is kept, so that hours of
walking do not drown the rest. The same inputs and settings give the same bytes; takes seconds.
"""

from __future__ import annotations

import argparse
import hashlib
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from library_store.anatomy import Float, encode, measure_lengths, root_of
from library_store.limits import learn_limits
from library_store.population import Population
from library_store.prior import Composition, Exemplars, PosePrior, PriorCard, save_prior
from library_store.skeleton import L_HIP, R_HIP
from library_store.thin import greedy_cover


@dataclass(frozen=True)
class PriorSettings:
    """How the prior is fitted and composed; all of it goes into the card.

    ``radius_mm``: RMS joint distance within which one pose stands for another, whichever way they
    head; ``limit_quantile`` is the share of frames each limit may refuse.
    """

    radius_mm: float = 30.0
    limit_quantile: float = 0.0003
    composition: Composition = field(default_factory=Composition)
    population: Population = field(default_factory=Population)


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
    """Thin the poses, take them apart, measure their people and learn what bodies cannot do."""
    names, subjects = np.unique(mocap.subjects, return_inverse=True)
    measured = measure_lengths(mocap.poses_mm)
    usual = np.stack([np.median(measured[subjects == i], axis=0) for i in range(len(names))])
    kept = greedy_cover(face_ahead(mocap.poses_mm).astype(np.float32), settings.radius_mm)
    parts = encode(mocap.poses_mm[kept], usual[subjects[kept]])
    notes = {**card, "settings": asdict(settings), "frames": len(mocap.poses_mm)}
    prior = PosePrior(
        exemplars=Exemplars(parts.legs, parts.upper, subjects[kept], usual),
        composition=settings.composition,
        population=settings.population,
        limits=learn_limits(mocap.poses_mm, settings.limit_quantile),
        card=PriorCard(
            name=str(card["name"]), version=str(card["version"]), licences=(), notes=notes
        ),
    )
    notes["measured"] = {
        "exemplars": len(kept),
        "subjects": len(names),
        "samples_accepted": round(prior.acceptance(20_000, np.random.default_rng(0)), 3),
    }
    return prior


def face_ahead(poses_mm: Float) -> Float:
    """Poses (n, 14, 3) turned about Y so that the left hip lies to +X of the right one."""
    hips = poses_mm[:, L_HIP] - poses_mm[:, R_HIP]
    level = np.hypot(hips[:, 0], hips[:, 2])
    cosine, sine = hips[:, 0] / level, hips[:, 2] / level
    turned = poses_mm.copy()
    x, z = poses_mm[..., 0], poses_mm[..., 2]
    turned[..., 0] = cosine[:, None] * x + sine[:, None] * z
    turned[..., 2] = cosine[:, None] * z - sine[:, None] * x
    return turned


def main() -> None:
    """The command line: fit, write ``<name>.npz`` and ``<name>.json``."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--mocap", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True, help="folder for the prior's two files")
    parser.add_argument("--name", default="cmu", help="the prior's name and file name")
    parser.add_argument("--exclude-subjects", default="", help="numbers, separated by commas")
    arguments = parser.parse_args()
    excluded = tuple(number for number in arguments.exclude_subjects.split(",") if number)
    command = "python -m library_store.fit_prior --mocap cmu.npz --out library_store/prior_data"
    if excluded:
        command += f" --name {arguments.name} --exclude-subjects {','.join(excluded)}"
    card: dict[str, object] = {
        "name": arguments.name,
        "version": "2",
        "kind": "pose prior: recombined exemplars of captured poses, with composed parts",
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
    prior = fit_prior(read_mocap(arguments.mocap, excluded), PriorSettings(), card)
    path = arguments.out / f"{arguments.name}.npz"
    save_prior(prior, path)
    print(f"{path}: {path.stat().st_size / 1024:.0f} KiB, {prior.card.notes['measured']}")


if __name__ == "__main__":
    main()
