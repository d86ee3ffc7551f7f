"""Checkpoint -> ONNX and model card: ``python -m models.training.export {cpm,person} --help``.

The graph takes uint8 BGR images as OpenCV has them and scales them itself. Large weights are stored
in half precision (and run in single): half the download, no measurable loss.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from torch import Tensor, nn

from library_store.arguments import integer
from library_store.skeleton import LSP14
from models.card import WEIGHTS_DIR, DetectorOutput, ModelCard, PoseOutput, write_network
from models.errors import ModelError
from models.training.augment import CROP_SCALE
from models.training.loop import read_checkpoint
from models.training.network import (
    BACKGROUND,
    COARSEST_STRIDE_PX,
    ConvolutionalPoseMachine,
    CpmConfig,
    PersonConfig,
    PersonNetwork,
)
from models.training.objective import FINE_SIGMA_CELLS
from models.training.onnx_graph import HALF, PREFIX, person_model, pose_model
from models.training.train_people import UNIT_PX

Kind = Literal["cpm", "person"]
DETECTOR_THRESHOLD = 0.35
PHOTO_PX = 320
"""Default for the longer side of the photo that the person network sees."""
LABELLED = "Leeds Sports Pose Extended (Johnson & Everingham 2011, research use), human labels"
PHOTOS = "web photos of everyday and sport poses, labels by BlazePose heavy and a mobile CPM"
RENDERED = "rendered people: MakeHuman bodies (CC0) in CMU mocap poses"
DEPTHS = "depths of joints in the photos by BlazePose heavy, where it agrees with their labels"
SCENES = (
    "whole street and sport scenes, boxes by the BlazePose detector and landmark network, "
    "and by earlier versions of these networks"
)
RESEARCH = (
    "trained partly on images published for research use: judge whether that suits a commercial use"
)


def multiply_adds(network: nn.Module, image: Tensor) -> int:
    """Multiply-adds of all convolutions for one forward pass."""
    total = 0

    def count(module: nn.Module, _: Any, out: Tensor) -> None:
        nonlocal total
        assert isinstance(module, nn.Conv2d)
        total += out.shape[-1] * out.shape[-2] * module.weight.numel()

    hooks = [m.register_forward_hook(count) for m in network.modules() if isinstance(m, nn.Conv2d)]
    was_training = network.training
    network.eval()  # while training, a pass would move the statistics of the batch norms
    with torch.no_grad():
        network(image)
    network.train(was_training)
    for hook in hooks:
        hook.remove()
    return total


def read_weights(path: Path) -> dict[str, Tensor]:
    """The state dict that an exported file was written from (without the batch counters)."""
    weights: dict[str, Tensor] = {}
    for initializer in onnx.load(str(path)).graph.initializer:
        name = initializer.name.removesuffix(HALF)
        if name.startswith(PREFIX):
            value = numpy_helper.to_array(initializer).astype(np.float32)
            weights[name.removeprefix(PREFIX)] = torch.from_numpy(value)
    return weights


def config_of(weights: dict[str, Tensor]) -> CpmConfig:
    """The sizes of a CPM, from its weights; ``KeyError`` when they are of another network."""
    score = weights["fine_score.weight"]

    def count(prefix: str) -> int:
        return len({k.removeprefix(prefix).split(".")[0] for k in weights if k.startswith(prefix)})

    n4, n8, n16, n32 = (count(f"backbone.c{stride}.") for stride in (4, 8, 16, 32))
    return CpmConfig(
        n_joints=len(score) - BACKGROUND,
        width=score.shape[1],
        blocks=(n4, n8, n16, n32),
        stage_width=weights["stages.0.score.weight"].shape[1],
        n_stages=count("stages."),
        depths="depth.score.weight" in weights,
    )


def pose_card(network: ConvolutionalPoseMachine, name: str, version: str, size: int) -> ModelCard:
    """The card of a CPM for crops of ``size`` pixels; its sha256 is for :func:`publish` to fill."""
    return ModelCard(
        name=name,
        version=version,
        file=f"{name}.onnx",
        sha256="",
        description="Convolutional Pose Machine: dense residual backbone, "
        f"{network.cfg.n_stages} supervised stages at stride 8, last maps at stride 4"
        + (", joints' depths" if network.cfg.depths else ""),
        parameters=sum(p.numel() for p in network.parameters()),
        multiply_adds=multiply_adds(network, torch.zeros(1, 3, size, size)),
        output=PoseOutput(
            kind="pose",
            joint_names=list(LSP14.joint_names),
            input_px=size,
            crop_scale=CROP_SCALE,
            stride_px=4.0,
            target_sigma_cells=FINE_SIGMA_CELLS,
            maps="logits",
            depths=network.cfg.depths,
        ),
        training_data=[LABELLED, PHOTOS, RENDERED, *([DEPTHS] if network.cfg.depths else [])],
        licence="Apache-2.0 (weights); the training images keep their own terms",
        limits=[
            "one person per crop, the one in its centre",
            "labels are crowd-sourced or by other networks: hips and neck follow their conventions",
            "weak on rare poses, on heavy occlusion and in crowds",
            RESEARCH,
        ],
        measured={},
    )


def person_card(network: PersonNetwork, name: str, version: str, size: int) -> ModelCard:
    """The card of a person network for photos of ``size`` pixels; its cost is a 4:3 photo's."""
    return ModelCard(
        name=name,
        version=version,
        file=f"{name}.onnx",
        sha256="",
        description="Person detector: residual pyramid, centre map and box sides at stride 8",
        parameters=sum(p.numel() for p in network.parameters()),
        multiply_adds=multiply_adds(network, torch.zeros(1, 3, -(-size * 3 // 4 // 32) * 32, size)),
        output=DetectorOutput(
            kind="people",
            long_side_px=size,
            stride_px=PersonNetwork.STRIDE,
            unit_px=UNIT_PX,
            threshold=DETECTOR_THRESHOLD,
        ),
        training_data=[LABELLED, PHOTOS, RENDERED, SCENES],
        licence="Apache-2.0 (weights); the training images keep their own terms",
        limits=[
            "people smaller than a fifteenth of the photo's longer side are often missed",
            "boxes are of the joints, not of hair, clothes or things held; "
            "of somebody cut off they end where the photo does",
            RESEARCH,
        ],
        measured={},
    )


def publish(model: onnx.ModelProto, card: ModelCard, directory: Path) -> ModelCard:
    """Write the ONNX file and its card; returns the card with the file's sha256."""
    return write_network(directory, model.SerializeToString(deterministic=True), card)


def export(
    checkpoint: Path,
    directory: Path,
    kind: Kind,
    *,
    version: str,
    name: str | None = None,
    size_px: int | None = None,
) -> ModelCard:
    """Write the averaged weights of a training run's checkpoint as ONNX and card.

    ``size_px`` is the crop's side (default: that of the run's last step) or the photo's longer
    side (default: 320); both are multiples of 32. Raises ``ModelError`` for another size and for a
    file that is no such checkpoint.
    """
    if size_px is not None and size_px % COARSEST_STRIDE_PX:
        raise ModelError(f"an input of {size_px} px: a multiple of {COARSEST_STRIDE_PX} is wanted")
    state = read_checkpoint(checkpoint)
    try:
        config = {**state["config"], "blocks": tuple(state["config"]["blocks"])}
        if kind == "cpm":
            cpm = ConvolutionalPoseMachine(CpmConfig(**config))
            cpm.load_state_dict(state["ema"])
            size = size_px or int(state["size_px"])
            card, model = pose_card(cpm, name or kind, version, size), pose_model(cpm, size)
        else:
            person = PersonNetwork(PersonConfig(**config))
            person.load_state_dict(state["ema"])
            size = size_px or PHOTO_PX
            card, model = person_card(person, name or kind, version, size), person_model(person)
    except (KeyError, TypeError, RuntimeError) as error:
        raise ModelError(f"{checkpoint} is of no {kind} network: {error}") from error
    card = card.model_copy(update={"measured": {"training_steps": float(state["step"])}})
    return publish(model, card, directory)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("network", choices=get_args(Kind))
    parser.add_argument("--checkpoint", type=Path, required=True)
    parser.add_argument("--out", type=Path, default=WEIGHTS_DIR)
    parser.add_argument("--name", help="file name without its suffix; the network's by default")
    parser.add_argument("--version", required=True)
    parser.add_argument(
        "--input-px", type=integer(32), help="crop side, or the photo's longer side"
    )
    args = parser.parse_args()
    export(
        args.checkpoint,
        args.out,
        args.network,
        version=args.version,
        name=args.name,
        size_px=args.input_px,
    )


if __name__ == "__main__":
    main()
