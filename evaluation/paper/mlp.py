"""Train the MLP that is measured beside matching, on the poses of one library.

    python -m evaluation.paper.mlp --library DIR --out mlp.npz --minutes 30

Each sample is a pose of the library seen by a new camera (drawn as the library's own are), with
noise of 0 to 14 px at a focal length of 1150 and now and then a joint missing: more views of the
same people than matching ever sees. Needs torch, of the extra ``train``. The rate of learning falls
to nothing over ``--minutes`` of wall time; the result is an average of the weights.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from app.lifting.geometry import Floats, Mask, normalised_projection
from evaluation.paper.network import N_FEATURES, N_JOINTS, RMS_FLOOR, UNIT_MM, about_root, features
from library_store.arguments import SEED, integer, real
from library_store.cameras import extrinsics, sample_cameras
from library_store.library import Library, load
from library_store.skeleton import LIMB_JOINTS

if TYPE_CHECKING:
    import torch

CHUNK, BATCH = 8_192, 512
FOCAL_PX, MAX_NOISE_PX = 1150.0, 14.0
NO_NOISE, MISSING = 0.25, 0.1
"""Shares of the samples."""


@dataclass(frozen=True)
class Samples:
    """2D in, 3D out: ``points`` (N, 14, 2), ``present`` (N, 14), ``joints_mm`` (N, 14, 3)."""

    points: Floats
    present: Mask
    joints_mm: Floats


def draw(poses_mm: Floats, n: int, rng: np.random.Generator) -> Samples:
    """``n`` views of ``poses_mm`` (P, 14, 3), as the module says."""
    poses = poses_mm[rng.integers(len(poses_mm), size=n)]
    rotation, translation = extrinsics(sample_cameras(n, rng), poses)
    seen = poses @ np.swapaxes(rotation, 1, 2) + translation[:, None]
    sigma = rng.uniform(0.0, MAX_NOISE_PX, (n, 1, 1)) * (rng.random((n, 1, 1)) >= NO_NOISE)
    points = normalised_projection(seen) + sigma / FOCAL_PX * rng.standard_normal((n, N_JOINTS, 2))
    present = np.ones((n, N_JOINTS), dtype=bool)
    without = np.flatnonzero(rng.random(n) < MISSING)
    present[without, rng.choice(LIMB_JOINTS, len(without))] = False
    return Samples(points, present, about_root(seen))


def train(library: Library, width: int, n_blocks: int, minutes: float, seed: int, out: Path) -> int:
    """Train for so long and write ``out``, from time to time and at the end; returns samples."""
    import torch

    from models.training.precision import mixed_precision

    torch.manual_seed(seed)
    torch.set_num_threads(1)
    rng = np.random.default_rng(seed)
    poses = library.poses_mm(np.arange(len(library)))
    weights = initial_weights(width, n_blocks, rng)
    parameters = {name: torch.tensor(value).requires_grad_() for name, value in weights.items()}
    average = {name: value.detach().clone() for name, value in parameters.items()}
    optimiser = torch.optim.AdamW(
        parameters.values(), lr=1e-3, weight_decay=0.01, betas=(0.9, 0.99)
    )
    started, spoken, step, errors = time.monotonic(), 0.0, 0, []
    for inputs, wanted in _batches(poses, rng):
        spent = (time.monotonic() - started) / (60.0 * minutes)
        if spent >= 1.0:
            break
        for group in optimiser.param_groups:
            group["lr"] = 1e-3 * min(1.0, (step + 1) / 500, 1.6 * (1.0 - spent))
        with mixed_precision("cpu"):
            found = forward(parameters, n_blocks, inputs)
        difference = found.float().view(-1, N_JOINTS, 3) - wanted
        loss = torch.sqrt((difference**2).sum(-1) + 1e-8).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        step += 1
        decay = min(0.999, (step + 1) / (step + 50))
        with torch.no_grad():
            for name, value in parameters.items():
                average[name].lerp_(value, 1.0 - decay)
        errors.append(loss.item() * UNIT_MM)
        if time.monotonic() - spoken > 60.0:
            spoken = time.monotonic()
            cpu_s = time.process_time()
            print(
                f"{step * BATCH / 1e6:.2f} M samples, {np.mean(errors):.1f} mm, "
                f"{spent:.0%}, {cpu_s:.0f} CPU-s",
                flush=True,
            )
            errors = []
            _write(out, average, n_blocks, step * BATCH, library)
    _write(out, average, n_blocks, step * BATCH, library)
    return step * BATCH


def initial_weights(
    width: int, n_blocks: int, rng: np.random.Generator
) -> dict[str, NDArray[np.float32]]:
    """He's initialisation; what ends a block, and the network, begins at 0. float32."""
    shapes = {"in": (N_FEATURES, width), "out": (width, 3 * N_JOINTS)}
    for block in range(n_blocks):
        shapes |= {f"{block}a": (width, width), f"{block}b": (width, width)}
    weights: dict[str, NDArray[np.float32]] = {}
    for name, (fan_in, fan_out) in shapes.items():
        # Half of a block's last layer would never wake if it began at 0 under a relu.
        gain = 0.0 if name == "out" else 0.1 if name.endswith("b") else 1.0
        drawn = gain * rng.normal(0.0, np.sqrt(2.0 / fan_in), (fan_in, fan_out))
        weights[f"w_{name}"] = drawn.astype(np.float32)
        weights[f"b_{name}"] = np.zeros(fan_out, np.float32)
    return weights


def _batches(poses: Floats, rng: np.random.Generator) -> Iterator[tuple[Any, Any]]:
    import torch

    while True:
        drawn = draw(poses, CHUNK, rng)
        inputs = torch.tensor(features(drawn.points, drawn.present), dtype=torch.float32)
        wanted = torch.tensor(drawn.joints_mm / UNIT_MM, dtype=torch.float32)
        for start in range(0, CHUNK, BATCH):
            yield inputs[start : start + BATCH], wanted[start : start + BATCH]


def forward(w: dict[str, torch.Tensor], n_blocks: int, inputs: torch.Tensor) -> torch.Tensor:
    """The same as ``Network.lift``, up to the hip midpoint."""
    import torch

    def unit(hidden: torch.Tensor) -> torch.Tensor:
        mean = (hidden.float() ** 2).mean(1, keepdim=True)
        return hidden * torch.rsqrt(mean + RMS_FLOOR).to(hidden.dtype)

    linear = torch.nn.functional.linear
    hidden = torch.relu(linear(inputs, w["w_in"].T, w["b_in"]))
    for block in range(n_blocks):
        inner = torch.relu(linear(unit(hidden), w[f"w_{block}a"].T, w[f"b_{block}a"]))
        hidden = hidden + torch.relu(linear(inner, w[f"w_{block}b"].T, w[f"b_{block}b"]))
    return linear(unit(hidden), w["w_out"].T, w["b_out"])


def _write(
    out: Path, weights: dict[str, torch.Tensor], n_blocks: int, n_samples: int, library: Library
) -> None:
    unfinished = out.with_name(f".{out.name}")
    with unfinished.open("wb") as stream:
        np.savez(
            stream,
            n_blocks=n_blocks,
            n_samples=n_samples,
            poses=library.manifest.files["poses.npy"].sha256,
            **{name: value.numpy() for name, value in weights.items()},
        )
    unfinished.replace(out)


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line: see the module."""
    parser = argparse.ArgumentParser(prog="evaluation.paper.mlp", description=__doc__)
    parser.add_argument("--library", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True, help=".npz")
    parser.add_argument("--minutes", type=real(0.1), default=30.0)
    parser.add_argument("--width", type=integer(1), default=1024)
    parser.add_argument("--blocks", type=integer(0), default=2)
    parser.add_argument("--seed", type=SEED, default=0)
    chosen = parser.parse_args(arguments)
    library = load(chosen.library, verify=False)
    n = train(library, chosen.width, chosen.blocks, chosen.minutes, chosen.seed, chosen.out)
    print(f"{chosen.out}: {n:,} samples of {library.manifest.name}")


if __name__ == "__main__":
    main()
