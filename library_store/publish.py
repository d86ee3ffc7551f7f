"""Putting a directory in place in one step, and keeping builders of the same one apart.

Beside a target ``<name>`` live, hidden, its lock ``.<name>.lock`` and the directories
``.<name>.building-*`` that builds work in. A killed build leaves such a directory; the next
builder, who holds the lock, sweeps it.
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

_AT_FDCWD = -100
_RENAME_EXCHANGE = 2


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
def replacing(target: Path) -> Iterator[Path]:
    """An empty directory to fill, which takes the place of ``target`` when the block ends well.

    To be used while :func:`locked`. If the block raises, ``target`` stays as it was and the
    directory is removed.
    """
    prefix = f".{target.name}.building-"
    for leftover in target.parent.glob(f"{prefix}*"):
        shutil.rmtree(leftover, ignore_errors=True)
    workshop = target.parent / f"{prefix}{os.getpid()}"
    workshop.mkdir()
    try:
        yield workshop
        for path in workshop.iterdir():
            _flush(path)
        _flush(workshop)
        put_in_place(workshop, target)
        _flush(target.parent)
    finally:
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


def _flush(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
