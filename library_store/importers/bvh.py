"""BVH: a hierarchy of joints with offsets, and per frame the channels that move them.

A joint's rotation is the product of its rotation channels in the order listed, relative to its
parent, and turns the offsets of its children; position channels replace the joint's own offset,
except where all they ever say is zero: programs that add them to the offset write that.
Each ROOT with a person's joints is a person, and becomes a clip.
Offsets have no stated unit. CMU's two conversions are known (``joint_tables``): their unit, where
that makes a person, the thorax and wrist bones they lost, and the T-pose that one of them puts
before the first frame.
Root-centred joints then agree with ASF/AMC of the same clip within 7 mm (0.3 to 4 mm on the mean,
eleven clips of four people): thoraxes are not quite as long as upper backs.
"""

from __future__ import annotations

import codecs
import math
import re
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from library_store.importers.asf_amc import CMU_LICENCE, describe_cmu
from library_store.importers.checks import checked_or_error, unit_that_fits
from library_store.importers.clip import Clip, Float, MocapError, counted
from library_store.importers.head import HEAD_PER_TRUNK, put_head_top
from library_store.importers.joint_tables import (
    JointMapping,
    JointTable,
    find_table,
    plain,
    read_mapping,
)
from library_store.importers.rotation import euler
from library_store.skeleton import HEAD_TOP, L_WRIST, LSP14, R_WRIST

_ZERO = 1e-6

_MOTION = re.compile(
    r"^[ \t]*MOTION\s+Frames\s*:\s*(?P<frames>\S+)\s+Frame\s+Time\s*:\s*(?P<time_s>\S+)",
    re.IGNORECASE | re.MULTILINE,
)
_BRACE = re.compile(r"[{}]")


@dataclass(frozen=True)
class Joint:
    """A joint or end site: its parent's number (-1: none), offset (3,) and channels."""

    name: str
    parent: int
    offset: Float
    channels: tuple[str, ...]


@dataclass(frozen=True)
class BvhFile:
    """A parsed file: joints, parents before children, and ``motion`` (F, all channels).

    ``frame_time_s`` is 0 where the file has none, as single poses do.
    """

    joints: tuple[Joint, ...]
    motion: Float
    frame_time_s: float

    def index(self, name: str) -> int:
        """Number of the joint with the plain name ``name``."""
        return next(i for i, joint in enumerate(self.joints) if plain(joint.name) == name)


def read(path: Path, *, mapping: Path | None = None) -> list[Clip | MocapError]:
    """The clips of a BVH file, one a person, or what is wrong with that person's.

    ``mapping`` is a table for joint names that are not known.
    """
    bvh = parse(path)
    given = read_mapping(mapping) if mapping else None
    people: list[BvhFile] = []
    left_out: list[str] = []
    for tree in split(bvh):
        if _is_person(tree, given):
            people.append(tree)
        else:
            left_out.append(tree.joints[0].name)
    findings = [f"left out, not the joints of a person: {', '.join(left_out)}"] if left_out else []
    if not people:  # the joints of one person may hang on several roots; else it says what it lacks
        people, findings = [bvh], []
    numbers = [""] if len(people) == 1 else [f"_{n}" for n in range(1, len(people) + 1)]
    return [
        _clip(path, path.stem + number, person, given, findings)
        for number, person in zip(numbers, people, strict=True)
    ]


def _clip(
    path: Path, name: str, bvh: BvhFile, mapping: JointMapping | None, noticed: list[str]
) -> Clip | MocapError:
    """The clip of one person, with what was ``noticed`` of the file among its findings."""
    if mapping is not None:
        table = JointTable(name=mapping.name, targets=())
        positions, findings = _mapped(path, bvh, mapping), list[str]()
    else:
        table = _table_for(path, bvh)
        positions, findings = _by_table(bvh, table)
    mm_per_unit = unit_that_fits(positions, table.mm_per_unit or 1.0)
    frames = np.arange(len(positions), dtype=np.int64)
    rate = 1.0 / bvh.frame_time_s if bvh.frame_time_s else math.nan
    subject = action = ""
    if table.is_cmu:
        subject, action, known_rate, notes = describe_cmu(path)
        if subject:
            findings += notes
        if subject and not abs(known_rate - rate) <= 1.0:
            said = "no rate" if math.isnan(rate) else f"{rate:.0f} Hz"
            findings.append(f"the file says {said}, CMU's index {known_rate:.0f}: the latter")
            rate = known_rate
    if math.isnan(rate):
        findings.append("a frame time of 0: the frame rate is not known")
    clip = Clip(
        name=name,
        subject=subject,
        action=action,
        frame_rate_hz=round(rate, 3),
        positions_mm=(positions * mm_per_unit).astype(np.float32),
        frames=frames,
        findings=(f"joint names: {table.name}", *findings, *noticed),
        licence=CMU_LICENCE if subject else "",
    )
    return checked_or_error(path, clip, up_is_known=table.is_cmu, bones_are_known=table.is_cmu)


def parse(path: Path) -> BvhFile:
    """Parse a BVH file; ``MocapError`` says where it is not one."""
    text = _text(path)
    motion = _MOTION.search(text)
    if motion is None or text.lstrip()[:9].upper() != "HIERARCHY":
        raise MocapError(
            path, "not a BVH file: HIERARCHY and MOTION with Frames and Frame Time expected"
        )
    try:
        joints = _parse_hierarchy(_BRACE.sub(r" \g<0> ", text[: motion.start()]).split()[1:])
        n_frames, frame_time_s = int(motion["frames"]), float(motion["time_s"])
        values = np.array(text[motion.end() :].split(), dtype=np.float64)
    except (IndexError, StopIteration) as error:
        raise MocapError(path, "not a whole BVH file: its braces do not match") from error
    except ValueError as error:
        raise MocapError(path, f"not a whole BVH file: {error}") from error
    width = sum(len(joint.channels) for joint in joints)
    if n_frames < 1 or values.size != n_frames * width:
        raise MocapError(
            path,
            f"{counted(n_frames, 'frame')} of {width} channels expected, "
            f"{counted(values.size, 'value')} found",
        )
    if not 0.0 <= frame_time_s < math.inf:
        raise MocapError(path, f"a frame time of {frame_time_s:g} s is none")
    if frame_time_s > 1.0:
        raise MocapError(
            path,
            f"a frame time of {frame_time_s:g} s is too long; if it is frames a second, "
            f"write {1 / frame_time_s:.6g}",
        )
    return _without_idle_places(
        BvhFile(tuple(joints), values.reshape(n_frames, width), frame_time_s)
    )


def _text(path: Path) -> str:
    """What a BVH file says, in UTF-8 as programs write it today, or in Latin-1 as older ones do.

    UTF-16, which Windows' editors call Unicode, is told by its byte order mark.
    """
    content = path.read_bytes()
    is_utf16 = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        text = content.decode("utf-16" if is_utf16 else "utf-8-sig")
    except UnicodeDecodeError as error:
        if is_utf16:
            raise MocapError(path, f"begins as UTF-16 text, but is none: {error.reason}") from error
        text = content.decode("latin-1")
    return text.replace("\r", "\n")


def _parse_hierarchy(words: list[str]) -> list[Joint]:
    joints: list[Joint] = []
    open_joints: list[int] = []
    tokens = iter(words)
    for token in tokens:
        keyword = token.upper()
        if keyword in ("ROOT", "JOINT", "END"):
            name = next(tokens)
            parent = open_joints[-1] if open_joints else -1
            if keyword == "END":
                name = f"{joints[parent].name}.end"
            while (brace := next(tokens)) != "{":  # names may have spaces
                name += f" {brace}"
            open_joints.append(len(joints))
            joints.append(Joint(name, parent, np.zeros(3), ()))
        elif keyword == "OFFSET":
            offset = np.array([float(next(tokens)) for _ in range(3)])
            joints[open_joints[-1]] = replace(joints[open_joints[-1]], offset=offset)
        elif keyword == "CHANNELS":
            # A list: running out of words ends a generator with another error.
            channels = tuple([next(tokens).lower() for _ in range(int(next(tokens)))])
            known = {f"{axis}{kind}" for axis in "xyz" for kind in ("position", "rotation")}
            if not known.issuperset(channels):
                raise ValueError(f"unknown channels {channels}")
            joints[open_joints[-1]] = replace(joints[open_joints[-1]], channels=channels)
        elif token == "}":
            open_joints.pop()
        else:
            raise ValueError(f"unexpected {token!r}")
    if open_joints or not joints:
        raise ValueError("the hierarchy does not end")
    return joints


def _without_idle_places(bvh: BvhFile) -> BvhFile:
    """The file without position channels, below the root, that are zero in every frame."""
    joints: list[Joint] = []
    kept: list[int] = []
    column = 0
    for joint in bvh.joints:
        columns = range(column, column + len(joint.channels))
        column += len(joint.channels)
        named = list(zip(joint.channels, columns, strict=True))
        turns = [(channel, at) for channel, at in named if channel.endswith("rotation")]
        places = [at for channel, at in named if channel.endswith("position")]
        if joint.parent >= 0 and not bvh.motion[:, places].any():
            named = turns
        joints.append(replace(joint, channels=tuple(channel for channel, _ in named)))
        kept += [at for _, at in named]
    return replace(bvh, joints=tuple(joints), motion=bvh.motion[:, kept])


def world_positions(bvh: BvhFile) -> Float:
    """Positions (F, joints, 3) of all joints and end sites, in the file's units."""
    n_frames = len(bvh.motion)
    places = np.empty((n_frames, len(bvh.joints), 3))
    turns: list[Float] = []
    column = 0
    for i, joint in enumerate(bvh.joints):
        values = bvh.motion[:, column : column + len(joint.channels)]
        column += len(joint.channels)
        offset = np.broadcast_to(joint.offset, (n_frames, 3)).copy()
        spins = [k for k, channel in enumerate(joint.channels) if channel.endswith("rotation")]
        for k, channel in enumerate(joint.channels):
            if channel.endswith("position"):
                offset[:, "xyz".index(channel[0])] = values[:, k]
        turn = euler("".join(joint.channels[k][0] for k in spins), values[:, spins])
        if joint.parent < 0:
            places[:, i] = offset
            turns.append(turn)
        else:
            parent = turns[joint.parent]
            places[:, i] = places[:, joint.parent] + np.einsum("fij,fj->fi", parent, offset)
            turns.append(parent @ turn)
    return places


def split(bvh: BvhFile) -> list[BvhFile]:
    """The hierarchies of a file, each as a file of its own."""
    starts = [i for i, joint in enumerate(bvh.joints) if joint.parent < 0]
    trees: list[BvhFile] = []
    column = 0
    for start, end in pairwise([*starts, len(bvh.joints)]):
        joints = bvh.joints[start:end]
        width = sum(len(joint.channels) for joint in joints)
        trees.append(
            BvhFile(
                joints=tuple(replace(it, parent=max(it.parent - start, -1)) for it in joints),
                motion=bvh.motion[:, column : column + width],
                frame_time_s=bvh.frame_time_s,
            )
        )
        column += width
    return trees


def _is_person(bvh: BvhFile, mapping: JointMapping | None) -> bool:
    return not _missing(bvh, mapping) if mapping else _known_table(bvh) is not None


def _missing(bvh: BvhFile, mapping: JointMapping) -> list[str]:
    """The joints that a user's table names and a file does not have."""
    wanted = {plain(name) for targets in mapping.targets for name in targets}
    return sorted(wanted.difference(plain(joint.name) for joint in bvh.joints))


def _mapped(path: Path, bvh: BvhFile, mapping: JointMapping) -> Float:
    """The joints (F, 14, 3) that a user's table names."""
    if missing := _missing(bvh, mapping):
        raise MocapError(path, f"has no joints {', '.join(missing)}, which {mapping.name} names")
    names = [plain(joint.name) for joint in bvh.joints]
    wanted = [[plain(name) for name in targets] for targets in mapping.targets]
    joints = world_positions(bvh)
    return np.stack([joints[:, [names.index(n) for n in t]].mean(axis=1) for t in wanted], axis=1)


def _by_table(bvh: BvhFile, table: JointTable) -> tuple[Float, list[str]]:
    """The joints (F, 14, 3) of a known table, with what the conversion lost put back; findings."""
    bvh, findings = restore_thorax(bvh, table)
    joints = world_positions(bvh)
    numbers = [bvh.index(target) for target in table.targets]
    positions = joints[:, numbers]
    for joint, stretch in (
        (HEAD_TOP, table.head_stretch),
        (R_WRIST, table.wrist_stretch),
        (L_WRIST, table.wrist_stretch),
    ):
        start = joints[:, bvh.joints[numbers[joint]].parent]
        positions[:, joint] = start + stretch * (positions[:, joint] - start)
    if table.wrist_stretch != 1.0:
        findings.append("wrist bones, half as long as the radius, put back")
    if table.head_is_base:
        positions, _ = put_head_top(positions)
        findings.append(f"head top at {HEAD_PER_TRUNK} of the trunk beyond the neck assumed")
    return positions, findings


def _known_table(bvh: BvhFile) -> JointTable | None:
    named = [(plain(joint.name), joint) for joint in bvh.joints]
    names = frozenset(name for name, _ in named)
    # An end site of no length, as MotionBuilder writes them, ends no bone: not a head's either.
    names -= {name for name, joint in named if name.endswith(".end") and _is_zero(joint)}
    return find_table(names, coinciding=_coinciding(bvh))


def _table_for(path: Path, bvh: BvhFile) -> JointTable:
    found = _known_table(bvh)
    if found is None:
        listed = ", ".join(joint.name for joint in bvh.joints)
        raise MocapError(
            path,
            f"joint names not known: {listed}. Give a mapping file, a JSON or TOML table from each "
            f"of {', '.join(LSP14.joint_names)} to one of these names, or a list of them",
        )
    return found


def _coinciding(bvh: BvhFile) -> frozenset[str]:
    """Joints with an offset, below the root, with children that lie where they do."""
    parents = [bvh.joints[j.parent] for j in bvh.joints if j.parent > 0 and _is_zero(j)]
    return frozenset(plain(parent.name) for parent in parents if parent.offset.any())


def _is_zero(joint: Joint) -> bool:
    moves = any(channel.endswith("position") for channel in joint.channels)
    return not moves and bool(np.abs(joint.offset).max() < _ZERO)


def restore_thorax(bvh: BvhFile, table: JointTable) -> tuple[BvhFile, list[str]]:
    """The file with the thorax that the conversion lost put back, and a finding on it."""
    if table.lost_thorax is None:
        return bvh, []
    back = bvh.index(table.lost_thorax)
    # As long as the upper back, and straight up at rest, as thoraxes in CMU's skeletons are.
    offset = np.array([0.0, float(np.linalg.norm(bvh.joints[back].offset)), 0.0])
    joints = tuple(
        replace(joint, offset=offset) if joint.parent == back and _is_zero(joint) else joint
        for joint in bvh.joints
    )
    finding = f"thorax above {bvh.joints[back].name}, as long as the upper back, put back"
    return replace(bvh, joints=joints), [finding]
