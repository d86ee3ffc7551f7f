"""Putting a directory in place in one step, and keeping builders of the same one apart.

Beside a target ``<name>`` live, hidden, its lock ``.<name>.lock`` and the directory
``.<name>.building-<key>`` that a build works in, the key being a digest of what is built. A killed
build leaves its directory; the next builder, who holds the lock, goes on with it if the key is the
same and sweeps it if not.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from library_store.errors import LibraryError
from library_store.manifest import CONTENT_FILES, MANIFEST
from library_store.steps import flush

_AT_FDCWD = -100
_RENAME_EXCHANGE = 2


def landing(directory: Path) -> Path:
    """Where a library built at ``directory`` goes: links followed, so that a link stays one.

    Raises ``LibraryError`` where something is that is not a library and would be lost, or that
    nothing can take the place of.
    """
    target = directory.resolve()
    if target.is_mount():  # said before the build, not after
        raise LibraryError(
            f"{directory} is where a volume is mounted, which a library cannot take the place of: "
            "build into a directory on it"
        )
    if target.is_dir():
        strangers = sorted(path.name for path in target.iterdir() if not _is_ours(path))
        if not strangers:
            return target
        problem = f"is a directory that holds {', '.join(strangers[:3])}"
    elif not target.exists():
        return target
    else:
        problem = "is a file"
    raise LibraryError(
        f"{directory} {problem}, which is no part of a library and would be lost: build into a "
        "directory that does not exist yet, is empty or holds a library"
    )


def _is_ours(path: Path) -> bool:
    # Not whatever is called index: a web page may lie beside a manifest.json too.
    index = path.name.startswith("index.") and path.suffix in {".npy", ".npz", ".hnsw"}
    return index or path.name in (MANIFEST, *CONTENT_FILES)


@contextmanager
def locked(target: Path, waiting: Callable[[], None]) -> Iterator[None]:
    """Hold the lock of ``target``; ``waiting`` is called once if somebody else has it.

    The kernel drops the lock with the process, so a killed builder never leaves it behind.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    with (target.parent / f".{target.name}.lock").open("w") as handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            waiting()
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield


@contextmanager
def replacing(target: Path, key: str) -> Iterator[Path]:
    """The directory to fill, which takes the place of ``target`` when the block ends well.

    To be used while :func:`locked`. It is empty, or what a killed build of the same ``key`` left.
    If the block fails, ``target`` stays as it was and the directory is removed; if it is
    interrupted (Ctrl-C), the directory stays for the next attempt.
    """
    prefix = f".{target.name}.building-"
    workshop = target.parent / f"{prefix}{key}"
    for leftover in target.parent.iterdir():
        if leftover.name.startswith(prefix) and leftover != workshop:
            shutil.rmtree(leftover, ignore_errors=True)
    workshop.mkdir(exist_ok=True)
    try:
        yield workshop
        for path in workshop.iterdir():
            flush(path)
        flush(workshop)
        put_in_place(workshop, target)
        flush(target.parent)
    except Exception:
        shutil.rmtree(workshop, ignore_errors=True)
        raise
    # After an exchange this is the old library; readers keep their open maps of it.
    shutil.rmtree(workshop, ignore_errors=True)


def put_in_place(workshop: Path, target: Path) -> None:
    """Move ``workshop`` to ``target``; what was there ends up at ``workshop``, if anywhere.

    A target that exists is exchanged atomically where the system can (Linux on the usual file
    systems); elsewhere it is moved aside first, so that a crash between the two moves leaves it
    under the hidden name.
    """
    if not target.exists():
        workshop.rename(target)
        return
    if _exchange(workshop, target):
        return
    aside = Path(tempfile.mkdtemp(prefix=f".{target.name}.replaced-", dir=target.parent))
    target.rename(aside / target.name)
    workshop.rename(target)
    shutil.rmtree(aside, ignore_errors=True)


def _exchange(one: Path, other: Path) -> bool:
    """Swap two paths atomically by renameat2; False where that does not exist."""
    try:
        renameat2 = ctypes.CDLL(None, use_errno=True).renameat2
    except AttributeError:
        return False
    failed = renameat2(
        _AT_FDCWD, os.fsencode(one), _AT_FDCWD, os.fsencode(other), ctypes.c_uint(_RENAME_EXCHANGE)
    )
    if not failed:
        return True
    number = ctypes.get_errno()
    if number in (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP):
        return False
    raise OSError(number, os.strerror(number), str(other))
