"""Several libraries made one, without building their parts anew.

Poses, cameras and descriptors are taken over as they are, in the order given; only the index is
built over all of them. Ids keep everything but the library's name and the camera's number, which
counts on from one library to the next; where two libraries have a group of the same name, the later
one's gets a number (``cmu-2bca2d33-2``).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from library_store.assemble import (
    CAMERAS_FILE,
    POSES_FILE,
    PROJECTIONS_FILE,
    Report,
    write_index,
    write_manifest,
)
from library_store.backends import DESCRIPTORS_FILE, IndexSettings
from library_store.build import verify_library
from library_store.cameras import COLUMNS
from library_store.descriptor import DIMENSIONS
from library_store.errors import LibraryError
from library_store.manifest import FORMAT, Licence, Manifest, is_replaced
from library_store.publish import landing, locked, replacing
from library_store.sources import (
    FRAMES_FILE,
    MIRRORED,
    NAME_PATTERN,
    PARTS_FILE,
    SOURCES_FILE,
    SourceClip,
    SourceGroup,
    Sources,
    moved,
    read_sources,
    unique_name,
    write_sources,
)
from library_store.steps import Facts, Steps
from library_store.tables import TableWriter, open_table

_ROWS = 65_536
_TABLES: tuple[tuple[str, tuple[int, ...], type], ...] = (
    (POSES_FILE, (14, 3), np.float32),
    (FRAMES_FILE, (), np.int32),
    (PARTS_FILE, (2, 3), np.int32),
    (CAMERAS_FILE, (len(COLUMNS),), np.float32),
    (PROJECTIONS_FILE, (2,), np.int32),
    (DESCRIPTORS_FILE, (DIMENSIONS,), np.float32),
)


def merge_libraries(
    directory: Path,
    parts: Sequence[Path],
    *,
    name: str,
    version: str = "1",
    index: IndexSettings | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Manifest:
    """Merge the libraries in ``parts`` into one at ``directory``, replacing the one that is there.

    All files of the parts are checked first. Restartable and atomic as a build. Raises
    ``LibraryError`` for a part that cannot be used, or that is given twice, and where ``directory``
    is a part or holds anything but a library, ``ValueError`` for a name that ids cannot have.
    """
    if not NAME_PATTERN.fullmatch(name):
        raise ValueError(f"library name {name!r} must match {NAME_PATTERN.pattern}")
    report = progress or (lambda _stage, _fraction: None)
    directory = landing(directory)
    if directory.resolve() in {part.resolve() for part in parts}:
        raise LibraryError(
            f"{directory} is one of the libraries to merge and would be replaced; "
            "choose another directory"
        )
    settings = index or IndexSettings()
    manifests = []
    for number, part in enumerate(parts):
        manifests.append(verify_library(part))
        report("checking", (number + 1) / len(parts))
    of = [{"name": m.name, "version": m.version, "sha256": m.sha256} for m in manifests]
    if len({m.sha256 for m in manifests}) < len(manifests) or len(parts) < 2:
        raise LibraryError("merge at least two libraries, each once")
    key = hashlib.sha256(
        json.dumps([of, name, version, asdict(settings), FORMAT], sort_keys=True).encode()
    ).hexdigest()
    try:
        with (
            locked(directory, waiting=lambda: report("waiting for another build", 0.0)),
            replacing(directory, key[:12]) as workshop,
        ):
            steps = Steps(workshop)
            counts = _join_tables(steps, workshop, parts, manifests, report)
            return write_manifest(
                steps,
                workshop,
                report,
                name=name,
                version=version,
                licences=list(_numbered_licences(manifests)),
                build={"merged": of},
                index=write_index(steps, workshop, settings, report),
                counts=counts,
            )
    except OSError as error:
        raise LibraryError(f"the library {directory} cannot be built: {error}") from error


def _join_tables(
    steps: Steps,
    workshop: Path,
    parts: Sequence[Path],
    manifests: Sequence[Manifest],
    report: Report,
) -> Facts:
    """Write all tables one behind the other, with their numbers moved on."""

    def work() -> Facts:
        poses_before = np.cumsum([0, *(m.n_poses for m in manifests)])
        cameras_before = np.cumsum([0, *(m.n_cameras for m in manifests)])
        joined = _join_sources(parts, manifests)
        write_sources(workshop / SOURCES_FILE, joined.groups, joined.clips)
        clips_before = np.cumsum([0, *(len(_sources(part).clips) for part in parts)])
        for done, (file, shape, kind) in enumerate(_TABLES):
            tables = [open_table(part / file) for part in parts]
            n = sum(len(table) for table in tables)
            with TableWriter(workshop / file, (n, *shape), kind) as writer:
                for number, table in enumerate(tables):
                    for start in range(0, len(table), _ROWS):
                        rows = np.array(table[start : start + _ROWS])
                        if file == PROJECTIONS_FILE:
                            rows += [poses_before[number], cameras_before[number]]
                        if file == PARTS_FILE:
                            rows[..., 0] += clips_before[number]
                        writer.append(rows)
            report("joining", (done + 1) / len(_TABLES))
        for part, manifest in zip(parts, manifests, strict=True):
            if is_replaced(part, manifest):
                raise LibraryError(f"{part} was built anew while it was merged; merge again")
        return {
            "n_poses": int(poses_before[-1]),
            "n_cameras": int(cameras_before[-1]),
            "n_exemplars": sum(m.n_exemplars for m in manifests),
        }

    return steps.run("join", work, SOURCES_FILE, *(file for file, _, _ in _TABLES))


def _join_sources(parts: Sequence[Path], manifests: Sequence[Manifest]) -> Sources:
    """Groups and clips of all parts, renamed where names clash; frames and parts are not read."""
    numbers = _numbered_licences(manifests)
    groups: list[SourceGroup] = []
    clips: list[SourceClip] = []
    taken: dict[str, set[str]] = {}
    poses = rows = 0
    for part, manifest in zip(parts, manifests, strict=True):
        own = _sources(part)
        licences = [numbers[licence] for licence in manifest.licences]
        n_clips = len(clips)
        for clip in own.clips:
            name = unique_name(clip.name, taken.setdefault("mocap", set()))
            taken["mocap"].add(name)
            clips.append(
                replace(clip, name=name, licences=tuple(licences[n] for n in clip.licences))
            )
        for group in own.groups:
            group = moved(group, poses=poses, parts=rows, clips=n_clips, licences=licences)
            if group.clip is not None:
                name = clips[group.clip].name + MIRRORED * group.mirrored
            else:
                name = unique_name(group.name, taken.setdefault(group.kind, set()))
                taken[group.kind].add(name)
            groups.append(replace(group, name=name))
        poses += manifest.n_poses
        rows += len(own.parts)
    nothing = np.zeros(0, dtype=np.int32)
    return Sources(groups, clips, nothing, nothing)


def _sources(part: Path) -> Sources:
    def table(file: str) -> Any:
        return open_table(part / file)

    try:
        return read_sources(part / SOURCES_FILE, table(FRAMES_FILE), table(PARTS_FILE))
    except (ValueError, TypeError, KeyError) as error:
        raise LibraryError(f"{part / SOURCES_FILE} cannot be read: {error!r}") from error


def _numbered_licences(manifests: Sequence[Manifest]) -> dict[Licence, int]:
    """All different licences, numbered in the order they come up."""
    found: dict[Licence, int] = {}
    for manifest in manifests:
        for licence in manifest.licences:
            found.setdefault(licence, len(found))
    return found
