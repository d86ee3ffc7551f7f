"""ONNX files of a few nodes, written byte by byte: good ones and ones that must be refused."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from library_store.skeleton import LSP14

UINT8, FLOAT, FLOAT16, INT64 = 2, 1, 10, 7
Axes = Sequence[int | str]


def _varint(value: int) -> bytes:
    out = b""
    while value > 127:
        out += bytes([value & 127 | 128])
        value >>= 7
    return out + bytes([value])


def _field(number: int, value: int | str | bytes) -> bytes:
    """One field of a protobuf message."""
    if isinstance(value, int):
        return _varint(number << 3) + _varint(value)
    data = value.encode() if isinstance(value, str) else value
    return _varint(number << 3 | 2) + _varint(len(data)) + data


def node(operator: str, inputs: Sequence[str], output: str, **integers: int | list[int]) -> bytes:
    """A NodeProto with integer attributes."""
    data = b"".join(_field(1, name) for name in inputs)
    data += _field(2, output) + _field(3, output) + _field(4, operator)
    for name, value in integers.items():
        if isinstance(value, int):
            data += _field(5, _field(1, name) + _field(3, value) + _field(20, 2))
        else:
            numbers = b"".join(_field(8, v) for v in value)
            data += _field(5, _field(1, name) + numbers + _field(20, 7))
    return data


def constant(output: str, array: NDArray[np.float32] | NDArray[np.int64]) -> bytes:
    """A NodeProto that gives an array."""
    tensor = b"".join(_field(1, axis) for axis in array.shape)
    tensor += _field(2, FLOAT if array.dtype == np.float32 else INT64) + _field(9, array.tobytes())
    return (
        _field(2, output)
        + _field(4, "Constant")
        + _field(5, _field(1, "value") + _field(5, tensor) + _field(20, 4))
    )


def _value(name: str, kind: int, axes: Axes) -> bytes:
    dims = b"".join(_field(1, _field(1 if isinstance(a, int) else 2, a)) for a in axes)
    return _field(1, name) + _field(2, _field(1, _field(1, kind) + _field(2, dims)))


def planes(*more: bytes, last: str = "planes") -> list[bytes]:
    """uint8 (N, H, W, 3) -> float (N, 3, H, W), and more nodes."""
    return [
        node("Cast", ["image"], "pixels", to=FLOAT),
        node("Transpose", ["pixels"], "planes", perm=[0, 3, 1, 2]),
        *more,
        node("Identity", [last], "maps"),
    ]


def model(
    nodes: Sequence[bytes],
    *,
    image: Axes = ("n", 32, 32, 3),
    kind: int = UINT8,
    made: int = FLOAT,
    answer: Axes = ("a", "b", "c", "d"),
    also: str | None = None,
    opset: int = 17,
) -> bytes:
    """A ModelProto from ``image`` to ``maps``, float unless something else is ``made``.

    ``also`` names a second output, (N, any) floats.
    """
    graph = b"".join(_field(1, n) for n in nodes) + _field(2, "tiny")
    graph += _field(11, _value("image", kind, image))
    graph += _field(12, _value("maps", made, answer))
    if also is not None:
        graph += _field(12, _value(also, FLOAT, ("a", "e")))
    return _field(1, 8) + _field(7, graph) + _field(8, _field(2, opset))


def believer(columns: int, sigma: float, depths_from: int = 3) -> bytes:
    """A lifting network that takes joints to be where they are given, all within ``sigma``.

    Of the ``columns`` numbers it is told of a joint, ``depths_from`` is the one it takes for the
    depth.
    """
    n = LSP14.n_joints
    covariance = np.eye(3 * n, dtype=np.float32)[None] * np.float32(sigma**2)
    return model(
        [
            constant("image_columns", np.array([0, 1])),
            constant("depth_column", np.array([depths_from])),
            constant("image_shape", np.array([-1, 1, 2 * n])),
            constant("depth_shape", np.array([-1, 1, n])),
            constant("nothing", np.zeros(1, np.float32)),
            constant("covariance", covariance),
            node("Gather", ["image", "image_columns"], "points", axis=2),
            node("Gather", ["image", "depth_column"], "depths", axis=2),
            node("Reshape", ["points", "image_shape"], "points_row"),
            node("Reshape", ["depths", "depth_shape"], "depths_row"),
            node("Concat", ["points_row", "depths_row"], "state", axis=2),
            node("Mul", ["state", "nothing"], "zeros"),
            node("Add", ["zeros", "covariance"], "covariances"),
            node("Concat", ["state", "covariances"], "maps", axis=1),
        ],
        image=("n", n, columns),
        kind=FLOAT,
        answer=("a", "b", "c"),
    )


def lift_output(**changes: object) -> dict[str, object]:
    """The output of a lifting network's card."""
    return {"kind": "lift", "joint_names": LSP14.joint_names} | changes


def card(name: str, data: bytes, **changes: object) -> dict[str, object]:
    """A card of a pose network with two joints whose maps are as large as its 32 px crop."""
    return {
        "name": name,
        "version": "1",
        "file": f"{name}.onnx",
        "sha256": hashlib.sha256(data).hexdigest(),
        "description": "",
        "parameters": 0,
        "multiply_adds": 0,
        "output": {
            "kind": "pose",
            "joint_names": ["a", "b"],
            "input_px": 32,
            "crop_scale": 1.25,
            "stride_px": 1.0,
            "target_sigma_cells": 1.0,
            "maps": "logits",
        },
        "training_data": [],
        "licence": "",
        "limits": [],
        "measured": {},
    } | changes


def write(directory: Path, name: str, data: bytes, **changes: object) -> None:
    """Write a model and its card."""
    directory.mkdir(exist_ok=True)
    (directory / f"{name}.onnx").write_bytes(data)
    (directory / f"{name}.json").write_text(json.dumps(card(name, data, **changes)))
