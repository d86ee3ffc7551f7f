"""CMU's own pair of files: ASF (a skeleton with its rest pose) and AMC (one clip of its motion).

A bone of the ASF has a direction and length at rest, and an ``axis``: Euler angles of the local
frame C in which the AMC's angles are given. With M the product of a bone's motion rotations, its
rotation in the world is W_child = W_parent C M C⁻¹, and its end is the parent's end plus
W direction · length. ``axis a b c XYZ`` is C = Rz(c) Ry(b) Rx(a), and so is M for ``dof rx ry rz``.

Lengths are in inches divided by the file's ``length`` unit, so 25.4 / 0.45 mm each for CMU, unless
that makes nobody's size. Joints are ends of bones: the neck is the end of ``lowerneck``, the wrist
that of ``lwrist`` (``lradius`` ends in the forearm, two thirds of the way from elbow to wrist). The
bone ``head`` ends inside the skull: the head top is 1.6 of its length from its start, as in the
prior's data. Y is up.
"""

from __future__ import annotations

import codecs
import csv
import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from library_store.importers.checks import checked, unit_that_fits
from library_store.importers.clip import Clip, Float, Frames, MocapError, counted
from library_store.importers.rotation import euler
from library_store.skeleton import HEAD_TOP

MM_PER_INCH = 25.4
CMU_LICENCE = (
    "CMU Graphics Lab mocap database (mocap.cs.cmu.edu), free for all uses; "
    "funded by NSF EIA-0196217"
)

JOINTS: tuple[str, ...] = (
    "head",
    "lowerneck",
    "rclavicle",
    "rhumerus",
    "rwrist",
    "lclavicle",
    "lhumerus",
    "lwrist",
    "rhipjoint",
    "rfemur",
    "rtibia",
    "lhipjoint",
    "lfemur",
    "ltibia",
)
"""The bone whose end is the joint, in lsp14 order; the head top is beyond that of ``head``."""

HEAD_STRETCH = 1.6
"""Start of the bone ``head`` to the top of the head, over the bone's length."""

SUBJECTS_60_HZ = frozenset((33, 34, 42, 60, 61, 62, 74, 75, 77, 79, 80, 87, 88, 89))
"""CMU subjects recorded at 60 Hz; the others are at 120 Hz. (One clip of 136 is at 60 Hz.)"""

INDEX_FILE = "cmu_index.csv"
"""Looked for beside the clip and in the three folders above: actions and frame rates by clip."""

_CMU_NAME = re.compile(r"(?P<subject>[0-9]{2,3})_(?P<number>[0-9]{2})(?:-.*)?")
_CMU_SUBJECTS = 144

_DEGREES_PER = {"deg": 1.0, "degrees": 1.0, "rad": math.degrees(1.0), "radians": math.degrees(1.0)}
_NO_BONE = "root"
_ROOT_ORDER = ("tx", "ty", "tz", "rx", "ry", "rz")


@dataclass(frozen=True)
class Bone:
    """A bone at rest: ``offset`` (3,) from its parent's end to its own, in the file's units."""

    parent: str
    offset: Float
    frame: Float
    dof: tuple[str, ...]


@dataclass(frozen=True)
class SkeletonFile:
    """An ASF: bones by name, parents before children, and how the root moves.

    ``degrees_per_angle`` is the unit of its angles, and of an AMC's that states none.
    """

    bones: dict[str, Bone]
    root_order: tuple[str, ...]
    root_axes: str
    root_frame: Float
    mm_per_unit: float
    degrees_per_angle: float


def read(path: Path) -> Clip:
    """The clip of an AMC file, by the ASF in the same folder."""
    asf = read_asf(find_skeleton(path))
    frames, motion = read_amc(path, asf)
    ends = bone_ends(asf, motion)
    missing = [name for name in JOINTS if name not in ends]
    if missing:
        raise MocapError(path, f"the skeleton has no bones {', '.join(missing)}")
    joints = np.stack([ends[name] for name in JOINTS], axis=1)
    start = ends[asf.bones["head"].parent]
    joints[:, HEAD_TOP] = start + HEAD_STRETCH * (joints[:, HEAD_TOP] - start)
    subject, action, rate, findings = describe_cmu(path)
    clip = Clip(
        name=path.stem,
        subject=subject,
        action=action,
        frame_rate_hz=rate,
        positions_mm=(joints * unit_that_fits(joints, asf.mm_per_unit)).astype(np.float32),
        frames=frames,
        findings=findings,
        licence=CMU_LICENCE if subject else "",
    )
    return checked(path, clip, up_is_known=True, bones_are_known=True)


def find_skeleton(path: Path) -> Path:
    """The ASF of an AMC: the one its name begins with, or the only one in the folder.

    ``10.asf`` is that of ``10_01.amc``, not of ``105_01.amc``, which may lie beside it.
    """
    here = sorted(
        p
        for p in path.parent.iterdir()
        if p.suffix.lower() == ".asf" and not p.name.startswith("._")  # macOS' own
    )
    named = [p for p in here if re.match(rf"{re.escape(p.stem)}(?![A-Za-z0-9])", path.stem)]
    if len(named) != 1 and len(here) != 1:
        found = ", ".join(p.name for p in here) or "none"
        raise MocapError(path, f"its ASF skeleton must lie in the same folder; found: {found}")
    return named[0] if len(named) == 1 else here[0]


def describe_cmu(path: Path) -> tuple[str, str, float, tuple[str, ...]]:
    """Subject, action, frame rate and findings of a clip named as CMU's are: ``02_01``, ``143_42``.

    Neither AMC files nor CMU's conversions to BVH can be trusted on the rate, so it comes from the
    index file if there is one, else from the list of subjects at 60 Hz.
    """
    named = _CMU_NAME.fullmatch(path.stem)
    # Others name files by numbers too, such as dates: those are not CMU's to be free for all uses.
    if named is None or not 1 <= int(named["subject"]) <= _CMU_SUBJECTS:
        finding = "the file does not say its frame rate and its name is not CMU's: 120 Hz assumed"
        return "", "", 120.0, (finding,)
    subject, number = named["subject"], named["number"]
    for folder in list(path.resolve().parents)[:4]:
        row = _index_row(folder / INDEX_FILE, int(subject), int(number))
        if row is not None:
            return f"cmu_{subject}", row[0], row[1], ()
    rate = 60.0 if int(subject) in SUBJECTS_60_HZ else 120.0
    finding = f"frame rate {rate:.0f} Hz from the list of CMU subjects"
    return f"cmu_{subject}", "", rate, (finding,)


def _index_row(index: Path, subject: int, number: int) -> tuple[str, float] | None:
    if not index.is_file():
        return None
    with index.open(encoding="utf-8", errors="replace", newline="") as lines:
        for row in csv.reader(lines):
            if row[:2] == [str(subject), str(number)] and len(row) > 3:
                try:
                    return row[2], float(row[3])
                except ValueError:
                    return None
    return None


def read_asf(path: Path) -> SkeletonFile:
    """Parse an ASF file; ``MocapError`` says what is missing."""
    try:
        sections = _sections(_text(path))
        units = {words[0]: words[1] for words in sections["units"]}
        degrees = _DEGREES_PER[units.get("angle", "deg").lower()]
        length = float(units["length"])
        if not 0.0 < length < math.inf:
            raise ValueError(f"length {length}")
        root = {words[0]: words[1:] for words in sections["root"]}
        parents = {child: words[0] for words in sections["hierarchy"] for child in words[1:]}
        seen = [_NO_BONE]
        for child, parent in parents.items():
            if parent not in seen:
                raise ValueError(f"bone {child} hangs on {parent}, which is not above it")
            seen.append(child)
        at_rest = {bone["name"][0]: bone for bone in _blocks(sections["bonedata"])}
        bones = {name: _bone(at_rest[name], parent, degrees) for name, parent in parents.items()}
        orientation = degrees * np.array([float(v) for v in root["orientation"]])
        axes = root["axis"][0].lower()
        order = tuple(word.lower() for word in root["order"])
        if sorted(order) != sorted(_ROOT_ORDER) or sorted(axes) != ["x", "y", "z"]:
            raise ValueError(f"root with order {order} and axis {axes}")
        return SkeletonFile(
            bones=bones,
            root_order=order,
            root_axes=axes,
            root_frame=euler(axes[::-1], orientation[::-1]),
            mm_per_unit=MM_PER_INCH / length,
            degrees_per_angle=degrees,
        )
    except KeyError as error:
        raise MocapError(path, f"not a whole ASF skeleton: it has no {error}") from error
    except IndexError as error:
        raise MocapError(path, "not a whole ASF skeleton: a line ends too soon") from error
    except ValueError as error:
        raise MocapError(path, f"not a whole ASF skeleton: {error}") from error


def _text(path: Path) -> str:
    return path.read_bytes().removeprefix(codecs.BOM_UTF8).decode("latin-1")


def _bone(block: dict[str, list[str]], parent: str, degrees: float) -> Bone:
    direction = np.array([float(v) for v in block["direction"][:3]])
    *angles, axes = block["axis"]
    axes = axes.lower()
    dof = tuple(word.lower() for word in block.get("dof", ()))
    if len(angles) != 3 or direction.shape != (3,) or not {"rx", "ry", "rz"}.issuperset(dof):
        raise ValueError(f"bone {block['name'][0]}: direction, axis or dof {dof}")
    return Bone(
        parent=parent,
        offset=direction * float(block["length"][0]),
        frame=euler(axes[::-1], degrees * np.array([float(v) for v in angles])[::-1]),
        dof=dof,
    )


def _sections(text: str) -> dict[str, list[list[str]]]:
    sections: dict[str, list[list[str]]] = {}
    current: list[list[str]] = []
    for line in text.splitlines():
        words = line.split("#")[0].split()
        if words and words[0].startswith(":"):
            current = sections.setdefault(words[0][1:].lower(), [])
        elif words and words != ["begin"]:
            current.append(words)
    for name in ("hierarchy", "root", "units"):
        sections[name] = [words for words in sections[name] if words != ["end"]]
    return sections


def _blocks(lines: list[list[str]]) -> list[dict[str, list[str]]]:
    blocks: list[dict[str, list[str]]] = [{}]
    for words in lines:
        if words == ["end"]:
            blocks.append({})
        else:
            blocks[-1][words[0]] = words[1:]
    return [block for block in blocks if block]


def read_amc(path: Path, asf: SkeletonFile) -> tuple[Frames, dict[str, Float]]:
    """Frame numbers (F,) and, by bone, values (F, n) in the order of its degrees of freedom.

    Angles are in degrees, whichever unit the file has.
    """
    widths = {name: len(bone.dof) for name, bone in asf.bones.items() if bone.dof}
    widths[_NO_BONE] = len(asf.root_order)
    frames: list[int] = []
    values: dict[str, list[list[float]]] = {name: [] for name in widths}
    degrees = asf.degrees_per_angle
    for number, line in enumerate(_text(path).splitlines(), 1):
        words = line.split("#")[0].split()
        if not words or words[0].startswith(":"):
            degrees = _DEGREES_PER.get(words[0][1:].lower(), degrees) if words else degrees
            continue
        try:
            if len(words) == 1:
                frames.append(int(words[0]))
            elif words[0] not in widths:
                raise ValueError("its skeleton has no such bone, or none that turns")
            elif len(words) - 1 != widths[words[0]] or not frames:
                raise ValueError(f"{counted(widths[words[0]], 'value')} expected")
            else:
                values[words[0]].append([float(word) for word in words[1:]])
                if len(values[words[0]]) != len(frames):
                    raise ValueError("the bone is missing in a frame before, or is here twice")
        except ValueError as error:
            raise MocapError(path, f"line {number}: {line.strip()!r}: {error}") from error
    short = [name for name, rows in values.items() if len(rows) != len(frames)]
    if not frames or short:
        raise MocapError(path, f"{len(frames)} frames, not all with values for {short or 'a bone'}")
    motion = {name: degrees * np.array(rows, dtype=np.float64) for name, rows in values.items()}
    places = [i for i, name in enumerate(asf.root_order) if name.startswith("t")]
    motion[_NO_BONE][:, places] /= degrees
    return np.array(frames, dtype=np.int64), motion


def bone_ends(asf: SkeletonFile, motion: dict[str, Float]) -> dict[str, Float]:
    """Ends of all bones (F, 3) in the world, in the file's units."""
    root = motion[_NO_BONE]
    columns = {name: root[:, i] for i, name in enumerate(asf.root_order)}
    place = np.stack([columns[name] for name in ("tx", "ty", "tz")], axis=-1)
    turns = [f"r{axis}" for axis in asf.root_axes]
    angles = np.stack([columns[name] for name in reversed(turns)], axis=-1)
    turned = asf.root_frame @ euler(asf.root_axes[::-1], angles) @ asf.root_frame.T
    ends, world = {_NO_BONE: place}, {_NO_BONE: turned}
    for name, bone in asf.bones.items():
        spin = world[bone.parent]
        if bone.dof:
            axes = "".join(dof[1] for dof in reversed(bone.dof))
            local = euler(axes, motion[name][:, ::-1])
            spin = spin @ bone.frame @ local @ bone.frame.T
        world[name] = spin
        ends[name] = ends[bone.parent] + spin @ bone.offset
    return ends
