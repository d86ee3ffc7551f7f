"""What every importer yields: a clip of 14-joint poses, and the error for a file it cannot read."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from library_store.errors import LibraryError
from library_store.skeleton import LSP14

Float = NDArray[np.float64]
Frames = NDArray[np.int64]


class MocapError(LibraryError):
    """A motion capture file cannot be imported; the message names the file and what is wrong."""

    def __init__(self, path: Path, problem: str) -> None:
        super().__init__(f"{path}: {problem}")


@dataclass(frozen=True)
class Clip:
    """One recording of one person, on the lsp14 skeleton.

    name: the clip's name, from the file's name or the file.
    subject: who it shows; empty if the file does not say.
    action: what the person does; empty if the file does not say.
    frame_rate_hz: poses a second, gaps aside; NaN if the file does not say.
    positions_mm: (F, 14, 3) float32, world frame with Y up, mm. Not root-centred.
    frames: (F,) int64, the frames' numbers in the file, which may be of every n-th frame.
    findings: what the importer noticed, mended or assumed, one sentence each.
    licence: the licence of the data as far as the file states it, else empty.
    """

    name: str
    subject: str
    action: str
    frame_rate_hz: float
    positions_mm: NDArray[np.float32]
    frames: Frames
    findings: tuple[str, ...] = ()
    licence: str = ""

    def __post_init__(self) -> None:
        if self.positions_mm.shape != (len(self.frames), LSP14.n_joints, 3):
            raise ValueError(
                f"clip {self.name!r}: {self.positions_mm.shape} positions, "
                f"{len(self.frames)} frames"
            )

    def __len__(self) -> int:
        return len(self.frames)

    def thinned(self, rate_hz: float) -> Clip:
        """Every n-th pose, as few as still give ``rate_hz``; all where the rate is not known."""
        # Rates such as 119.98 for 120 must still be thinned by four to 30.
        step = int(self.frame_rate_hz / rate_hz + 0.01) if np.isfinite(self.frame_rate_hz) else 1
        if step <= 1:
            return self
        return replace(
            self,
            frame_rate_hz=self.frame_rate_hz / step,
            positions_mm=self.positions_mm[::step],
            frames=self.frames[::step],
        )


def counted(n: int, noun: str) -> str:
    """``1 frame``, ``2 frames``: for findings."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"
