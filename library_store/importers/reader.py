"""Any motion capture file in, clips out: the importer is chosen by the file's suffix."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from library_store.importers import asf_amc, bvh, c3d, h36m, npz
from library_store.importers.clip import Clip, MocapError
from library_store.importers.joint_tables import read_mapping

SUFFIXES = (".amc", ".bvh", ".c3d", ".cdf", ".npz")
_ARCHIVES = (".zip", ".gz", ".tgz", ".bz2", ".xz", ".tar", ".7z", ".rar")


def read(path: Path, *, mapping: Path | None = None) -> list[Clip]:
    """The clips of one file; ``mapping`` is a table for BVH joints or C3D markers of other names.

    Raises ``MocapError`` for a file that is missing, malformed or of a person no unit fits; nothing
    of such a file is returned.
    """
    clips: list[Clip] = []
    for it in _read_file(path, mapping):
        if isinstance(it, MocapError):
            raise it
        clips.append(it)
    return clips


def _read_file(path: Path, mapping: Path | None) -> Sequence[Clip | MocapError]:
    """The clips of one file, and what is wrong with those that cannot be used.

    Raises ``MocapError`` where the file itself is missing or malformed.
    """
    importers: dict[str, Callable[[], Sequence[Clip | MocapError]]] = {
        ".amc": lambda: [asf_amc.read(path)],
        ".bvh": lambda: bvh.read(path, mapping=mapping),
        ".c3d": lambda: c3d.read(path, mapping=mapping),
        ".cdf": lambda: [h36m.read(path)],
        ".npz": lambda: npz.read(path),
    }
    importer = importers.get(path.suffix.lower())
    try:
        mode = path.stat().st_mode
        if stat.S_ISDIR(mode):
            os.scandir(path).close()  # says why it cannot be read, if so
        if not stat.S_ISREG(mode):
            raise MocapError(path, "is no file")  # a pipe would be waited for
    except OSError as error:
        raise MocapError(path, f"cannot be read: {error.strerror}") from error
    if importer is None:
        problem = f"not a kind of file that can be imported: {', '.join(SUFFIXES)}"
        packed = path.suffix.lower() in _ARCHIVES
        raise MocapError(path, f"{problem}; unpack it first" if packed else problem)
    try:
        # Damaged numbers overflow to infinity; the checks then drop their frames.
        with np.errstate(over="ignore", invalid="ignore"):
            return importer()
    except OSError as error:
        raise MocapError(path, f"cannot be read: {error.strerror}") from error


def find_files(paths: Iterable[Path]) -> Iterator[Path]:
    """The files given, and those below the folders given that an importer would take, in order.

    Among them are folders that cannot be read, for ``read`` to say so: what is in them is missing.
    Links to folders are followed, to each folder once. What macOS keeps beside files on foreign
    disks and in archives (``._walk.bvh``) is no file of a folder.
    """
    for path in paths:
        if path.is_dir():
            yield from sorted(_below(path))
        else:
            yield path


def _below(folder: Path) -> Iterator[Path]:
    entered: set[str] = set()
    closed: list[OSError] = []
    for place, folders, files in os.walk(folder, onerror=closed.append, followlinks=True):
        if os.path.realpath(place) in entered:
            folders.clear()
            continue
        entered.add(os.path.realpath(place))
        for file in files:
            if Path(file).suffix.lower() in SUFFIXES and not file.startswith("._"):
                yield Path(place, file)
    yield from (Path(error.filename) for error in closed)


def read_each(
    paths: Iterable[Path], *, mapping: Path | None = None, strict: bool = False
) -> Iterator[Clip | MocapError]:
    """The clips of all files and folders one by one, and the error of each that is skipped.

    Skipped is a malformed file as a whole; of a sound one with several people or clips, those that
    cannot be used. With ``strict`` the first such error is raised instead; that of a bad
    ``mapping`` always is.
    """
    if mapping is not None:
        read_mapping(mapping)
    for path in find_files(paths):
        try:
            found = _read_file(path, mapping)
        except MocapError as error:
            found = [error]
        for it in found:
            if strict and isinstance(it, MocapError):
                raise it
            yield it


def read_all(
    paths: Iterable[Path], *, mapping: Path | None = None, strict: bool = False
) -> tuple[list[Clip], list[MocapError]]:
    """What :func:`read_each` yields, clips and errors apart."""
    found = list(read_each(paths, mapping=mapping, strict=strict))
    clips = [it for it in found if isinstance(it, Clip)]
    return clips, [it for it in found if isinstance(it, MocapError)]
