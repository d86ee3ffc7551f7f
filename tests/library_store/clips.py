"""Small files of clips to build libraries from."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from library_store.anatomy import BodyParts, Float, decode, encode, measure_lengths
from library_store.importers import Clip, write_npz
from library_store.importers.rotation import euler
from library_store.prior import PosePrior
from tests.library_store.importers.files import ADULT_MM


def moving(n: int, seed: int) -> Float:
    """Poses (n, 14, 3) mm, Y up, of one person moving steadily from pose to pose on the floor."""
    # A second from one pose to the next: nobody is faster than the importers' checks believe.
    ends = PosePrior.load().sample(n // 30 + 2, np.random.default_rng(seed))
    parts = encode(ends, measure_lengths(ends))
    at = np.linspace(0.0, len(ends) - 1.001, n)
    whole, share = at.astype(int), (at % 1.0)[:, None]

    def between(values: Float) -> Float:
        blended: Float = (1.0 - share) * values[whole] + share * values[whole + 1]
        return blended

    lengths = np.tile(ADULT_MM * (1.0 + 0.03 * (seed % 3)), (n, 1))
    poses = decode(BodyParts(between(parts.legs), between(parts.upper)), lengths)
    turns = euler("y", np.linspace(0.0, 300.0, n)[:, None])
    placed: Float = poses @ turns.transpose(0, 2, 1) + np.array([300.0, 900.0, -200.0])
    return placed


def clip(name: str, n: int, seed: int, *, licence: str = "free for all uses") -> Clip:
    return Clip(
        name=name,
        subject=f"person {seed}",
        action="moves about",
        frame_rate_hz=30.0,
        positions_mm=moving(n, seed).astype(np.float32),
        frames=np.arange(0, 2 * n, 2),
        licence=licence,
    )


def write_clips(path: Path, *clips: Clip) -> Path:
    write_npz(path, list(clips))
    return path
