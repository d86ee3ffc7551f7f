"""Average the weights of runs that began as one another: ``python -m models.training.average``.

A run and the one that it went on from lie in one valley of the loss; the middle between them is
often better than both (Wortsman et al., "Model soups", ICML 2022), at no cost.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import torch

from models.training.loop import read_checkpoint


def average(checkpoints: list[dict[str, Any]]) -> dict[str, Any]:
    """The last checkpoint with the mean of all averaged weights. One architecture only."""
    *others, last = checkpoints
    for other in others:
        if _architecture(other) != _architecture(last):
            raise ValueError(f"of another architecture: {other['config']}, not {last['config']}")
    mean = {
        key: torch.stack([c["ema"][key] for c in checkpoints]).mean(0)
        if value.dtype.is_floating_point
        else value
        for key, value in last["ema"].items()
    }
    return {**{k: last[k] for k in ("config", "step", "size_px")}, "ema": mean}


def _architecture(checkpoint: dict[str, Any]) -> dict[str, Any]:
    """Its configuration; runs from before any network read depths say nothing of them."""
    return {"depths": False, **checkpoint["config"]}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkpoints", type=Path, nargs="+", help="in the order they were trained")
    parser.add_argument("--out", type=Path, required=True, help="a checkpoint to export")
    args = parser.parse_args()
    states = [read_checkpoint(p) for p in args.checkpoints]
    torch.save(average(states), args.out)


if __name__ == "__main__":
    main()
