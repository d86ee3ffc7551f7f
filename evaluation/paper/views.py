"""People seen by cameras: what is lifted, and what libraries of training frames are made of.

A *scene* is a clip and the cameras around it. A *view* is one frame of it seen by one of them:
joints in the camera frame (OpenCV axes, mm) and in pixels. The world has Y up.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from app.lifting.geometry import Floats, Integers, project
from app.lifting.types import Intrinsics
from evaluation.metrics import root
from evaluation.protocols import LiftingSet
from library_store.cameras import rotations
from library_store.importers.clip import Clip

VIRTUAL_FOCAL_PX = 1150.0
VIRTUAL_DISTANCE_MM = 4500.0
VIRTUAL_ELEVATION_DEG = 8.0
N_VIRTUAL = 4
"""Human3.6M has four cameras about as far away, at about that height and focal length."""
FIRST_VIRTUAL = "virtual-0"


@dataclass(frozen=True)
class SceneCamera:
    """A pinhole: X_camera = R (X_world - place).

    ``place_mm`` (3,) is None for a camera that keeps the person's hips on its axis, at
    ``VIRTUAL_DISTANCE_MM``.
    """

    name: str
    rotation: Floats
    place_mm: Floats | None
    intrinsics: Intrinsics

    def see(self, positions_mm: Floats) -> Floats:
        """(F, 14, 3) in the world -> in the camera frame."""
        if self.place_mm is not None:
            return (positions_mm - self.place_mm) @ self.rotation.T
        turned: Floats = (positions_mm - root(positions_mm)) @ self.rotation.T
        turned[..., 2] += VIRTUAL_DISTANCE_MM
        return turned


@dataclass(frozen=True)
class Scene:
    """A clip, the column of a table it counts under, and its cameras."""

    clip: Clip
    action: str
    cameras: tuple[SceneCamera, ...]


@dataclass(frozen=True)
class Views:
    """N views: ``joints_mm`` (N, 14, 3), camera frame; where each is from, by number.

    ``scene`` (N,), ``camera`` (N,) within the scene, ``at`` (N,) row of the clip.
    """

    scenes: tuple[Scene, ...]
    joints_mm: Floats
    scene: Integers
    camera: Integers
    at: Integers

    def __len__(self) -> int:
        return len(self.joints_mm)

    def __getitem__(self, rows: Integers | slice) -> Views:
        return Views(
            self.scenes, self.joints_mm[rows], self.scene[rows], self.camera[rows], self.at[rows]
        )

    @property
    def actions(self) -> np.ndarray[tuple[int], np.dtype[np.str_]]:
        """(N,) the columns of the table."""
        names = np.array([scene.action for scene in self.scenes])
        return names[self.scene]

    def camera_of(self, row: int) -> SceneCamera:
        """The camera of one view."""
        return self.scenes[int(self.scene[row])].cameras[int(self.camera[row])]

    def by_camera(self) -> list[tuple[SceneCamera, Integers]]:
        """The rows that each camera sees; a camera that sees nobody is left out."""
        if not len(self):
            return []
        pairs = np.stack([self.scene, self.camera], axis=1)
        unique, which = np.unique(pairs, axis=0, return_inverse=True)
        order = np.argsort(which.reshape(-1), kind="stable")
        runs = np.split(order, np.cumsum(np.bincount(which.reshape(-1)))[:-1])
        return [
            (self.scenes[scene].cameras[camera], rows)
            for (scene, camera), rows in zip(unique.tolist(), runs, strict=True)
        ]

    def points_px(self) -> Floats:
        """(N, 14, 2) true 2D."""
        points = np.empty((len(self), self.joints_mm.shape[1], 2))
        for camera, rows in self.by_camera():
            pinhole = camera.intrinsics
            points[rows] = project(
                self.joints_mm[rows],
                pinhole.focal_length_px,
                np.array(pinhole.principal_point_px),
            )
        return points


def look(
    scenes: Sequence[Scene],
    *,
    seconds_apart: float | None = None,
    first_seconds: float = np.inf,
    cameras: Collection[str] | None = None,
) -> Views:
    """Every frame, or one every ``seconds_apart``, by all cameras of each scene or those named.

    Frames of which the person, or a part, is not in front of the camera are left out.
    """
    parts: list[tuple[int, int, Integers]] = []
    for number, scene in enumerate(scenes):
        clip = scene.clip
        rate = clip.frame_rate_hz if np.isfinite(clip.frame_rate_hz) else 50.0
        step = 1 if seconds_apart is None else max(1, round(rate * seconds_apart))
        n = int(min(len(clip), np.ceil(first_seconds * rate)))
        parts += [
            (number, k, np.arange(0, n, step))
            for k, camera in enumerate(scene.cameras)
            if cameras is None or camera.name in cameras
        ]
    return _gather(tuple(scenes), parts)


def draw(scenes: Sequence[Scene], n: int | None, rng: np.random.Generator) -> Views:
    """``n`` different views drawn from all frames and cameras (all when None), in order."""
    ends = np.cumsum([len(scene.clip) * len(scene.cameras) for scene in scenes])
    total = int(ends[-1]) if len(ends) else 0
    if n is None or n >= total:
        return look(scenes)
    chosen = np.sort(rng.choice(total, n, replace=False))
    parts: list[tuple[int, int, Integers]] = []
    for number, rows in enumerate(np.split(chosen, np.searchsorted(chosen, ends[:-1]))):
        scene = scenes[number]
        camera, at = np.divmod(
            rows - (ends[number] - len(scene.clip) * len(scene.cameras)), len(scene.clip)
        )
        parts += [(number, k, at[camera == k]) for k in np.unique(camera).tolist()]
    return _gather(tuple(scenes), parts)


def some(views: Views, n: int | None, rng: np.random.Generator) -> Views:
    """``n`` of the views, drawn; in order."""
    if n is None or n >= len(views):
        return views
    return views[np.sort(rng.choice(len(views), n, replace=False))]


def virtual_cameras(rng: np.random.Generator) -> tuple[SceneCamera, ...]:
    """Four cameras a quarter of a circle apart, from a random heading, that follow the person."""
    first = rng.uniform(0.0, 360.0)
    rows = [
        (first + 360.0 * k / N_VIRTUAL, VIRTUAL_ELEVATION_DEG, 0.0, VIRTUAL_DISTANCE_MM)
        for k in range(N_VIRTUAL)
    ]
    pinhole = Intrinsics(VIRTUAL_FOCAL_PX, (0.0, 0.0), "request")
    return tuple(
        SceneCamera(f"virtual-{k}", rotation, None, pinhole)
        for k, rotation in enumerate(rotations(np.array(rows)))
    )


def of_lifting_set(data: LiftingSet) -> Views:
    """The people of a lifting set as views of its one camera, all of one action."""
    upright = np.diag([1.0, -1.0, -1.0])
    n = len(data.joints_3d_mm)
    world = (data.joints_3d_mm @ upright).astype(np.float32)
    clip = Clip(data.name, "", "", 1.0, world, np.arange(n))
    scene = Scene(clip, "all", (SceneCamera("", upright, np.zeros(3), data.intrinsics),))
    zeros = np.zeros(n, dtype=np.int64)
    return Views((scene,), data.joints_3d_mm, zeros, zeros, np.arange(n))


def _gather(scenes: tuple[Scene, ...], parts: Sequence[tuple[int, int, Integers]]) -> Views:
    seen, scene, camera, at = [np.zeros((0, 14, 3))], [], [], []
    for number, k, rows in parts:
        joints = scenes[number].cameras[k].see(scenes[number].clip.positions_mm[rows].astype(float))
        ahead = np.isfinite(joints).all((1, 2)) & (joints[..., 2] > 100.0).all(1)
        seen.append(joints[ahead])
        at.append(rows[ahead])
        scene.append(np.full(int(ahead.sum()), number))
        camera.append(np.full(int(ahead.sum()), k))
    none = [np.zeros(0, np.int64)]
    return Views(
        scenes,
        np.concatenate(seen),
        np.concatenate(none + scene),
        np.concatenate(none + camera),
        np.concatenate(none + at),
    )
