"""Building libraries: from a pose prior, from captured poses, or from both.

Every file is written into a hidden directory beside the target and flushed to the disk, the
manifest last; then the directory takes the target's place in one step. A build killed at any
moment leaves the library that was there, and its finished steps to the next build of the same
inputs. A lock beside the target keeps builds of the same library from running at once; whoever
holds it sweeps what killed builds of other inputs left behind.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from library_store.assemble import write_descriptors, write_index, write_manifest, write_poses
from library_store.backends import IndexSettings
from library_store.cameras import COLUMNS, DISTANCE_RANGE_MM
from library_store.errors import LibraryError
from library_store.library import load
from library_store.manifest import (
    FORMAT,
    Licence,
    Manifest,
    check_files,
    file_sum,
    read_manifest,
    steadily,
)
from library_store.mocap import MocapSettings, gather
from library_store.prior import DEFAULT_PRIOR, PosePrior
from library_store.publish import landing, locked, replacing
from library_store.sections import Composed, Sampled, Section, captured
from library_store.sources import NAME_PATTERN, SourceClip
from library_store.steps import Facts, Steps

Progress = Callable[[str, float], None]
"""Hears the stage's name and the fraction of it that is done."""

RECIPE = 4
"""Raised whenever the code would build another library from the same parameters."""

BYTES_PER_EXEMPLAR = 620
"""About what an exemplar takes on the disk, its share of cells and graph included."""


@dataclass(frozen=True)
class BuildSettings:
    """What a library is built with.

    ``n_poses`` poses are drawn and each seen by ``cameras_per_pose`` cameras of its own. Sample i
    depends on the seed, the prior and i only: a smaller library is the beginning of a larger one.
    With mocap their product is the number of exemplars in all; captured poses get as many cameras
    as it takes. ``version`` is free text; by default the prior's and the recipe's, or 1 with mocap.
    """

    name: str = "default"
    n_poses: int = 200_000
    cameras_per_pose: int = 1
    seed: int = 0
    index: IndexSettings = field(default_factory=IndexSettings)
    version: str = ""

    def __post_init__(self) -> None:
        if not NAME_PATTERN.fullmatch(self.name):
            raise ValueError(f"library name {self.name!r} must match {NAME_PATTERN.pattern}")
        if self.n_poses < 1 or self.cameras_per_pose < 1:
            raise ValueError("a library needs at least one pose and one camera")

    @property
    def n_exemplars(self) -> int:
        """How many exemplars are wanted."""
        return self.n_poses * self.cameras_per_pose


@dataclass(frozen=True)
class Mocap:
    """Captured poses to build from: npz files of clips (`posematch library import` writes them).

    ``prior_share``: the share of exemplars that are sampled, when a prior joins the mocap.
    """

    files: tuple[Path, ...]
    settings: MocapSettings = field(default_factory=MocapSettings)
    prior_share: float = 0.5

    def __post_init__(self) -> None:
        if not self.files or not 0 <= self.prior_share <= 1:
            raise ValueError("there must be files, and a share between 0 and 1")


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
    directory = default_library_dir(cache_dir, prior, settings)
    if not _is_whole(directory):
        build_library(directory, prior, settings, progress, keep_if=_is_whole)
    return directory


def default_library_dir(
    cache_dir: Path, prior: PosePrior | None = None, settings: BuildSettings | None = None
) -> Path:
    """Where ``ensure_default_library`` keeps the default library, whether it is there or not."""
    prior, settings = prior or PosePrior.load(DEFAULT_PRIOR), settings or BuildSettings()
    return cache_dir / f"{settings.name}-{build_key(prior, settings)[:12]}"


def build_key(prior: PosePrior | None, settings: BuildSettings, mocap: Mocap | None = None) -> str:
    """Digest of everything that decides a library's content. Reads the files of mocap."""
    inputs: dict[str, Any] = {
        "prior": prior.sha256 if prior else None,
        "settings": asdict(settings) | {"version": _version(prior, settings, mocap)},
        "recipe": RECIPE,
        "format": FORMAT,
    }
    if mocap:
        inputs["mocap"] = [_digests(mocap), asdict(mocap.settings), mocap.prior_share]
    return _digest(inputs)


def build_library(
    directory: Path,
    prior: PosePrior | None,
    settings: BuildSettings,
    progress: Progress | None = None,
    *,
    mocap: Mocap | None = None,
    keep_if: Callable[[Path], bool] | None = None,
) -> Manifest:
    """Build a library and put it at ``directory``, replacing the library that is there, if any.

    ``prior`` alone: sampled poses. ``mocap`` alone: captured and recombined ones. Both: all three.
    ``keep_if`` is asked once the lock is held: when another process has meanwhile built what is
    wanted, that is kept. Returns the manifest. Raises ``LibraryError`` when an input cannot be
    used, the disk refuses, or ``directory`` holds anything but a library.
    """
    if prior is None and mocap is None:
        raise ValueError("a library is built from a prior, from mocap or from both")
    report = progress or (lambda _stage, _fraction: None)
    try:
        directory = landing(directory)
        with locked(directory, waiting=lambda: report("waiting for another build", 0.0)):
            if keep_if is not None and keep_if(directory):
                return read_manifest(directory)
            key = build_key(prior, settings, mocap)
            with replacing(directory, key[:12]) as workshop:
                return _fill(workshop, prior, settings, mocap, report)
    except OSError as error:
        needed_mb = 100 + settings.n_exemplars * BYTES_PER_EXEMPLAR // 1_000_000
        raise LibraryError(
            f"the library {directory} cannot be built: {error}; "
            f"check that its parent directory is writable and has {needed_mb} MB free"
        ) from error


def describe_library(directory: Path) -> Manifest:
    """What the library in ``directory`` is; presence and sizes of its files are checked."""

    def check(manifest: Manifest) -> Manifest:
        check_files(directory, manifest, sums=False)
        return manifest

    return steadily(directory, check)


def verify_library(directory: Path) -> Manifest:
    """Check every file of the library against its SHA-256, and that they are a library that opens.

    ``LibraryError`` names the first that is bad.
    """

    def check(manifest: Manifest) -> Manifest:
        check_files(directory, manifest, sums=True)
        load(directory, verify=False).close()
        return manifest

    return steadily(directory, check)


def _is_whole(directory: Path) -> bool:
    try:
        describe_library(directory)
    except LibraryError:
        return False
    return True


def _fill(
    workshop: Path,
    prior: PosePrior | None,
    settings: BuildSettings,
    mocap: Mocap | None,
    report: Progress,
) -> Manifest:
    """Write all files of the library into ``workshop``, step by step; the manifest last."""
    steps = Steps(workshop)
    sections: list[Section] = []
    clips: tuple[SourceClip, ...] = ()
    licences: list[Licence] = []
    build: dict[str, Any] = {
        "recipe": RECIPE,
        "seed": settings.seed,
        "cameras_per_pose": settings.cameras_per_pose,
        "camera_columns": list(COLUMNS),
        "camera_distance_mm": list(DISTANCE_RANGE_MM),
    }
    n_sampled = settings.n_exemplars
    if mocap:
        share = mocap.prior_share if prior else 0.0
        n_sampled = round(share * settings.n_exemplars)
        pool, facts = gather(steps, workshop, mocap.files, mocap.settings, report)
        clips, licences = pool.clips, list(pool.licences)
        n_composed = round(mocap.settings.recombined * (settings.n_exemplars - n_sampled))
        n_captured = settings.n_exemplars - n_sampled - n_composed
        sections += captured(pool, mocap.settings, n_captured, settings.seed)
        if n_composed:
            sections.append(
                Composed(
                    pool=pool,
                    settings=mocap.settings,
                    name=f"mix-{_composition(mocap, settings.seed)[:8]}",
                    cameras=_spread(n_composed, settings.cameras_per_pose),
                    seed=settings.seed,
                )
            )
        build["sources"] = _digests(mocap)
        build["steps"] = {**facts, **_describe(mocap.settings, n_captured, n_composed)}
    if prior and n_sampled:
        numbers = tuple(range(len(licences), len(licences) + len(prior.card.licences)))
        licences += [Licence(**licence) for licence in prior.card.licences]
        cameras = _spread(n_sampled, settings.cameras_per_pose)
        sections.append(Sampled(prior, cameras, settings.seed, numbers))
        build["prior"] = {
            "name": prior.card.name,
            "version": prior.card.version,
            "sha256": prior.sha256,
            "exemplars": n_sampled,
        }
    posed = write_poses(steps, workshop, sections, clips, report)
    seen = write_descriptors(steps, workshop, settings.seed, report)
    return write_manifest(
        steps,
        workshop,
        report,
        name=settings.name,
        version=_version(prior, settings, mocap),
        licences=licences,
        build=build,
        index=write_index(steps, workshop, settings.index, report),
        counts={**posed, **seen},
    )


def _version(prior: PosePrior | None, settings: BuildSettings, mocap: Mocap | None) -> str:
    """What is asked for; else, e.g. 2.3, the prior's and the recipe's: either makes other poses."""
    if settings.version:
        return settings.version
    return f"{prior.card.version}.{RECIPE}" if prior and not mocap else "1"


def _describe(settings: MocapSettings, n_captured: int, n_composed: int) -> dict[str, Facts]:
    """What the manifest says about the steps after thinning."""
    return {
        "captured": {"exemplars": n_captured, "mirrored_too": settings.mirror},
        "recombine": {
            "exemplars": n_composed,
            "limit_quantile": settings.limit_quantile,
            "stature_sd": settings.stature_sd,
            "bone_sd": settings.bone_sd,
        },
    }


def _spread(n_exemplars: int, cameras_per_pose: int) -> NDArray[np.int64]:
    """How many cameras see each pose, the last one maybe fewer than the others."""
    whole, rest = divmod(n_exemplars, cameras_per_pose)
    counts = np.full(whole + (rest > 0), cameras_per_pose, dtype=np.int64)
    counts[whole:] = rest
    return counts


def _composition(mocap: Mocap, seed: int) -> str:
    """Digest of what decides recombined poses; how many are wanted does not."""
    settings = asdict(mocap.settings) | {"recombined": None, "licence": None, "credit": None}
    return _digest({"files": _digests(mocap), "settings": settings, "seed": seed, "recipe": RECIPE})


def _digests(mocap: Mocap) -> list[dict[str, str]]:
    """The files by name and SHA-256, in order."""
    try:
        return [{"file": file.name, "sha256": file_sum(file).sha256} for file in mocap.files]
    except OSError as error:
        raise LibraryError(f"{error.filename} cannot be read: {error.strerror}") from error


def _digest(inputs: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()
