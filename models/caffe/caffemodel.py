"""Trained weights: the blobs of a ``.caffemodel``, by layer.

Caffe wrote two kinds: ``layer`` (field 100, blobs with a shape) and the older ``layers`` (field 2,
blobs with num, channels, height and width). Both are read, also mixed.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.caffe import wire
from models.errors import CaffeError

Blob = NDArray[np.float32]

_LAYERS, _LAYER = 2, 100
_NAME_AND_BLOBS = {_LAYER: (1, 7), _LAYERS: (4, 6)}
"""Field numbers of a layer's name and blobs."""
_OLD_AXES = (1, 2, 3, 4)
_DATA, _SHAPE, _DOUBLE_DATA, _DIM = 5, 7, 8, 1


def read_caffemodel(path: Path) -> dict[str, list[Blob]]:
    """Every layer that has blobs: weight and bias, as a rule. Raises ``CaffeError``."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise CaffeError(f"{path} cannot be read: {error.strerror}") from error
    found: dict[str, list[Blob]] = {}
    try:
        for number, kind, value in wire.fields(memoryview(data)):
            if number in _NAME_AND_BLOBS and kind == wire.BYTES:
                name, blobs = _layer(_bytes(value), *_NAME_AND_BLOBS[number])
                if blobs:
                    found[name] = blobs
    except (CaffeError, UnicodeDecodeError) as error:
        raise CaffeError(
            f"{path} is no caffemodel, or one that was not downloaded whole: {error}"
        ) from error
    if not found:
        raise CaffeError(f"{path} has no layer with weights; is it a caffemodel?")
    return found


def _layer(data: memoryview, name_field: int, blob_field: int) -> tuple[str, list[Blob]]:
    name, blobs = "", []
    for number, kind, value in wire.fields(data):
        if kind != wire.BYTES:
            continue
        if number == name_field:
            name = str(_bytes(value), "utf-8")
        elif number == blob_field:
            blobs.append(_blob(_bytes(value)))
    return name, blobs


def _blob(data: memoryview) -> Blob:
    old_shape, shape = dict.fromkeys(_OLD_AXES, 0), None
    parts: list[NDArray[Any]] = []
    for number, kind, value in wire.fields(data):
        if number in _OLD_AXES and kind == wire.VARINT:
            assert isinstance(value, int)
            old_shape[number] = value
        elif number == _SHAPE and kind == wire.BYTES:
            shape = _shape(_bytes(value))
        elif number == _DATA and kind in (wire.BYTES, wire.FOUR_BYTES):
            parts.append(_numbers(value, "<f4"))
        elif number == _DOUBLE_DATA and kind in (wire.BYTES, wire.EIGHT_BYTES):
            parts.append(_numbers(value, "<f8"))
    values = np.concatenate(parts).astype(np.float32) if parts else np.zeros(0, np.float32)
    wanted = tuple(old_shape.values()) if shape is None else shape
    if values.size != np.prod(wanted, dtype=object):
        raise CaffeError(f"a blob of shape {wanted} has {values.size} values")
    return values.reshape(wanted)


def _shape(data: memoryview) -> tuple[int, ...]:
    dims: list[int] = []
    for number, _, value in wire.fields(data):
        if number == _DIM:
            dims += [value] if isinstance(value, int) else wire.varints(value)
    return tuple(dims)


def _numbers(value: wire.Value, kind: str) -> NDArray[Any]:
    data = _bytes(value)
    if len(data) % np.dtype(kind).itemsize:
        raise CaffeError("a blob ends in the middle of a number")
    return np.frombuffer(data, kind)


def _bytes(value: wire.Value) -> memoryview:
    assert isinstance(value, memoryview)
    return value
