"""Clips made ready for a library: one frame of reference, no faster than need be, with a licence.

Importers have mended or refused what is wrong with a clip (``importers/checks.py``). Here every
clip is thinned to a rate, its poses are centred on the hip midpoint and turned about the vertical
until the person faces +Z: cameras go all round anyway, and poses that differ by their heading alone
are the same pose.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from library_store.anatomy import Float, measure_lengths, root_of, unit
from library_store.importers import Clip, MocapError, read
from library_store.skeleton import L_HIP, NECK, R_HIP

_AHEAD_WEIGHT = 0.5
"""Of the way ahead against the hip axis: unequal, so that they never cancel out when inverted."""


@dataclass(frozen=True)
class CleanClip:
    """A clip's poses (F, 14, 3) float32 mm, root-centred, Y up, facing +Z, and their frames (F,).

    ``lengths`` (8,) are the person's usual lengths in mm; ``licence`` says what may be done.
    """

    name: str
    subject: str
    action: str
    licence: str
    poses: NDArray[np.float32]
    frames: NDArray[np.int32]
    lengths: Float


def clean(file: Path, *, rate_hz: float, licence: str) -> Iterator[CleanClip]:
    """The clips of an npz file, made ready; ``licence`` is that of clips that state none.

    Raises ``MocapError`` for a file that cannot be read or whose licence is not known.
    """
    for clip in read(file):
        terms = clip.licence or licence
        if not terms:
            raise MocapError(
                file,
                f"does not say under which licence clip {clip.name!r} may be used; "
                "give it with --licence",
            )
        thinned = in_order(clip).thinned(rate_hz)
        ready = face_ahead(thinned.positions_mm.astype(np.float64))
        yield CleanClip(
            name=clip.name,
            subject=clip.subject,
            action=clip.action,
            licence=terms,
            poses=ready.astype(np.float32),
            frames=thinned.frames.astype(np.int32),
            lengths=np.median(measure_lengths(ready), axis=0),
        )


def in_order(clip: Clip) -> Clip:
    """The clip with its frames ascending, each once."""
    frames, first = np.unique(clip.frames, return_index=True)
    if len(frames) == len(clip) and np.array_equal(frames, clip.frames):
        return clip
    return replace(clip, positions_mm=clip.positions_mm[first], frames=frames)


def face_ahead(poses_mm: Float) -> Float:
    """Poses (n, 14, 3), Y up, root-centred and turned about Y until they face +Z.

    The turn is the one that best takes the hip axis (right to left) to +X and the way ahead, square
    to hip axis and trunk, to +Z. Somebody who lies on their side has a vertical hip axis, somebody
    who lies on their back a vertical way ahead; the other then decides.
    """
    centred = poses_mm - root_of(poses_mm)[:, None]
    left = unit(centred[:, L_HIP] - centred[:, R_HIP])
    ahead = _AHEAD_WEIGHT * unit(np.cross(left, centred[:, NECK]))
    # Maximise (turned left) . X + (turned ahead) . Z over turns about Y.
    cosine = left[:, 0] + ahead[:, 2]
    sine = left[:, 2] - ahead[:, 0]
    size = np.maximum(np.hypot(cosine, sine), 1e-12)
    cosine, sine = (cosine / size)[:, None], (sine / size)[:, None]
    turned = centred.copy()
    turned[..., 0] = cosine * centred[..., 0] + sine * centred[..., 2]
    turned[..., 2] = cosine * centred[..., 2] - sine * centred[..., 0]
    return turned
