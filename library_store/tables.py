"""Tables on disk that are written piece by piece, so that their size costs no memory."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import DTypeLike, NDArray


class TableWriter:
    """Writes an ``.npy`` file of known shape by appending rows; the bytes are those of ``np.save``.

    A context manager; leaving it with fewer rows than announced raises ``ValueError``.
    """

    def __init__(self, path: Path, shape: tuple[int, ...], dtype: DTypeLike) -> None:
        self._shape = shape
        self._dtype = np.dtype(dtype)
        self._missing = shape[0]
        self._file = path.open("wb")
        header = {"descr": np.lib.format.dtype_to_descr(self._dtype), "fortran_order": False}
        np.lib.format.write_array_header_1_0(self._file, header | {"shape": shape})

    def append(self, rows: NDArray[np.generic]) -> None:
        """Write further rows (n, ...); they are cast to the table's type."""
        if rows.shape[1:] != self._shape[1:] or len(rows) > self._missing:
            raise ValueError(f"rows of shape {rows.shape} do not fit a table of {self._shape}")
        self._missing -= len(rows)
        self._file.write(np.ascontiguousarray(rows, dtype=self._dtype).data)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()
        if kind is None and self._missing:
            raise ValueError(f"{self._missing} rows of a table of {self._shape} were not written")


def open_table(path: Path) -> NDArray[np.generic]:
    """An ``.npy`` file, memory-mapped and read-only, as a plain array.

    np.memmap's own indexing is slow for small reads.
    """
    mapped: NDArray[np.generic] = np.load(path, mmap_mode="r", allow_pickle=False)
    return mapped.view(np.ndarray)
