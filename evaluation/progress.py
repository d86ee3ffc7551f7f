"""A bar on stderr beside whatever takes minutes; gone when it is done, absent in pipes and logs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypeVar

from rich.console import Console
from rich.progress import track

T = TypeVar("T")


def followed(items: Sequence[T], label: str) -> Iterable[T]:
    """The items, with a bar that says how many are done."""
    console = Console(stderr=True)
    return track(items, label, transient=True, console=console, disable=not console.is_terminal)
