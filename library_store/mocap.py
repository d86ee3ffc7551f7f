"""Captured poses on their way into a library: read and cleaned, then thinned, each a step on disk.

The pool is what sections (:mod:`library_store.sections`) draw from: the cleaned poses of all clips,
and which of them thinning keeps.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from library_store.anatomy import N_LENGTHS, Float
from library_store.clean import clean
from library_store.errors import LibraryError
from library_store.manifest import Licence
from library_store.sources import SourceClip, unique_name
from library_store.steps import Facts, Steps
from library_store.thin import greedy_cover

Report = Callable[[str, float], None]

_POSES, _PLACES, _CLIPS, _KEPT = "clean.poses", "clean.places.npy", "clean.json", "thin.npy"


@dataclass(frozen=True)
class MocapSettings:
    """How captured poses become exemplars.

    rate_hz: of a clip every n-th pose is taken, as few as still give so many a second.
    radius_mm: of poses nearer than this (RMS over the joints), one is kept.
    mirror: add every pose's mirror image.
    recombined: share of the exemplars from mocap that are recombined.
    stature_sd, bone_sd: spread of recombined people's size and of each of their lengths (of the
        logarithm).
    limit_quantile: how much of the captured poses lies beyond each limit of the body.
    licence, credit: of clips that state no licence.
    """

    rate_hz: float = 30.0
    radius_mm: float = 30.0
    mirror: bool = True
    recombined: float = 0.5
    stature_sd: float = 0.05
    bone_sd: float = 0.03
    limit_quantile: float = 0.001
    licence: str = ""
    credit: str = ""

    def __post_init__(self) -> None:
        finite = 0 < self.rate_hz < math.inf and 0 <= self.radius_mm < math.inf
        if not (finite and 0 <= self.recombined <= 1):
            raise ValueError("rate, radius and share of recombined poses must make sense")
        if not (0 <= self.limit_quantile < 0.5 and self.stature_sd >= 0 and self.bone_sd >= 0):
            raise ValueError("spreads and the limits' quantile must make sense")


@dataclass(frozen=True)
class Pool:
    """Cleaned poses of all clips and which are kept.

    ``poses`` (N, 14, 3) float32 mm, memory-mapped, facing +Z; ``places`` (N, 2) int32, clip and
    frame; ``lengths`` (clips, 8) usual lengths in mm; ``kept`` (T,) rows, ascending.
    """

    poses: NDArray[np.float32]
    places: NDArray[np.int32]
    lengths: Float
    clips: tuple[SourceClip, ...]
    licences: tuple[Licence, ...]
    kept: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))


def gather(
    steps: Steps, workshop: Path, files: Sequence[Path], settings: MocapSettings, report: Report
) -> tuple[Pool, dict[str, Facts]]:
    """Clean and thin the clips of npz files, or find that done; the pool and each step's facts.

    Raises ``LibraryError`` for a file that cannot be used.
    """

    def clean_all() -> Facts:
        return _clean_all(workshop, files, settings, report)

    cleaned = steps.run("clean", clean_all, _POSES, _PLACES, _CLIPS)
    shape = (cleaned["poses"], 14, 3)
    poses = np.memmap(workshop / _POSES, dtype=np.float32, mode="r", shape=shape).view(np.ndarray)

    def thin() -> Facts:
        kept = greedy_cover(poses, settings.radius_mm, lambda done: report("thinning", done))
        np.save(workshop / _KEPT, kept)
        return {"radius_mm": settings.radius_mm, "kept": len(kept)}

    thinned = steps.run("thin", thin, _KEPT)
    found = json.loads((workshop / _CLIPS).read_text(encoding="utf-8"))
    pool = Pool(
        poses=poses,
        places=np.load(workshop / _PLACES),
        lengths=np.array(found["lengths"]).reshape(-1, N_LENGTHS),
        clips=tuple(
            SourceClip(**clip | {"licences": tuple(clip["licences"])}) for clip in found["clips"]
        ),
        licences=tuple(Licence(**licence) for licence in found["licences"]),
        kept=np.load(workshop / _KEPT),
    )
    return pool, {"clean": cleaned, "thin": thinned}


def _clean_all(
    workshop: Path, files: Sequence[Path], settings: MocapSettings, report: Report
) -> Facts:
    """Write the cleaned poses of all files, one clip at a time."""
    places: list[NDArray[np.int32]] = []
    lengths: list[list[float]] = []
    clips: list[SourceClip] = []
    terms: dict[str, list[str]] = {}
    taken: set[str] = set()
    with (workshop / _POSES).open("wb") as table:
        for number, file in enumerate(files):
            for clip in clean(file, rate_hz=settings.rate_hz, licence=settings.licence):
                table.write(np.ascontiguousarray(clip.poses).data)
                rows = np.full(len(clip.frames), len(clips), dtype=np.int32)
                places.append(np.column_stack([rows, clip.frames]))
                lengths.append(clip.lengths.tolist())
                named = terms.setdefault(clip.licence, [])
                if file.name not in named:
                    named.append(file.name)
                licence = list(terms).index(clip.licence)
                name = unique_name(clip.name, taken)
                taken.add(name)
                clips.append(SourceClip(name, clip.subject, clip.action, (licence,)))
            report("reading", (number + 1) / len(files))
    if not clips:
        raise LibraryError("the files hold no clips")
    np.save(workshop / _PLACES, np.concatenate(places))
    licences = [
        Licence(
            source=", ".join(names),
            licence=licence,
            credit=settings.credit if licence == settings.licence else "",
        )
        for licence, names in terms.items()
    ]
    content = {
        "clips": [asdict(clip) for clip in clips],
        "lengths": lengths,
        "licences": [asdict(licence) for licence in licences],
    }
    (workshop / _CLIPS).write_text(json.dumps(content), encoding="utf-8")
    n_poses = sum(len(rows) for rows in places)
    return {"rate_hz": settings.rate_hz, "clips": len(clips), "poses": n_poses}
