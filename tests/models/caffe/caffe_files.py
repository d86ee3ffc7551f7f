"""Caffe files of networks like the paper's, any width, with random weights; our own writer.

Also the same networks in plain numpy, by Caffe's definitions and nothing of the importer.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
N_JOINTS = 14


@dataclass(frozen=True)
class Conv:
    name: str
    bottom: str
    top: str
    n_outputs: int
    kernel: int


@dataclass(frozen=True)
class Relu:
    blob: str


@dataclass(frozen=True)
class Pool:
    bottom: str
    top: str
    kernel: int
    stride: int
    mean: bool = False


@dataclass(frozen=True)
class Cat:
    bottoms: tuple[str, ...]
    top: str


@dataclass(frozen=True)
class Drop:
    blob: str


Step = Conv | Relu | Pool | Cat | Drop
CENTER = Pool("center_map", "pool_center_lower", 9, 8, mean=True)


def _stage(
    steps: list[Step], stage: int, last: str, widths: Sequence[int], kernels: Sequence[int]
) -> str:
    """Convolutions after the joining of a stage's inputs; its maps' name."""
    for i, (width, kernel) in enumerate(zip(widths, kernels, strict=True), 1):
        name = f"Mconv{i}_stage{stage}"
        steps.append(Conv(name, last, name, width, kernel))
        if i < len(widths):
            steps.append(Relu(name))
        last = name
    return last


def vgg_like(divide: int = 1, n_stages: int = 6, n_maps: int = N_JOINTS + 1) -> list[Step]:
    """The networks trained on MPII: ten layers of VGG, then stages of 7x7 convolutions."""
    steps: list[Step] = [CENTER]
    last, features = "image", ""
    blocks = ((64, 64), (128, 128), (256,) * 4, (512, 512, 256, 256, 256, 256, 128))
    for b, widths in enumerate(blocks, 1):
        for i, width in enumerate(widths, 1):
            name = f"conv{b}_{i}"
            steps += [Conv(name, last, name, width // divide, 3), Relu(name)]
            last = name
        if b < len(blocks):
            steps.append(Pool(last, f"pool{b}_stage1", 2, 2))
            last = f"pool{b}_stage1"
    features = last
    steps += [Conv("conv5_1", features, "conv5_1", 512 // divide, 1), Relu("conv5_1")]
    steps.append(Conv("conv5_2", "conv5_1", "conv5_2", n_maps, 1))
    last = "conv5_2"
    wide = 128 // divide
    for stage in range(2, n_stages + 1):
        joined = f"concat_stage{stage}"
        steps.append(Cat((last, features, CENTER.top), joined))
        last = _stage(steps, stage, joined, [wide] * 6 + [n_maps], [7] * 5 + [1, 1])
    return steps


def nine_by_nine(divide: int = 1, n_stages: int = 6, n_maps: int = N_JOINTS + 1) -> list[Step]:
    """The network trained on LSP: 9x9 convolutions, pooling whose windows stick out, Dropout."""
    steps: list[Step] = [CENTER]
    wide = 128 // divide

    def trunk(stage: int) -> str:
        last = "image"
        for i in (1, 2, 3):
            name, pooled = f"conv{i}_stage{stage}", f"pool{i}_stage{stage}"
            steps.extend([Conv(name, last, name, wide, 9), Relu(name), Pool(name, pooled, 3, 2)])
            last = pooled
        return last

    def features(stage: int, shared: str) -> str:
        name = f"conv4_stage{stage}" if stage < 3 else f"conv1_stage{stage}"
        steps.extend([Conv(name, shared, name, 32 // divide, 5), Relu(name)])
        return name

    last = features(1, trunk(1))
    for i, kernel in ((5, 9), (6, 1)):
        name = f"conv{i}_stage1"
        steps += [Conv(name, last, name, 512 // divide, kernel), Relu(name), Drop(name)]
        last = name
    steps.append(Conv("conv7_stage1", last, "conv7_stage1", n_maps, 1))
    last, shared = "conv7_stage1", ""
    for stage in range(2, n_stages + 1):
        shared = trunk(2) if stage == 2 else shared
        joined = f"concat_stage{stage}"
        steps.append(Cat((features(stage, shared), last, CENTER.top), joined))
        last = _stage(steps, stage, joined, [wide] * 4 + [n_maps], [11] * 3 + [1, 1])
    return steps


Weights = dict[str, tuple[Array, Array]]


def random_weights(steps: Sequence[Step], seed: int = 0) -> Weights:
    """Sizes as variance-preserving as needed to keep the last maps near one."""
    rng = np.random.default_rng(seed)
    channels = {"image": 3, "center_map": 1}
    weights: Weights = {}
    for step in steps:
        if isinstance(step, Conv):
            n = channels[step.bottom]
            shape = (step.n_outputs, n, step.kernel, step.kernel)
            weight = rng.normal(0, np.sqrt(2 / (n * step.kernel**2)), shape)
            bias = rng.normal(0, 0.1, step.n_outputs)
            weights[step.name] = (weight.astype(np.float32), bias.astype(np.float32))
            channels[step.top] = step.n_outputs
        elif isinstance(step, Pool):
            channels[step.top] = channels[step.bottom]
        elif isinstance(step, Cat):
            channels[step.top] = sum(channels[b] for b in step.bottoms)
    return weights


def _layer(kind: str, name: str, bottoms: Sequence[str], tops: Sequence[str], body: str) -> str:
    blobs = "".join(f'  bottom: "{b}"\n' for b in bottoms) + "".join(
        f'  top: "{t}"\n' for t in tops
    )
    return f'layer {{\n  name: "{name}"\n  type: "{kind}"\n{blobs}  {body}\n}}\n'


def prototxt(steps: Sequence[Step], side_px: int = 368, *, old: bool = False) -> str:
    """The text, as Caffe writes it; ``old`` is how it wrote it before 2014."""
    dims = "".join(f"input_dim: {d}\n" for d in (1, 4, side_px, side_px))
    text = f'name: "CPM"  # made for a test\ninput: "data"\n{dims}'
    cut = "slice_param { slice_point: 3 axis: 1 }"
    text += _layer("Slice", "image", ["data"], ["image", "center_map"], cut)
    for step in steps:
        if isinstance(step, Conv):
            body = (
                "param { lr_mult: 4.0 decay_mult: 1 }\n  convolution_param {\n    "
                f"num_output: {step.n_outputs}\n    pad: {step.kernel // 2}\n    "
                f"kernel_size: {step.kernel}\n"
                '    weight_filler { type: "gaussian" std: 0.01 }\n  }'
            )
            text += _layer("Convolution", step.name, [step.bottom], [step.top], body)
        elif isinstance(step, Relu):
            text += _layer("ReLU", f"{step.blob}_relu", [step.blob], [step.blob], "")
        elif isinstance(step, Pool):
            pool = "AVE" if step.mean else "MAX"
            body = f"pooling_param {{ pool: {pool} kernel_size: {step.kernel} "
            body += f"stride: {step.stride} }}"
            text += _layer("Pooling", step.top, [step.bottom], [step.top], body)
        elif isinstance(step, Cat):
            body = "concat_param { axis: 1 }"
            text += _layer("Concat", step.top, step.bottoms, [step.top], body)
        else:
            body = "dropout_param { dropout_ratio: 0.5 }"
            text += _layer("Dropout", f"{step.blob}_drop", [step.blob], [step.blob], body)
    if old:
        text = re.sub(r"(?m)^layer \{", "layers {", text)
        text = re.sub(
            r'(^  type: )"(\w+)"', lambda m: m[1] + m[2].upper(), text, flags=re.MULTILINE
        )
        text = text.replace("axis: 1", "").replace("concat_param {  }", "")
    return text


def _varint(value: int) -> bytes:
    out = b""
    while value > 127:
        out += bytes([value & 127 | 128])
        value >>= 7
    return out + bytes([value])


def _field(number: int, value: int | bytes) -> bytes:
    if isinstance(value, int):
        return _varint(number << 3) + _varint(value)
    return _varint(number << 3 | 2) + _varint(len(value)) + value


def _blob(value: Array, *, old: bool, packed: bool) -> bytes:
    if old:
        shape = (1,) * (4 - value.ndim) + value.shape
        head = b"".join(_field(i, size) for i, size in enumerate(shape, 1))
    else:
        head = _field(7, _field(1, b"".join(_varint(size) for size in value.shape)))
    data = value.astype("<f4").tobytes()
    if packed:
        return head + _field(5, data)
    return head + b"".join(b"\x2d" + data[i : i + 4] for i in range(0, len(data), 4))


def caffemodel(weights: Weights, *, old: bool = False, packed: bool = True) -> bytes:
    """A NetParameter with a layer that only training has before the others."""
    parts = [_field(1, b"CPM")]
    names = (4, 5, 6, 2) if old else (1, 2, 7, 100)
    name_field, type_field, blob_field, layer_field = names
    kind: int | bytes = 5 if old else b"Data"
    parts.append(_field(layer_field, _field(name_field, b"data") + _field(type_field, kind)))
    for name, blobs in weights.items():
        body = _field(name_field, name.encode())
        body += _field(type_field, 4 if old else b"Convolution")
        for blob in blobs:
            body += _field(blob_field, _blob(blob, old=old, packed=packed))
        parts.append(_field(layer_field, body))
    return b"".join(parts)


def write(
    directory: Path, steps: Sequence[Step], weights: Weights, side_px: int, *, old: bool = False
) -> tuple[Path, Path]:
    """Both files."""
    paths = directory / "deploy.prototxt", directory / "pose_iter_1.caffemodel"
    paths[0].write_text(prototxt(steps, side_px, old=old))
    paths[1].write_bytes(caffemodel(weights, old=old))
    return paths


def network_input(images: NDArray[np.uint8]) -> dict[str, Array]:
    """What the authors' code feeds: pixel / 256 - 0.5, and a Gaussian about the crop's middle."""
    n, side = images.shape[:2]
    y, x = np.mgrid[:side, :side] - (side - 1) / 2
    center = np.exp(-(x * x + y * y) / 2 / 21.0 / 21.0).astype(np.float32)
    planes = images.transpose(0, 3, 1, 2).astype(np.float32) / 256 - 0.5
    return {
        "image": planes.astype(np.float32),
        "center_map": np.repeat(center[None, None], n, axis=0),
    }


def forward(steps: Sequence[Step], weights: Weights, images: NDArray[np.uint8]) -> Array:
    """The last blob, in numpy, window by window."""
    blobs = network_input(images)
    last = ""
    for step in steps:
        if isinstance(step, Conv):
            last, weight_bias = step.top, weights[step.name]
            blobs[last] = _convolve(blobs[step.bottom], *weight_bias)
        elif isinstance(step, Relu):
            blobs[step.blob] = np.maximum(blobs[step.blob], 0)
        elif isinstance(step, Pool):
            blobs[step.top] = _pool(blobs[step.bottom], step)
        elif isinstance(step, Cat):
            blobs[step.top] = np.concatenate([blobs[b] for b in step.bottoms], axis=1)
    return blobs[last]


def _convolve(x: Array, weight: Array, bias: Array) -> Array:
    kernel = weight.shape[-1]
    pad = kernel // 2
    padded = np.pad(x, ((0, 0), (0, 0), (pad, pad), (pad, pad)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, (kernel, kernel), axis=(2, 3))
    out: Array = np.einsum("nchwij,ocij->nohw", windows, weight, optimize=True)
    return out + bias[:, None, None]


def _pool(x: Array, step: Pool) -> Array:
    """As many windows as cover everything; what sticks out is cut off."""
    height, width = x.shape[2:]
    rows, columns = (-(-(size - step.kernel) // step.stride) + 1 for size in (height, width))
    out = np.zeros((*x.shape[:2], rows, columns), np.float32)
    for r in range(rows):
        for c in range(columns):
            top, left = r * step.stride, c * step.stride
            window = x[:, :, top : top + step.kernel, left : left + step.kernel]
            out[:, :, r, c] = window.mean((2, 3)) if step.mean else window.max((2, 3))
    return out
