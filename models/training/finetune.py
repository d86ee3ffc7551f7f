"""Going on from the shipped weights with a user's own labelled people: see :func:`finetune`.

Behind ``posematch model finetune``. A share of the images (whole images, whole takes) is held out,
measured before and after through the files that are served.
"""

from __future__ import annotations

import argparse
import hashlib
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from models.card import ModelCard, PoseOutput, printable, read_card, write_card
from models.card import read_weights as read_file
from models.errors import AnnotationError, ModelError
from models.heatmaps import read_maps
from models.looks import looked_at
from models.pck import correct_keypoints
from models.session import OnnxModel
from models.training import loop
from models.training.augment import canonical, random_view
from models.training.dataset import LabelledCrop
from models.training.export import config_of, pose_card, publish, read_weights
from models.training.network import ConvolutionalPoseMachine, CpmConfig
from models.training.objective import total_loss
from models.training.onnx_graph import pose_model
from models.training.precision import mixed_precision
from models.training.train import measure, to_batch

LEAST_HELD, LEAST_TRAINED = 5, 20
BATCH_MOST = 32


@dataclass(frozen=True)
class FinetuneSettings:
    """How long and how fast; ``minutes`` brings the schedule to its end by then."""

    steps: int = 500
    minutes: float | None = None
    lr: float = 3e-4
    hold_out: float = 0.15
    seed: int = 0
    threads: int = 2


@dataclass(frozen=True)
class FinetuneResult:
    """PCK@0.2 of the held-out people with the old and with the new weights, as shares of one."""

    card: ModelCard
    n_trained: int
    n_held_out: int
    before: float
    after: float


def split(
    crops: list[LabelledCrop], share: float, seed: int
) -> tuple[list[LabelledCrop], list[LabelledCrop]]:
    """(train, held out); people of one image or take stay together.

    Raises ``AnnotationError`` when either part would be too small.
    """
    groups = sorted({crop.group for crop in crops})
    order = sorted(groups, key=lambda g: zlib.crc32(f"{seed}/{g}".encode()))
    kept = set(order[: max(1, round(share * len(groups)))])
    held = [c for c in crops if c.group in kept and c.has_torso]
    train = [c for c in crops if c.group not in kept]
    if len(held) < LEAST_HELD or len(train) < LEAST_TRAINED:
        raise AnnotationError(
            f"{len(crops)} labelled people in {len(groups)} images or takes leave {len(train)} to "
            f"train on and {len(held)} with shoulders and hips to measure on; at least "
            f"{LEAST_TRAINED} and {LEAST_HELD} are needed: label more images, or change --hold-out"
        )
    return train, held


def pck(directory: Path, name: str, crops: list[LabelledCrop]) -> float:
    """PCK@0.2 of an exported network over the labelled joints."""
    model = OnnxModel(directory, name)
    output = model.card.output
    assert isinstance(output, PoseOutput)
    right = total = 0
    for crop in crops:
        sample = canonical(crop, output.input_px)
        maps = looked_at(model.see, sample.image[None], output.looks).maps
        cells = read_maps(maps, len(output.joint_names), output.maps, output.target_sigma_cells).at[
            0
        ]
        found = (cells + 0.5) * output.stride_px - 0.5
        known = sample.weight > 0
        right += int(correct_keypoints(found, sample.joints_px)[known].sum())
        total += int(known.sum())
    return right / total


def finetune(
    crops: list[LabelledCrop],
    *,
    weights_dir: Path,
    start: str,
    out: Path,
    name: str,
    source: str,
    settings: FinetuneSettings,
) -> FinetuneResult:
    """Train on ``crops`` from the weights of card ``start``; write ``out/name.onnx`` and card.

    ``source`` says in the card what was trained on. The training run itself is kept in
    ``out/run`` and is resumed from there. Raises ``ModelError``, also where ``out/run`` is of other
    labels or settings: who was held out then may have been trained on there.
    """
    begin = _read_start(weights_dir, start, out / f"{name}.onnx")
    train, held = split(crops, settings.hold_out, settings.seed)
    _keep_to(out / "run", _inputs(crops, begin.card, settings))
    before = pck(weights_dir, start, held)
    network, n_steps = _train(begin, train, held, out / "run", settings)
    card = _publish(network, begin, name, source, out)
    after = pck(out, name, held)
    measured: dict[str, float | str] = {
        "training_steps": float(n_steps),
        "held_out_people": float(len(held)),
        "pck_0.2/held_out/before": round(before, 4),
        "pck_0.2/held_out/after": round(after, 4),
    }
    card = card.model_copy(update={"measured": measured})
    write_card(out / f"{name}.json", card)
    return FinetuneResult(card, len(train), len(held), before, after)


@dataclass(frozen=True)
class _Start:
    """The network that is gone on from: its card and weights file, what it puts out, its shape."""

    card: ModelCard
    path: Path
    output: PoseOutput
    config: CpmConfig


def _read_start(weights_dir: Path, start: str, result: Path) -> _Start:
    """The network of card ``start``; ``ModelError`` if it is none to go on from.

    Nor may it lie where the ``result`` shall be.
    """
    card = read_card(weights_dir / f"{start}.json")
    if not isinstance(card.output, PoseOutput) or card.precision != "fp32":
        raise ModelError(f"model {start} cannot be trained on: name an fp32 pose network's card")
    path = weights_dir / card.file
    if path.resolve() == result.resolve():
        raise ModelError(
            f"{result.parent} is where {start} lies, which would be overwritten: give another "
            "--name or --out"
        )
    read_file(path, card)  # it is there, whole and the card's
    try:
        config = config_of(read_weights(path))
    except KeyError as error:
        raise ModelError(
            f"model {start} cannot be trained on: it has no {error} as networks of this "
            "architecture do; name another in --start"
        ) from error
    return _Start(card, path, card.output, config)


def _train(
    begin: _Start,
    train: list[LabelledCrop],
    held: list[LabelledCrop],
    run: Path,
    settings: FinetuneSettings,
) -> tuple[ConvolutionalPoseMachine, int]:
    """The network after training, its weights averaged over the last steps; how many there were."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    args = argparse.Namespace(
        out=run,
        init=begin.path,
        steps=settings.steps,
        minutes=settings.minutes,
        batch=min(BATCH_MOST, len(train)),
        lr=settings.lr,
        optimizer="adamw",
        seed=settings.seed,
        threads=settings.threads,
        every=min(100, settings.steps),
        device=device,
    )

    def make_batch(step: int, size: int) -> loop.Batch:
        rng = np.random.default_rng((settings.seed, step))
        picked = rng.integers(0, len(train), (args.batch, 2))
        return to_batch([random_view(train[i], train[j], size, rng) for i, j in picked])

    def loss_of(model: ConvolutionalPoseMachine, batch: loop.Batch) -> Tensor:
        x, joints, weight, presence, _ = batch
        with mixed_precision(device):
            stages = model(x)
        return total_loss(stages, joints, weight, presence, x.shape[-1])

    loop.fit(
        ConvolutionalPoseMachine(begin.config),
        args,
        sizes=[(1.0, begin.output.input_px)],
        make_batch=make_batch,
        loss_of=loss_of,
        evaluate=lambda model, px: {"pck_0.2/held_out": measure(model, held, px, device)},
        config=begin.config.as_dict(),
    )
    state = loop.read_checkpoint(run / "last.pt")
    network = ConvolutionalPoseMachine(begin.config)
    network.load_state_dict(state["ema"])
    return network.eval(), state["step"]


def _publish(
    network: ConvolutionalPoseMachine, begin: _Start, name: str, source: str, out: Path
) -> ModelCard:
    """Write the network and its card, which says what it has from the one it began as."""
    old, size = begin.card, begin.output.input_px
    source = printable(source)
    fresh = pose_card(network, name, f"{old.version}+{name}", size)
    inherited = {
        "output": _calibration_inherited(begin.output, old.name),
        "training_data": [*old.training_data, source],
        "limits": old.limits,
        "licence": f"{old.licence}; and whatever {source} demands",
        "cost_ms": old.cost_ms,
        "cost_cpu": old.cost_cpu,
    }
    return publish(pose_model(network, size), fresh.model_copy(update=inherited), out)


def _inputs(crops: list[LabelledCrop], start: ModelCard, settings: FinetuneSettings) -> str:
    """Digest of what decides who is held out and what is learned, but for how long."""
    digest = hashlib.sha256(f"{start.sha256} {settings.hold_out} {settings.seed}".encode())
    for crop in crops:
        digest.update(f"{crop.name} {crop.group}".encode())
        for part in (crop.image, crop.joints_px, crop.visible):
            digest.update(part.tobytes())
    return digest.hexdigest()


def _keep_to(run: Path, inputs: str) -> None:
    """Note what ``run`` learns from; ``ModelError`` when it has begun with something else."""
    note = run / "inputs.sha256"
    known = note.read_text(encoding="utf-8") if note.exists() else ""
    if (run / "last.pt").exists() and known != inputs:
        raise ModelError(
            f"{run} has been trained on other labels, from other weights or with another --seed or "
            "--hold-out: whom it has learned may be held out now; give another --out, or delete it"
        )
    run.mkdir(parents=True, exist_ok=True)
    note.write_text(inputs, encoding="utf-8")


def _calibration_inherited(output: PoseOutput, start: str) -> PoseOutput:
    """The old network's calibration, which says so: a few images are too few to fit it anew."""
    said = f"{{}}; of {start}, which this network was fine-tuned from"
    update = {
        key: part.model_copy(update={"fitted_on": said.format(part.fitted_on)})
        for key in ("confidence", "spread")
        if (part := getattr(output, key)) is not None
    }
    return output.model_copy(update=update)
