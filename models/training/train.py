"""Train the CPM: ``python -m models.training.train --data DIR --out DIR``.

Runs on a CPU (bf16 where it has it) or a GPU. Seeded by step, so a run that is stopped and resumed sees
the crops it would have seen. Metrics go to ``log.jsonl``, the state to ``last.pt``, both in --out.
"""

from __future__ import annotations

import argparse
import copy
import json
import math
import queue
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.training import optimizer as optim
from models.training.augment import Sample, canonical, random_view
from models.training.dataset import LabelledCrop, held_out, load
from models.training.network import ConvolutionalPoseMachine, CpmConfig
from models.training.objective import total_loss

DEV_LABELLED = 400
"""Human-labelled training crops kept aside to choose by; lspet_val is only ever reported."""


def torso_px(joints: NDArray[np.float32]) -> NDArray[np.float32]:
    """The longer of the two shoulder-to-opposite-hip diagonals, (N, 14, 2) -> (N,)."""
    a = np.linalg.norm(joints[:, 2] - joints[:, 11], axis=-1)
    b = np.linalg.norm(joints[:, 5] - joints[:, 8], axis=-1)
    longest: NDArray[np.float32] = np.maximum(a, b)
    return longest


def pck(
    predicted: NDArray[np.float32],
    truth: NDArray[np.float32],
    known: NDArray[np.bool_],
    threshold: float = 0.2,
) -> float:
    """Share of known joints within ``threshold`` torso lengths of the truth."""
    error = np.linalg.norm(predicted - truth, axis=-1) / torso_px(truth)[:, None]
    return float((error < threshold)[known].mean())


def to_batch(samples: list[Sample]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Samples -> (image (B,3,S,S) in [-1,1], joints (B,14,2), weight (B,14), presence (B,14))."""
    images = torch.from_numpy(np.stack([s.image for s in samples]))
    x = images.permute(0, 3, 1, 2).float().mul_(1 / 127.5).sub_(1)
    return (
        x.contiguous(memory_format=torch.channels_last),
        torch.from_numpy(np.stack([s.joints_px for s in samples])),
        torch.from_numpy(np.stack([s.weight for s in samples])),
        torch.from_numpy(np.stack([s.presence for s in samples])),
    )


def peaks_px(logits: Tensor, n_joints: int, size: int) -> NDArray[np.float32]:
    """Expected position around the strongest cell, (B, 15, h, w) -> (B, 14, 2) pixels."""
    maps = torch.softmax(logits[:, :n_joints].float().flatten(2), -1)
    cells = logits.shape[-1]
    p = maps.reshape(*maps.shape[:2], cells, cells)
    best = maps.argmax(-1)
    axis = torch.arange(cells, dtype=torch.float32, device=p.device)
    by, bx = (best // cells).float(), (best % cells).float()
    near_y = ((axis - by[..., None]).abs() <= 2).float()
    near_x = ((axis - bx[..., None]).abs() <= 2).float()
    p = p * near_y[..., :, None] * near_x[..., None, :]
    p = p / p.sum((-1, -2), keepdim=True).clamp_min(1e-9)
    x, y = (p.sum(-2) * axis).sum(-1), (p.sum(-1) * axis).sum(-1)
    at = torch.stack([x, y], -1)
    px: NDArray[np.float32] = ((at + 0.5) * (size / cells) - 0.5).cpu().numpy()
    return px


class Feeder:
    """Makes the batches of the coming steps in a thread of its own."""

    def __init__(
        self, crops: list[LabelledCrop], batch: int, seed: int, plan: list[tuple[int, int]]
    ) -> None:
        self._crops, self._batch, self._seed = crops, batch, seed
        self._queue: queue.Queue[tuple[int, int, list[Sample]]] = queue.Queue(6)
        self._plan = plan
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        for step, size in self._plan:
            rng = np.random.default_rng((self._seed, step))
            picked = rng.integers(0, len(self._crops), (self._batch, 2))
            samples = [
                random_view(self._crops[i], self._crops[j], size, rng) for i, j in picked
            ]
            self._queue.put((step, size, samples))

    def __iter__(self) -> Iterator[tuple[int, int, list[Sample]]]:
        for _ in self._plan:
            yield self._queue.get()


def evaluate(
    model: ConvolutionalPoseMachine, crops: list[LabelledCrop], size: int, device: str
) -> float:
    """PCK@0.2 on canonical crops."""
    model.eval()
    predicted, truth, known = [], [], []
    for start in range(0, len(crops), 64):
        samples = [canonical(c, size) for c in crops[start : start + 64]]
        x, joints, weight, _ = to_batch(samples)
        with torch.no_grad(), torch.autocast(device, torch.bfloat16):
            logits = model(x.to(device))[-1]
        predicted.append(peaks_px(logits, model.cfg.n_joints, size))
        truth.append(joints.numpy())
        known.append(weight.numpy() > 0)
    return pck(np.concatenate(predicted), np.concatenate(truth), np.concatenate(known))


def parse_sizes(text: str) -> list[tuple[float, int]]:
    """``96:0.4,128:1`` -> [(0.4, 96), (1.0, 128)]: input size up to that share of the steps."""
    pairs = [part.split(":") for part in text.split(",")]
    return [(float(until), int(size)) for size, until in pairs]


def learning_rate(progress: float) -> float:
    """Factor on the base rate: short warm-up, flat, then a linear way down to zero."""
    if progress < 0.01:
        return progress / 0.01
    return min(1.0, max(0.0, (1 - progress) / 0.6))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder with the datasets' tars")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--train", default="lspet_train_a,lspet_train_b,photos_a,photos_b")
    parser.add_argument("--test", default="lspet_val")
    parser.add_argument("--init", type=Path, help="start from this checkpoint's weights")
    parser.add_argument("--steps", type=int, default=12000)
    parser.add_argument("--minutes", type=float, help="bring the schedule to its end by then")
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--sizes", default="96:0.35,128:1")
    parser.add_argument("--lr", type=float, default=2e-3)
    parser.add_argument("--optimizer", choices=["muon", "adamw"], default="muon")
    parser.add_argument("--width", type=int, default=32)
    parser.add_argument("--blocks", default="2,3,4,3")
    parser.add_argument("--stage-width", type=int, default=64)
    parser.add_argument("--stages", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--every", type=int, default=500, help="steps between evaluations")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    train(parser.parse_args())


def train(args: argparse.Namespace) -> None:
    """Run or resume the training that ``args`` describes."""
    torch.manual_seed(args.seed)
    torch.set_num_threads(args.threads)
    args.out.mkdir(parents=True, exist_ok=True)
    crops: list[LabelledCrop] = []
    dev: dict[str, list[LabelledCrop]] = {"photos_dev": [], "labelled_dev": []}
    for name in args.train.split(","):
        loaded = load(args.data / f"{name}.tar")
        if loaded[0].group == 0 and loaded[0].wild and name.startswith("lspet"):
            share = DEV_LABELLED // 2
            dev["labelled_dev"] += loaded[-share:]
            crops += loaded[:-share]
        else:
            dev["photos_dev"] += [c for c in loaded if held_out(c)]
            crops += [c for c in loaded if not held_out(c)]
    dev["photos_dev"] = dev["photos_dev"][::2]
    for name in args.test.split(","):
        dev[name] = load(args.data / f"{name}.tar")
    print({"train": len(crops)} | {k: len(v) for k, v in dev.items()}, flush=True)

    cfg = CpmConfig(
        width=args.width,
        blocks=tuple(int(b) for b in args.blocks.split(",")),  # type: ignore[arg-type]
        stage_width=args.stage_width,
        n_stages=args.stages,
    )
    model = ConvolutionalPoseMachine(cfg).to(args.device, memory_format=torch.channels_last)
    if args.init:
        model.load_state_dict(torch.load(args.init, map_location=args.device)["ema"])
    ema = copy.deepcopy(model).eval()
    optimizers = optim.build(model, args.optimizer, args.lr)
    base_rates = [[g["lr"] for g in o.param_groups] for o in optimizers]
    step, spent_s = 0, 0.0
    last = args.out / "last.pt"
    if last.exists():
        state: dict[str, Any] = torch.load(last, map_location=args.device, weights_only=True)
        model.load_state_dict(state["model"])
        ema.load_state_dict(state["ema"])
        for o, s in zip(optimizers, state["optimizers"], strict=True):
            o.load_state_dict(s)
        step, spent_s = state["step"], state["spent_s"]
        print(f"resumed at step {step}", flush=True)

    sizes = parse_sizes(args.sizes)
    started = time.monotonic() - spent_s

    def progress_at(step: int) -> float:
        by_time = 0.0
        if args.minutes:
            by_time = (time.monotonic() - started) / (60 * args.minutes)
        return max(step / args.steps, by_time)

    def size_at(progress: float) -> int:
        return next(size for until, size in sizes if progress <= until or until >= 1)

    def save() -> None:
        state = {
            "model": model.state_dict(),
            "ema": ema.state_dict(),
            "optimizers": [o.state_dict() for o in optimizers],
            "config": cfg.as_dict(),
            "step": step,
            "spent_s": time.monotonic() - started,
            "size": size,
        }
        torch.save(state, last.with_suffix(".tmp"))
        last.with_suffix(".tmp").replace(last)

    log = (args.out / "log.jsonl").open("a")
    size = size_at(progress_at(step))
    mark, mark_step, running = time.monotonic(), step, math.nan
    while progress_at(step) < 1:
        plan = [(s, size) for s in range(step, step + args.every)]
        for _, _, samples in Feeder(crops, args.batch, args.seed, plan):
            progress = progress_at(step)
            factor = learning_rate(progress)
            for o, rates in zip(optimizers, base_rates, strict=True):
                for g, rate in zip(o.param_groups, rates, strict=True):
                    g["lr"] = rate * factor
            model.train()
            x, joints, weight, presence = (t.to(args.device) for t in to_batch(samples))
            with torch.autocast(args.device, torch.bfloat16):
                stages = model(x)
            loss = total_loss(stages, joints, weight, presence, size)
            loss.backward()
            for o in optimizers:
                o.step()
                o.zero_grad(set_to_none=True)
            with torch.no_grad():
                decay = min(0.998, (1 + step) / (10 + step))
                for a, b in zip(ema.state_dict().values(), model.state_dict().values(), strict=True):
                    if a.dtype.is_floating_point:
                        a.lerp_(b, 1 - decay)
                    else:
                        a.copy_(b)
            value = float(loss.detach())
            running = value if math.isnan(running) else 0.98 * running + 0.02 * value
            step += 1
            if progress_at(step) >= 1:
                break
        rate = (step - mark_step) * args.batch / (time.monotonic() - mark)
        scores = {k: round(evaluate(ema, v, size, args.device), 4) for k, v in dev.items()}
        line = {
            "step": step,
            "crops": step * args.batch,
            "size_px": size,
            "loss": round(running, 4),
            "progress": round(progress_at(step), 4),
            "crops_per_s": round(rate, 1),
            "pck_0.2": scores,
        }
        print(json.dumps(line), flush=True)
        log.write(json.dumps(line) + "\n")
        log.flush()
        save()
        size = size_at(progress_at(step))
        mark, mark_step = time.monotonic(), step


if __name__ == "__main__":
    main()
