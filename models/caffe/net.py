"""A deploy prototxt as layers with the parameters that matter, checked; new and old spelling.

Layers that only training has (``include { phase: TRAIN }``, ``exclude { phase: TEST }``) are left
out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from models.caffe.prototxt import Message, parse
from models.errors import CaffeError

KINDS = ("Convolution", "ReLU", "Pooling", "Concat", "Slice", "Dropout", "Split", "Silence")
"""Layers that can be imported: all that the published pose networks have."""
_OLD_KINDS = {kind.upper(): kind for kind in KINDS}
_CHANNELS = 1


@dataclass(frozen=True)
class Convolution:
    """``kernel``, ``stride``, ``pad`` and ``dilation`` are (vertical, horizontal)."""

    n_outputs: int
    kernel: tuple[int, int]
    stride: tuple[int, int]
    pad: tuple[int, int]
    dilation: tuple[int, int]
    group: int
    bias: bool


@dataclass(frozen=True)
class Pooling:
    """Strongest or mean of each window; Caffe rounds the number of windows up."""

    pool: Literal["MAX", "AVE"]
    kernel: tuple[int, int]
    stride: tuple[int, int]
    pad: tuple[int, int]


@dataclass(frozen=True)
class ReLU:
    """``negative_slope`` is 0 but for the leaky kind."""

    negative_slope: float


@dataclass(frozen=True)
class Concat:
    """Along the channels."""


@dataclass(frozen=True)
class Slice:
    """Along the channels, at ``points``; into equal parts when there are none."""

    points: tuple[int, ...]


@dataclass(frozen=True)
class Identity:
    """What does nothing at test time: Dropout, Split (several tops), Silence (none)."""


Operation = Convolution | Pooling | ReLU | Concat | Slice | Identity


@dataclass(frozen=True)
class Layer:
    """One layer; ``bottoms`` and ``tops`` are the blobs it reads and writes."""

    name: str
    operation: Operation
    bottoms: tuple[str, ...]
    tops: tuple[str, ...]


@dataclass(frozen=True)
class Net:
    """``inputs``: shape (batch, channels, height, width) by blob; ``layers`` in their order."""

    inputs: dict[str, tuple[int, int, int, int]]
    layers: tuple[Layer, ...]


def read_net(text: str) -> Net:
    """The network a prototxt describes. Raises ``CaffeError`` for what cannot be imported."""
    root = parse(text)
    messages = root.messages.get("layer", []) + root.messages.get("layers", [])
    if not messages:
        raise CaffeError("there is no layer in it: a deploy prototxt is wanted")
    inputs = _inputs(root)
    layers = []
    for message in messages:
        name = message.text("name", message.where)
        only_trained = (("include", "TRAIN"), ("exclude", "TEST"))
        if any(
            rule.text("phase") == phase
            for word, phase in only_trained
            for rule in message.messages.get(word, [])
        ):
            continue
        kind = message.text("type")
        tops = tuple(message.texts("top"))
        if kind == "Input":
            shapes = message.child("input_param").messages.get("shape", [])
            if not tops or len(shapes) not in (1, len(tops)):
                raise CaffeError(f"layer {name} has {len(shapes)} shapes for {len(tops)} inputs")
            for top, shape in zip(tops, shapes * len(tops), strict=False):
                inputs[top] = _shape(top, shape.integers("dim"))
            continue
        kind = _OLD_KINDS.get(kind, kind)
        if kind not in KINDS:
            raise CaffeError(
                f"layer {name} is of type {kind or '(none)'}; only {', '.join(KINDS)} and Input "
                "can be imported. Is this the deploy prototxt, not the one for training?"
            )
        layers.append(
            Layer(name, _operation(name, kind, message), tuple(message.texts("bottom")), tops)
        )
    if not inputs:
        raise CaffeError("it names no input: the deploy prototxt is wanted, not that for training")
    return Net(inputs, tuple(layers))


def _inputs(root: Message) -> dict[str, tuple[int, int, int, int]]:
    names = root.texts("input")
    dims = root.integers("input_dim")
    shapes = [shape.integers("dim") for shape in root.messages.get("input_shape", [])]
    if dims:
        shapes = [dims[i : i + 4] for i in range(0, len(dims), 4)]
    if len(shapes) != len(names):
        raise CaffeError(f"{len(names)} inputs have {len(shapes)} shapes")
    return {name: _shape(name, shape) for name, shape in zip(names, shapes, strict=True)}


def _shape(name: str, dims: list[int]) -> tuple[int, int, int, int]:
    if len(dims) != 4 or min(dims) < 1:
        raise CaffeError(f"input {name} has the shape {dims}; wanted are four sizes")
    return dims[0], dims[1], dims[2], dims[3]


def _operation(name: str, kind: str, layer: Message) -> Operation:
    if kind == "Convolution":
        return _convolution(name, layer.child("convolution_param"))
    if kind == "Pooling":
        return _pooling(name, layer.child("pooling_param"))
    if kind == "ReLU":
        return ReLU(layer.child("relu_param").number("negative_slope", 0.0))
    if kind == "Concat":
        _along_channels(name, layer.child("concat_param"), "concat_dim")
        return Concat()
    if kind == "Slice":
        parameters = layer.child("slice_param")
        _along_channels(name, parameters, "slice_dim")
        return Slice(tuple(parameters.integers("slice_point")))
    return Identity()


def _along_channels(name: str, parameters: Message, old: str) -> None:
    axis = parameters.integer("axis", parameters.integer(old, _CHANNELS))
    if axis not in (_CHANNELS, _CHANNELS - 4):
        raise CaffeError(f"layer {name} works along axis {axis}; only channels, 1, can be imported")


def _pair(name: str, parameters: Message, field: str, default: int) -> tuple[int, int]:
    """(vertical, horizontal) from ``kernel_size: 9``, or two of it, or ``kernel_h``/``_w``."""
    stem = field.removesuffix("_size")
    both = parameters.integers(field) or [default]
    if len(both) > 2:
        raise CaffeError(f"layer {name} is not two-dimensional: {field} {both}")
    return parameters.integer(f"{stem}_h", both[0]), parameters.integer(f"{stem}_w", both[-1])


def _convolution(name: str, parameters: Message) -> Convolution:
    found = Convolution(
        n_outputs=parameters.integer("num_output", 0),
        kernel=_pair(name, parameters, "kernel_size", 0),
        stride=_pair(name, parameters, "stride", 1),
        pad=_pair(name, parameters, "pad", 0),
        dilation=_pair(name, parameters, "dilation", 1),
        group=parameters.integer("group", 1),
        bias=parameters.flag("bias_term", True),
    )
    _check_window(name, found.kernel, found.stride, found.pad)
    if found.n_outputs < 1 or min(found.dilation) < 1 or found.group < 1:
        raise CaffeError(f"layer {name} has a num_output, dilation or group below 1")
    return found


def _pooling(name: str, parameters: Message) -> Pooling:
    pool = parameters.text("pool", "MAX")
    pool = {"0": "MAX", "1": "AVE"}.get(pool, pool)
    if parameters.flag("global_pooling", False) or parameters.text("round_mode", "CEIL") != "CEIL":
        raise CaffeError(f"layer {name}: global pooling and round_mode cannot be imported")
    kernel = _pair(name, parameters, "kernel_size", 0)
    stride = _pair(name, parameters, "stride", 1)
    pad = _pair(name, parameters, "pad", 0)
    _check_window(name, kernel, stride, pad)
    if any(step > size for step, size in zip(stride, kernel, strict=True)):
        raise CaffeError(f"layer {name} has gaps between its windows; that cannot be imported")
    if any(edge >= size for edge, size in zip(pad, kernel, strict=True)):
        raise CaffeError(f"layer {name} has windows that lie in the padding altogether")
    if pool == "MAX":
        return Pooling("MAX", kernel, stride, pad)
    if pool == "AVE" and pad == (0, 0):
        return Pooling("AVE", kernel, stride, pad)
    raise CaffeError(f"layer {name}: pooling {pool} with padding {pad} cannot be imported")


def _check_window(
    name: str, kernel: tuple[int, int], stride: tuple[int, int], pad: tuple[int, int]
) -> None:
    if min(kernel) < 1 or min(stride) < 1 or min(pad) < 0:
        raise CaffeError(f"layer {name} has kernel {kernel}, stride {stride} and padding {pad}")
