"""What imported poses must satisfy, and how common mistakes are found, mended or refused.

Every importer hands its clip to ``checked``. Each mend and each doubt becomes a finding, a sentence
in ``Clip.findings``; poses that no known mistake explains raise ``MocapError``. In this order:

*a frame rate that is none*, zero or less, is taken as not known;
*frames with numbers that are not finite* are dropped;
*several poses under one frame's number*, as of recordings strung together, are refused: a library
would keep the first alone;
*a T-pose as the first frame*, with straight arms and a jump to the second, is dropped;
*units*: trunk + thigh + shank of a standing adult is 1.37 m; a clip that is off by the ratio of
metres, centimetres, inches, feet or CMU's units is scaled, one that fits none is refused;
*glitches*: frames in which a bone is 30% off its usual length, or a joint jumps out and back faster
than 15 m/s, are dropped; a clip that loses more than half of its frames is refused;
*up axis*: where the file does not say it, a person who stands along another axis is turned;
*left and right*: knees bend forwards, so legs that bend backwards mean that the sides are swapped;
they are exchanged (this also makes a mirrored recording a possible, mirrored person);
*proportions*: a short forearm or trunk hints that the file drops the wrist or thorax bone, as
conversions of CMU's files do; sides of different length, a head too short. Reported only.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from library_store.anatomy import LENGTHS, measure_lengths, root_of, unit
from library_store.importers.clip import Clip, Float, Frames, MocapError, counted
from library_store.importers.rotation import up_to_y
from library_store.skeleton import (
    L_ANKLE,
    L_ELBOW,
    L_HIP,
    L_KNEE,
    L_SHOULDER,
    L_WRIST,
    LSP14,
    NECK,
    R_ANKLE,
    R_ELBOW,
    R_HIP,
    R_KNEE,
    R_SHOULDER,
    R_WRIST,
)

ADULT_MM = 1370.0
"""Trunk + thigh + shank of the median CMU subject."""

MM_PER_UNIT = {
    "metres": 1000.0,
    "feet": 304.8,
    "CMU's units": 25.4 / 0.45,
    "inches": 25.4,
    "centimetres": 10.0,
}
_PLAUSIBLE = (0.6, 1.3)
"""Of ``ADULT_MM``: who is so large, children too, is believed to be given in mm."""
_PLAUSIBLE_SCALED = (0.78, 1.25)
"""The same where the unit has to be guessed; narrower, and no two units fit one size."""

BONE_TOLERANCE = 0.3
"""Of a bone's usual length."""
MAX_SPEED_MM_S = 15_000.0
"""About the root; see ``find_glitches``."""
_MAX_LOST = 0.5

_JUMP = 4.0
"""How many times as far as 95% of the other steps the first frame is from the second."""
_STRAIGHT = 0.97
"""Shoulder to wrist, over the arm's bones."""

_STANDS = 0.85
"""Length of the mean direction from ankles to neck along the axis that is taken for up."""
_BENT_MM = 30.0
"""How far a clearly bent knee lies ahead of, or behind, the line from hip to ankle."""
_MIN_BENT = 5
_MOST = 0.9
"""How many knees must be clearly bent, and the share of them that bends backwards."""

_SHORT_FOREARM = 0.78
"""Of the upper arm."""
_SHORT_TRUNK = 0.55
"""Of the leg."""
_SHORT_HEAD = 0.25
"""Neck to head top, of the trunk."""
_ASYMMETRY = 0.15

_RIGID = tuple(edge for edge in LSP14.edges if edge[0] != NECK)
"""Bones of constant length: the limbs. Shoulders and head move against the neck."""


def checked(
    path: Path, clip: Clip, *, up_is_known: bool = False, bones_are_known: bool = False
) -> Clip:
    """The clip with all that can be mended mended, and with what was noticed in its findings.

    ``up_is_known``: the format or the file says that Y is up (a person lying is then believed).
    ``bones_are_known``: the skeleton is known to be whole (short forearms are then the person's).
    Raises ``MocapError``, which names the file, if the poses cannot be used.
    """
    findings: list[str] = list(clip.findings)
    positions = clip.positions_mm.astype(np.float64)
    if not (math.isnan(clip.frame_rate_hz) or 0.0 < clip.frame_rate_hz < math.inf):
        findings.append(f"a frame rate of {clip.frame_rate_hz:g} Hz is taken as not known")
        clip = replace(clip, frame_rate_hz=math.nan)
    keep = np.isfinite(positions).all(axis=(1, 2))
    if not keep.all():
        lost = counted(int(np.count_nonzero(~keep)), "frame")
        findings.append(f"{lost} with missing joints dropped")
    if not keep.any():
        seen = np.flatnonzero(np.isfinite(positions).all(axis=2).any(axis=0))
        names = [name for joint, name in enumerate(LSP14.joint_names) if joint not in seen]
        never = f"; never there: {', '.join(names)}" if names else ""
        raise MocapError(path, f"clip {clip.name!r} has no frame with all 14 joints{never}")
    positions, frames = positions[keep], clip.frames[keep]
    if _frames_contradict(frames, positions):
        raise MocapError(
            path,
            f"clip {clip.name!r} has several poses under one frame's number: recordings strung "
            "together must be clips of their own",
        )
    if starts_with_t_pose(positions):
        findings.append("the first frame is a T-pose: dropped")
        positions, frames = positions[1:], frames[1:]
    if np.abs(positions).max() > 1e9:
        raise MocapError(path, f"clip {clip.name!r} has coordinates beyond any unit of length")

    scale, finding = unit_scale(positions)
    if scale is None:
        raise MocapError(path, f"clip {clip.name!r}: {finding}")
    findings += [finding] if finding else []
    positions = positions * scale

    glitches = find_glitches(positions, frames, clip.frame_rate_hz)
    if glitches.any():
        findings.append(
            f"{np.count_nonzero(glitches)} of {len(glitches)} frames with a jumping joint or a "
            "bone of another length dropped"
        )
    if glitches.mean() > _MAX_LOST:
        raise MocapError(path, f"clip {clip.name!r} is no one skeleton: {findings[-1]}")
    positions, frames = positions[~glitches], frames[~glitches]

    rotation, finding = up_rotation(positions, up_is_known=up_is_known)
    findings += [finding] if finding else []
    positions = positions @ rotation.T

    if sides_are_swapped(positions):
        findings.append("the knees bend backwards: left and right exchanged")
        positions = positions[:, LSP14.mirror]
    if not bones_are_known:
        findings += doubts_about_proportions(positions)
    return replace(
        clip,
        positions_mm=positions.astype(np.float32),
        frames=frames,
        findings=tuple(dict.fromkeys(findings)),  # those of an earlier import only once
    )


def checked_or_error(
    path: Path, clip: Clip, *, up_is_known: bool = False, bones_are_known: bool = False
) -> Clip | MocapError:
    """What ``checked`` returns or raises: of a file of several clips one may be beyond use."""
    try:
        return checked(path, clip, up_is_known=up_is_known, bones_are_known=bones_are_known)
    except MocapError as error:
        return error


def _frames_contradict(frames: Frames, positions: Float) -> bool:
    """Whether a frame's number comes up again with another pose."""
    _, first, again = np.unique(frames, return_index=True, return_inverse=True)
    return len(first) < len(frames) and not np.array_equal(positions[first][again], positions)


def starts_with_t_pose(positions: Float) -> bool:
    """Whether the first frame of (F, 14, 3) has straight arms and jumps to the second."""
    if len(positions) < 3:
        return False
    centred = positions - root_of(positions)[:, None]
    steps = np.linalg.norm(np.diff(centred, axis=0), axis=-1).mean(axis=1)
    for shoulder, elbow, wrist in ((R_SHOULDER, R_ELBOW, R_WRIST), (L_SHOULDER, L_ELBOW, L_WRIST)):
        first = positions[0]
        bones = np.linalg.norm(first[elbow] - first[shoulder])
        bones += np.linalg.norm(first[wrist] - first[elbow])
        if np.linalg.norm(first[wrist] - first[shoulder]) < _STRAIGHT * bones:
            return False
    return bool(steps[0] > _JUMP * max(float(np.percentile(steps[1:], 95)), 1e-12))


def unit_scale(positions: Float) -> tuple[float | None, str]:
    """Factor from the unit of poses (F, 14, 3) to mm, and a finding; None where no unit fits."""
    lengths = np.median(measure_lengths(positions), axis=0)
    size = float(lengths[[LENGTHS.index(name) for name in ("trunk", "thigh", "shank")]].sum())
    low, high = _PLAUSIBLE
    if low < size / ADULT_MM < high:
        return 1.0, ""
    low, high = _PLAUSIBLE_SCALED
    fitting = {u: f for u, f in MM_PER_UNIT.items() if low < size * f / ADULT_MM < high}
    if len(fitting) == 1:
        ((name, factor),) = fitting.items()
        return factor, f"lengths are in {name}: scaled by {factor:.4g} to mm"
    return None, (
        f"trunk + thigh + shank is {size:.4g}, which is no person's in mm or in "
        f"{', '.join(MM_PER_UNIT)} (an adult's is {ADULT_MM:.0f} mm)"
    )


def unit_that_fits(positions: Float, stated: float) -> float:
    """The length of a unit of poses (F, 14, 3) in mm: as stated, or 1 where that makes nobody.

    ``checked`` then finds the unit by the person's size.
    """
    whole = positions[np.isfinite(positions).all(axis=(1, 2))]
    fits = not len(whole) or unit_scale(whole * stated)[0] == 1.0
    return stated if fits else 1.0


def find_glitches(positions_mm: Float, frames: Frames, frame_rate_hz: float) -> NDArray[np.bool_]:
    """Whether each frame (F,) has a bone of another length or a joint that jumps out and back."""
    starts, ends = np.array(_RIGID).T
    bones = np.linalg.norm(positions_mm[:, ends] - positions_mm[:, starts], axis=-1)
    usual = np.median(bones, axis=0)
    glitch = (np.abs(bones - usual) > BONE_TOLERANCE * usual).any(axis=1)
    if len(frames) > 2 and np.isfinite(frame_rate_hz):
        gaps = np.maximum(np.abs(np.diff(frames)), 1)
        seconds = gaps / np.median(gaps) / frame_rate_hz
        step = np.diff(positions_mm - root_of(positions_mm)[:, None], axis=0)
        speed = np.linalg.norm(step, axis=-1) / seconds[:, None]
        fast = speed > MAX_SPEED_MM_S
        back = (step[:-1] * step[1:]).sum(-1) < 0.0
        glitch[1:-1] |= (fast[:-1] & fast[1:] & back).any(axis=1)
    return np.asarray(glitch, dtype=np.bool_)


def up_rotation(positions_mm: Float, *, up_is_known: bool) -> tuple[Float, str]:
    """Rotation (3, 3) that takes the poses' up axis to +Y, and a finding.

    The up axis is the one along which people stand, ankles to neck, on the mean over the frames.
    """
    ankles = 0.5 * (positions_mm[:, R_ANKLE] + positions_mm[:, L_ANKLE])
    stance = unit(positions_mm[:, NECK] - ankles).mean(axis=0)
    axis = int(np.argmax(np.abs(stance)))
    sign = "+" if stance[axis] > 0 else "-"
    name = sign + "XYZ"[axis]
    if name == "+Y":
        return np.eye(3), ""
    if up_is_known or abs(stance[axis]) < _STANDS:
        lying = "people mostly lie, are upside down, or the up axis is not Y"
        return np.eye(3), f"{lying} (ankles to neck is along {name}); left as it is"
    return up_to_y(name), f"people stand along {name}: turned so that Y is up"


def sides_are_swapped(positions_mm: Float) -> bool:
    """Whether nearly all clearly bent knees of poses (F, 14, 3) bend backwards.

    Thigh cross shank, the knee's hinge, then points to the right: whichever way the trunk leans.
    """
    left = unit(positions_mm[:, L_HIP] - positions_mm[:, R_HIP])
    bends = []
    for hip, knee, ankle in ((R_HIP, R_KNEE, R_ANKLE), (L_HIP, L_KNEE, L_ANKLE)):
        leg = unit(positions_mm[:, ankle] - positions_mm[:, hip])
        thigh = positions_mm[:, knee] - positions_mm[:, hip]
        bends.append((np.cross(thigh, leg) * left).sum(-1))  # mm: how far the knee is off the leg
    bend = np.concatenate(bends)
    clear = bend[np.abs(bend) > _BENT_MM]
    return len(clear) >= _MIN_BENT and float((clear < 0.0).mean()) > _MOST


def doubts_about_proportions(positions_mm: Float) -> list[str]:
    """Findings on bones that are missing, of different length left and right, or too short."""
    usual = dict(
        zip(LENGTHS, np.median(measure_lengths(positions_mm), axis=0).tolist(), strict=True)
    )
    findings = []
    forearm = usual["forearm"] / max(usual["upper_arm"], 1e-9)
    if forearm < _SHORT_FOREARM:
        findings.append(f"forearms are {forearm:.2f} of the upper arms: is the wrist bone missing?")
    trunk = usual["trunk"] / max(usual["thigh"] + usual["shank"], 1e-9)
    if trunk < _SHORT_TRUNK:
        findings.append(f"the trunk is {trunk:.2f} of the legs: is the thorax bone missing?")
    head = usual["head"] / max(usual["trunk"], 1e-9)
    if head < _SHORT_HEAD:
        findings.append(f"neck to head top is {head:.2f} of the trunk: is it the head's base?")
    starts, ends = np.array(_RIGID).T
    mirror = np.array(LSP14.mirror)
    bones = np.linalg.norm(positions_mm[:, ends] - positions_mm[:, starts], axis=-1)
    other = np.linalg.norm(positions_mm[:, mirror[ends]] - positions_mm[:, mirror[starts]], axis=-1)
    uneven = np.abs(np.median(bones, axis=0) / np.maximum(np.median(other, axis=0), 1e-9) - 1.0)
    if uneven.max() > _ASYMMETRY:
        worst = LSP14.joint_names[ends[int(np.argmax(uneven))]]
        findings.append(f"the bone to {worst} differs by {uneven.max():.0%} from the other side's")
    return findings
