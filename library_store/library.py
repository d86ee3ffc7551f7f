"""The exemplar library: poses, the cameras that see them, and matching of 2D poses to both.

An *exemplar* (an entry) is one pose seen by one virtual camera. Entries are numbers from 0; their
ids, ``<library>:<source>:<clip>:<frame>:<camera>``, are URL-safe and stable across rebuilds from
the same inputs. ``<source>`` is ``mocap`` or ``sampled``; for a sampled pose ``<clip>`` is the
prior and ``<frame>`` the number of the sample.
"""

from __future__ import annotations

import json
import re
from bisect import bisect_right
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from library_store import cameras as camera_geometry
from library_store.descriptor import DIMENSIONS, describe
from library_store.errors import LibraryError
from library_store.index import ExactIndex, HnswIndex, Index
from library_store.manifest import MEND, Manifest, check_files, read_manifest
from library_store.masked import MaskedSearch

Float = NDArray[np.float64]
Entries = NDArray[np.int64]

INDEX_FILE = "index.hnsw"
NAME_PATTERN = re.compile(r"[A-Za-z0-9._~-]+")
"""What names of libraries, clips and priors are made of, so that exemplar ids are URL-safe."""


@dataclass(frozen=True)
class Source:
    """Where a pose comes from.

    ``kind`` ``mocap``: ``clip`` and ``frame``; ``sampled``: ``prior`` and ``index``, the number of
    the sample. The other fields are ``None``.
    """

    kind: Literal["mocap", "sampled"]
    clip: str | None
    frame: int | None
    prior: str | None
    index: int | None


@dataclass(frozen=True)
class SourceGroup:
    """A run of poses from one clip or one prior, in ascending order of frame."""

    kind: Literal["mocap", "sampled"]
    name: str
    first_pose: int
    n_poses: int


@dataclass(frozen=True)
class Matches:
    """Nearest exemplars: ``entries`` (Q, k) int64, ``distances`` (Q, k) float64, ascending.

    Distances are those of :mod:`library_store.descriptor`, masked if joints are missing or unsure.
    """

    entries: Entries
    distances: Float


class Library:
    """An immutable, memory-mapped library; safe to read from several threads.

    Made by :func:`load`. ``manifest`` says what it is.
    """

    def __init__(self, directory: Path, manifest: Manifest, *, exact_index: bool) -> None:
        self.directory = directory
        self.manifest = manifest

        def table(name: str) -> NDArray[np.generic]:
            # A plain view of the map: np.memmap's own indexing is slow for small reads.
            mapped: NDArray[np.generic] = np.load(
                directory / name, mmap_mode="r", allow_pickle=False
            )
            return mapped.view(np.ndarray)

        self._poses = table("poses.npy")
        self._frames = table("frames.npy")
        self._cameras = table("cameras.npy")
        self._projections = table("projections.npy")
        self._descriptors: NDArray[np.float32] = table("descriptors.npy").astype(
            np.float32, copy=False
        )
        groups = json.loads((directory / "sources.json").read_text(encoding="utf-8"))
        self._groups = tuple(SourceGroup(**group) for group in groups)
        self._first_poses = [group.first_pose for group in self._groups]
        self._group_of = {(group.kind, group.name): group for group in self._groups}
        self._check_shapes()
        self._index: Index
        if exact_index or manifest.index["backend"] == ExactIndex.backend:
            self._index = ExactIndex(self._descriptors)
        else:
            self._index = HnswIndex.load(directory / INDEX_FILE, self._descriptors)
        self._masked = MaskedSearch(self._descriptors)

    def _check_shapes(self) -> None:
        counts = self.manifest
        expected = {
            "poses.npy": (self._poses, (counts.n_poses, 14, 3)),
            "frames.npy": (self._frames, (counts.n_poses,)),
            "cameras.npy": (self._cameras, (counts.n_cameras, 4)),
            "projections.npy": (self._projections, (counts.n_exemplars, 2)),
            "descriptors.npy": (self._descriptors, (counts.n_exemplars, 28)),
        }
        for name, (array, shape) in expected.items():
            if array.shape != shape:
                raise LibraryError(
                    f"{self.directory / name} holds {array.shape} instead of {shape}; "
                    + MEND.format(directory=self.directory)
                )

    def __len__(self) -> int:
        return len(self._projections)

    @property
    def index_backend(self) -> str:
        """Which nearest-neighbour index answers: ``hnsw`` or ``exact``."""
        return self._index.backend

    def poses_mm(self, entries: ArrayLike) -> Float:
        """3D poses of entries (...): (..., 14, 3) float64 mm, root-centred, Y up."""
        poses = self._projections[np.asarray(entries, dtype=np.int64), 0]
        return np.asarray(self._poses[poses], dtype=np.float64)

    def cameras(self, entries: ArrayLike) -> tuple[Float, Float]:
        """Extrinsics M_i of entries (...): R (..., 3, 3) and t (..., 3) mm, both float64.

        X_camera = R X_exemplar + t in OpenCV axes; see :mod:`library_store.cameras`.
        """
        rows = self._cameras[self._projections[np.asarray(entries, dtype=np.int64), 1]]
        return camera_geometry.extrinsics(rows, self.poses_mm(entries))

    def rotations(self, entries: ArrayLike) -> Float:
        """R of :meth:`cameras` alone, (..., 3, 3) float64."""
        rows = self._projections[np.asarray(entries, dtype=np.int64), 1]
        return camera_geometry.rotations(self._cameras[rows])

    def descriptors(self, entries: ArrayLike) -> NDArray[np.float32]:
        """Descriptors of entries (...): (..., 28) float32."""
        return self._descriptors[np.asarray(entries, dtype=np.int64)]

    def match(self, points: ArrayLike, weights: ArrayLike | None, k: int) -> Matches:
        """The k exemplars whose projections are nearest to 2D poses (eq. 4's shortlist).

        ``points``: (Q, 14, 2) in any unit, scale and position; ``weights``: (Q, 14) in [0, 1], 0
        for a missing joint (whose coordinates are not read), ``None`` for all 1. Returns
        ``min(k, len)`` entries per query. Raises ``ValueError`` for a query whose joints of
        positive weight are fewer than two or coincide.
        """
        points = np.asarray(points, dtype=np.float64)
        if k < 1:
            raise ValueError(f"k must be positive, not {k}")
        k = min(k, len(self))
        entries = np.empty((len(points), k), dtype=np.int64)
        distances = np.empty((len(points), k))
        shares = np.ones(points.shape[:2]) if weights is None else np.asarray(weights, np.float64)
        complete = (shares > 0).all(axis=1) & (np.ptp(shares, axis=1) == 0)
        if complete.any():
            found = self._index.query(describe(points[complete]), k)
            entries[complete], distances[complete] = found.entries, found.distances
        for row in np.flatnonzero(~complete):
            masked = self._masked.query(points[row], shares[row], k)
            entries[row], distances[row] = masked.entries, masked.distances
        return Matches(entries=entries, distances=distances)

    def source(self, entry: int) -> Source:
        """Where the pose of ``entry`` comes from."""
        group, frame = self._group_and_frame(int(self._projections[entry, 0]))
        if group.kind == "mocap":
            return Source("mocap", clip=group.name, frame=frame, prior=None, index=None)
        return Source("sampled", clip=None, frame=None, prior=group.name, index=frame)

    def exemplar_id(self, entry: int) -> str:
        """The id of ``entry``: ``<library>:<source>:<clip>:<frame>:<camera>``."""
        pose, camera = (int(number) for number in self._projections[entry])
        group, frame = self._group_and_frame(pose)
        return f"{self.manifest.name}:{group.kind}:{group.name}:{frame}:{camera}"

    def find(self, exemplar_id: str) -> int:
        """The entry of an exemplar id; ``KeyError`` when this library has none of that id."""
        try:
            library, kind, name, frame, camera = exemplar_id.split(":")
            group = self._group_of[kind, name]  # type: ignore[index]
            frames = self._frames[group.first_pose : group.first_pose + group.n_poses]
            at = int(np.searchsorted(frames, int(frame)))
            pose = group.first_pose + at
            span = np.searchsorted(self._projections[:, 0], [pose, pose + 1])
            seen_by = self._projections[span[0] : span[1], 1]
            entry = int(span[0] + np.searchsorted(seen_by, int(camera)))
            # Also refuses what int() is lenient about: "+7", "07", " 7".
            if library == self.manifest.name and self.exemplar_id(entry) == exemplar_id:
                return entry
        except (ValueError, KeyError, IndexError):
            pass
        raise KeyError(exemplar_id)

    def close(self) -> None:
        """Let go of the memory; the library must not be used afterwards."""
        empty = np.zeros(0, dtype=np.float32)
        self._poses = self._frames = self._cameras = self._projections = empty
        self._descriptors = empty
        self._index = ExactIndex(empty)
        self._masked = MaskedSearch(empty.reshape(0, DIMENSIONS))

    def _group_and_frame(self, pose: int) -> tuple[SourceGroup, int]:
        group = self._groups[bisect_right(self._first_poses, pose) - 1]
        return group, int(self._frames[pose])


def load(directory: Path, *, verify: bool = True, exact_index: bool = False) -> Library:
    """Open the library in ``directory``.

    ``verify`` checks the SHA-256 of every file (a quarter of a second for 200,000 exemplars);
    presence, size and shape are always checked. ``exact_index`` searches by brute force instead of
    the library's index. Raises ``LibraryError``, naming the file and the way to mend it.
    """
    manifest = read_manifest(directory)
    check_files(directory, manifest, sums=verify)
    try:
        return Library(directory, manifest, exact_index=exact_index)
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise LibraryError(
            f"{directory} cannot be opened ({error}); " + MEND.format(directory=directory)
        ) from error
