"""``manifest.json``: what a library is, how it was built, under which licences, and its checksums.

A library is a directory of

- ``manifest.json``   this file's subject, written last;
- ``poses.npy``       (P, 14, 3) float32 mm, exemplar frame, grouped by source;
- ``frames.npy``      (P,) int32, the frame or sample number within the source;
- ``sources.json``    the sources, :mod:`library_store.sources`;
- ``parts.npy``       (composed poses, 2, 3) int32, what each was composed of;
- ``cameras.npy``     (C, 4) float32, :mod:`library_store.cameras`;
- ``projections.npy`` (E, 2) int32, pose and camera of each exemplar, ascending;
- ``descriptors.npy`` (E, 28) float32, :mod:`library_store.descriptor`;
- ``index.*``         the nearest-neighbour index, :mod:`library_store.backends`.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Collection, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

from library_store.errors import LibraryError

T = TypeVar("T")

FORMAT = 4
MANIFEST = "manifest.json"
CONTENT_FILES = (
    "poses.npy",
    "frames.npy",
    "sources.json",
    "parts.npy",
    "cameras.npy",
    "projections.npy",
    "descriptors.npy",
)
"""The files that the same inputs and seed give byte for byte."""

BACKENDS = ("cells", "hnsw")
"""What a library may be built for; others search it too, :mod:`library_store.backends`."""

MEND = (
    "delete the directory {directory} and start again: the default library is then built anew, "
    "another one by `posematch library build`"
)


@dataclass(frozen=True)
class Licence:
    """Where some of a library's poses come from and what may be done with them."""

    source: str
    licence: str
    credit: str


@dataclass(frozen=True)
class FileSum:
    """Size and SHA-256 of a file."""

    bytes: int
    sha256: str


@dataclass(frozen=True)
class Manifest:
    """The identity card of a library.

    ``sha256`` identifies the content: it is taken over the names and sums of the content files, not
    of the index, so that two builds of the same library carry the same one. ``build`` holds the
    parameters the library was built with, ``index`` the backend it was built for, its files and
    parameters.
    """

    name: str
    version: str
    skeleton: str
    n_poses: int
    n_cameras: int
    n_exemplars: int
    licences: tuple[Licence, ...]
    build: Mapping[str, Any]
    index: Mapping[str, Any]
    files: Mapping[str, FileSum]
    sha256: str

    def to_json(self) -> str:
        """The text of ``manifest.json``."""
        content: dict[str, Any] = {"format": FORMAT}
        for field in fields(self):
            content[field.name] = getattr(self, field.name)
        content["licences"] = [vars(licence) for licence in self.licences]
        content["files"] = {name: vars(total) for name, total in self.files.items()}
        return json.dumps(content, indent=2, ensure_ascii=False) + "\n"


def content_digest(files: Mapping[str, FileSum]) -> str:
    """The identity of a library's content, from the sums of its content files."""
    lines = "".join(f"{files[name].sha256}  {name}\n" for name in sorted(CONTENT_FILES))
    return hashlib.sha256(lines.encode()).hexdigest()


def file_sum(path: Path) -> FileSum:
    """Size and SHA-256 of the file at ``path``."""
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return FileSum(bytes=path.stat().st_size, sha256=digest)


def read_manifest(directory: Path) -> Manifest:
    """Read and check ``manifest.json``; ``LibraryError`` when there is no whole one."""
    path = directory / MANIFEST
    mend = MEND.format(directory=directory)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise LibraryError(
            f"{path} is missing: there is no pose library in {directory}; "
            "build one with `posematch library build`"
        ) from None
    except OSError as error:
        raise LibraryError(
            f"{path} cannot be read ({error.strerror}): is {directory} the directory of a library, "
            "and may this user read it?"
        ) from error
    except ValueError as error:
        raise LibraryError(f"{path} cannot be read ({error}); {mend}") from error
    try:
        written = content.pop("format")
        if written != FORMAT:
            raise LibraryError(
                f"{path} was written by another version of posematch (format {written}, this one "
                f"reads {FORMAT}): build the library again with `posematch library build`, from "
                "the same inputs; ids and poses stay the same"
            )
        content["licences"] = tuple(Licence(**licence) for licence in content["licences"])
        content["files"] = {name: FileSum(**total) for name, total in content["files"].items()}
        manifest = Manifest(**content)
        consistent = (
            manifest.sha256 == content_digest(manifest.files)
            and manifest.index["backend"] in BACKENDS
            and {*manifest.index["files"]} <= manifest.files.keys()
        )
    except (KeyError, TypeError, AttributeError) as error:
        raise LibraryError(f"{path} is not a library manifest ({error!r}); {mend}") from error
    if not consistent:
        raise LibraryError(
            f"{path} contradicts itself: its sha256 or its index is not that of its files; {mend}"
        )
    return manifest


def written(directory: Path, names: Iterable[str]) -> dict[str, tuple[int, int, int] | None]:
    """What changes when one of these files is replaced or written to; None where it is missing.

    Its inode, its size and when it was last written to, in ns.
    """
    states: dict[str, tuple[int, int, int] | None] = {}
    for name in names:
        try:
            stat = (directory / name).stat()
            states[name] = stat.st_ino, stat.st_size, stat.st_mtime_ns
        except OSError:
            states[name] = None
    return states


def steadily(directory: Path, work: Callable[[Manifest], T]) -> T:
    """What ``work`` makes of the library in ``directory``, told its manifest.

    Done again where a build has put another library there meanwhile, so that the files of two are
    never taken for one, nor for a corrupt one.
    """
    while True:
        manifest = read_manifest(directory)
        try:
            result = work(manifest)
        except LibraryError:
            if is_replaced(directory, manifest):
                continue
            raise
        if not is_replaced(directory, manifest):
            return result


def is_replaced(directory: Path, manifest: Manifest) -> bool:
    """Whether another library than that of ``manifest`` is in ``directory`` now."""
    try:
        return read_manifest(directory).to_json() != manifest.to_json()  # NaN is not itself
    except LibraryError:
        return False


def check_files(
    directory: Path, manifest: Manifest, *, sums: bool, names: Collection[str] | None = None
) -> None:
    """Check presence, size and, with ``sums``, SHA-256 of every file; ``LibraryError`` if wrong.

    ``names``: only these files.
    """
    mend = MEND.format(directory=directory)

    def check(name: str) -> None:
        path = directory / name
        expected = manifest.files[name]
        try:
            size = path.stat().st_size
            if size != expected.bytes:
                raise LibraryError(f"{path} has {size} bytes instead of {expected.bytes}; {mend}")
            if sums and file_sum(path) != expected:
                raise LibraryError(f"{path} is corrupt: its SHA-256 has changed; {mend}")
        except FileNotFoundError:
            raise LibraryError(f"{path} is missing; {mend}") from None
        except OSError as error:
            raise LibraryError(
                f"{path} cannot be read ({error.strerror}): may this user read it?"
            ) from error

    # Summing runs without Python's lock, and is most of opening a large library.
    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
        for _ in pool.map(check, manifest.files if names is None else names):
            pass
