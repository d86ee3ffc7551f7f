"""Writing ONNX files with nothing but their wire format: no onnx package is needed to import.

Field numbers are those of onnx.proto; what is written is opset 17.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from models.caffe.wire import field, varint

IR_VERSION, OPSET = 8, 17
FLOAT, UINT8, INT64 = 1, 2, 7
"""TensorProto.DataType."""
_INT, _FLOAT_ATTRIBUTE, _INTS = 2, 1, 7
_TENSOR_TYPES = {"float32": FLOAT, "int64": INT64}

Axes = Sequence[int | str]


def node(
    operator: str,
    inputs: Sequence[str],
    output: str,
    **attributes: int | float | Sequence[int],
) -> bytes:
    """A NodeProto with one output, named after it."""
    parts = [field(1, name) for name in inputs]
    parts += [field(2, output), field(3, output), field(4, operator)]
    for name, value in attributes.items():
        if isinstance(value, float):
            number = varint(2 << 3 | 5) + np.float32(value).tobytes()
            body = field(1, name) + number + field(20, _FLOAT_ATTRIBUTE)
        elif isinstance(value, int):
            body = field(1, name) + field(3, value) + field(20, _INT)
        else:
            numbers = b"".join(field(8, v) for v in value)
            body = field(1, name) + numbers + field(20, _INTS)
        parts.append(field(5, body))
    return b"".join(parts)


def tensor(name: str, value: NDArray[np.float32] | NDArray[np.int64]) -> bytes:
    """A TensorProto with raw little-endian data."""
    dims = b"".join(field(1, size) for size in value.shape)
    kind = _TENSOR_TYPES[value.dtype.name]
    raw = np.ascontiguousarray(value, value.dtype.newbyteorder("<")).tobytes()
    return dims + field(2, kind) + field(8, name) + field(9, raw)


def value_info(name: str, kind: int, axes: Axes) -> bytes:
    """A ValueInfoProto; axes that are free have names."""
    dims = b"".join(field(1, field(1 if isinstance(a, int) else 2, a)) for a in axes)
    return field(1, name) + field(2, field(1, field(1, kind) + field(2, dims)))


def model(nodes: Sequence[bytes], tensors: Sequence[bytes], inputs: bytes, outputs: bytes) -> bytes:
    """A ModelProto of one input and one output (``value_info``)."""
    graph = b"".join(
        [
            *(field(1, n) for n in nodes),
            field(2, "cpm"),
            *(field(5, t) for t in tensors),
            field(11, inputs),
            field(12, outputs),
        ]
    )
    opset = field(8, field(1, "") + field(2, OPSET))
    return field(1, IR_VERSION) + field(2, "posematch") + field(7, graph) + opset
