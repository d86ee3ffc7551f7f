"""The training loop that both networks share: schedule, EMA, checkpoints, log.

A run is seeded by step, so one that is stopped and resumed sees the samples it would have seen.
Metrics go to ``log.jsonl``, the state to ``last.pt``, both in the output folder.
"""

from __future__ import annotations

import argparse
import copy
import json
import math
import queue
import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from library_store.arguments import SEED, integer, real
from models.errors import ModelError
from models.training import optimizer as optim
from models.training.network import COARSEST_STRIDE_PX

Model = TypeVar("Model", bound=nn.Module)
Batch = tuple[Tensor, ...]
EMA_DECAY = 0.998


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options every training program has."""
    parser.add_argument("--data", type=Path, required=True, help="folder with the datasets")
    parser.add_argument(
        "--out", type=Path, required=True, help="folder of this run; resumed if any"
    )
    parser.add_argument("--init", type=Path, help="start from this checkpoint or exported ONNX")
    parser.add_argument("--steps", type=integer(1), default=12000)
    parser.add_argument("--minutes", type=real(0.1), help="bring the schedule to its end by then")
    parser.add_argument("--batch", type=integer(1), default=64)
    parser.add_argument(
        "--lr", type=real(1e-7), default=2e-3, help="AdamW's; Muon's is ten times that"
    )
    parser.add_argument("--optimizer", choices=["muon", "adamw"], default="muon")
    parser.add_argument("--seed", type=SEED, default=0)
    parser.add_argument("--threads", type=integer(1), default=2)
    parser.add_argument("--every", type=integer(1), default=500, help="steps between evaluations")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")


def parse_sizes(text: str) -> list[tuple[float, int]]:
    """``96:0.4,128:1`` -> [(0.4, 96), (1.0, 128)]: input size up to that share of the run.

    For ``add_argument(type=...)``. Shares ascend; the last size is that of the rest of the run.
    """
    try:
        pairs = [part.split(":") for part in text.split(",")]
        sizes = [(float(until), int(size)) for size, until in pairs]
    except ValueError:
        sizes = []
    shares = [0.0, *(until for until, _ in sizes)]
    ascend = all(before < after <= 1.0 for before, after in pairwise(shares))
    if not sizes or not ascend or any(size < 1 or size % COARSEST_STRIDE_PX for _, size in sizes):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not like 96:0.3,128:1, multiples of {COARSEST_STRIDE_PX} px up to "
            "ascending shares of the run"
        )
    return sizes


def learning_rate(progress: float) -> float:
    """Factor on the base rate: short warm-up, flat, then a straight way down to zero."""
    if progress < 0.01:
        return progress / 0.01
    return min(1.0, max(0.0, (1 - progress) / 0.6))


class Feeder:
    """Makes the batches of the coming steps in a thread of its own."""

    def __init__(self, make: Callable[[int], Batch], steps: range) -> None:
        self._make, self._steps = make, steps
        self._queue: queue.Queue[Batch | BaseException] = queue.Queue(4)
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            for step in self._steps:
                if self._closed.is_set():
                    return
                self._queue.put(self._make(step))
        except BaseException as error:  # handed to the training thread, which raises it
            self._queue.put(error)

    def __iter__(self) -> Iterator[Batch]:
        for _ in self._steps:
            item = self._queue.get()
            if isinstance(item, BaseException):
                raise item
            yield item

    def close(self) -> None:
        """Make no more; what is made and not taken is dropped, what is being made waited for."""
        self._closed.set()
        with suppress(queue.Empty):
            while True:
                self._queue.get_nowait()
        self._thread.join()


def _learn(
    model: Model,
    batch: Batch,
    loss_of: Callable[[Model, Batch], Tensor],
    optimizers: list[torch.optim.Optimizer],
) -> float:
    """One step on a batch: its loss before. Where that is no number, the weights stay."""
    model.train()
    loss = loss_of(model, batch)
    value = float(loss.detach())
    if math.isfinite(value):
        loss.backward()  # type: ignore[no-untyped-call]
        for o in optimizers:
            o.step()
            o.zero_grad(set_to_none=True)
    return value


def _average_into(ema: nn.Module, model: nn.Module, decay: float) -> None:
    with torch.no_grad():
        for a, b in zip(ema.state_dict().values(), model.state_dict().values(), strict=True):
            if a.dtype.is_floating_point:
                a.lerp_(b, 1 - decay)
            else:
                a.copy_(b)


def _start_from(path: Path, model: nn.Module, config: dict[str, object]) -> None:
    """Load a checkpoint's averaged weights, or those of an exported ONNX file.

    Parts that the model's ``ADDED`` describes may be missing in them. See :func:`_load`.
    """
    its_config: dict[str, object] = {}
    if path.suffix == ".onnx":
        from models.training.export import config_of, read_weights

        weights = read_weights(path)
        with suppress(KeyError):  # another network's
            its_config = config_of(weights).as_dict()
    else:
        state = read_checkpoint(path)
        weights, its_config = state["ema"], state["config"]
    _load(path, weights, its_config, model, config, getattr(model, "ADDED", None))


def _resume(
    path: Path,
    model: nn.Module,
    ema: nn.Module,
    optimizers: list[torch.optim.Optimizer],
    args: argparse.Namespace,
    config: dict[str, object],
) -> tuple[int, float]:
    """Load a run's state: the steps done and the seconds they took.

    ``SystemExit`` where the run was started with another network or optimizer, or the file is no
    run's own, such as the average of several.
    """
    state = read_checkpoint(path, args.device)
    if missing := sorted({"model", "optimizers", "spent_s"} - state.keys()):
        raise SystemExit(
            f"{path} cannot be resumed: no {', '.join(missing)}; start from it in another --out "
            "(--init)"
        )
    _load(path, state["model"], state["config"], model, config)
    ema.load_state_dict(state["ema"])
    if len(state["optimizers"]) != len(optimizers):
        raise SystemExit(
            f"{path} is of a run that was started with another optimizer than {args.optimizer}: "
            "resume it with that (--optimizer), or start anew in another --out"
        )
    for o, s in zip(optimizers, state["optimizers"], strict=True):
        o.load_state_dict(s)
    return state["step"], state["spent_s"]


def _load(
    path: Path,
    weights: dict[str, Tensor],
    its_config: dict[str, object],
    model: nn.Module,
    config: dict[str, object],
    added: str | None = None,
) -> None:
    """Load a file's weights, which may lack whole parts that the pattern ``added`` describes.

    ``SystemExit`` where they are of a network of another ``config``.
    """
    if differs := _differs(weights, model, added):
        sizes = [f"{key} {value}" for key, value in its_config.items() if value != config.get(key)]
        hint = f" (made with {', '.join(sizes)})" if sizes else ""
        raise SystemExit(f"{path} is of another architecture: it {differs}{hint}")
    model.load_state_dict(weights, strict=False)


def _differs(weights: dict[str, Tensor], model: nn.Module, added: str | None) -> str:
    """What weights lack, have too or have in another shape than a model's; empty if nothing."""
    own = model.state_dict()

    def is_new(key: str) -> bool:
        part = re.match(added, key) if added else None
        return part is not None and not any(other.startswith(part[0]) for other in weights)

    unset = [
        key
        for key in own
        if key not in weights and not key.endswith("num_batches_tracked") and not is_new(key)
    ]
    if unset:
        return f"lacks {unset[:3]} ..."
    if unknown := [key for key in weights if key not in own]:
        return f"has {unknown[:3]} ... too"
    for key, value in weights.items():
        if value.shape != own[key].shape:
            return f"has {key} of {tuple(value.shape)}, not of {tuple(own[key].shape)}"
    return ""


def read_checkpoint(path: Path, device: str = "cpu") -> dict[str, Any]:
    """The state in a run's ``last.pt``, on ``device``; ``ModelError`` for any other file."""
    try:
        state = torch.load(path, map_location=device, weights_only=True)
    except Exception as error:  # a reader of foreign bytes fails in every way
        raise ModelError(f"{path} cannot be read as a training run's last.pt: {error}") from error
    missing = {"config", "ema", "step"} - (state.keys() if isinstance(state, dict) else set())
    if missing:
        raise ModelError(f"{path} is not a training run's last.pt: no {', '.join(sorted(missing))}")
    return dict(state)


def fit(
    model: Model,
    args: argparse.Namespace,
    *,
    sizes: list[tuple[float, int]],
    make_batch: Callable[..., Batch],
    loss_of: Callable[[Model, Batch], Tensor],
    evaluate: Callable[[Model, int], dict[str, float]],
    config: dict[str, object],
) -> None:
    """Train ``model`` as ``args`` says, resuming from ``args.out / last.pt`` when it is there.

    ``make_batch(step, size=pixels)`` makes a batch on the CPU, ``loss_of(model, batch)`` its loss,
    ``evaluate(averaged model, size_px)`` the metrics that are logged. ``ModelError`` when the loss
    is no number any more; what has been kept of the run is from before.
    """
    torch.manual_seed(args.seed)
    torch.set_num_threads(args.threads)
    args.out.mkdir(parents=True, exist_ok=True)
    model = model.to(args.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    if args.init:
        _start_from(args.init, model, config)
    ema = copy.deepcopy(model).eval()
    optimizers = optim.build(model, args.optimizer, args.lr)
    base_rates = [[g["lr"] for g in o.param_groups] for o in optimizers]
    step, spent_s = 0, 0.0
    last = args.out / "last.pt"
    if last.exists():
        step, spent_s = _resume(last, model, ema, optimizers, args, config)
        print(f"resumed at step {step}", flush=True)
    started = time.monotonic() - spent_s

    def progress() -> float:
        by_time = (time.monotonic() - started) / (60 * args.minutes) if args.minutes else 0.0
        return max(step / args.steps, by_time)

    def size_now() -> int:
        return next((size for until, size in sizes if progress() <= until), sizes[-1][1])

    running = math.nan
    while progress() < 1:
        size = size_now()
        mark, mark_step = time.monotonic(), step
        coming = range(step, step + args.every)
        with closing(Feeder(partial(make_batch, size=size), coming)) as feeder:
            for batch in feeder:
                factor = learning_rate(progress())
                for o, rates in zip(optimizers, base_rates, strict=True):
                    for g, rate in zip(o.param_groups, rates, strict=True):
                        g["lr"] = rate * factor
                value = _learn(model, tuple(t.to(args.device) for t in batch), loss_of, optimizers)
                if not math.isfinite(value):
                    raise ModelError(
                        f"{args.out}: the loss of step {step} is {value}: go on, from the last "
                        "evaluation, at a lower rate of learning (--lr)"
                    )
                _average_into(ema, model, min(EMA_DECAY, (1 + step) / (10 + step)))
                running = value if math.isnan(running) else 0.98 * running + 0.02 * value
                step += 1
                if progress() >= 1 or size_now() != size:
                    break
        rate = (step - mark_step) * args.batch / (time.monotonic() - mark)
        line = {
            "step": step,
            "crops": step * args.batch,
            "size_px": size,
            "loss": round(running, 4),
            "progress": round(progress(), 4),
            "crops_per_s": round(rate, 1),
            **{k: round(v, 4) for k, v in evaluate(ema, size).items()},
        }
        print(json.dumps(line), flush=True)
        with (args.out / "log.jsonl").open("a") as log:
            log.write(json.dumps(line) + "\n")
        state = {
            "model": model.state_dict(),
            "ema": ema.state_dict(),
            "optimizers": [o.state_dict() for o in optimizers],
            "config": config,
            "step": step,
            "spent_s": time.monotonic() - started,
            "size_px": size,
        }
        torch.save(state, last.with_suffix(".tmp"))
        last.with_suffix(".tmp").replace(last)
