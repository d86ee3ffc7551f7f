r"""From reflective markers on the skin to the 14 joints inside.

Two marker sets are known, which name most markers alike: **CMU's 41** (waist ``LFWT RFWT LBWT
RBWT``) and **Plug-in Gait** (pelvis ``LASI RASI``, ``LPSI RPSI`` or ``SACR``). Both need ``LFHD
RFHD LBHD RBHD``, ``C7 T10 CLAV STRN`` and, for L and R, ``SHO ELB WRA WRB KNE ANK HEE TOE``; other
markers are not read. Lengths are mm. With the pelvis' axes lateral x (to the left), up y, forward
z, PW its width (front marker to front marker) and PD its depth (middle of the front to middle of
the back markers):

* **hip**: Harrington et al. 2007, from the middle of the front markers ±(0.33 PW + 7.3) x,
  -(0.30 PW + 10.9) y, -(0.24 PD + 9.9) z.
* **knee**: from ``KNE`` (outer epicondyle) towards the other leg, square to the thigh, by half the
  knee's width and a marker's radius. "Towards the other leg" is the knee's hinge axis, the normal
  of the plane of hip, knee and ankle, as long as the knee is bent; as it straightens, the mean of
  the pelvis' lateral axis and the ankle's axis takes over.
* **ankle**: from ``ANK`` (outer malleolus) towards the other leg, along the normal of the plane of
  shank and foot (``HEE`` to ``TOE``), by half the ankle's width and a marker's radius.
* **shoulder**: from ``SHO`` (on the acromion) down the thorax by the shoulder offset and a marker's
  radius, and outwards by 40 mm. The thorax' up axis runs from the middle of ``T10 STRN`` to that of
  ``C7 CLAV``.
* **elbow**: from ``ELB`` (outer epicondyle) along the normal of the plane of shoulder, elbow and
  wrist, by half the elbow's width and a marker's radius; as the arm straightens, along the wrist's
  bar ``WRB`` to ``WRA``.
* **wrist**: from the middle of ``WRA WRB``, square to the bar and the forearm, towards the palm, by
  half the wrist's thickness and a marker's radius.
* **neck**: ``C7`` + 0.12 (``CLAV`` - ``C7``); **head top**: 85 mm above and 40 mm behind the
  middle of the four head markers. Both as in the skeletons that CMU fitted to its markers, so that
  C3D and ASF/AMC of a clip agree.

Measured on a real clip against CMU's own skeleton of it (05_13, a dance, 1,095 frames): 30 mm on
the mean over the joints, 11 mm at the hips. CMU's joints are themselves a fit to the markers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np

from library_store.anatomy import Float, unit
from library_store.skeleton import LSP14

MARKER_RADIUS_MM = 7.0
SHOULDER_OUT_MM = 40.0
HEAD_TOP_MM = (85.0, 40.0)
"""Above and behind the middle of the head's markers."""
NECK_SHARE = 0.12

_STRAIGHT = 0.5
_STRAIGHT_ARM = 0.1
"""Sine of the bend at which the hinge's own axis and its stand-in weigh the same."""


@dataclass(frozen=True)
class Sizes:
    """A person's widths in mm; the defaults are an adult's. Plug-in Gait files may state them."""

    knee: float = 100.0
    ankle: float = 70.0
    elbow: float = 80.0
    wrist: float = 46.0
    shoulder_offset: float = 40.0


@dataclass(frozen=True)
class MarkerSet:
    """What a marker set calls the pelvis' markers: left and right front, and those at the back."""

    name: str
    front: tuple[str, str]
    back: tuple[str, ...]

    @property
    def markers(self) -> tuple[str, ...]:
        """All markers that the joint centres are computed from."""
        return (*_COMMON, *self.front, *self.back)


_COMMON = (
    *("LFHD", "RFHD", "LBHD", "RBHD", "C7", "T10", "CLAV", "STRN"),
    *(s + m for s in "LR" for m in ("SHO", "ELB", "WRA", "WRB", "KNE", "ANK", "HEE", "TOE")),
)

MARKER_SETS = (
    MarkerSet("CMU's 41 markers", ("LFWT", "RFWT"), ("LBWT", "RBWT")),
    MarkerSet("Plug-in Gait", ("LASI", "RASI"), ("LPSI", "RPSI")),
    MarkerSet("Plug-in Gait with a sacrum marker", ("LASI", "RASI"), ("SACR",)),
)


def find_marker_set(names: frozenset[str]) -> MarkerSet | None:
    """The first marker set of which ``names`` has every marker."""
    return next((known for known in MARKER_SETS if names.issuperset(known.markers)), None)


def sizes_from(stated: Mapping[str, float]) -> Sizes:
    """Sizes with those that a Plug-in Gait file states, e.g. ``LKneeWidth``, averaged over sides.

    What is missing, zero or no adult's or child's width keeps its default.
    """
    given = {}
    for field in fields(Sizes):
        key = "".join(word.capitalize() for word in field.name.split("_"))
        key = key if field.name == "shoulder_offset" else f"{key}Width"
        sides = [stated[side + key] for side in "LR" if 15.0 < stated.get(side + key, 0.0) < 200.0]
        if sides:
            given[field.name] = sum(sides) / len(sides)
    return Sizes(**given)


def markers_by_joint(marker_set: MarkerSet, markers: Mapping[str, Float]) -> Float:
    """For each joint the marker nearest to it, (F, 14, 3): enough to tell a person's size by."""
    names = ["RFHD", "C7"]
    for side in "RL":
        names += [side + marker for marker in ("SHO", "ELB", "WRA")]
    for side, waist in zip("RL", reversed(marker_set.front), strict=True):
        names += [waist, f"{side}KNE", f"{side}ANK"]
    return np.stack([markers[name] for name in names], axis=1)


def joint_centres(marker_set: MarkerSet, markers: Mapping[str, Float], sizes: Sizes) -> Float:
    """Joints (F, 14, 3) from markers (F, 3), mm, in the markers' frame, whichever axis is up.

    Joints are NaN in frames that lack one of their markers.
    """

    def middle(*names: str) -> Float:
        mean: Float = np.mean([markers[name] for name in names], axis=0)
        return mean

    front, back = middle(*marker_set.front), middle(*marker_set.back)
    across = markers[marker_set.front[0]] - markers[marker_set.front[1]]
    depth = np.linalg.norm(front - back, axis=-1, keepdims=True)
    width = np.linalg.norm(across, axis=-1, keepdims=True)
    pelvis_left = unit(across)
    pelvis_ahead = square_to(front - back, pelvis_left)
    pelvis_up = np.cross(pelvis_ahead, pelvis_left)

    thorax_up = unit(middle("C7", "CLAV") - middle("T10", "STRN"))
    thorax_ahead = square_to(middle("CLAV", "STRN") - middle("C7", "T10"), thorax_up)
    thorax_left = np.cross(thorax_up, thorax_ahead)

    head_left = middle("LFHD", "LBHD") - middle("RFHD", "RBHD")
    head_ahead = unit(middle("LFHD", "RFHD") - middle("LBHD", "RBHD"))
    head_up = unit(np.cross(head_ahead, head_left))
    above, behind = HEAD_TOP_MM
    joints = {
        "head_top": middle("LFHD", "RFHD", "LBHD", "RBHD") + above * head_up - behind * head_ahead,
        "neck": markers["C7"] + NECK_SHARE * (markers["CLAV"] - markers["C7"]),
    }
    for side, letter, sign in (("l", "L", 1.0), ("r", "R", -1.0)):
        inwards = -sign * pelvis_left
        hip = front - inwards * (0.33 * width + 7.3)
        hip = hip - pelvis_up * (0.30 * width + 10.9) - pelvis_ahead * (0.24 * depth + 9.9)
        knee, ankle = markers[f"{letter}KNE"], markers[f"{letter}ANK"]
        thigh, shank = unit(knee - hip), unit(ankle - knee)
        foot = unit(markers[f"{letter}TOE"] - markers[f"{letter}HEE"])
        ankle_axis = sign * unit(np.cross(shank, foot))
        stand_in = _STRAIGHT * (inwards + ankle_axis)
        hinge = -sign * np.cross(thigh, shank) + stand_in
        joints[f"{side}_hip"] = hip
        joints[f"{side}_knee"] = knee + _inside(sizes.knee) * square_to(hinge, thigh)
        joints[f"{side}_ankle"] = ankle + _inside(sizes.ankle) * square_to(ankle_axis, shank)

        elbow, bar = markers[f"{letter}ELB"], markers[f"{letter}WRA"] - markers[f"{letter}WRB"]
        wrist = middle(f"{letter}WRA", f"{letter}WRB")
        shoulder = markers[f"{letter}SHO"] + sign * SHOULDER_OUT_MM * thorax_left
        shoulder = shoulder - (sizes.shoulder_offset + MARKER_RADIUS_MM) * thorax_up
        forearm = unit(wrist - elbow)
        hinge = -sign * np.cross(unit(shoulder - elbow), forearm)
        hinge = hinge + _STRAIGHT_ARM * square_to(bar, forearm)
        palm = sign * unit(np.cross(forearm, bar))
        joints[f"{side}_shoulder"] = shoulder
        joints[f"{side}_elbow"] = elbow + _inside(sizes.elbow) * unit(hinge)
        joints[f"{side}_wrist"] = wrist + _inside(sizes.wrist) * palm
    return np.stack([joints[name] for name in LSP14.joint_names], axis=1)


def square_to(vectors: Float, axes: Float) -> Float:
    """Unit vectors along what of ``vectors`` (..., 3) is square to the unit ``axes`` (..., 3)."""
    return unit(vectors - (vectors * axes).sum(axis=-1, keepdims=True) * axes)


def fill_gaps(points: Float, longest: int) -> Float:
    """Points (F, 3) with gaps (NaN) of at most ``longest`` frames filled along straight lines."""
    missing = np.asarray(~np.isfinite(points).all(axis=1))
    if not missing.any() or missing.all():
        return points
    known = np.flatnonzero(~missing)
    gaps = np.diff(known)
    short = np.zeros(len(points), dtype=np.bool_)
    for at, gap in zip(known[:-1], gaps, strict=True):
        if 1 < gap <= longest + 1:
            short[at + 1 : at + gap] = True
    filled = np.where(missing[:, None], np.nan, points)
    for axis in range(3):
        filled[short, axis] = np.interp(np.flatnonzero(short), known, points[known, axis])
    return filled


def _inside(width: float) -> float:
    return 0.5 * width + MARKER_RADIUS_MM
