"""Train the CPM: ``python -m models.training.train --data DIR --out DIR``.

Runs on a CPU or a GPU (in bf16 where that is native), resumes by itself, is seeded and logs its
metrics: see loop.py.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from library_store.arguments import integer, integers
from models.pck import correct_keypoints
from models.training import loop
from models.training.augment import Sample, canonical, random_view
from models.training.dataset import LabelledCrop, read_crops
from models.training.network import ConvolutionalPoseMachine, CpmConfig
from models.training.objective import depth_loss, total_loss
from models.training.precision import mixed_precision


def to_batch(samples: list[Sample]) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Samples -> image (B,3,S,S) in [-1,1], joints (B,14,2); weight, presence, depths (B,14)."""
    images = torch.from_numpy(np.stack([s.image for s in samples]))
    x = images.permute(0, 3, 1, 2).float().mul_(1 / 127.5).sub_(1)
    return (
        x.contiguous(memory_format=torch.channels_last),
        torch.from_numpy(np.stack([s.joints_px for s in samples])),
        torch.from_numpy(np.stack([s.weight for s in samples])),
        torch.from_numpy(np.stack([s.presence for s in samples])),
        torch.from_numpy(np.stack([s.depths for s in samples])),
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


def measure(
    model: ConvolutionalPoseMachine, crops: list[LabelledCrop], size: int, device: str
) -> float:
    """PCK@0.2 on canonical crops."""
    predicted, truth, known = [], [], []
    for start in range(0, len(crops), 64):
        samples = [canonical(c, size) for c in crops[start : start + 64]]
        x, joints, weight, *_ = to_batch(samples)
        with torch.no_grad(), mixed_precision(device):
            logits = model(x.to(device))[-1]
        predicted.append(peaks_px(logits, model.cfg.n_joints, size))
        truth.append(joints.numpy())
        known.append(weight.numpy() > 0)
    correct = correct_keypoints(np.concatenate(predicted), np.concatenate(truth))
    return float(correct[np.concatenate(known)].mean())


def measure_depths(
    model: ConvolutionalPoseMachine, crops: list[LabelledCrop], size: int, device: str
) -> float:
    """Mean distance of the depths from the known ones over the crop's side."""
    errors = []
    for start in range(0, len(crops), 64):
        x, _, weight, _, depths = to_batch([canonical(c, size) for c in crops[start : start + 64]])
        with torch.no_grad(), mixed_precision(device):
            seen = model.seen(x.to(device))
        assert seen.depths is not None
        errors.append(
            (seen.depths.float().cpu() - depths).abs()[(weight > 0) & torch.isfinite(depths)]
        )
    return float(torch.cat(errors).mean())


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    loop.add_arguments(parser)
    parser.add_argument("--train", default="lspet_train_a,lspet_train_b,photos_a,photos_b")
    parser.add_argument("--test", default="lspet_val")
    parser.add_argument(
        "--sizes",
        type=loop.parse_sizes,
        default="96:0.3,128:0.7,160:1",
        help="input px:up to share of run",
    )
    parser.add_argument("--width", type=integer(1), default=32)
    parser.add_argument("--blocks", type=integers(4, ","), default="2,3,4,3")
    parser.add_argument("--stage-width", type=integer(1), default=64)
    parser.add_argument("--stages", type=integer(1), default=3)
    parser.add_argument("--depths", type=Path, help="learn depths too; what depth_teacher wrote")
    parser.add_argument("--only-depths", action="store_true", help="all else stays as it is")
    args = parser.parse_args()
    if args.only_depths and args.depths is None:
        parser.error("--only-depths needs --depths")

    torch.manual_seed(args.seed)
    crops, kept = read_crops(args.data, args.train, args.test, args.depths)
    print({"train": len(crops)} | {k: len(v) for k, v in kept.items()}, flush=True)
    n4, n8, n16, n32 = args.blocks
    cfg = CpmConfig(
        width=args.width,
        blocks=(n4, n8, n16, n32),
        stage_width=args.stage_width,
        n_stages=args.stages,
        depths=args.depths is not None,
    )

    def make_batch(step: int, size: int) -> loop.Batch:
        rng = np.random.default_rng((args.seed, step))
        picked = rng.integers(0, len(crops), (args.batch, 2))
        return to_batch([random_view(crops[i], crops[j], size, rng) for i, j in picked])

    def loss_of(model: ConvolutionalPoseMachine, batch: loop.Batch) -> Tensor:
        x, joints, weight, presence, depths = batch
        if args.only_depths:
            model.eval()  # statistics of the batch norms stay as well
            assert model.depth is not None
            model.depth.train()
        with mixed_precision(args.device):
            seen = model.seen(x, only_depths=args.only_depths)
        if seen.depths is None:
            return total_loss(seen.stages, joints, weight, presence, x.shape[-1])
        of_depths = depth_loss(seen.depths, depths, weight)
        if args.only_depths:
            return of_depths
        return of_depths + total_loss(seen.stages, joints, weight, presence, x.shape[-1])

    measured = {name: those for name, those in kept.items() if those}
    deep = {k: v for k, v in measured.items() if any(c.depths_px is not None for c in v)}

    def evaluate(model: ConvolutionalPoseMachine, size: int) -> dict[str, float]:
        found = {f"pck_0.2/{k}": measure(model, v, size, args.device) for k, v in measured.items()}
        if cfg.depths:
            found |= {
                f"depth_error/{k}": measure_depths(model, v, size, args.device)
                for k, v in deep.items()
            }
        return found

    loop.fit(
        ConvolutionalPoseMachine(cfg),
        args,
        sizes=args.sizes,
        make_batch=make_batch,
        loss_of=loss_of,
        evaluate=evaluate,
        config=cfg.as_dict(),
    )


if __name__ == "__main__":
    main()
