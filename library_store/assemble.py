"""From sections of poses to the files of a library: poses, cameras, descriptors, index, manifest.

Everything is written and read in chunks, so that the index alone decides how much memory a build
takes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from library_store.backends import DESCRIPTORS_FILE, IndexSettings
from library_store.backends import write_index as write_index_files
from library_store.cameras import COLUMNS, project, rolled_upright, sample_cameras
from library_store.descriptor import DIMENSIONS, describe
from library_store.manifest import (
    CONTENT_FILES,
    MANIFEST,
    Licence,
    Manifest,
    content_digest,
    file_sum,
)
from library_store.sections import CHUNK, Section, camera_generator, slices
from library_store.skeleton import LSP14
from library_store.sources import (
    FRAMES_FILE,
    PARTS_FILE,
    SOURCES_FILE,
    SourceClip,
    SourceGroup,
    moved,
    write_sources,
)
from library_store.steps import Facts, Steps
from library_store.tables import TableWriter, open_table

Report = Callable[[str, float], None]

POSES_FILE, CAMERAS_FILE = "poses.npy", "cameras.npy"
PROJECTIONS_FILE = "projections.npy"

_VIEWS = "views.npy"
_POSE_GRID_MM = 0.01


def write_poses(
    steps: Steps,
    workshop: Path,
    sections: Sequence[Section],
    clips: Sequence[SourceClip],
    report: Report,
) -> Facts:
    """Write the poses of all sections one behind the other, with their sources."""

    def work() -> Facts:
        views = np.concatenate([section.cameras for section in sections])
        n_poses, n_parts = len(views), sum(section.n_parts for section in sections)
        groups: list[SourceGroup] = []
        done = parts_done = 0
        with (
            TableWriter(workshop / POSES_FILE, (n_poses, 14, 3), np.float32) as poses,
            TableWriter(workshop / FRAMES_FILE, (n_poses,), np.int32) as frames,
            TableWriter(workshop / PARTS_FILE, (n_parts, 2, 3), np.int32) as parts,
        ):
            for section in sections:
                groups += [moved(g, poses=done, parts=parts_done) for g in section.groups()]
                for chunk in section.chunks():
                    # A grid much finer than the poses are true hides the last bits of the maths
                    # library.
                    poses.append(np.round(chunk.poses / _POSE_GRID_MM) * _POSE_GRID_MM)
                    frames.append(chunk.frames)
                    parts.append(chunk.parts)
                    done, parts_done = done + len(chunk.poses), parts_done + len(chunk.parts)
                    report("poses", done / n_poses)
        write_sources(workshop / SOURCES_FILE, groups, clips)
        np.save(workshop / _VIEWS, views)
        return {"n_poses": n_poses, "n_exemplars": int(views.sum())}

    return steps.run("poses", work, POSES_FILE, FRAMES_FILE, PARTS_FILE, SOURCES_FILE, _VIEWS)


def write_descriptors(steps: Steps, workshop: Path, seed: int, report: Report) -> Facts:
    """Draw the cameras of every pose and describe what they see."""

    def work() -> Facts:
        poses, views = open_table(workshop / POSES_FILE), np.load(workshop / _VIEWS)
        pose_of = np.repeat(np.arange(len(views), dtype=np.int32), views)
        n = len(pose_of)
        with (
            TableWriter(workshop / CAMERAS_FILE, (n, len(COLUMNS)), np.float32) as cameras,
            TableWriter(workshop / PROJECTIONS_FILE, (n, 2), np.int32) as projections,
            TableWriter(workshop / DESCRIPTORS_FILE, (n, DIMENSIONS), np.float32) as descriptors,
        ):
            for number, rows in enumerate(slices(n)):
                # Always a whole chunk, so that a camera does not depend on how many are wanted.
                drawn = sample_cameras(CHUNK, camera_generator(seed, number))
                seen = poses[pose_of[rows]]
                drawn = rolled_upright(drawn[: rows.stop - rows.start], seen)
                cameras.append(drawn)
                entries = np.arange(rows.start, rows.stop, dtype=np.int32)
                projections.append(np.column_stack([pose_of[rows], entries]))
                descriptors.append(describe(project(drawn, seen)))
                report("descriptors", rows.stop / n)
        return {"n_cameras": n}

    return steps.run("descriptors", work, CAMERAS_FILE, PROJECTIONS_FILE, DESCRIPTORS_FILE)


def write_index(steps: Steps, workshop: Path, settings: IndexSettings, report: Report) -> Facts:
    """Build the nearest-neighbour index over the descriptors."""

    def work() -> Facts:
        descriptors: NDArray[np.float32] = open_table(workshop / DESCRIPTORS_FILE).astype(
            np.float32, copy=False
        )
        return write_index_files(
            workshop, descriptors, settings, lambda done: report("index", done)
        )

    return steps.run("index", work, *settings.files)


def write_manifest(
    steps: Steps,
    workshop: Path,
    report: Report,
    *,
    name: str,
    version: str,
    licences: Sequence[Licence],
    build: Mapping[str, Any],
    index: Facts,
    counts: Facts,
) -> Manifest:
    """Sum up all files, remove what only the build needed, and write the manifest, the last file.

    ``counts`` has ``n_poses``, ``n_cameras`` and ``n_exemplars``.
    """
    report("checksums", 0.0)
    files = {name: file_sum(workshop / name) for name in (*CONTENT_FILES, *index["files"])}
    manifest = Manifest(
        name=name,
        version=version,
        skeleton=LSP14.name,
        n_poses=counts["n_poses"],
        n_cameras=counts["n_cameras"],
        n_exemplars=counts["n_exemplars"],
        licences=tuple(licences),
        build=build,
        index=index,
        files=files,
        sha256=content_digest(files),
    )
    steps.sweep(files)
    # Names of files may be any bytes.
    (workshop / MANIFEST).write_text(manifest.to_json(), encoding="utf-8", errors="replace")
    report("checksums", 1.0)
    return manifest
