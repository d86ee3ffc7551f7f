"""The wire format of protocol buffers, as far as caffemodels (read) and ONNX (written) need it.

A message is a row of fields: a tag (field number and wire type), then a varint, eight bytes, four
bytes, or a length and as many bytes (strings, packed numbers, messages).
"""

from __future__ import annotations

from collections.abc import Iterator

from models.errors import CaffeError

VARINT, EIGHT_BYTES, BYTES, FOUR_BYTES = 0, 1, 2, 5
_FIXED = {EIGHT_BYTES: 8, FOUR_BYTES: 4}
_LONGEST_VARINT = 10

Value = int | memoryview


def fields(data: memoryview) -> Iterator[tuple[int, int, Value]]:
    """(field number, wire type, value) of every field; raises ``CaffeError`` for other bytes."""
    at, end = 0, len(data)
    while at < end:
        tag, at = _varint(data, at)
        number, kind = tag >> 3, tag & 7
        if number == 0:
            raise CaffeError("a field has number 0")
        if kind == VARINT:
            value, at = _varint(data, at)
            yield number, kind, value
            continue
        if kind == BYTES:
            size, at = _varint(data, at)
        elif kind in _FIXED:
            size = _FIXED[kind]
        else:
            raise CaffeError(f"a field has wire type {kind}")
        if at + size > end:
            raise CaffeError("it ends in the middle of a field")
        yield number, kind, data[at : at + size]
        at += size


def varints(data: memoryview) -> list[int]:
    """Packed varints."""
    values, at = [], 0
    while at < len(data):
        value, at = _varint(data, at)
        values.append(value)
    return values


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    value = 0
    for i in range(_LONGEST_VARINT):
        if at + i >= len(data):
            raise CaffeError("it ends in the middle of a number")
        byte = data[at + i]
        value |= (byte & 127) << 7 * i
        if byte < 128:
            return value, at + i + 1
    raise CaffeError("a number has more than ten bytes")


def varint(value: int) -> bytes:
    """A number as a varint; negative ones in two's complement of 64 bits."""
    value &= (1 << 64) - 1
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    out.append(value)
    return bytes(out)


def field(number: int, value: int | str | bytes) -> bytes:
    """One field: a varint, or a length and bytes."""
    if isinstance(value, int):
        return varint(number << 3 | VARINT) + varint(value)
    data = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | BYTES) + varint(len(data)) + data
