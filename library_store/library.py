"""The exemplar library: poses, the cameras that see them, and matching of 2D poses to both.

An *exemplar* (an entry) is one pose seen by one virtual camera. Entries are numbers from 0; their
ids, ``<library>:<source>:<clip>:<frame>:<camera>``, are URL-safe and stable across rebuilds from
the same inputs. ``<source>`` is ``mocap``, ``composed`` or ``sampled``; for a composed pose
``<clip>`` is the composition and ``<frame>`` its number in it, for a sampled one the prior and the
number of the sample (:mod:`library_store.sources`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from library_store import cameras as camera_geometry
from library_store.backends import (
    DESCRIPTORS_FILE,
    Backend,
    needed_files,
    open_index,
    resolve,
)
from library_store.descriptor import describe
from library_store.errors import LibraryError
from library_store.manifest import MANIFEST, MEND, Licence, Manifest, check_files, steadily, written
from library_store.milvus import MilvusSettings
from library_store.sources import (
    FRAMES_FILE,
    PARTS_FILE,
    SOURCES_FILE,
    Kind,
    Source,
    Sources,
    read_sources,
)
from library_store.tables import open_table

Float = NDArray[np.float64]
Entries = NDArray[np.int64]


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

    def __init__(
        self,
        directory: Path,
        manifest: Manifest,
        backend: Backend,
        milvus: MilvusSettings | None,
        files: Mapping[str, tuple[int, int, int] | None],
    ) -> None:
        self.directory = directory
        self.manifest = manifest
        self._files = files

        self._poses = open_table(directory / "poses.npy")
        self._cameras = open_table(directory / "cameras.npy")
        self._projections = open_table(directory / "projections.npy")
        self._descriptors: NDArray[np.float32] | None = None
        if DESCRIPTORS_FILE in needed_files(backend):
            self._descriptors = open_table(directory / DESCRIPTORS_FILE).astype(
                np.float32, copy=False
            )
        self.sources = read_sources(
            directory / SOURCES_FILE,
            open_table(directory / FRAMES_FILE).astype(np.int32, copy=False),
            open_table(directory / PARTS_FILE).astype(np.int32, copy=False),
        )
        self._check_shapes()
        self._index = open_index(
            backend,
            directory,
            manifest,
            descriptors=self._descriptors,
            describe=self._described,
            milvus=milvus,
        )

    def _check_shapes(self) -> None:
        counts = self.manifest
        expected: dict[str, tuple[NDArray[np.generic], tuple[int, ...]]] = {
            "poses.npy": (self._poses, (counts.n_poses, 14, 3)),
            FRAMES_FILE: (self.sources.frames, (counts.n_poses,)),
            "cameras.npy": (self._cameras, (counts.n_cameras, 4)),
            "projections.npy": (self._projections, (counts.n_exemplars, 2)),
        }
        if self._descriptors is not None:
            expected[DESCRIPTORS_FILE] = (self._descriptors, (counts.n_exemplars, 28))
        for name, (array, shape) in expected.items():
            if array.shape != shape:
                raise LibraryError(
                    f"{self.directory / name} holds {array.shape} instead of {shape}; "
                    + MEND.format(directory=self.directory)
                )
        licensed = [it.licences for it in self.sources.groups]
        licensed += [it.licences for it in self.sources.clips]
        if max((number for it in licensed for number in it), default=-1) >= len(counts.licences):
            raise LibraryError(
                f"{self.directory / SOURCES_FILE} names more licences than the "
                f"{len(counts.licences)} of the manifest; " + MEND.format(directory=self.directory)
            )

    def __len__(self) -> int:
        return len(self._projections)

    @property
    def index_backend(self) -> str:
        """Which nearest-neighbour index answers: :mod:`library_store.backends`."""
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
        chosen = np.asarray(entries, dtype=np.int64)
        return self._described(chosen) if self._descriptors is None else self._descriptors[chosen]

    def _described(self, entries: Entries) -> NDArray[np.float32]:
        """Descriptors of entries (...), as the build made them: from poses and cameras."""
        rows = self._cameras[self._projections[entries, 1]]
        return describe(camera_geometry.project(rows, self.poses_mm(entries)))

    def match(self, points: ArrayLike, weights: ArrayLike | None, k: int) -> Matches:
        """The k exemplars whose projections are nearest to 2D poses (eq. 4's shortlist).

        ``points``: (Q, 14, 2) in any unit, scale and position; ``weights``: (Q, 14) in [0, 1], 0
        for a missing joint (whose coordinates are not read), ``None`` for all 1. Returns
        ``min(k, len)`` entries per query. Raises ``ValueError`` for a query whose joints of
        positive weight are fewer than two or coincide, ``IndexUnavailableError`` while the index's
        engine is away.
        """
        points = np.asarray(points, dtype=np.float64)
        if k < 1:
            raise ValueError(f"k must be positive, not {k}")
        k = min(k, len(self))
        shares = np.ones(points.shape[:2]) if weights is None else np.asarray(weights, np.float64)
        least = shares.min(axis=1)
        complete = (least > 0) & (least == shares.max(axis=1))
        if complete.all():
            found = self._index.query(describe(points), k)
            return Matches(entries=found.entries, distances=found.distances)
        entries = np.empty((len(points), k), dtype=np.int64)
        distances = np.empty((len(points), k))
        if complete.any():
            found = self._index.query(describe(points[complete]), k)
            entries[complete], distances[complete] = found.entries, found.distances
        found = self._index.query_masked(points[~complete], shares[~complete], k)
        entries[~complete], distances[~complete] = found.entries, found.distances
        return Matches(entries=entries, distances=distances)

    def source(self, entry: int) -> Source:
        """Where the pose of ``entry`` comes from."""
        return self.sources.of(int(self._projections[entry, 0]))

    def licences(self, entry: int) -> tuple[Licence, ...]:
        """Under which licences the pose of ``entry`` may be used: all of them at once."""
        return tuple(self.manifest.licences[number] for number in self.source(entry).licences)

    def entries_of(self, kind: Kind) -> Entries:
        """All entries whose poses are of one kind, ascending."""
        runs = [np.zeros(0, dtype=np.int64)]
        for group in self.sources.groups:
            if group.kind == kind:
                ends = (group.first_pose, group.first_pose + group.n_poses)
                runs.append(np.arange(*np.searchsorted(self._projections[:, 0], ends)))
        return np.concatenate(runs)

    def exemplar_id(self, entry: int) -> str:
        """The id of ``entry``: ``<library>:<source>:<clip>:<frame>:<camera>``."""
        pose, camera = (int(number) for number in self._projections[entry])
        return f"{self.manifest.name}:{self.sources.name_of(pose)}:{camera}"

    def find(self, exemplar_id: str) -> int:
        """The entry of an exemplar id; ``KeyError`` when this library has none of that id."""
        try:
            library, kind, name, frame, camera = exemplar_id.split(":")
            pose = self.sources.find(kind, name, int(frame))
            span = np.searchsorted(self._projections[:, 0], [pose, pose + 1])
            seen_by = self._projections[span[0] : span[1], 1]
            entry = int(span[0] + np.searchsorted(seen_by, int(camera)))
            # Also refuses what int() is lenient about: "+7", "07", " 7".
            if library == self.manifest.name and self.exemplar_id(entry) == exemplar_id:
                return entry
        except (ValueError, KeyError, IndexError, OverflowError):
            pass
        raise KeyError(exemplar_id)

    def is_in(self, directory: Path) -> bool:
        """Whether the files there are those that were opened, and nobody has written to them."""
        return written(directory, self._files) == self._files

    def close(self) -> None:
        """Let go of the memory; the library must not be used afterwards."""
        empty = np.zeros(0, dtype=np.float32)
        self._poses = self._cameras = self._projections = empty
        self.sources = Sources((), (), empty.astype(np.int32), empty.astype(np.int32))
        self._descriptors = empty
        self._index.close()


def load(
    directory: Path,
    *,
    verify: bool = True,
    backend: Backend = "auto",
    milvus: MilvusSettings | None = None,
) -> Library:
    """Open the library in ``directory``.

    ``verify`` checks the SHA-256 of every file that is needed (a quarter of a second for 200,000
    exemplars); presence, size and shape are always checked. ``backend`` chooses the index
    (:mod:`library_store.backends`), ``milvus`` says where that one is. A library that a build
    replaces meanwhile is the old one or the new one. Raises ``LibraryError``, naming the file and
    the way to mend it.
    """

    def open_it(manifest: Manifest) -> Library:
        chosen = resolve(backend, manifest)
        files = written(directory, (MANIFEST, *needed_files(chosen)))
        try:
            check_files(directory, manifest, sums=verify, names=needed_files(chosen))
            return Library(directory, manifest, chosen, milvus, files)
        except (OSError, ValueError, TypeError, KeyError, IndexError) as error:
            raise LibraryError(
                f"{directory} cannot be opened ({error}); " + MEND.format(directory=directory)
            ) from error

    return steadily(directory, open_it)
