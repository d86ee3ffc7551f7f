"""Which BVH joint is which of the 14, for the joint names that are in use; mapping files.

A target is the name of a BVH joint, or ``<name>.end`` for its end site. Names are compared without
regard to case and without what exporters put before them: a namespace (``mixamorig:Hips`` is
``Hips``), ``mixamorig_``, HumanIK's ``Character1_``, ``Bip01``, Rigify's ``DEF-``, Character
Creator's ``CC_Base_``; blanks and dots count as underscores. The first table of which the file has
every joint is taken.

**A mapping file** is a user's own table, for BVH joints or C3D markers of other names: a JSON
object, or a TOML file, from each of the fourteen lsp14 joints to a name, or to a list of names
whose mean the joint is. ``<name>.end`` is a BVH joint's end site.
"""

from __future__ import annotations

import json
import re
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from library_store.importers.clip import MocapError
from library_store.skeleton import LSP14


@dataclass(frozen=True)
class JointTable:
    """Targets in lsp14 order, and what is known about files that use these names.

    mm_per_unit: None where files differ (the checks then find the unit by the person's size, as
        they do where this one makes nobody's).
    lost_thorax: the joint whose children were moved onto it when the thorax bone was made zero
        long: those with zero offset get the length of the joint's own, the upper back's.
    wrist_stretch: elbow to wrist over the elbow to the joint named as the wrist.
    head_stretch: the same for the head's bone and the head top.
    head_is_base: the target of the head top is the base of the skull: the top is put beyond it.
    is_cmu: the clip is one of CMU's: its name gives frame rate and action.
    """

    name: str
    targets: tuple[str, ...]
    mm_per_unit: float | None = None
    lost_thorax: str | None = None
    wrist_stretch: float = 1.0
    head_stretch: float = 1.0
    head_is_base: bool = False
    is_cmu: bool = False


def _table(name: str, head_top: str, neck: str, right: str, left: str, limbs: str) -> JointTable:
    """A table from the limbs' names (shoulder elbow wrist hip knee ankle), {} being the side."""
    names = limbs.split()
    sides = [[limb.format(side) for limb in names] for side in (right, left)]
    targets = (head_top, neck, *sides[0][:3], *sides[1][:3], *sides[0][3:], *sides[1][3:])
    return JointTable(name=name, targets=targets)


def _with_head(
    name: str, head: str, neck: str, right: str, left: str, limbs: str
) -> tuple[JointTable, JointTable]:
    """Two tables: the head's bone ends at the top of the head, or it has no end site at all."""
    ends = _table(name, f"{head}.end", neck, right, left, limbs)
    open_ended = _table(f"{name}, no head top", head, neck, right, left, limbs)
    return ends, replace(open_ended, head_is_base=True)


CMU_MM_PER_UNIT = 25.4 / 0.45


def _cmu(table: JointTable, thorax: str) -> JointTable:
    # Both conversions leave the thorax and wrist bones at zero length. In CMU's skeletons the wrist
    # bone is half of the radius and in line with it; thorax and upper back are equal to 1%.
    return replace(
        table,
        mm_per_unit=CMU_MM_PER_UNIT,
        lost_thorax=thorax,
        wrist_stretch=1.5,
        head_stretch=1.6,
        is_cmu=True,
    )


TABLES: tuple[JointTable, ...] = (
    _cmu(
        _table(
            "CMU, MotionBuilder-friendly",
            *("head.end", "neck1", "right", "left"),
            "{}arm {}forearm {}hand {}upleg {}leg {}foot",
        ),
        "spine1",
    ),
    _cmu(
        _table(
            "CMU, 3ds Max-friendly",
            *("head.end", "neck", "right", "left"),
            "{}shoulder {}elbow {}wrist {}hip {}knee {}ankle",
        ),
        "chest2",
    ),
    _table(
        "Mixamo",
        *("headtop_end", "neck", "right", "left"),
        "{}arm {}forearm {}hand {}upleg {}leg {}foot",
    ),
    *_with_head(
        "MotionBuilder",
        *("head", "neck", "right", "left"),
        "{}arm {}forearm {}hand {}upleg {}leg {}foot",
    ),
    *_with_head(
        "3ds Max, Xsens",
        *("head", "neck", "right", "left"),
        "{}shoulder {}elbow {}wrist {}hip {}knee {}ankle",
    ),
    *_with_head(
        "Character Studio biped",
        *("head", "neck", "r", "l"),
        "{}_upperarm {}_forearm {}_hand {}_thigh {}_calf {}_foot",
    ),
    *_with_head(
        "Unity humanoid",
        *("head", "neck", "right", "left"),
        "{}upperarm {}lowerarm {}hand {}upperleg {}lowerleg {}foot",
    ),
    *_with_head(
        "Rokoko",
        *("head", "neck", "right", "left"),
        "{}arm {}forearm {}hand {}thigh {}shin {}foot",
    ),
    *_with_head(
        "Rokoko, VRM",
        *("head", "neck", "right", "left"),
        "{}upperarm {}lowerarm {}hand {}thigh {}shin {}foot",
    ),
    *_with_head(
        "Unreal mannequin",
        *("head", "neck_01", "r", "l"),
        "upperarm_{} lowerarm_{} hand_{} thigh_{} calf_{} foot_{}",
    ),
    _table(
        "Blender Rigify",
        *("spine_006.end", "spine_004", "r", "l"),
        "upper_arm_{} forearm_{} hand_{} thigh_{} shin_{} foot_{}",
    ),
    *_with_head(
        "Blender",
        *("head", "neck", "r", "l"),
        "upper_arm_{} forearm_{} hand_{} thigh_{} shin_{} foot_{}",
    ),
    *_with_head(
        "SMPL",
        *("head", "neck", "r", "l"),
        "{}_shoulder {}_elbow {}_wrist {}_hip {}_knee {}_ankle",
    ),
    *_with_head(
        "SMPL-X",
        *("head", "neck", "right", "left"),
        "{}_shoulder {}_elbow {}_wrist {}_hip {}_knee {}_ankle",
    ),
    *_with_head(
        "Poser, Daz",
        *("head", "neck", "r", "l"),
        "{}shldr {}forearm {}hand {}thigh {}shin {}foot",
    ),
)

_PREFIX = re.compile(r"^(?:mixamorig\d*_|character\d*_|bip\d*_|def-|org-|cc_base_)")


def plain(name: str) -> str:
    """A joint's name as tables have it: lower case, without namespace and exporters' prefixes."""
    name, end = (name[:-4], ".end") if name.lower().endswith(".end") else (name, "")
    bare = re.sub(r"[ .]+", "_", re.split(r"[:|]", name)[-1].strip().lower())
    return _PREFIX.sub("", bare) + end


def find_table(names: frozenset[str], *, coinciding: frozenset[str]) -> JointTable | None:
    """The first table of which ``names`` (plain, with end sites) has every joint, if any.

    ``coinciding``: joints with children at zero offset, which is how CMU's conversions are told
    from other files with their names.
    """
    for table in TABLES:
        if names.issuperset(table.targets) and (
            table.lost_thorax is None or table.lost_thorax in coinciding
        ):
            return table
    return None


@dataclass(frozen=True)
class JointMapping:
    """A user's table: ``targets`` are, in lsp14 order, the names whose mean the joint is."""

    name: str
    targets: tuple[tuple[str, ...], ...]


def read_mapping(path: Path) -> JointMapping:
    """Read a mapping file (.toml, else JSON); ``MocapError`` names the file and what it lacks."""
    kind = "TOML" if path.suffix.lower() == ".toml" else "JSON"
    try:
        text = path.read_text(encoding="utf-8-sig")
        given: Any = tomllib.loads(text) if kind == "TOML" else json.loads(text)
    except (OSError, ValueError) as error:
        raise MocapError(path, f"cannot be read as {kind}: {error}") from error
    if not isinstance(given, dict):
        raise MocapError(path, "must be an object from lsp14 joint to one or several names")
    missing = [joint for joint in LSP14.joint_names if joint not in given]
    unknown = sorted(set(given) - set(LSP14.joint_names))
    if missing or unknown:
        raise MocapError(
            path,
            f"joints missing: {', '.join(missing) or 'none'}; unknown: "
            f"{', '.join(unknown) or 'none'}; wanted are {', '.join(LSP14.joint_names)}",
        )
    targets = []
    for joint in LSP14.joint_names:
        names = given[joint] if isinstance(given[joint], list) else [given[joint]]
        if not names or not all(isinstance(name, str) for name in names):
            raise MocapError(path, f"{joint} must be a name or a list of names")
        targets.append(tuple(names))
    return JointMapping(name=path.name, targets=tuple(targets))
