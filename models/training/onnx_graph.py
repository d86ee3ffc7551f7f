"""The networks as ONNX graphs, written node by node for inference.

The graphs compute what the modules do in eval mode (a test holds the two together), laid out so
that onnxruntime's CPU kernels waste nothing, and keep every parameter under its own name, so that
training can go on from an exported file. Whatever is done to a parameter here (padding, reordering,
joining a normalisation with its convolution) is done once, when a runtime loads the graph.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper, numpy_helper
from torch import nn

from models.training.network import (
    Backbone,
    ConvolutionalPoseMachine,
    DepthHead,
    PersonNetwork,
    Residual,
    Stage,
)

OPSET = 17
HALF = ".half"
PREFIX = "network."
INPUT, OUTPUT = "image", "maps"
LAST = "last."
"""Nodes whose names begin so make the last maps, and depths; an 8-bit twin keeps them in single
precision."""
DEPTHS = LAST + "depths"
"""The second output of pose networks that read depths."""
Axes = tuple[str | int, ...]
LANES = 16
"""CPU kernels work on blocks of so many channels; other counts fall back to slow ones."""


class GraphWriter:
    """Collects nodes and initialisers; every method returns the name of its result."""

    def __init__(self, network: nn.Module) -> None:
        self.network = network
        self._names = {id(module): name for name, module in network.named_modules()}
        self._nodes: list[onnx.NodeProto] = []
        self._initializers: dict[str, onnx.TensorProto] = {}

    def name_of(self, module: nn.Module) -> str:
        """The module's name within the network."""
        return self._names[id(module)]

    def node(self, operator: str, *inputs: str, name: str = "", **attributes: object) -> str:
        """Add a node with one output."""
        out = name or f"{operator.lower()}_{len(self._nodes)}"
        self._nodes.append(helper.make_node(operator, inputs, [out], out, **attributes))
        return out

    def nodes(self, operator: str, inputs: list[str], outputs: list[str]) -> None:
        """Add a node with several outputs, named by the caller."""
        self._nodes.append(helper.make_node(operator, inputs, outputs, outputs[0]))

    def constant(self, value: NDArray[np.generic], name: str = "") -> str:
        """Add an initialiser that is no parameter."""
        name = name or f"constant_{len(self._initializers)}"
        self._initializers[name] = numpy_helper.from_array(value, name)
        return name

    def shape(self, *sizes: int) -> str:
        """A vector of integers."""
        return self.constant(np.array(sizes, np.int64))

    def parameter(self, module: nn.Module, attribute: str) -> str:
        """A parameter or buffer; large ones are stored in half precision."""
        tensor = getattr(module, attribute).detach().cpu().numpy()
        name = f"{PREFIX}{self._names[id(module)]}.{attribute}"
        if name in self._initializers or name + HALF in self._initializers:
            return name
        if tensor.size < 1024:
            return self.constant(tensor.astype(np.float32), name)
        half = self.constant(tensor.astype(np.float16), name + HALF)
        return self.node("Cast", half, name=name, to=onnx.TensorProto.FLOAT)

    def padded(self, value: str, before: tuple[int, ...], after: tuple[int, ...]) -> str:
        """Zeros around ``value``."""
        if not any(before + after):
            return value
        return self.node("Pad", value, self.shape(*before, *after))

    def conv(
        self,
        x: str,
        module: nn.Conv2d,
        *,
        weight: str = "",
        bias: str = "",
        side: int = 0,
        stride: int = 0,
        pads: tuple[int, int, int, int] | None = None,
        name: str = "",
    ) -> str:
        """A convolution as the module has it, but for what is given."""
        side = side or int(module.kernel_size[0])
        stride = stride or int(module.stride[0])
        around = int(module.padding[0])  # type: ignore[arg-type]
        # Over an even size a stride of two never reaches the padding at the end: left out, the
        # result's size is half the input's by the look of it, which lets more nodes be fused.
        end = around if stride == 1 else 0
        inputs = [x, weight or self.parameter(module, "weight")]
        if bias or module.bias is not None:
            inputs.append(bias or self.parameter(module, "bias"))
        return self.node(
            "Conv",
            *inputs,
            kernel_shape=[side, side],
            strides=[stride, stride],
            pads=list(pads or (around, around, end, end)),
            name=name,
        )

    def norm(self, x: str, module: nn.BatchNorm2d) -> str:
        """Batch normalisation with the running statistics."""
        names = ("weight", "bias", "running_mean", "running_var")
        return self.node(
            "BatchNormalization",
            x,
            *(self.parameter(module, name) for name in names),
            epsilon=module.eps,
        )

    def conv_norm(self, x: str, module: nn.Sequential, *, relu: bool = False) -> str:
        """network._conv_bn, and a ReLU if wanted."""
        y = self.norm(self.conv(x, module[0]), module[1])
        return self.node("Relu", y) if relu else y

    def residual(self, x: str, module: Residual) -> str:
        """network.Residual."""
        y = self.conv_norm(self.conv_norm(x, module.a, relu=True), module.b)
        skip = x if isinstance(module.skip, nn.Identity) else self.conv_norm(x, module.skip)
        return self.node("Relu", self.node("Add", y, skip))

    def chain(self, x: str, modules: nn.Sequential) -> str:
        """A row of residual blocks."""
        for module in modules:
            x = self.residual(x, module)
        return x

    def up2(self, x: str, mode: str = "nearest", name: str = "") -> str:
        """Twice the size."""
        scales = self.constant(np.array([1, 1, 2, 2], np.float32))
        grid = "asymmetric" if mode == "nearest" else "half_pixel"
        extra = {"nearest_mode": "floor"} if mode == "nearest" else {}
        return self.node(
            "Resize",
            x,
            "",
            scales,
            mode=mode,
            coordinate_transformation_mode=grid,
            name=name,
            **extra,
        )

    def stem(self, image: str, module: nn.Sequential) -> str:
        """uint8 (N, H, W, 3) BGR -> the stem's features.

        Its 3x3 convolution of 4x4 blocks is one of 12x12 pixels: the same products, and nothing to
        shuffle. The scale of the pixels goes into the kernel.
        """
        unshuffle, (conv, norm) = module[0], module[1]
        block, side = int(unshuffle.downscale_factor), int(conv.kernel_size[0])
        around = block * int(conv.padding[0])
        planes = self.node("Transpose", image, perm=[0, 3, 1, 2])
        pixels = self.node("Cast", planes, to=onnx.TensorProto.FLOAT)
        centred = self.node("Sub", pixels, self.constant(np.array(127.5, np.float32)))
        kernel = self.node(
            "Reshape",
            self.parameter(conv, "weight"),
            self.shape(conv.out_channels, 3, block, block, side, side),
        )
        kernel = self.node("Transpose", kernel, perm=[0, 1, 4, 2, 5, 3])
        kernel = self.node(
            "Reshape", kernel, self.shape(conv.out_channels, 3, block * side, block * side)
        )
        kernel = self.node("Mul", kernel, self.constant(np.array(1 / 127.5, np.float32)))
        y = self.conv(
            centred,
            conv,
            weight=kernel,
            side=block * side,
            stride=block * int(conv.stride[0]),
            pads=(around,) * 4,
        )
        return self.node("Relu", self.norm(y, norm))

    def model(
        self,
        result: str,
        given: Axes,
        found: Axes,
        *,
        kind: int = onnx.TensorProto.UINT8,
        names: tuple[str, str] = (INPUT, OUTPUT),
        also: Mapping[str, Axes] | None = None,
    ) -> onnx.ModelProto:
        """The finished, checked model; axes of its input and outputs have a name or a size.

        ``also``: further outputs, by the names of their nodes.
        """
        self._nodes.append(helper.make_node("Identity", [result], [names[1]], names[1]))
        graph = helper.make_graph(
            self._nodes,
            type(self.network).__name__,
            [helper.make_tensor_value_info(names[0], kind, given)],
            [
                helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, axes)
                for name, axes in {names[1]: found, **(also or {})}.items()
            ],
            list(self._initializers.values()),
        )
        model = helper.make_model(
            graph,
            opset_imports=[helper.make_opsetid("", OPSET)],
            ir_version=8,
            producer_name="posematch",
        )
        onnx.checker.check_model(model, full_check=True)
        return model


def _backbone(w: GraphWriter, image: str, net: Backbone) -> tuple[str, str]:
    x4 = w.chain(w.stem(image, net.stem), net.c4)
    x8 = w.chain(x4, net.c8)
    x16 = w.chain(x8, net.c16)
    x32 = w.chain(x16, net.c32)
    y16 = w.node("Add", w.conv_norm(x16, net.t16), w.up2(w.conv_norm(x32, net.t32)))
    y16 = w.residual(w.node("Relu", y16), net.m16)
    y8 = w.node("Add", w.conv_norm(x8, net.t8), w.up2(y16))
    return x4, w.residual(w.node("Relu", y8), net.m8)


def _stage(w: GraphWriter, features: str, beliefs: str, net: Stage) -> str:
    """The stage's hidden features; ``beliefs`` of the stage before, padded to LANES, or empty."""
    conv, norm = net.enter
    x, weight = features, ""
    if beliefs:
        x = w.node("Concat", features, beliefs, axis=1)
        weight = w.parameter(conv, "weight")
        weight = w.padded(weight, (0,) * 4, (0, -conv.in_channels % LANES, 0, 0))
    x = w.node("Relu", w.norm(w.conv(x, conv, weight=weight), norm))
    low = w.residual(w.residual(x, net.down), net.low)
    return w.residual(w.node("Add", x, w.up2(low)), net.high)


def _beliefs(w: GraphWriter, hidden: str, score: nn.Conv2d) -> str:
    """The stage's beliefs, with as many idle channels as fill the last block."""
    more = -score.out_channels % LANES
    weight = w.padded(w.parameter(score, "weight"), (0,) * 4, (more, 0, 0, 0))
    bias = w.padded(w.parameter(score, "bias"), (0,), (more,))
    return w.node("Sigmoid", w.conv(hidden, score, weight=weight, bias=bias))


def _depths(
    w: GraphWriter, features: str, hidden: str, logits: str, net: DepthHead, cells: int
) -> str:
    """network.DepthHead, in single precision throughout."""
    n_joints = net.score.out_features
    names = (f"{LAST}depths.{number}" for number in itertools.count())

    def node(operator: str, *inputs: str, **attributes: object) -> str:
        return w.node(operator, *inputs, name=next(names), **attributes)

    flat = w.shape(0, 0, -1)
    joints = node("Slice", logits, w.shape(0), w.shape(n_joints), w.shape(1))
    where = node("Softmax", node("Reshape", joints, flat), axis=2)
    axis = np.linspace(-1, 1, cells, dtype=np.float32)
    grid = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    read = [
        node("MatMul", where, node("Transpose", node("Reshape", maps, flat), perm=[0, 2, 1]))
        for maps in (features, hidden)
    ]
    read.append(node("MatMul", where, w.constant(grid)))
    every = node("Reshape", node("Concat", *read, axis=2), w.shape(0, -1))
    mean, spread = (w.parameter(net.norm, name) for name in ("running_mean", "running_var"))
    deviation = node("Sqrt", node("Add", spread, w.constant(np.array(net.norm.eps, np.float32))))
    x = node("Div", node("Sub", every, mean), deviation)
    for layer in (net.a, net.b):
        x = node("Relu", _linear(w, x, layer, next(names)))
    return _linear(w, x, net.score, DEPTHS)


def _linear(w: GraphWriter, x: str, module: nn.Linear, name: str) -> str:
    weight, bias = w.parameter(module, "weight"), w.parameter(module, "bias")
    return w.node("Gemm", x, weight, bias, transB=1, name=name)


def pose_model(network: ConvolutionalPoseMachine, size_px: int) -> onnx.ModelProto:
    """uint8 (n, size, size, 3) BGR -> the last logits (n, 15, size / 4, size / 4).

    Depths (n, 14) are a second output if the network reads them.
    """
    w = GraphWriter(network)
    x4, features = _backbone(w, INPUT, network.backbone)
    hidden, beliefs = features, ""
    for i, stage in enumerate(network.stages):
        hidden = _stage(w, features, beliefs, stage)
        if i + 1 < len(network.stages):
            beliefs = _beliefs(w, hidden, stage.score)
    fine = w.node("Add", x4, w.up2(w.conv_norm(hidden, network.fine_low)))
    fine = w.residual(w.node("Relu", fine), network.fine)
    logits = w.conv(hidden, network.stages[-1].score, name=LAST + "coarse")
    coarse = w.up2(logits, "linear", name=LAST + "raised")
    fine = w.conv(fine, network.fine_score, name=LAST + "fine")
    result = w.node("Add", fine, coarse, name=LAST + "sum")
    side = size_px // 4
    found = ("n", network.fine_score.out_channels, side, side)
    also = {}
    if network.depth is not None:
        deep = _depths(w, features, hidden, logits, network.depth, size_px // 8)
        also = {deep: ("n", network.cfg.n_joints)}
    return w.model(result, ("n", size_px, size_px, 3), found, also=also)


def person_model(network: PersonNetwork) -> onnx.ModelProto:
    """uint8 (n, h, w, 3) BGR, sides multiples of 32 -> maps (n, 5, h / 8, w / 8)."""
    w = GraphWriter(network)
    x8 = w.chain(w.stem(INPUT, network.stem), network.c8)
    x16 = w.chain(x8, network.c16)
    up = w.up2(w.conv_norm(w.chain(x16, network.c32), network.t32))
    y16 = w.residual(w.node("Relu", w.node("Add", x16, up)), network.m16)
    up = w.up2(w.conv_norm(y16, network.t16))
    y8 = w.residual(w.node("Relu", w.node("Add", x8, up)), network.m8)
    return w.model(
        w.conv(y8, network.score, name=LAST + "score"),
        ("n", "h", "w", 3),
        ("n", network.score.out_channels, "h8", "w8"),
    )
