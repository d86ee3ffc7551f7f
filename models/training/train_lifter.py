"""Train the learned lifter: ``python -m models.training.train_lifter --out models/weights``.

It learns from the pose prior alone (``library_store.prior_data``; ``--prior`` for another), so that
it can be made again from what is in the repository. Twenty minutes of one core with AMX; the rate
of learning falls to nothing over ``--minutes`` of wall time, and an average of the weights is kept.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from library_store.prior import DEFAULT_PRIOR, PosePrior
from library_store.skeleton import LSP14
from models.card import WEIGHTS_DIR, LiftOutput, ModelCard
from models.training.export import publish
from models.training.lifter_network import (
    LOG_SIZE,
    PoseMlp,
    lifter_model,
    losses,
    normalised,
    read_last,
)
from models.training.lifter_samples import IN_MIRROR, Floats, Samples, draw
from models.training.precision import has_bf16

CHUNK, BATCH, POOL, MEASURED = 16_384, 1_024, 250_000, 16_384
RATE, WARM_UP_STEPS, STEADY, AVERAGE = 1.5e-3, 500, 0.15, 0.9985
COMPILED = 3
"""The clock starts after so many steps: the first ones take a minute to compile."""
SURPRISE = 0.05
"""Weight of how well errors are foretold against how small they are."""


def train(poses_mm: Floats, minutes: float, seed: int) -> tuple[PoseMlp, int]:
    """The averaged network after so long, and how many samples it has seen."""
    rng = np.random.default_rng(seed)
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    bf16 = has_bf16("cpu")
    network, average = PoseMlp(), PoseMlp()
    average.load_state_dict(network.state_dict())
    optimiser = torch.optim.AdamW(
        network.parameters(), lr=RATE, betas=(0.9, 0.99), weight_decay=0.01, fused=True
    )

    @torch.compile
    def loss_of(features: Tensor, *wanted: Tensor) -> tuple[Tensor, Tensor]:
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            last = network(features)
        distance, surprise = losses(last, *wanted)
        return distance + SURPRISE * surprise, distance

    started, spoken, step, spent = time.monotonic(), 0.0, 0, 0.0
    while spent < 1.0:
        chunk = tensors(draw(poses_mm, CHUNK, rng))
        for first in range(0, CHUNK, BATCH):
            if step == COMPILED:
                started = time.monotonic()
            spent = (time.monotonic() - started) / (60.0 * minutes)
            cooled = max(0.0, (spent - STEADY) / (1.0 - STEADY))
            rate = min(1.0, (step + 1) / WARM_UP_STEPS) * 0.5 * (1.0 + np.cos(np.pi * cooled))
            for group in optimiser.param_groups:
                group["lr"] = RATE * max(rate, 1e-3)
            loss, distance = loss_of(*(part[first : first + BATCH] for part in chunk))
            optimiser.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimiser.step()
            step += 1
            keep = min(AVERAGE, (step + 1) / (step + 20))
            with torch.no_grad():
                for mean, value in zip(average.parameters(), network.parameters(), strict=True):
                    mean.lerp_(value, 1.0 - keep)
            if spent >= 1.0:
                break
        if time.monotonic() - spoken > 60.0:
            spoken = time.monotonic()
            print(f"{step * BATCH / 1e6:.1f} M, {distance.item():.4f}, {spent:.0%}", flush=True)
    return average, step * BATCH


def tensors(samples: Samples) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Features, and what the last layer should say of them: see ``lifter_network.losses``."""
    points, present, truth, depths, root_mm = (
        torch.from_numpy(np.ascontiguousarray(part, np.float32))
        for part in (
            samples.points,
            samples.present,
            samples.truth,
            samples.depths,
            samples.root_mm,
        )
    )
    features, centre, radius = normalised(points, present)
    given = (points - centre) / radius * present[..., None]
    log_size = torch.log(radius[:, 0, 0] * root_mm) - LOG_SIZE
    return features, (truth - centre) / radius - given, depths / radius[:, 0], log_size


def error_moments(network: PoseMlp, samples: Samples) -> NDArray[np.float64]:
    """Second moments (42, 42) of errors in units of the foretold deviations, mirror included."""
    features, image, depths, _ = tensors(samples)
    mirror = list(LSP14.mirror)
    flipped = Samples(
        (samples.points * IN_MIRROR[:2])[:, mirror],
        samples.present[:, mirror],
        samples.truth,
        samples.depths,
        samples.root_mm,
    )
    with torch.no_grad():
        plain = read_last(network(features))
        other = read_last(network(tensors(flipped)[0]))
    sides = torch.tensor([-1.0, 1.0])
    found = 0.5 * (plain.image + (other.image * sides)[:, mirror])
    along = 0.5 * (plain.depths + other.depths[:, mirror])
    sigma_image = 0.5 * (plain.log_across + other.log_across[:, mirror])
    sigma_depth = 0.5 * (plain.log_along + other.log_along[:, mirror])
    errors = torch.cat(
        [
            ((found - image) / sigma_image.exp()[..., None]).flatten(1),
            (along - depths) / sigma_depth.exp(),
        ],
        1,
    ).double()
    moments: NDArray[np.float64] = (errors.T @ errors / len(errors)).numpy()
    # What holds for a person holds for the one in the mirror.
    n = LSP14.n_joints
    joints = np.array(mirror)
    order = np.concatenate([(2 * joints[:, None] + [0, 1]).ravel(), 2 * n + joints])
    signs = np.concatenate([np.tile([-1.0, 1.0], n), np.ones(n)])
    in_mirror = moments[np.ix_(order, order)] * np.outer(signs, signs)
    return 0.5 * (moments + in_mirror)


def lifter_card(
    network: PoseMlp, name: str, version: str, prior: PosePrior, measured: dict[str, float | str]
) -> ModelCard:
    """The card of a trained network."""
    layers = [p.numel() for p in network.parameters() if p.ndim == 2]
    return ModelCard(
        name=name,
        version=version,
        file=f"{name}.onnx",
        sha256="",
        description="Lifter: residual MLP from 14 2D joints to their depths, with uncertainty",
        precision="int8",
        providers=("cpu",),
        parameters=sum(p.numel() for p in network.parameters()),
        multiply_adds=2 * sum(layers),
        output=LiftOutput(kind="lift", joint_names=list(LSP14.joint_names)),
        training_data=[
            f"poses drawn from the pose prior {prior.card.name} {prior.card.version}, fitted on "
            "the CMU Graphics Lab Motion Capture Database (free for all uses), seen by made-up "
            "cameras; no photo"
        ],
        licence="Apache-2.0",
        limits=[
            "knows the postures of its prior's mocap, whatever library is served",
            "says nothing of how large or how far away a person is",
            "one person's joints, the camera turned onto them",
        ],
        measured=measured,
    )


def main() -> None:
    """Command line: see the module."""
    parser = argparse.ArgumentParser(prog="models.training.train_lifter", description=__doc__)
    parser.add_argument("--prior", type=Path, default=DEFAULT_PRIOR, help=".npz with its card")
    parser.add_argument("--out", type=Path, default=WEIGHTS_DIR, help="for .onnx and .json")
    parser.add_argument("--name", default="lifter")
    parser.add_argument("--version", default="0.1.0")
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    prior = PosePrior.load(chosen.prior)
    rng = np.random.default_rng(chosen.seed)
    poses = prior.sample(POOL, rng).astype(np.float32)
    network, n = train(poses, chosen.minutes, chosen.seed)
    save(network, n, prior, poses, chosen.out, name=chosen.name, version=chosen.version)


def save(
    network: PoseMlp,
    n_samples: int,
    prior: PosePrior,
    poses_mm: Floats,
    directory: Path,
    *,
    name: str,
    version: str,
) -> ModelCard:
    """Measure the network's errors on fresh samples and write it with its card."""
    samples = draw(poses_mm, MEASURED, np.random.default_rng(9))
    with torch.no_grad():
        features, *wanted = tensors(samples)
        distance, _ = losses(network(features), *wanted)
    measured: dict[str, float | str] = {
        "samples": float(n_samples),
        "mean_error/fresh_samples_in_radii": round(float(distance), 4),
        "prior_sha256": prior.sha256,
        "command": "python -m models.training.train_lifter",
    }
    card = lifter_card(network, name, version, prior, measured)
    return publish(lifter_model(network, error_moments(network, samples)), card, directory)


if __name__ == "__main__":
    main()
