"""Net and weights -> ONNX graph: layer by layer, sizes worked out as Caffe does."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from models.caffe import onnx_file
from models.caffe.caffemodel import Blob
from models.caffe.net import Concat, Convolution, Identity, Layer, Net, Pooling, ReLU, Slice
from models.errors import CaffeError

IMAGE, MAPS = "image", "maps"
CENTER_SIGMA_PX = 21.0
"""Width of the centre map's Gaussian, as in the published training and test code."""
MOST_PX = 2048
_PIXEL_SCALE, _PIXEL_MEAN = 1 / 256, 0.5
"""The network sees pixel / 256 - 0.5, blue first."""


@dataclass(frozen=True)
class Blobs:
    """A value of the graph: its name there and its size."""

    name: str
    channels: int
    height: int
    width: int


@dataclass(frozen=True)
class Graph:
    """An ONNX file's bytes and what they compute.

    Maps (N, C, ``map_cells``, ``map_cells``) float32 from images (N, ``input_px``, ``input_px``, 3)
    uint8 BGR.
    """

    data: bytes
    input_px: int
    map_cells: int
    parameters: int
    multiply_adds: int


def build(
    net: Net, weights: dict[str, list[Blob]], channels: tuple[int, ...], n_channels: int
) -> Graph:
    """The graph of ``net``, whose maps are ``channels`` of the ``n_channels`` of its last blob.

    Pictures are scaled and the map of the person's centre made inside the graph. Raises
    ``CaffeError`` when layers and weights do not fit each other.
    """
    builder = _Builder(net, weights)
    for layer in net.layers:
        builder.add(layer)
    return builder.finish(channels, n_channels)


def center_map(side_px: int) -> NDArray[np.float32]:
    """Gaussian about the middle of the crop, where the person is: (1, 1, side, side)."""
    squares = (np.arange(side_px) - (side_px - 1) / 2) ** 2
    exponent = (squares[:, None] + squares) / (2 * CENTER_SIGMA_PX**2)
    return np.exp(-exponent).astype(np.float32)[None, None]


class _Builder:
    def __init__(self, net: Net, weights: dict[str, list[Blob]]) -> None:
        self._weights = weights
        self._nodes: list[bytes] = []
        self._tensors: list[bytes] = []
        self._blobs: dict[str, Blobs] = {}
        self._unread: dict[str, None] = {}
        self._parameters = self._multiply_adds = self._n_values = 0
        sizes = {shape[2:] for shape in net.inputs.values()}
        channels = sorted(shape[1] for shape in net.inputs.values())
        if len(sizes) != 1 or (side := next(iter(sizes)))[0] != side[1]:
            raise CaffeError(f"inputs of {sorted(sizes)} px: one square size is wanted")
        if channels not in ([3], [4], [1, 3]):
            raise CaffeError(
                f"inputs of {channels} channels: a colour image is wanted, with or without a "
                "centre map (3 or 4 channels)"
            )
        self._side = side[0]
        if self._side > MOST_PX:
            raise CaffeError(f"inputs of {self._side} px; at most {MOST_PX} can be imported")
        self._node("Cast", [IMAGE], "pixels", to=onnx_file.FLOAT)
        self._node("Transpose", ["pixels"], "planes", perm=[0, 3, 1, 2])
        for name, shape in net.inputs.items():
            self._define(name, self._input(shape[1]))

    def _input(self, channels: int) -> Blobs:
        parts = []
        if channels != 1:
            scale = self._tensor("pixel_scale", np.array(_PIXEL_SCALE, np.float32))
            self._node("Mul", ["planes", scale], "scaled")
            mean = self._tensor("pixel_mean", np.array(-_PIXEL_MEAN, np.float32))
            parts.append(self._node("Add", ["scaled", mean], "centred"))
        if channels != 3:
            # One for each image, by arithmetic alone: GPUs leave the reckoning with shapes to the
            # CPU, and a network of which they cannot run every node is not run by them at all.
            ends = [self._tensor(f"plane_{i}", np.array([i], np.int64)) for i in range(2)]
            nothing = self._tensor("nothing", np.array(0, np.float32))
            one = self._tensor("center_map", center_map(self._side))
            self._node("Slice", ["planes", *ends, ends[1]], "plane")
            self._node("Mul", ["plane", nothing], "zeros")
            parts.append(self._node("Add", ["zeros", one], "center_maps"))
        name = parts[0]
        if len(parts) > 1:
            name = self._node("Concat", parts, "image_and_center", axis=1)
        return Blobs(name, channels, self._side, self._side)

    def add(self, layer: Layer) -> None:
        """Append one layer's nodes."""
        operation = layer.operation
        for name in layer.bottoms:
            if name not in self._blobs:
                raise CaffeError(f"layer {layer.name} reads {name}, which no layer before it makes")
        bottoms = [self._blobs[name] for name in layer.bottoms]
        for name in layer.bottoms:
            self._unread.pop(name, None)
        if isinstance(operation, Concat):
            self._count(layer, bottoms=None, tops=1)
            made = [self._concat(layer, bottoms)]
        else:
            self._count(layer, bottoms=1, tops=None)
            made = self._from_one(layer, bottoms[0])
        for top, blob in zip(layer.tops, made, strict=True):
            self._define(top, blob)

    def finish(self, channels: tuple[int, ...], n_channels: int) -> Graph:
        """The whole file; its output is the one blob that no layer reads."""
        if len(self._unread) != 1:
            raise CaffeError(
                "one blob that no layer reads is wanted, the last stage's maps; there are "
                f"{', '.join(self._unread) or 'none'}"
            )
        last = next(iter(self._unread))
        out = self._blobs[last]
        if out.channels != n_channels:
            raise CaffeError(
                f"{last}, the last blob, has {out.channels} maps; {n_channels} are wanted, the "
                "joints' and the background's: this network knows other joints"
            )
        order = self._tensor("joint_order", np.array(channels, np.int64))
        self._node("Gather", [out.name, order], MAPS, axis=1)
        if out.height != out.width or self._side % out.height:
            raise CaffeError(
                f"the maps are {out.width}x{out.height} cells for {self._side} px: the stride is "
                "no whole number"
            )
        axes = ("n", self._side, self._side, 3)
        image = onnx_file.value_info(IMAGE, onnx_file.UINT8, axes)
        maps = onnx_file.value_info(
            MAPS, onnx_file.FLOAT, ("n", len(channels), out.height, out.width)
        )
        data = onnx_file.model(self._nodes, self._tensors, image, maps)
        return Graph(data, self._side, out.height, self._parameters, self._multiply_adds)

    def _from_one(self, layer: Layer, x: Blobs) -> list[Blobs]:
        operation = layer.operation
        if isinstance(operation, Identity):
            return [x] * len(layer.tops)
        if isinstance(operation, Slice):
            return self._slices(layer, operation, x)
        self._count(layer, bottoms=1, tops=1)
        if isinstance(operation, ReLU):
            name = self._fresh(layer.tops[0])
            if operation.negative_slope:
                self._node("LeakyRelu", [x.name], name, alpha=float(operation.negative_slope))
            else:
                self._node("Relu", [x.name], name)
            return [Blobs(name, x.channels, x.height, x.width)]
        if isinstance(operation, Pooling):
            return [self._pooling(layer, operation, x)]
        assert isinstance(operation, Convolution)
        return [self._convolution(layer, operation, x)]

    def _convolution(self, layer: Layer, operation: Convolution, x: Blobs) -> Blobs:
        blobs = self._weights.get(layer.name)
        if blobs is None:
            raise CaffeError(f"the caffemodel has no weights for layer {layer.name}")
        if len(blobs) != 1 + operation.bias:
            raise CaffeError(f"the caffemodel has {len(blobs)} blobs for layer {layer.name}")
        wanted = (operation.n_outputs, x.channels // operation.group, *operation.kernel)
        if blobs[0].shape != wanted or x.channels % operation.group:
            raise CaffeError(
                f"the caffemodel's weights for layer {layer.name} are {blobs[0].shape}, but the "
                f"prototxt's are {wanted}: they belong to different networks"
            )
        name = self._fresh(layer.tops[0])
        inputs = [x.name, self._tensor(f"{name}.weight", blobs[0])]
        if operation.bias:
            if blobs[1].size != operation.n_outputs:
                raise CaffeError(f"the caffemodel's bias for layer {layer.name} is of another size")
            inputs.append(self._tensor(f"{name}.bias", blobs[1].reshape(-1)))
        if not all(np.isfinite(blob).all() for blob in blobs):
            raise CaffeError(f"the caffemodel's weights for layer {layer.name} are not all numbers")
        height, width = (
            (size + 2 * pad - dilation * (kernel - 1) - 1) // stride + 1
            for size, kernel, stride, pad, dilation in zip(
                (x.height, x.width),
                operation.kernel,
                operation.stride,
                operation.pad,
                operation.dilation,
                strict=True,
            )
        )
        self._node(
            "Conv",
            inputs,
            name,
            kernel_shape=operation.kernel,
            strides=operation.stride,
            pads=operation.pad * 2,
            dilations=operation.dilation,
            group=operation.group,
        )
        self._parameters += sum(blob.size for blob in blobs)
        self._multiply_adds += blobs[0].size * height * width
        return self._sized(layer, name, operation.n_outputs, height, width)

    def _pooling(self, layer: Layer, operation: Pooling, x: Blobs) -> Blobs:
        """Caffe rounds up: the last window may stick out, which is padding that counts nowhere."""
        sizes, ends = [], []
        for size, kernel, stride, pad in zip(
            (x.height, x.width), operation.kernel, operation.stride, operation.pad, strict=True
        ):
            n = -(-(size + 2 * pad - kernel) // stride) + 1
            if pad and (n - 1) * stride >= size + pad:
                n -= 1  # a window may not begin in the padding
            sizes.append(n)
            ends.append(max(0, (n - 1) * stride + kernel - size - pad))
        name = self._fresh(layer.tops[0])
        self._node(
            {"MAX": "MaxPool", "AVE": "AveragePool"}[operation.pool],
            [x.name],
            name,
            kernel_shape=operation.kernel,
            strides=operation.stride,
            pads=(*operation.pad, *ends),
        )
        return self._sized(layer, name, x.channels, *sizes)

    def _concat(self, layer: Layer, bottoms: list[Blobs]) -> Blobs:
        if len({(b.height, b.width) for b in bottoms}) != 1:
            sizes = ", ".join(f"{b.width}x{b.height}" for b in bottoms)
            raise CaffeError(
                f"layer {layer.name} joins blobs of different sizes: {sizes or 'none'}"
            )
        name = self._node("Concat", [b.name for b in bottoms], self._fresh(layer.tops[0]), axis=1)
        channels = sum(b.channels for b in bottoms)
        return Blobs(name, channels, bottoms[0].height, bottoms[0].width)

    def _slices(self, layer: Layer, operation: Slice, x: Blobs) -> list[Blobs]:
        points = operation.points
        n = len(layer.tops)
        if not points and n and x.channels % n == 0:
            points = tuple(x.channels // n * i for i in range(1, n))
        edges = (0, *points, x.channels)
        if len(edges) != n + 1 or any(b <= a for a, b in pairwise(edges)):
            raise CaffeError(
                f"layer {layer.name} cannot cut {x.channels} channels at {list(points)} into {n}"
            )
        made = []
        axis = self._tensor(self._fresh(f"{layer.name}.axis"), np.array([1], np.int64))
        for top, (start, end) in zip(layer.tops, pairwise(edges), strict=True):
            name = self._fresh(top)
            ends = [
                self._tensor(f"{name}.{what}", np.array([value], np.int64))
                for what, value in (("start", start), ("end", end))
            ]
            self._node("Slice", [x.name, *ends, axis], name)
            made.append(Blobs(name, end - start, x.height, x.width))
        return made

    def _sized(self, layer: Layer, name: str, channels: int, height: int, width: int) -> Blobs:
        if height < 1 or width < 1:
            raise CaffeError(f"layer {layer.name} has a window larger than what it sees")
        return Blobs(name, channels, height, width)

    def _count(self, layer: Layer, bottoms: int | None, tops: int | None) -> None:
        wrong_bottoms = bottoms is not None and len(layer.bottoms) != bottoms
        if wrong_bottoms or (tops is not None and len(layer.tops) != tops):
            raise CaffeError(
                f"layer {layer.name} has {len(layer.bottoms)} bottoms and {len(layer.tops)} tops"
            )

    def _define(self, blob: str, value: Blobs) -> None:
        self._blobs[blob] = value
        self._unread[blob] = None

    def _fresh(self, blob: str) -> str:
        """A name of its own for each value: Caffe's layers may overwrite their bottom."""
        self._n_values += 1
        return f"{blob}/{self._n_values}"

    def _tensor(self, name: str, value: NDArray[np.float32] | NDArray[np.int64]) -> str:
        self._tensors.append(onnx_file.tensor(name, value))
        return name

    def _node(
        self,
        operator: str,
        inputs: list[str],
        output: str,
        **attributes: int | float | list[int] | tuple[int, ...],
    ) -> str:
        self._nodes.append(onnx_file.node(operator, inputs, output, **attributes))
        return output
