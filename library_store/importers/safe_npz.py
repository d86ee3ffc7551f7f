"""Reading npz files from strangers: no code of theirs is run.

An object array in an npz is a pickle, and unpickling can call anything. Here only what the arrays
of motion capture files are made of can be named by a pickle: numpy arrays, dtypes and scalars.
Dicts, lists, strings and numbers need no name.
"""

from __future__ import annotations

import io
import pickle
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from library_store.importers.clip import MocapError

MAX_BYTES = 8 << 30
"""An array that unpacks to more is refused."""

_ALLOWED = {
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    *(
        (f"numpy.{core}.multiarray", name)
        for core in ("core", "_core")
        for name in ("_reconstruct", "scalar")
    ),
    *((f"numpy.{core}.numeric", "_frombuffer") for core in ("core", "_core")),
}


class _ArraysOnly(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"names {module}.{name}, which is not part of an array")
        return super().find_class(module, name)


class NpzFile:
    """The arrays of an npz file by name; object arrays are read without running foreign code."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            with zipfile.ZipFile(path) as archive:
                self._sizes = {i.filename: i.file_size for i in archive.infolist()}
        except zipfile.BadZipFile as error:
            raise MocapError(path, f"not an npz file: {error}") from error
        self.names = frozenset(n.removesuffix(".npy") for n in self._sizes if n.endswith(".npy"))

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def __getitem__(self, name: str) -> np.ndarray[Any, Any]:
        """The array called ``name``; ``MocapError`` where it is missing, damaged or not allowed."""
        member = f"{name}.npy"
        if name not in self.names:
            raise MocapError(self._path, f"has no array {name!r}")
        if self._sizes[member] > MAX_BYTES:
            raise MocapError(
                self._path, f"array {name!r} unpacks to more than {MAX_BYTES >> 30} GiB"
            )
        try:
            with zipfile.ZipFile(self._path) as archive:
                return _read_array(archive.read(member))
        except (
            *(ValueError, TypeError, EOFError, KeyError, IndexError, AttributeError),
            *(pickle.UnpicklingError, zipfile.BadZipFile, MemoryError, RuntimeError),
            *(OverflowError, zlib.error),
        ) as error:
            raise MocapError(self._path, f"array {name!r} cannot be read: {error}") from error

    def column(self, name: str) -> list[str]:
        """A one-dimensional array, or a single value, as strings; empty where there is none."""
        values = np.atleast_1d(self[name]) if name in self.names else np.array([])
        if values.ndim != 1:
            raise MocapError(self._path, f"array {name!r} must have one dimension")
        return [_string(value) for value in values]

    def number(self, name: str) -> float:
        """The number stored under ``name``; NaN where there is none."""
        try:
            return float(self.text(name) or "nan")
        except ValueError as error:
            raise MocapError(self._path, f"array {name!r} must be a number") from error

    def text(self, name: str) -> str:
        """The string stored under ``name``; empty where there is none."""
        if name not in self.names:
            return ""
        value = self[name]
        return _string(value.reshape(-1)[0]) if value.size == 1 else ""


def _string(value: object) -> str:
    # Arrays of bytes are what strings become on their way through HDF5, MATLAB or Python 2.
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _read_array(data: bytes) -> np.ndarray[Any, Any]:
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
    else:
        shape, _, dtype = np.lib.format.read_array_header_2_0(stream)
    if dtype.hasobject:
        loaded = _ArraysOnly(stream).load()
        if not isinstance(loaded, np.ndarray) or loaded.shape != shape:
            raise ValueError("the pickle is not the array that was announced")
        return loaded
    stream.seek(0)
    array: np.ndarray[Any, Any] = np.lib.format.read_array(stream, allow_pickle=False)
    return array
