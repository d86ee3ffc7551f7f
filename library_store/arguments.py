"""Numbers on command lines: what is out of range is refused by ``argparse``, in one line."""

from __future__ import annotations

import math
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
