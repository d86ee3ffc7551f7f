"""Checkpoint -> ONNX and model card: ``python -m models.training.export {cpm,person} --help``.

The graph takes uint8 BGR images as OpenCV has them and scales them itself. Large weights are stored
in half precision (and run in single): half the download, no measurable loss.
"""

from __future__ import annotations

import argparse
import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import helper, numpy_helper
from torch import Tensor, nn

from library_store.skeleton import LSP14
from models.card import DetectorOutput, ModelCard, PoseOutput
from models.training.augment import CROP_SCALE
from models.training.network import (
    ConvolutionalPoseMachine,
    CpmConfig,
    PersonConfig,
    PersonNetwork,
)
from models.training.objective import FINE_SIGMA_CELLS
from models.training.train_people import UNIT_PX

DETECTOR_THRESHOLD = 0.35
LABELLED = "Leeds Sports Pose Extended (Johnson & Everingham 2011, research use), human labels"
PHOTOS = "web photos of everyday and sport poses, labels by BlazePose heavy and a mobile CPM"
SCENES = "whole street and sport scenes, boxes by the BlazePose detector and landmark network"


HALF = ".half"
PREFIX = "network."


RESEARCH = (
    "trained partly on images published for research use: judge whether that suits a commercial use"
)


class _FromBytes(nn.Module):
    """uint8 (N, H, W, 3) BGR -> the network's last maps."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Tensor) -> Tensor:
        x = image.permute(0, 3, 1, 2).float() * (1 / 127.5) - 1.0
        out = self.network(x)
        last: Tensor = out[-1] if isinstance(out, list) else out
        return last


def multiply_adds(network: nn.Module, image: Tensor) -> int:
    """Multiply-adds of all convolutions for one forward pass."""
    total = 0

    def count(module: nn.Module, _: Any, out: Tensor) -> None:
        nonlocal total
        assert isinstance(module, nn.Conv2d)
        total += out.shape[-1] * out.shape[-2] * module.weight.numel()

    hooks = [m.register_forward_hook(count) for m in network.modules() if isinstance(m, nn.Conv2d)]
    with torch.no_grad():
        network(image)
    for hook in hooks:
        hook.remove()
    return total


def halve_weights(model: onnx.ModelProto) -> None:
    """Store large float32 initialisers as float16 behind a Cast, in place."""
    casts = []
    for initializer in model.graph.initializer:
        value = numpy_helper.to_array(initializer)
        if value.dtype != np.float32 or value.size < 1024:
            continue
        name = initializer.name
        stored = numpy_helper.from_array(value.astype(np.float16), name + HALF)
        initializer.CopyFrom(stored)
        casts.append(helper.make_node("Cast", [stored.name], [name], to=onnx.TensorProto.FLOAT))
    for cast in reversed(casts):
        model.graph.node.insert(0, cast)


def read_weights(path: Path) -> dict[str, Tensor]:
    """The state dict that an exported file was written from (without the batch counters)."""
    weights: dict[str, Tensor] = {}
    for initializer in onnx.load(str(path)).graph.initializer:
        name = initializer.name.removesuffix(HALF)
        if name.startswith(PREFIX):
            value = numpy_helper.to_array(initializer).astype(np.float32)
            weights[name.removeprefix(PREFIX)] = torch.from_numpy(value)
    # Equal tensors are stored once, and a strided block's two last biases always are equal: they
    # are added up, so they get the same gradient from the same start.
    for name in [n for n in weights if n.endswith(".b.1.bias")]:
        block = name.removesuffix(".b.1.bias")
        if f"{block}.skip.1.weight" in weights:
            weights.setdefault(f"{block}.skip.1.bias", weights[name])
    return weights


def write_onnx(network: nn.Module, example: Tensor, path: Path, axes: dict[int, str]) -> str:
    """Write ``path`` and return its sha256."""
    torch.onnx.export(
        _FromBytes(network).eval(),
        (example,),
        str(path),
        input_names=["image"],
        output_names=["maps"],
        dynamic_axes={"image": axes, "maps": {k + (k > 0): f"maps_{v}" for k, v in axes.items()}},
        opset_version=17,
        dynamo=False,
        # Keeps the parameters apart and by their names, so that training can go on from the file;
        # onnxruntime folds the normalisations into the convolutions when it loads it.
        training=torch.onnx.TrainingMode.PRESERVE,
        do_constant_folding=False,
    )
    model = onnx.load(str(path))
    halve_weights(model)
    onnx.checker.check_model(model)
    path.write_bytes(model.SerializeToString())
    return hashlib.sha256(path.read_bytes()).hexdigest()


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("network", choices=["cpm", "person"])
    parser.add_argument("--checkpoint", type=Path, required=True)
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "weights")
    parser.add_argument("--name", help="file name without its suffix; the network's by default")
    parser.add_argument("--version", required=True)
    parser.add_argument("--input-px", type=int, help="crop side, or the photo's longer side")
    args = parser.parse_args()

    state = torch.load(args.checkpoint, map_location="cpu", weights_only=True)
    name = args.name or args.network
    args.out.mkdir(parents=True, exist_ok=True)
    path = args.out / f"{name}.onnx"
    network: nn.Module
    output: PoseOutput | DetectorOutput
    if args.network == "cpm":
        size = args.input_px or state["size_px"]
        config = {**state["config"], "blocks": tuple(state["config"]["blocks"])}
        network = ConvolutionalPoseMachine(CpmConfig(**config))
        example, axes = torch.zeros(1, size, size, 3, dtype=torch.uint8), {0: "n"}
        output = PoseOutput(
            kind="pose",
            joint_names=list(LSP14.joint_names),
            input_px=size,
            crop_scale=CROP_SCALE,
            stride_px=4.0,
            target_sigma_cells=FINE_SIGMA_CELLS,
            maps="logits",
        )
        description = (
            "Convolutional Pose Machine: dense residual backbone, "
            f"{config['n_stages']} supervised stages at stride 8, last maps at stride 4"
        )
        data = [LABELLED, PHOTOS]
        limits = [
            "one person per crop, the one in its centre",
            "labels are crowd-sourced or by other networks: hips and neck follow their conventions",
            "weak on rare poses, on heavy occlusion and in crowds",
            RESEARCH,
        ]
    else:
        size = args.input_px or 320
        config = {**state["config"], "blocks": tuple(state["config"]["blocks"])}
        network = PersonNetwork(PersonConfig(**config))
        example = torch.zeros(1, size * 3 // 4 // 32 * 32, size, 3, dtype=torch.uint8)
        axes = {0: "n", 1: "h", 2: "w"}
        output = DetectorOutput(
            kind="people",
            long_side_px=size,
            stride_px=PersonNetwork.STRIDE,
            unit_px=UNIT_PX,
            threshold=DETECTOR_THRESHOLD,
        )
        description = "Person detector: residual pyramid, centre map and box sides at stride 8"
        data = [LABELLED, PHOTOS, SCENES]
        limits = [
            "people smaller than a tenth of the photo's longer side are often missed",
            "boxes are of the joints, not of hair, clothes or things held",
            RESEARCH,
        ]
    network.load_state_dict(state["ema"])
    network.eval()
    count = multiply_adds(network, example.permute(0, 3, 1, 2).float())
    sha256 = write_onnx(network, example, path, axes)
    card = ModelCard(
        name=name,
        version=args.version,
        file=path.name,
        sha256=sha256,
        description=description,
        parameters=sum(p.numel() for p in network.parameters()),
        multiply_adds=count,
        output=output,
        training_data=data,
        licence="Apache-2.0 (weights); the training images keep their own terms",
        limits=limits,
        measured={"training_steps": state["step"]},
    )
    (args.out / f"{name}.json").write_text(card.model_dump_json(indent=2) + "\n")


if __name__ == "__main__":
    main()
