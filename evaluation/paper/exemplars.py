"""Libraries of training frames as their cameras saw them: the paper's own kind of library.

They are written by the same code as every other library and read as such: nothing of matching is
written twice.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from app.lifting.geometry import Floats, rotation_onto_axis
from evaluation.metrics import root
from evaluation.paper.views import Views
from library_store.assemble import (
    CAMERAS_FILE,
    PROJECTIONS_FILE,
    write_index,
    write_manifest,
    write_poses,
)
from library_store.backends import DESCRIPTORS_FILE, IndexSettings
from library_store.cameras import COLUMNS, project, rolled_upright
from library_store.descriptor import DIMENSIONS, describe
from library_store.library import Library, load
from library_store.manifest import Licence
from library_store.publish import locked, replacing
from library_store.sections import Chunk, no_parts, slices
from library_store.sources import SourceClip, SourceGroup
from library_store.steps import Facts, Steps
from library_store.tables import TableWriter, open_table


@dataclass(frozen=True)
class Exemplars:
    """Poses (N, 14, 3) mm, root-centred, Y up, and the orbit camera (N, 4) that sees each.

    ``groups`` lie one behind the other and name runs of poses, with ``frames`` (N,) ascending in
    each. It is a section of a library.
    """

    poses_mm: Floats
    cameras_of: NDArray[np.float32]
    frames: NDArray[np.int32]
    runs: tuple[SourceGroup, ...]
    clips: tuple[SourceClip, ...]
    licence: str
    n_parts: int = 0

    @property
    def cameras(self) -> NDArray[np.int64]:
        """One camera a pose."""
        return np.ones(len(self.poses_mm), dtype=np.int64)

    def groups(self) -> list[SourceGroup]:
        """One a clip and camera."""
        return list(self.runs)

    def chunks(self) -> Iterator[Chunk]:
        """The poses, in order."""
        for rows in slices(len(self.poses_mm)):
            yield Chunk(self.poses_mm[rows], self.frames[rows], no_parts())


def orbit_rows(rotation: Floats, distance_mm: Floats) -> NDArray[np.float32]:
    """Rows (N, 4) of a camera table whose :func:`library_store.cameras.rotations` are (N, 3, 3)."""
    forward = rotation[:, 2]
    elevation = np.arcsin(np.clip(-forward[:, 1], -1.0, 1.0))
    azimuth = np.arctan2(-forward[:, 0], -forward[:, 2])
    roll = np.arctan2(rotation[:, 0, 1], -rotation[:, 1, 1])
    angles = np.degrees(np.stack([azimuth, elevation, roll], axis=1))
    return np.column_stack([angles, distance_mm]).astype(np.float32)


def exemplars_of(views: Views) -> Exemplars:
    """Every view as an exemplar: its pose, and its camera turned onto the person.

    An exemplar's camera looks at the mean of the joints; a view off the axis is turned there, and
    upright if the person leans far, as lifting turns whom it looks at.
    """
    key = np.lexsort((views.at, views.camera, views.scene))
    views = views[key]
    rotation = np.empty((len(views), 3, 3))
    poses = np.empty_like(views.joints_mm)
    for camera, rows in views.by_camera():
        seen = views.joints_mm[rows]
        poses[rows] = (seen - root(seen)) @ camera.rotation
        turns = np.stack([rotation_onto_axis(centre) for centre in seen.mean(1)])
        rotation[rows] = turns @ camera.rotation
    distance = np.linalg.norm(views.joints_mm.mean(1), axis=1)
    pairs = np.stack([views.scene, views.camera], axis=1)
    _, first, counts = np.unique(pairs, axis=0, return_index=True, return_counts=True)
    scenes = sorted(set(views.scene.tolist()))
    clip_number = {scene: number for number, scene in enumerate(scenes)}
    clips, runs = [], []
    for scene in scenes:
        clip = views.scenes[scene].clip
        clips.append(SourceClip(_url_safe(f"{scene}-{clip.name}"), clip.subject, clip.action, (0,)))
    for start, n in zip(first.tolist(), counts.tolist(), strict=True):
        scene, camera_number = pairs[start].tolist()
        number = clip_number[scene]
        runs.append(
            SourceGroup(
                kind="mocap",
                name=f"{clips[number].name}.{camera_number}",
                first_pose=start,
                n_poses=n,
                licences=(0,),
                clip=number,
            )
        )
    licences = sorted({views.scenes[scene].clip.licence for scene in scenes} - {""})
    return Exemplars(
        poses,
        rolled_upright(orbit_rows(rotation, distance), poses),
        views.at.astype(np.int32),
        tuple(runs),
        tuple(clips),
        "; ".join(licences) or "not stated by the files",
    )


def fraction(library: Library, n: int, seed: int) -> Exemplars:
    """``n`` random exemplars of a library, as figures 7 and 8 draw theirs."""
    chosen = np.sort(np.random.default_rng(seed).choice(len(library), n, replace=False))
    poses = library.poses_mm(chosen)
    rotation, translation = library.cameras(chosen)
    centre = np.einsum("nij,nj->ni", rotation, poses.mean(1)) + translation
    return Exemplars(
        poses,
        orbit_rows(rotation, centre[:, 2]),
        chosen.astype(np.int32),
        (SourceGroup("sampled", "fraction", 0, n, (0,)),),
        (),
        "; ".join(sorted({licence.licence for licence in library.manifest.licences})),
    )


def write_library(
    directory: Path,
    exemplars: Exemplars,
    report: Callable[[str, float], None] = lambda _stage, _fraction: None,
) -> Library:
    """Write a library at ``directory`` (replacing what is there) and open it.

    ``report`` hears the fraction done of each stage. It is searched exactly, as the paper's is:
    frames of videos lie in clumps, in which a graph misses one in twenty of the nearest, and
    another one whenever it is built anew.
    """
    with locked(directory, waiting=lambda: None), replacing(directory, "paper") as workshop:
        steps = Steps(workshop)
        posed = write_poses(steps, workshop, [exemplars], exemplars.clips, report)
        seen = steps.run(
            "descriptors",
            lambda: _write_descriptors(workshop, exemplars.cameras_of),
            *(CAMERAS_FILE, PROJECTIONS_FILE, DESCRIPTORS_FILE),
        )
        write_manifest(
            steps,
            workshop,
            report,
            name=_url_safe(directory.name),
            version="1",
            licences=[Licence(source="training frames", licence=exemplars.licence, credit="")],
            build={"by": "evaluation.paper", "camera_columns": list(COLUMNS)},
            index=write_index(steps, workshop, IndexSettings(hnsw=None), report),
            counts={**posed, **seen},
        )
    return load(directory, verify=False, backend="exact")


def _write_descriptors(workshop: Path, cameras: NDArray[np.float32]) -> Facts:
    poses = open_table(workshop / "poses.npy")
    n = len(cameras)
    np.save(workshop / CAMERAS_FILE, cameras)
    entries = np.arange(n, dtype=np.int32)
    np.save(workshop / PROJECTIONS_FILE, np.column_stack([entries, entries]))
    with TableWriter(workshop / DESCRIPTORS_FILE, (n, DIMENSIONS), np.float32) as table:
        for rows in slices(n):
            table.append(describe(project(cameras[rows], poses[rows])))
    return {"n_cameras": n}


def _url_safe(name: str) -> str:
    return "".join(c if c.isascii() and (c.isalnum() or c in "._-") else "-" for c in name)
