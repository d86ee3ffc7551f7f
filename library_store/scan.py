r"""Scanning the cells nearest to a query: tables of one byte a number, and the compiled loop.

A query's similarity to a descriptor e is the weighted correlation

.. math:: c = \sum_j w_j q_j \cdot e_j / \sqrt{\sum_j w_j |e_j|^2 - |\sum_j w_j e_j|^2}

(q normalised on its weights, which sum to 1). Its order is that of the masked distance,
D² = 28 (1 - c), and with equal weights that of the plain one. It does not depend on the scale of e,
so descriptors are rounded to steps of 1/42: an eighth of what neighbours differ by, and a quarter
of the memory to read. What is found is to be put in exact order by the descriptors themselves.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from library_store.descriptor import DIMENSIONS, N_JOINTS, Float
from library_store.errors import LibraryError
from library_store.neighbours import Descriptors, Entries

Codes = NDArray[np.int8]

LANES = 16
"""Rows of a block. Blocks are (28, 16): the same number of sixteen rows side by side."""

_STEPS = 42.0
"""To the unit of a descriptor, whose numbers seldom exceed 2.7: 127 of them reach to 3."""

_COMPILED = Path(__file__).with_name("_scan.so")


def n_blocks(n: int) -> int:
    """How many blocks hold ``n`` rows."""
    return -(-n // LANES)


def encode(rows: Descriptors) -> Codes:
    """Descriptors (n, 28) as blocks (⌈n / 16⌉, 28, 16), the last one filled up with zeros."""
    codes = np.zeros((n_blocks(len(rows)) * LANES, DIMENSIONS), dtype=np.int8)
    codes[: len(rows)] = np.clip(np.rint(rows * np.float32(_STEPS)), -127, 127)
    return np.ascontiguousarray(codes.reshape(-1, LANES, DIMENSIONS).transpose(0, 2, 1))


class Scan:
    """Rows in the order of their cells: ``codes`` of ``starts[-1]`` rows, :func:`encode`.

    Cell c is the rows ``starts[c]`` to ``starts[c + 1]`` (C + 1,) about ``centres[c]`` (C, 28).
    Raises ``LibraryError`` where these do not fit together: the compiled loop trusts them.
    """

    def __init__(self, codes: Codes, starts: NDArray[np.int64], centres: Descriptors) -> None:
        if (
            codes.dtype != np.int8
            or not codes.flags.c_contiguous
            or starts.dtype != np.int64
            or len(starts) != len(centres) + 1
            or starts[0] != 0
            or np.any(np.diff(starts) < 0)
            or codes.shape != (n_blocks(int(starts[-1])), DIMENSIONS, LANES)
        ):
            raise LibraryError("the cells do not partition the rows")
        self._codes, self._starts, self._centres = codes, starts, encode(centres)
        self._n = int(starts[-1])
        self._tables = (
            codes.ctypes.data,
            self._n,
            self._centres.ctypes.data,
            starts.ctypes.data,
            len(centres),
        )
        self._scan = _compiled()

    def __len__(self) -> int:
        return self._n

    def nearest(
        self, query: Float, share: Float, n_scanned: int, n: int, *, portable: bool = False
    ) -> Entries:
        """The ``n`` rows most similar to a query, in no order, of ``n_scanned`` in near cells.

        ``query`` (14, 2), finite, normalised on ``share`` (14,), which sums to 1. More rows are
        scanned where cells are equally near. ``portable``: without this CPU's own instructions.
        """
        load = np.ascontiguousarray(share[:, None] * query, dtype=np.float32)
        weights = np.ascontiguousarray(share, dtype=np.float32)
        if load.shape != (N_JOINTS, 2) or weights.shape != (N_JOINTS,) or n < 1:
            raise ValueError("a query has fourteen joints, their weights, and neighbours")
        rows = np.empty(n, dtype=np.int64)
        found = self._scan(
            *self._tables,
            load.ctypes.data,
            weights.ctypes.data,
            n_scanned,
            n,
            rows.ctypes.data,
            portable,
        )
        return rows[:found]


@cache
def _compiled() -> Callable[..., int]:
    """The loop of scan.cpp. It runs without Python's lock."""
    try:
        loop = ctypes.CDLL(str(_COMPILED)).posematch_scan
    except OSError as error:
        raise LibraryError(
            f"{_COMPILED} cannot be loaded ({error}); install posematch again: `scripts/setup`, "
            "or pip, compiles it"
        ) from error
    table, number, flag = ctypes.c_void_p, ctypes.c_int64, ctypes.c_int
    loop.argtypes = [
        *(table, number, table, table, number),
        *(table, table, number, number, table, flag),
    ]
    loop.restype = number
    scan: Callable[..., int] = loop
    return scan
