"""Small Human3.6M, HumanEva and CMU folders of a made-up person, in the documented layouts."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from app.lifting.geometry import Floats
from library_store.importers.h36m import CAMERAS, H36M_32, N_SUBJECTS
from library_store.importers.npz import HUMANEVA_15
from tests.library_store.importers.test_h36m import BONES_MM, PARENTS

H36M_SUBJECTS = ("S1", "S5", "S6", "S7", "S8", "S9", "S11")
FOCAL_PX, CENTRE_PX, DISTANCE_MM = 1145.0, (512.5, 515.5), 5000.0
_SWING = {2: 0.7, 3: 0.5, 7: -0.7, 8: -0.4, 18: 1.2, 19: 0.8, 26: -1.1, 27: -0.9, 12: 0.2}
"""Joint -> how far (radians) the bone to it swings about the person's own left-right axis."""


def acting(n_frames: int, seed: int) -> Floats:
    """(F, 32, 3) mm, Z up: somebody of the published skeleton who swings limbs and turns."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0.0, 4.0, n_frames)
    joints = np.zeros((n_frames, 32, 3))
    for joint in range(1, 32):
        x, y, z = BONES_MM.get(joint, (0.0, 0.0, 0.0))
        angle = _SWING.get(joint, 0.0) * np.sin(time * rng.uniform(0.7, 1.6) + rng.uniform(0, 6))
        bone = np.stack(
            [
                np.full(n_frames, x),
                y * np.cos(angle) - z * np.sin(angle),
                y * np.sin(angle) + z * np.cos(angle) + 0.5 * abs(x) * np.sin(angle),
            ],
            axis=1,
        )
        bone *= np.linalg.norm((x, y, z)) / np.maximum(np.linalg.norm(bone, axis=1), 1e-9)[:, None]
        joints[:, joint] = joints[:, PARENTS[joint]] + bone
    turn = time * rng.uniform(-0.5, 0.5) + rng.uniform(0, 6)
    turned = joints.copy()
    turned[..., 0] = joints[..., 0] * np.cos(turn)[:, None] + joints[..., 2] * np.sin(turn)[:, None]
    turned[..., 2] = joints[..., 2] * np.cos(turn)[:, None] - joints[..., 0] * np.sin(turn)[:, None]
    world: Floats = turned[..., [0, 2, 1]] * (1.0, -1.0, 1.0) + (100.0, -50.0, 950.0)
    return world


def h36m_npz(path: Path, actions: Iterable[str], n_frames: int = 70) -> None:
    """``data_3d_h36m.npz``: subject -> action -> (F, 32, 3) metres, Z up."""
    names = list(actions)
    held = {
        subject: {
            action: (acting(n_frames, 100 * i + k) / 1000.0).astype(np.float32)
            for k, action in enumerate(names)
        }
        for i, subject in enumerate(H36M_SUBJECTS)
    }
    np.savez_compressed(path, positions_3d=np.array(held, dtype=object))


def humaneva_npz(path: Path) -> None:
    """``data_3d_humaneva15.npz``: the same with 15 joints; training and validation."""
    held: dict[str, dict[str, Floats]] = {}
    for part in ("Train", "Validate"):
        for subject in (1, 2):
            actions = ("Walking 1 chunk0", "Jog 1 chunk0", "Box 1 chunk0")
            held[f"{part}/S{subject}"] = {
                action: _fifteen(acting(60, 7 * subject + k)) for k, action in enumerate(actions)
            }
    np.savez_compressed(path, positions_3d=np.array(held, dtype=object))


def _fifteen(joints: Floats) -> Floats:
    out = np.zeros((len(joints), 15, 3))
    out[:, HUMANEVA_15] = joints[:, H36M_32] / 1000.0
    out[:, 0] = joints[:, 0] / 1000.0
    return out


def made_camera(index: int) -> tuple[Floats, Floats]:
    """R (3, 3) and place (3,) mm, Z up, of a level camera that looks along a compass direction."""
    rotation = _rotation(*_angles(index))
    return rotation, np.array([0.0, 0.0, 1000.0]) - DISTANCE_MM * rotation[2]


def metadata_xml(path: Path) -> None:
    """``metadata.xml``: four cameras on a circle around the origin, the same for all subjects."""
    numbers: list[float] = []
    for index in range(len(CAMERAS)):
        numbers += [*_angles(index), *made_camera(index)[1].tolist()] * N_SUBJECTS
    for _ in CAMERAS:
        numbers += [FOCAL_PX, FOCAL_PX, *CENTRE_PX, 0, 0, 0, 0, 0]
    path.write_text(f"<metadata><w0>[{' '.join(f'{n:.9g}' for n in numbers)}]</w0></metadata>")


def _angles(index: int) -> tuple[float, float, float]:
    return np.pi / 2, 0.0, index * np.pi / 2


def _rotation(a: float, b: float, c: float) -> Floats:
    x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    product: Floats = x @ y @ z
    return product


def video(path: Path, n_frames: int) -> None:
    """A film of the right length: what is on it does not matter here."""
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 50.0, (1000, 1002))
    for number in range(n_frames):
        frame = np.full((1002, 1000, 3), 60 + number % 40, np.uint8)
        cv2.circle(frame, (500, 400), 60, (150, 170, 220), -1)
        writer.write(frame)
    writer.release()
