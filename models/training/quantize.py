"""An exported network's 8-bit twin: ``python -m models.training.quantize --name cpm --data DIR``.

Weights become int8 per channel, activations uint8 with ranges seen on training images; the last
maps stay in single precision, where a step would show as a jump of the joint. Weights keep 7 of
their bits: AVX2 adds two products in 16, where 8-bit ones overflow. This takes half the time of
single precision, and less on CPUs with 8-bit dot products. Measure the twin like any other:
``models.training.calibrate --name cpm-int8``.
"""

from __future__ import annotations

import argparse
import logging
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
import onnxruntime as ort
from numpy.typing import NDArray
from onnx import helper, numpy_helper
from onnxruntime.quantization import (
    CalibrationDataReader,
    CalibrationMethod,
    QuantFormat,
    QuantType,
    quantize_static,
)

from library_store.arguments import integer
from models.card import WEIGHTS_DIR, DetectorOutput, ModelCard, PoseOutput, read_card
from models.person_detector import PersonDetector, corners, iou, shrunk
from models.providers import INT8_FEATURES
from models.training.augment import canonical
from models.training.dataset import decode_members, read_crops
from models.training.export import publish
from models.training.onnx_graph import INPUT, LAST

Images = Iterable[NDArray[np.uint8]]
SUFFIX = "-int8"
SEED = 0
BLOCK, BLOCKS, MIDDLE = 4, "blocks", 128


class _Reader(CalibrationDataReader):  # type: ignore[misc]
    """Feeds images one by one."""

    def __init__(self, images: Images) -> None:
        self._left: Iterator[NDArray[np.uint8]] = iter(images)

    def get_next(self) -> dict[str, Any] | None:
        """The next input, None after the last."""
        image = next(self._left, None)
        return None if image is None else {INPUT: image[None]}


def quantized(path: Path, images: Images) -> onnx.ModelProto:
    """The network of an fp32 file in 8 bits; ``images`` (h, w, 3) uint8 BGR are as it gets them."""
    with tempfile.TemporaryDirectory() as folder:
        folded, out = Path(folder) / "folded.onnx", Path(folder) / "int8.onnx"
        fold(path, folded)
        model = onnx.load(str(folded))
        centred = take_blocks(model)
        onnx.save(model, str(folded))
        with _quiet():
            quantize_static(
                folded,
                out,
                _Reader(images),
                quant_format=QuantFormat.QDQ,
                per_channel=True,
                activation_type=QuantType.QUInt8,
                weight_type=QuantType.QInt8,
                reduce_range=True,
                calibrate_method=CalibrationMethod.MinMax,
                nodes_to_exclude=[n.name for n in model.graph.node if n.name.startswith(LAST)],
                extra_options={
                    "TensorQuantOverrides": {
                        centred: [
                            {
                                "scale": np.array(1, np.float32),
                                "zero_point": np.array(MIDDLE, np.uint8),
                            }
                        ]
                    }
                },
            )
        model = onnx.load(str(out))
    _take_bytes(model, centred)
    onnx.checker.check_model(model, full_check=True)
    return model


def fold(path: Path, folded: Path) -> None:
    """Write a network with its normalisations made part of their convolutions.

    Ranges are to be taken of what is left then.
    """
    options = ort.SessionOptions()
    options.log_severity_level = 3
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_BASIC
    options.optimized_model_filepath = str(folded)
    ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def take_blocks(model: onnx.ModelProto) -> str:
    """Let the stem read 4x4 blocks as 48 channels, in place; the name of its input.

    To 8-bit kernels, which gather their input pixel by pixel, that is worth half the stem's time.
    The two reshapes leave every size free: width, then height, is cut while it stands before the
    channels.
    """
    graph = model.graph
    stem = next(node for node in graph.node if node.op_type == "Conv")
    constants = {i.name: i for i in graph.initializer}
    wide = numpy_helper.to_array(constants[stem.input[1]])
    bias = numpy_helper.to_array(constants[stem.input[2]])
    side = wide.shape[-1] // BLOCK
    kernel = wide.reshape(len(wide), 3, side, BLOCK, side, BLOCK)
    kernel = kernel.transpose(0, 3, 5, 1, 2, 4).reshape(len(wide), -1, side, side)
    # Bytes are centred on 128 here, on 127.5 in training.
    bias = bias + (MIDDLE - 127.5) * kernel.sum((1, 2, 3))
    around = [pad // BLOCK for pad in _attribute(stem, "pads")]
    step = [stride // BLOCK for stride in _attribute(stem, "strides")]
    before = set(_upstream(graph, stem.input[0]))
    rest = [node for node in graph.node if node.name not in before and node is not stem]

    def constant(name: str, value: NDArray[Any]) -> str:
        graph.initializer.append(numpy_helper.from_array(value, name))
        return name

    row = constant("blocks.row", np.array([0, 0, -1, 3 * BLOCK], np.int64))
    whole = constant("blocks.whole", np.array([0, 0, -1, 3 * BLOCK**2], np.int64))
    nodes = [
        helper.make_node("Reshape", [INPUT, row], ["blocks.1"], "blocks.1"),
        helper.make_node("Transpose", ["blocks.1"], ["blocks.2"], "blocks.2", perm=[0, 2, 1, 3]),
        helper.make_node("Reshape", ["blocks.2", whole], ["blocks.3"], "blocks.3"),
        helper.make_node("Transpose", ["blocks.3"], [BLOCKS], BLOCKS, perm=[0, 3, 2, 1]),
        helper.make_node("Cast", [BLOCKS], ["blocks.4"], "blocks.4", to=onnx.TensorProto.FLOAT),
        helper.make_node(
            "Sub",
            ["blocks.4", constant("blocks.middle", np.array(MIDDLE, np.float32))],
            ["blocks.centred"],
            "blocks.centred",
        ),
        helper.make_node(
            "Conv",
            [
                "blocks.centred",
                constant("blocks.kernel", kernel.astype(np.float32)),
                constant("blocks.bias", bias.astype(np.float32)),
            ],
            list(stem.output),
            stem.name,
            kernel_shape=[side, side],
            strides=step,
            pads=around,
        ),
    ]
    _replace_nodes(graph, [*nodes, *rest])
    return "blocks.centred"


def _take_bytes(model: onnx.ModelProto, centred: str) -> None:
    """Let the stem take the photo's bytes for the quantised input they are already, in place."""
    graph = model.graph
    quantise = next(
        n for n in graph.node if n.op_type == "QuantizeLinear" and n.input[0] == centred
    )
    for node in graph.node:
        for i, name in enumerate(node.input):
            if name == quantise.output[0]:
                node.input[i] = BLOCKS
    unused = {"blocks.4", centred, quantise.name}
    _replace_nodes(graph, [node for node in graph.node if node.name not in unused])


def _replace_nodes(graph: onnx.GraphProto, nodes: list[onnx.NodeProto]) -> None:
    """Put ``nodes`` for those there are, and drop the constants that none of them uses."""
    used = {name for node in nodes for name in node.input}
    constants = [constant for constant in graph.initializer if constant.name in used]
    del graph.node[:], graph.initializer[:]
    graph.node.extend(nodes)
    graph.initializer.extend(constants)


def _upstream(graph: onnx.GraphProto, value: str) -> Iterator[str]:
    """Names of the nodes that ``value`` is computed by."""
    for node in graph.node:
        if value in node.output:
            yield node.name
            for name in node.input:
                yield from _upstream(graph, name)


def _attribute(node: onnx.NodeProto, name: str) -> list[int]:
    return next(list(a.ints) for a in node.attribute if a.name == name)


@contextmanager
def _quiet() -> Iterator[None]:
    """The quantiser advises on the root logger to do what has been done."""
    root = logging.getLogger()
    level = root.level
    root.setLevel(logging.ERROR)
    ort.set_default_logger_severity(3)
    try:
        yield
    finally:
        root.setLevel(level)
        ort.set_default_logger_severity(2)


def quantize(directory: Path, name: str, images: Images) -> ModelCard:
    """Write the 8-bit twin of a network and its card beside it, not measured yet."""
    card = read_card(directory / f"{name}.json")
    output = card.output
    if isinstance(output, PoseOutput):
        # What 8 bits save buys further looks, which are worth more than they cost.
        output = output.model_copy(update={"looks": 3, "confidence": None, "spread": None})
    twin = card.model_copy(
        update={
            "output": output,
            "name": name + SUFFIX,
            "file": f"{name}{SUFFIX}.onnx",
            "description": f"{card.description}; 8-bit twin of {name}",
            "precision": "int8",
            "providers": ("openvino", "cpu"),
            "cpu_features": INT8_FEATURES,
            "cost_ms": {},
            "cost_cpu": {},
            "accuracy": None,
            "measured": {},
        }
    )
    return publish(quantized(directory / card.file, images), twin, directory)


def same_boxes(directory: Path, names: tuple[str, str], photos: Images) -> float:
    """Share of the people found by both of two person networks (IoU over 0.5), of all found.

    1 where neither finds anybody.
    """
    first, second = (PersonDetector(name, weights_dir=directory) for name in names)
    both = total = 0
    for photo in photos:
        here, there = (corners(found.detect(photo, 100)) for found in (first, second))
        matched = int((iou(here, there).max(1, initial=0) > 0.5).sum())
        both += matched
        total += len(here) + len(there) - matched
    return both / total if total else 1.0


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--name", default="cpm")
    parser.add_argument("--weights", type=Path, default=WEIGHTS_DIR)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--train", default="lspet_train_a,photos_a", help="crops to take ranges on")
    parser.add_argument("--scenes", default="photos_scenes.tar", help="for the person network")
    parser.add_argument("--images", type=integer(1), default=300)
    args = parser.parse_args()
    cv2.setNumThreads(1)

    output = read_card(args.weights / f"{args.name}.json").output
    rng = np.random.default_rng(SEED)
    if isinstance(output, PoseOutput):
        crops, _ = read_crops(args.data, args.train, "")
        picked = rng.permutation(len(crops))[: args.images]
        card = quantize(
            args.weights, args.name, (canonical(crops[i], output.input_px).image for i in picked)
        )
    elif isinstance(output, DetectorOutput):
        scenes = list(decode_members(args.data / args.scenes).values())
        long = output.long_side_px
        card = quantize(args.weights, args.name, (shrunk(s, long)[0] for s in scenes[1::2]))
        kept = same_boxes(args.weights, (args.name, card.name), scenes[0::2])
        print({f"boxes_shared_with_{args.name}": round(kept, 4)})
    else:
        parser.error(f"{args.name} is a {output.kind} network, which gains nothing by 8 bits")
    print(card.model_dump_json(include={"name", "file", "sha256"}))


if __name__ == "__main__":
    main()
