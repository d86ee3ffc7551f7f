"""Numbers on command lines: what is out of range is refused by ``argparse``, in one line."""

from __future__ import annotations

import math
import re
from argparse import ArgumentTypeError
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T", int, float)


def integer(least: int, most: float = math.inf) -> Callable[[str], int]:
    """For ``add_argument(type=...)``: an integer from ``least`` to ``most``, both included."""
    return _reader(int, "integer", least, most)


def real(least: float, most: float = math.inf) -> Callable[[str], float]:
    """For ``add_argument(type=...)``: a finite number from ``least`` to ``most``, both included."""
    return _reader(float, "number", least, most)


def integers(count: int, separator: str, *, multiples_of: int = 1) -> Callable[[str], list[int]]:
    """For ``add_argument(type=...)``: ``count`` positive integers, such as ``2,3,4,3``."""
    wanted = f"{count} multiples of {multiples_of}" if multiples_of > 1 else f"{count} integers"

    def read(text: str) -> list[int]:
        parts = text.split(separator)
        if len(parts) == count and all(re.fullmatch("[0-9]{1,9}", part) for part in parts):
            values = [int(part) for part in parts]
            if all(value > 0 and value % multiples_of == 0 for value in values):
                return values
        raise ArgumentTypeError(f"{text!r} is not {wanted} above 0 with {separator!r} between them")

    return read


def _reader(kind: Callable[[str], T], name: str, least: T, most: float) -> Callable[[str], T]:
    wanted = f"of at least {least}" if most == math.inf else f"from {least} to {most}"

    def read(text: str) -> T:
        try:
            value = kind(text)
        except ValueError:
            pass
        else:
            if least <= value <= most and value < math.inf:
                return value
        raise ArgumentTypeError(f"{text!r} is no {name} {wanted}")

    return read


MAX_SEED = 2**63 - 1
"""The highest seed that NumPy and torch both take."""
SEED = integer(0, MAX_SEED)
