"""Building libraries: sampled poses, virtual cameras, descriptors, index, and the atomic publish.

Every file is written into a hidden directory beside the target and flushed to the disk, the
manifest last; then the directory takes the target's place in one step. A build killed at any
moment leaves the library that was there. A lock beside the target keeps builds of the same library
from running at once; whoever holds it sweeps what killed builds left behind.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from library_store.cameras import COLUMNS, DISTANCE_RANGE_MM, project, sample_cameras
from library_store.descriptor import DIMENSIONS, describe
from library_store.errors import LibraryError
from library_store.index import HnswIndex, HnswSettings
from library_store.library import INDEX_FILE, NAME_PATTERN, SourceGroup
from library_store.manifest import (
    CONTENT_FILES,
    FORMAT,
    MANIFEST,
    Licence,
    Manifest,
    check_files,
    content_digest,
    file_sum,
    read_manifest,
)
from library_store.prior import DEFAULT_PRIOR, PosePrior
from library_store.publish import locked, replacing
from library_store.skeleton import LSP14

Progress = Callable[[str, float], None]
"""Hears the stage's name and the fraction of it that is done."""

RECIPE = 1
"""Raised whenever the code would build another library from the same parameters."""

_CHUNK = 1_000
_POSE_GRID_MM = 0.01


@dataclass(frozen=True)
class BuildSettings:
    """What a sampled library is built with.

    ``n_poses`` poses are drawn and each seen by ``cameras_per_pose`` cameras of its own. Sample i
    depends on the seed, the prior and i only: a smaller library is the beginning of a larger one.
    """

    name: str = "default"
    n_poses: int = 200_000
    cameras_per_pose: int = 1
    seed: int = 0
    index: HnswSettings = field(default_factory=HnswSettings)

    def __post_init__(self) -> None:
        if not NAME_PATTERN.fullmatch(self.name):
            raise ValueError(f"library name {self.name!r} must match {NAME_PATTERN.pattern}")
        if self.n_poses < 1 or self.cameras_per_pose < 1:
            raise ValueError("a library needs at least one pose and one camera")


def ensure_default_library(
    cache_dir: Path,
    progress: Progress | None = None,
    *,
    settings: BuildSettings | None = None,
) -> Path:
    """The directory of the default library in ``cache_dir``, built there first if need be.

    Its name carries a digest of the prior and of all parameters, so a new prior or recipe is built
    beside the old library and never mistaken for it. A library with missing or cut files is built
    again. Takes a minute or two on two cores, once; ``settings`` can make it smaller. Raises
    ``LibraryError``.
    """
    prior = PosePrior.load(DEFAULT_PRIOR)
    settings = settings or BuildSettings()
    directory = cache_dir / f"{settings.name}-{build_key(prior, settings)[:12]}"
    if not _is_whole(directory):
        build_library(directory, prior, settings, progress, keep_if=_is_whole)
    return directory


def build_key(prior: PosePrior, settings: BuildSettings) -> str:
    """Digest of everything that decides a library's content."""
    inputs = {
        "prior": prior.sha256,
        "settings": asdict(settings),
        "recipe": RECIPE,
        "format": FORMAT,
    }
    return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()


def build_library(
    directory: Path,
    prior: PosePrior,
    settings: BuildSettings,
    progress: Progress | None = None,
    *,
    keep_if: Callable[[Path], bool] | None = None,
) -> Manifest:
    """Build a library of sampled poses and put it at ``directory``, replacing what is there.

    ``keep_if`` is asked once the lock is held: when another process has meanwhile built what is
    wanted, that is kept. Returns the manifest. Raises ``LibraryError`` when the disk refuses.
    """
    report = progress or (lambda _stage, _fraction: None)
    try:
        with locked(directory, waiting=lambda: report("waiting for another build", 0.0)):
            if keep_if is not None and keep_if(directory):
                return read_manifest(directory)
            with replacing(directory) as workshop:
                return _fill(workshop, prior, settings, report)
    except OSError as error:
        raise LibraryError(
            f"the library {directory} cannot be built: {error}; "
            "check that its parent directory is writable and has 300 MB free"
        ) from error


def describe_library(directory: Path) -> Manifest:
    """What the library in ``directory`` is; presence and sizes of its files are checked."""
    manifest = read_manifest(directory)
    check_files(directory, manifest, sums=False)
    return manifest


def verify_library(directory: Path) -> Manifest:
    """Check every file of the library against its SHA-256; ``LibraryError`` names the first bad."""
    manifest = read_manifest(directory)
    check_files(directory, manifest, sums=True)
    return manifest


def _is_whole(directory: Path) -> bool:
    try:
        describe_library(directory)
    except LibraryError:
        return False
    return True


def _fill(workshop: Path, prior: PosePrior, settings: BuildSettings, report: Progress) -> Manifest:
    """Write all files of the library into ``workshop``; the manifest last."""
    poses, cameras = _sample(prior, settings, report)
    n_exemplars = len(cameras)
    pose_of = np.repeat(np.arange(settings.n_poses, dtype=np.int32), settings.cameras_per_pose)
    projections = np.column_stack([pose_of, np.arange(n_exemplars, dtype=np.int32)])
    descriptors = np.empty((n_exemplars, DIMENSIONS), dtype=np.float32)
    for rows in _chunks(n_exemplars):
        descriptors[rows] = describe(project(cameras[rows], poses[pose_of[rows]]))
        report("descriptors", rows.stop / n_exemplars)
    source = f"{prior.card.name}-{prior.sha256[:8]}"
    group = SourceGroup(kind="sampled", name=source, first_pose=0, n_poses=settings.n_poses)

    tables: dict[str, NDArray[np.generic]] = {
        "poses.npy": poses,
        "frames.npy": np.arange(settings.n_poses, dtype=np.int32),
        "cameras.npy": cameras,
        "projections.npy": projections,
        "descriptors.npy": descriptors,
    }
    for name, table in tables.items():
        np.save(workshop / name, table, allow_pickle=False)
    (workshop / "sources.json").write_text(json.dumps([asdict(group)]) + "\n", encoding="utf-8")
    HnswIndex.build(descriptors, settings.index, lambda done: report("index", done)).save(
        workshop / INDEX_FILE
    )

    report("checksums", 0.0)
    files = {name: file_sum(workshop / name) for name in (*CONTENT_FILES, INDEX_FILE)}
    manifest = Manifest(
        name=settings.name,
        version=prior.card.version,
        skeleton=LSP14.name,
        n_poses=settings.n_poses,
        n_cameras=n_exemplars,
        n_exemplars=n_exemplars,
        licences=tuple(Licence(**licence) for licence in prior.card.licences),
        build={
            "recipe": RECIPE,
            "seed": settings.seed,
            "cameras_per_pose": settings.cameras_per_pose,
            "camera_columns": list(COLUMNS),
            "camera_distance_mm": list(DISTANCE_RANGE_MM),
            "prior": {
                "name": prior.card.name,
                "version": prior.card.version,
                "sha256": prior.sha256,
            },
        },
        index=settings.index.describe(),
        files=files,
        sha256=content_digest(files),
    )
    (workshop / MANIFEST).write_text(manifest.to_json(), encoding="utf-8")
    report("checksums", 1.0)
    return manifest


def _sample(
    prior: PosePrior, settings: BuildSettings, report: Progress
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Poses (P, 14, 3) mm and cameras (P * cameras_per_pose, 4), chunk by seeded chunk."""
    per_pose = settings.cameras_per_pose
    poses = np.empty((settings.n_poses, LSP14.n_joints, 3), dtype=np.float32)
    cameras = np.empty((settings.n_poses * per_pose, len(COLUMNS)), dtype=np.float32)
    for number, rows in enumerate(_chunks(settings.n_poses)):
        # Always a whole chunk, so that sample i does not depend on how many are wanted.
        n = rows.stop - rows.start
        drawn = prior.sample(_CHUNK, np.random.default_rng([settings.seed, number, 0]))
        # A grid much finer than the poses are true hides the last bits of the maths library.
        poses[rows] = np.round(drawn[:n] / _POSE_GRID_MM) * _POSE_GRID_MM
        seen = sample_cameras(_CHUNK * per_pose, np.random.default_rng([settings.seed, number, 1]))
        cameras[rows.start * per_pose : rows.stop * per_pose] = seen[: n * per_pose]
        report("poses", rows.stop / settings.n_poses)
    return poses, cameras


def _chunks(n: int) -> Iterator[slice]:
    for start in range(0, n, _CHUNK):
        yield slice(start, min(start + _CHUNK, n))
