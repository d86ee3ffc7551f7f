"""Which BVH joint is which of the 14, for the joint names that are in use.

A target is the name of a BVH joint, or ``<name>.end`` for its end site. Names are compared without
a namespace (``mixamorig:Hips`` is ``Hips``) and without regard to case. The first table of which
the file has every joint is taken. A user's own table is a JSON object from lsp14 joint to target.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

from library_store.importers.clip import MocapError
from library_store.skeleton import LSP14


@dataclass(frozen=True)
class JointTable:
    """Targets in lsp14 order, and what is known about files that use these names.

    mm_per_unit: None where files differ (the checks then find the unit by the person's size).
    lost_thorax: the joint whose children were moved onto it when the thorax bone was made zero
        long: those with zero offset get the length of the joint's own, the upper back's.
    wrist_stretch: elbow to wrist over the elbow to the joint named as the wrist.
    head_stretch: the same for the head's bone and the head top.
    is_cmu: the clip is one of CMU's: its name gives frame rate and action.
    """

    name: str
    targets: tuple[str, ...]
    mm_per_unit: float | None = None
    lost_thorax: str | None = None
    wrist_stretch: float = 1.0
    head_stretch: float = 1.0
    is_cmu: bool = False


def _table(name: str, head_top: str, neck: str, right: str, left: str, limbs: str) -> JointTable:
    """A table from the limbs' names (shoulder elbow wrist hip knee ankle), {} being the side."""
    names = limbs.split()
    sides = [[limb.format(side) for limb in names] for side in (right, left)]
    targets = (head_top, neck, *sides[0][:3], *sides[1][:3], *sides[0][3:], *sides[1][3:])
    return JointTable(name=name, targets=targets)


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
    _table(
        "MotionBuilder",
        *("head.end", "neck", "right", "left"),
        "{}arm {}forearm {}hand {}upleg {}leg {}foot",
    ),
    _table(
        "3ds Max",
        *("head.end", "neck", "right", "left"),
        "{}shoulder {}elbow {}wrist {}hip {}knee {}ankle",
    ),
    _table(
        "Unity humanoid",
        *("head.end", "neck", "right", "left"),
        "{}upperarm {}lowerarm {}hand {}upperleg {}lowerleg {}foot",
    ),
    _table(
        "Unreal mannequin",
        *("head.end", "neck_01", "r", "l"),
        "upperarm_{} lowerarm_{} hand_{} thigh_{} calf_{} foot_{}",
    ),
    _table(
        "Blender Rigify",
        *("spine.006.end", "spine.004", "r", "l"),
        "upper_arm.{} forearm.{} hand.{} thigh.{} shin.{} foot.{}",
    ),
    _table(
        "Blender",
        *("head.end", "neck", "r", "l"),
        "upper_arm.{} forearm.{} hand.{} thigh.{} shin.{} foot.{}",
    ),
    _table(
        "Poser, Daz",
        *("head.end", "neck", "r", "l"),
        "{}shldr {}forearm {}hand {}thigh {}shin {}foot",
    ),
)


def plain(name: str) -> str:
    """A BVH joint's name without namespace, in lower case."""
    return name.rsplit(":", 1)[-1].lower()


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


def read_mapping(path: Path) -> JointTable:
    """A user's table: a JSON object {lsp14 joint: BVH joint or "<joint>.end"}, all 14 of them."""
    try:
        given = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise MocapError(path, f"cannot be read as JSON: {error}") from error
    if not isinstance(given, dict) or not all(isinstance(v, str) for v in given.values()):
        raise MocapError(path, "must be an object from lsp14 joint to BVH joint")
    missing = [joint for joint in LSP14.joint_names if joint not in given]
    unknown = sorted(set(given) - set(LSP14.joint_names))
    if missing or unknown:
        raise MocapError(
            path,
            f"joints missing: {', '.join(missing) or 'none'}; unknown: "
            f"{', '.join(unknown) or 'none'}; wanted are {', '.join(LSP14.joint_names)}",
        )
    targets = tuple(plain(given[joint]) for joint in LSP14.joint_names)
    return JointTable(name=path.name, targets=targets)
