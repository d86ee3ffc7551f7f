"""npz files: our own generic form, Human3.6M and HumanEva as commonly packed, SMPL joints.

*Generic*: ``positions`` (N, 14, 3) on lsp14, or with ``joint_names`` in another order; optional
``clip`` (N,), ``frame`` (N,), ``clip_name``, ``clip_subject``, ``clip_action``, ``clip_fps`` (one
a clip), ``up_axis`` and ``license``. What ``write`` makes.

*Human3.6M* ``data_3d_h36m.npz``: ``positions_3d``, an object array that holds subject → action →
(F, 32 or 17, 3) in metres (some copies: millimetres), Z up, 50 Hz. The neck is H36M's thorax, where
the shoulders meet.

*HumanEva* ``data_3d_humaneva15.npz``: the same with 15 joints, 60 Hz.

*SMPL*: ``joints`` (F, 22 or more, 3) in metres, Z up as AMASS has it, in the order of SMPL's body
joints. SMPL has no top of the head: it is put beyond the neck, towards SMPL's head joint (the
skull's base), at 0.47 of the trunk's length, the median of CMU's people. AMASS's own files hold
angles, not joints, and need the licensed body model first.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from library_store.importers.checks import checked, checked_or_error
from library_store.importers.clip import Clip, Float, Frames, MocapError
from library_store.importers.h36m import H36M_32, H36M_HZ, H36M_LICENCE
from library_store.importers.head import put_head_top
from library_store.importers.rotation import up_to_y
from library_store.importers.safe_npz import NpzFile
from library_store.skeleton import LSP14

H36M_17 = (10, 8, 14, 15, 16, 11, 12, 13, 1, 2, 3, 4, 5, 6)
HUMANEVA_15 = (14, 1, 5, 6, 7, 2, 3, 4, 11, 12, 13, 8, 9, 10)
SMPL = (15, 12, 17, 19, 21, 16, 18, 20, 2, 5, 8, 1, 4, 7)
"""Index of each lsp14 joint in the other skeletons."""

HUMANEVA_HZ = 60.0
_MM_PER_M = 1000.0
_LARGEST_M = 20.0
"""Nobody's joints lie farther apart in metres; in millimetres everybody's do."""
_LAST_FRAME = 2**31 - 1
"""Libraries keep frame numbers in four bytes."""

_CLIP_COLUMNS = ("name", "subject", "action", "fps", "findings", "license")
_RATES = ("mocap_framerate", "mocap_frame_rate", "fps")

_NESTED = {
    32: ("Human3.6M", H36M_32, H36M_HZ, H36M_LICENCE),
    17: ("Human3.6M", H36M_17, H36M_HZ, H36M_LICENCE),
    15: ("HumanEva", HUMANEVA_15, HUMANEVA_HZ, "HumanEva licence: research use only"),
}


def read(path: Path) -> list[Clip | MocapError]:
    """All clips of an npz file, or what is wrong with one; its arrays' names tell the form."""
    npz = NpzFile(path)
    if "positions_3d" in npz:
        return _read_nested(path, npz)
    if "positions" in npz:
        return _read_generic(path, npz)
    if "joints" in npz:
        return [_read_smpl(path, npz)]
    if "poses" in npz and "betas" in npz:
        raise MocapError(
            path,
            "holds AMASS body parameters; export the joints with the SMPL body model first, as "
            "an array 'joints' (F, 22, 3) in metres",
        )
    raise MocapError(
        path,
        f"has arrays {', '.join(sorted(npz.names)) or 'none'}; wanted is 'positions' (N, 14, 3), "
        "'positions_3d' (Human3.6M) or 'joints' (SMPL)",
    )


def write(path: Path, clips: Sequence[Clip]) -> None:
    """Write clips as one generic npz file, mm and Y up; ``read`` yields them again.

    The file appears whole or not at all. Raises ``MocapError`` where it cannot be written.
    """
    if not clips:
        raise MocapError(
            path,
            "there are no clips to write: nothing given is motion capture that can be read "
            "(AMC with its ASF, BVH, C3D, Human3.6M CDF, npz)",
        )
    lengths = [len(clip) for clip in clips]
    licences = sorted({clip.licence for clip in clips})  # of all, or a reader would take it so
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with unfinished.open("wb") as stream:
            np.savez_compressed(
                stream,
                positions=np.concatenate([clip.positions_mm for clip in clips]),
                clip=np.repeat(np.arange(len(clips), dtype=np.int32), lengths),
                frame=np.concatenate([clip.frames for clip in clips]),
                joint_names=np.array(LSP14.joint_names),
                units=np.array("mm"),
                up_axis=np.array("Y"),
                license=np.array("; ".join(licences) if all(licences) else ""),
                clip_name=np.array([clip.name for clip in clips]),
                clip_subject=np.array([clip.subject for clip in clips]),
                clip_action=np.array([clip.action for clip in clips]),
                clip_fps=np.array([clip.frame_rate_hz for clip in clips]),
                clip_license=np.array([clip.licence for clip in clips]),
                clip_findings=np.array(["\n".join(clip.findings) for clip in clips]),
            )
        unfinished.replace(path)
    except OSError as error:
        raise MocapError(path, f"cannot be written: {error.strerror}") from error
    finally:
        unfinished.unlink(missing_ok=True)


def states_licence(path: Path) -> bool:
    """Whether an npz file says under which licence each of its clips may be used."""
    npz = NpzFile(path)
    if "positions_3d" in npz:
        return True
    return bool(npz.text("license")) or ("clip_license" in npz and all(npz.column("clip_license")))


def _read_generic(path: Path, npz: NpzFile) -> list[Clip | MocapError]:
    positions = _numbers(path, "positions", npz["positions"])
    n = len(positions) if positions.ndim else 0
    if positions.shape != (n, LSP14.n_joints, 3) or n == 0:
        raise MocapError(path, f"positions are {positions.shape}; wanted is (N, 14, 3)")
    if "joint_names" in npz:
        names = npz.column("joint_names")
        if sorted(names) != sorted(LSP14.joint_names):
            wanted = ", ".join(LSP14.joint_names)
            raise MocapError(path, f"joints are {', '.join(names)}; wanted are {wanted}")
        positions = positions[:, [names.index(name) for name in LSP14.joint_names]]
    number = _column(path, npz, "clip", n, np.zeros(n, dtype=np.int64))
    frame = _column(path, npz, "frame", n, np.arange(n))
    if frame.min() < 0 or frame.max() > _LAST_FRAME:
        raise MocapError(path, f"frames {frame.min()} to {frame.max()} are no frame numbers")
    up_axis = npz.text("up_axis").upper()
    positions, up_is_known = _with_y_up(path, positions, up_axis)
    columns = {name: npz.column(f"clip_{name}") for name in _CLIP_COLUMNS}
    if number.min() < 0 or any(c and len(c) <= number.max() for c in columns.values()):
        raise MocapError(path, f"clip numbers {number.min()} to {number.max()} are not all named")
    clips: list[Clip | MocapError] = []
    for i in np.unique(number):
        own = number == i
        said = {name: column[i] if column else "" for name, column in columns.items()}
        try:
            rate_hz = float(said["fps"] or "nan")
        except ValueError as error:
            raise MocapError(path, f"clip_fps {said['fps']!r} is not a number") from error
        unnamed = path.stem if number.max() == 0 else f"{path.stem}_{i}"
        clip = Clip(
            name=said["name"] or unnamed,
            subject=said["subject"],
            action=said["action"],
            frame_rate_hz=rate_hz,
            positions_mm=positions[own].astype(np.float32),
            frames=frame[own],
            findings=tuple(said["findings"].splitlines()),
            licence=said["license"] or npz.text("license"),
        )
        clips.append(checked_or_error(path, clip, up_is_known=up_is_known))
    return clips


def _read_nested(path: Path, npz: NpzFile) -> list[Clip | MocapError]:
    held = npz["positions_3d"]
    subjects = held.item() if held.dtype == object and held.size == 1 else None
    if not isinstance(subjects, dict) or not all(isinstance(v, dict) for v in subjects.values()):
        raise MocapError(path, "positions_3d must hold a dict subject → action → positions")
    if not any(subjects.values()):
        raise MocapError(path, "positions_3d holds no positions")
    clips: list[Clip | MocapError] = []
    for subject, actions in subjects.items():
        for action, values in actions.items():
            positions = _numbers(path, f"{subject} {action}", values)
            joints = positions.shape[1] if positions.ndim == 3 else 0
            if joints not in _NESTED or positions.shape[2] != 3:
                shapes = ", ".join(str(known) for known in _NESTED)
                raise MocapError(
                    path, f"{subject} {action} is {positions.shape}; wanted are {shapes} joints"
                )
            dataset, order, rate_hz, licence = _NESTED[joints]
            unit, mm_per_unit = _metric_unit(positions)
            positions, _ = _with_y_up(path, positions[:, order] * mm_per_unit, "Z")
            clip = Clip(
                name=f"{subject}_{action}".replace(" ", "_").replace("/", "_"),
                subject=str(subject),
                action=str(action),
                frame_rate_hz=rate_hz,
                positions_mm=positions.astype(np.float32),
                frames=np.arange(len(positions), dtype=np.int64),
                findings=(f"{dataset}, {joints} joints: {unit}, Z up",),
                licence=licence,
            )
            clips.append(checked_or_error(path, clip, up_is_known=True, bones_are_known=True))
    return clips


def _metric_unit(positions: Float) -> tuple[str, float]:
    """Metres or millimetres, whichever makes people (F, J, 3) of a person's size, and its mm."""
    extents = np.ptp(positions, axis=1).max(axis=-1)
    sizes = extents[np.isfinite(extents)]
    if len(sizes) and np.median(sizes) > _LARGEST_M:
        return "millimetres", 1.0
    return "metres", _MM_PER_M


def _read_smpl(path: Path, npz: NpzFile) -> Clip:
    joints = _numbers(path, "joints", npz["joints"])
    if joints.ndim != 3 or joints.shape[1] < 22 or joints.shape[2] != 3:
        raise MocapError(path, f"joints are {joints.shape}; wanted is (F, 22 or more, 3)")
    positions, _ = _with_y_up(path, joints[:, SMPL] * _MM_PER_M, "Z")
    positions, reach = put_head_top(positions)
    rate = next((name for name in _RATES if name in npz), "fps")
    clip = Clip(
        name=path.stem,
        subject=npz.text("subject"),
        action=npz.text("action"),
        frame_rate_hz=npz.number(rate),
        positions_mm=positions.astype(np.float32),
        frames=np.arange(len(positions), dtype=np.int64),
        findings=(f"SMPL joints: metres, Z up; head top {reach:.0f} mm beyond the neck assumed",),
    )
    return checked(path, clip)


def _with_y_up(path: Path, positions: Float, up_axis: str) -> tuple[Float, bool]:
    """Positions turned so that Y is up, and whether the up axis was known."""
    if not up_axis:
        return positions, False
    try:
        turned: Float = positions @ up_to_y(up_axis).T
    except ValueError as error:
        raise MocapError(path, f"up_axis: {error}") from error
    return turned, True


def _numbers(path: Path, name: str, values: Any) -> Float:
    array = np.asarray(values)
    if array.dtype.kind not in "fiu":
        raise MocapError(path, f"{name} is not an array of numbers")
    return array.astype(np.float64)


def _column(path: Path, npz: NpzFile, name: str, n: int, otherwise: Frames) -> Frames:
    if name not in npz:
        return otherwise
    values = npz[name]
    if values.shape != (n,) or values.dtype.kind not in "iu":
        raise MocapError(path, f"{name} must be {n} whole numbers, one a pose")
    return values.astype(np.int64)
