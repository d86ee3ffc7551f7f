"""The sections of a library's poses: captured, recombined, sampled. Each comes in chunks.

A chunk depends on the seed, its number and the section's inputs only, so memory is bounded by the
chunk and a shorter section of the composed or sampled kind is the beginning of a longer one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from library_store.anatomy import Float
from library_store.errors import LibraryError
from library_store.importers.clip import counted
from library_store.limits import Limits, learn_limits
from library_store.mocap import MocapSettings, Pool
from library_store.prior import PosePrior
from library_store.recombine import mirror, recombine
from library_store.sources import MIRRORED, SourceGroup

CHUNK = 1_000
"""Poses drawn at once; part of what decides a library's content."""

_LIMIT_POSES = 50_000
_SAMPLED, _CAMERAS, _COMPOSED, _CHOSEN = range(4)
"""What the generators of a build are for: their seeds are [seed, chunk, one of these]."""


@dataclass(frozen=True)
class Chunk:
    """Some poses (n, 14, 3) mm, their frames (n,) and, composed ones, their parts (n, 2, 3)."""

    poses: Float
    frames: NDArray[np.int32]
    parts: NDArray[np.int32]


class Section(Protocol):
    """Poses of one kind."""

    @property
    def cameras(self) -> NDArray[np.int64]:
        """How many cameras see each pose, (n_poses,)."""
        ...

    @property
    def n_parts(self) -> int:
        """How many of the poses are composed."""
        ...

    def groups(self) -> list[SourceGroup]:
        """Its groups, as if the section were alone in the library."""
        ...

    def chunks(self) -> Iterator[Chunk]:
        """Its poses, in order."""
        ...


def generator(seed: int, chunk: int, purpose: int) -> np.random.Generator:
    """The random numbers of one chunk and purpose."""
    return np.random.default_rng([seed, chunk, purpose])


def camera_generator(seed: int, chunk: int) -> np.random.Generator:
    """The random numbers of the cameras of one chunk of exemplars."""
    return generator(seed, chunk, _CAMERAS)


@dataclass(frozen=True)
class Sampled:
    """Poses drawn from a prior, of people of even proportions."""

    prior: PosePrior
    cameras: NDArray[np.int64]
    seed: int
    licences: tuple[int, ...]
    n_parts: int = 0

    @property
    def name(self) -> str:
        """The prior's name with a digest of its content."""
        return f"{self.prior.card.name}-{self.prior.sha256[:8]}"

    def groups(self) -> list[SourceGroup]:
        """One group."""
        return [SourceGroup("sampled", self.name, 0, len(self.cameras), self.licences)]

    def chunks(self) -> Iterator[Chunk]:
        """Samples; always whole chunks are drawn, so that a sample does not depend on the rest."""
        for number, rows in enumerate(slices(len(self.cameras))):
            rng = generator(self.seed, number, _SAMPLED)
            drawn = self.prior.sample(CHUNK, rng, evened=True)
            yield Chunk(drawn[: rows.stop - rows.start], _numbers(rows), no_parts())


@dataclass(frozen=True)
class Captured:
    """Frames of clips: ``rows`` (n,) of the pool, ascending, as they are or all mirrored."""

    pool: Pool
    rows: NDArray[np.int64]
    mirrored: bool
    cameras: NDArray[np.int64]
    n_parts: int = 0

    def groups(self) -> list[SourceGroup]:
        """One group a clip."""
        found, first = [], 0
        for clip, members in groupby(self.pool.places[self.rows, 0].tolist()):
            n = len(list(members))
            known = self.pool.clips[clip]
            found.append(
                SourceGroup(
                    kind="mocap",
                    name=known.name + MIRRORED * self.mirrored,
                    first_pose=first,
                    n_poses=n,
                    licences=known.licences,
                    clip=clip,
                    mirrored=self.mirrored,
                )
            )
            first += n
        return found

    def chunks(self) -> Iterator[Chunk]:
        """The frames."""
        for span in slices(len(self.rows)):
            rows = self.rows[span]
            poses = self.pool.poses[rows].astype(np.float64)
            poses = mirror(poses) if self.mirrored else poses
            yield Chunk(poses, self.pool.places[rows, 1], no_parts())


@dataclass(frozen=True)
class Composed:
    """Recombined poses; ``name`` stands for all that decides them."""

    pool: Pool
    settings: MocapSettings
    name: str
    cameras: NDArray[np.int64]
    seed: int

    @property
    def n_parts(self) -> int:
        """Every pose has its row of parts."""
        return len(self.cameras)

    def groups(self) -> list[SourceGroup]:
        """One group."""
        licences = sorted({number for clip in self.pool.clips for number in clip.licences})
        n = len(self.cameras)
        return [SourceGroup("composed", self.name, 0, n, tuple(licences), first_part=0)]

    def chunks(self) -> Iterator[Chunk]:
        """Whole chunks are drawn, as for samples."""
        kept, settings = self.pool.kept, self.settings
        limits = self._limits()
        # In memory, because they are drawn from all over.
        poses = self.pool.poses[kept]
        places = self.pool.places[kept]
        lengths = self.pool.lengths[places[:, 0]]
        for number, rows in enumerate(slices(len(self.cameras))):
            try:
                drawn = recombine(
                    poses,
                    lengths,
                    CHUNK,
                    generator(self.seed, number, _COMPOSED),
                    limits=limits,
                    may_mirror=settings.mirror,
                    stature_sd=settings.stature_sd,
                    bone_sd=settings.bone_sd,
                )
            except ValueError as error:
                raise LibraryError(
                    f"{counted(len(kept), 'pose')} cannot be recombined: {error}. Build from more "
                    "and other poses, or with --recombined 0"
                ) from error
            n = rows.stop - rows.start
            parts = np.concatenate([places[drawn.rows], drawn.mirrored[..., None]], axis=-1)
            yield Chunk(drawn.poses[:n], _numbers(rows), parts[:n].astype(np.int32))

    def _limits(self) -> Limits:
        kept = self.pool.kept[:: max(1, len(self.pool.kept) // _LIMIT_POSES)]
        poses = self.pool.poses[kept].astype(np.float64)
        return learn_limits(poses, self.settings.limit_quantile)


def captured(pool: Pool, settings: MocapSettings, n: int, seed: int) -> list[Captured]:
    """``n`` exemplars of kept poses and their mirror images, as evenly as can be.

    With more exemplars than poses some poses get one camera more than others; with fewer, some
    poses none. Who does is drawn.
    """
    kept = pool.kept
    n_poses = len(kept) * (2 if settings.mirror else 1)
    each, more = divmod(n, n_poses)
    counts = np.full(n_poses, each, dtype=np.int64)
    counts[generator(seed, 0, _CHOSEN).permutation(n_poses)[:more]] += 1
    halves = counts.reshape(-1, len(kept))
    sections = []
    for mirrored, half in zip((False, True), halves, strict=False):
        seen = half > 0
        if seen.any():
            sections.append(Captured(pool, kept[seen], mirrored, half[seen]))
    return sections


def slices(n: int) -> Iterator[slice]:
    """Runs of at most ``CHUNK`` rows that cover ``n``."""
    for start in range(0, n, CHUNK):
        yield slice(start, min(start + CHUNK, n))


def no_parts() -> NDArray[np.int32]:
    """The parts of poses that are not composed."""
    return np.zeros((0, 2, 3), dtype=np.int32)


def _numbers(rows: slice) -> NDArray[np.int32]:
    return np.arange(rows.start, rows.stop, dtype=np.int32)
