"""Train the learned lifter: ``python -m models.training.train_lifter --out models/weights``.

It learns from the pose prior (``library_store.prior_data``; ``--prior`` for another), which needs
nothing but what is in the repository; then, by ``--init`` of what that made and ``--mistakes`` of
``models.training.lifter_mistakes``, from what a pose network gets wrong, and to read depths if that
network does. Twenty minutes of one core for the first, eight for the second; the rate of learning
falls to nothing over ``--minutes`` of wall time, and an average of the weights is kept.
"""

from __future__ import annotations

import argparse
import copy
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from library_store.arguments import SEED, real
from library_store.prior import DEFAULT_PRIOR, PosePrior
from library_store.skeleton import LSP14
from models.card import WEIGHTS_DIR, LiftOutput, ModelCard
from models.training.export import publish
from models.training.lifter_mistakes import Mistakes, Transplanter
from models.training.lifter_network import (
    LOG_SIZE,
    PoseMlp,
    lifter_model,
    losses,
    normalised,
    read_last,
    read_network,
    with_depths,
)
from models.training.lifter_samples import Floats, Samples, draw, in_mirror, joined
from models.training.precision import has_bf16

CHUNK, BATCH, POOL, MEASURED = 16_384, 1_024, 250_000, 16_384
RATE, WARM_UP_STEPS, STEADY, AVERAGE = 1.5e-3, 500, 0.15, 0.9985
COMPILED = 3
"""The clock starts after so many steps: the first ones take a minute to compile."""
SURPRISE = 0.05
"""Weight of how well errors are foretold against how small they are."""
MISTAKEN = (
    "mistakes of our pose network about rendered people: MakeHuman bodies (CC0) in CMU mocap poses"
)


Draw = Callable[[int, np.random.Generator], Samples]


def drawing(poses_mm: Floats, mistakes: Mistakes | None) -> Draw:
    """What draws samples: of the prior, or half of them mistaken, a sixth of known people."""
    if mistakes is None:
        return lambda n, rng: draw(poses_mm, n, rng)
    transplanter = Transplanter(mistakes)

    def mixed(n: int, rng: np.random.Generator) -> Samples:
        mistaken, known = n // 2, n // 6
        parts = [
            transplanter.samples(poses_mm, mistaken, rng),
            mistakes.people(known, rng),
            draw(poses_mm, n - mistaken - known, rng),
        ]
        return joined(parts).taken(rng.permutation(n))

    return mixed


def train(
    drawn: Draw,
    minutes: float,
    seed: int,
    *,
    rate: float = RATE,
    start: PoseMlp | None = None,
    depths: bool = False,
) -> tuple[PoseMlp, int]:
    """The averaged network after so long, and how many samples it has seen.

    ``depths``: the samples have hints of them, and ``start`` is widened to read these.
    """
    rng = np.random.default_rng(seed)
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    bf16 = has_bf16("cpu")
    network = PoseMlp() if start is None else start
    if depths:
        network = with_depths(network)
    average = copy.deepcopy(network)
    optimiser = torch.optim.AdamW(
        network.parameters(), lr=rate, betas=(0.9, 0.99), weight_decay=0.01, fused=True
    )

    @torch.compile
    def loss_of(features: Tensor, *wanted: Tensor) -> tuple[Tensor, Tensor]:
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            last = network(features)
        distance, surprise = losses(last, *wanted)
        return distance + SURPRISE * surprise, distance

    started, spoken, step, spent = time.monotonic(), 0.0, 0, 0.0
    while spent < 1.0:
        chunk = tensors(drawn(CHUNK, rng))
        for first in range(0, CHUNK, BATCH):
            if step == COMPILED:
                started = time.monotonic()
            spent = (time.monotonic() - started) / (60.0 * minutes)
            cooled = max(0.0, (spent - STEADY) / (1.0 - STEADY))
            share = min(1.0, (step + 1) / WARM_UP_STEPS) * 0.5 * (1.0 + np.cos(np.pi * cooled))
            for group in optimiser.param_groups:
                group["lr"] = rate * max(share, 1e-3)
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
    points, present, doubt, hint, known, truth, depths, root_mm = (
        torch.from_numpy(np.ascontiguousarray(part, np.float32)) for part in vars(samples).values()
    )
    features, centre, radius = normalised(points, present, doubt, hint, known)
    given = (points - centre) / radius * present[..., None]
    log_size = torch.log(radius[:, 0, 0] * root_mm) - LOG_SIZE
    return features, (truth - centre) / radius - given, depths / radius[:, 0], log_size


def error_moments(network: PoseMlp, samples: Samples) -> NDArray[np.float64]:
    """Second moments (42, 42) of errors in units of the foretold deviations, mirror included."""
    features, image, depths, _ = tensors(samples)
    mirror = list(LSP14.mirror)
    with torch.no_grad():
        plain = read_last(network(features))
        other = read_last(network(tensors(in_mirror(samples))[0]))
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
    mirrored = moments[np.ix_(order, order)] * np.outer(signs, signs)
    return 0.5 * (moments + mirrored)


def lifter_card(
    network: PoseMlp,
    name: str,
    version: str,
    prior: PosePrior,
    measured: dict[str, float | str],
    *,
    mistaken: bool,
    found: str | None = None,
) -> ModelCard:
    """The card of a trained network.

    ``mistaken``: it has seen what a pose network mistakes; ``found``: the network that has, if this
    one has not.
    """
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
        output=LiftOutput(
            kind="lift",
            joint_names=list(LSP14.joint_names),
            reads_confidence=mistaken,
            reads_depths=network.reads_depths,
            found=found,
        ),
        training_data=[
            f"poses drawn from the pose prior {prior.card.name} {prior.card.version}, fitted on "
            "the CMU Graphics Lab Motion Capture Database (free for all uses), seen by made-up "
            "cameras",
            *([MISTAKEN] if mistaken else ["no photo"]),
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
    parser.add_argument("--minutes", type=real(0.1), default=20.0)
    parser.add_argument("--rate", type=real(1e-7), default=RATE, help="of learning, at its highest")
    parser.add_argument("--init", type=Path, help="go on from this .onnx of an earlier run")
    parser.add_argument("--mistakes", type=Path, help="what models.training.lifter_mistakes wrote")
    parser.add_argument("--found", help="name of the network for joints that are not all sure")
    parser.add_argument("--seed", type=SEED, default=0)
    chosen = parser.parse_args()
    prior = PosePrior.load(chosen.prior)
    rng = np.random.default_rng(chosen.seed)
    poses = prior.sample(POOL, rng).astype(np.float32)
    mistakes = None if chosen.mistakes is None else Mistakes.read(chosen.mistakes)
    depths = mistakes is not None and mistakes.have_depths
    start = None if chosen.init is None else read_network(chosen.init)
    if start is not None and start.reads_depths and not depths:
        parser.error(f"{chosen.init} reads depths: go on from it by --mistakes that have them")
    drawn = drawing(poses, mistakes)
    network, n = train(
        drawn, chosen.minutes, chosen.seed, rate=chosen.rate, start=start, depths=depths
    )
    measured: dict[str, float | str] = {
        "samples": float(n),
        "prior_sha256": prior.sha256,
        "command": "python -m models.training.train_lifter" + _options(chosen),
    }
    if mistakes is not None:
        measured["people_with_mistakes"] = float(len(mistakes))
    card = lifter_card(
        network,
        chosen.name,
        chosen.version,
        prior,
        measured,
        mistaken=mistakes is not None,
        found=chosen.found,
    )
    save(network, card, drawn, chosen.out)


def _options(chosen: argparse.Namespace) -> str:
    given = {"--init": chosen.init, "--mistakes": chosen.mistakes}
    return "".join(f" {option} {path.name}" for option, path in given.items() if path is not None)


def save(network: PoseMlp, card: ModelCard, drawn: Draw, directory: Path) -> ModelCard:
    """Measure the network's errors on fresh samples and write it with its card."""
    samples = drawn(MEASURED, np.random.default_rng(9))
    with torch.no_grad():
        features, *wanted = tensors(samples)
        distance, _ = losses(network(features), *wanted)
    error = {"mean_error/fresh_samples_in_radii": round(float(distance), 4)}
    card = card.model_copy(update={"measured": error | card.measured})
    return publish(lifter_model(network, error_moments(network, samples)), card, directory)


if __name__ == "__main__":
    main()
