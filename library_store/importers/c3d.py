"""C3D: the positions of markers in every frame, with names, units and axes among the parameters.

The marker sets of :mod:`library_store.importers.markers` are known; for others a mapping file says
which marker, or the mean of which markers, each joint is. A file may hold several people, told
apart by the prefix of their markers (``Ann:LFHD``): each becomes a clip. A mapping file may leave
the prefix out, and is for everybody then. Gaps of up to a tenth of a second are filled along
straight lines; frames with longer ones are dropped. Where the unit that a file states makes
nobody's size, it is found by the markers' distances, before joints are put beside them.

Reading needs ezc3d, of the extra ``mocap``. It crashes on some damaged files and therefore runs in
a process of its own, ``c3d_child``.
"""

from __future__ import annotations

import io
import re
import struct
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from library_store.importers.asf_amc import CMU_LICENCE, describe_cmu
from library_store.importers.checks import checked_or_error, unit_scale
from library_store.importers.clip import Clip, Float, MocapError, counted
from library_store.importers.joint_tables import JointMapping, read_mapping
from library_store.importers.markers import (
    MARKER_SETS,
    Sizes,
    fill_gaps,
    find_marker_set,
    joint_centres,
    markers_by_joint,
    sizes_from,
)
from library_store.importers.rotation import up_to_y

LONGEST_GAP_S = 0.1
TIMEOUT_S = 300.0

_MM_PER_UNIT = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4}
_CMU = MARKER_SETS[0].name
_MIPS = bytes([86])
"""The processor type of SGI's machines, whose numbers have their high byte first."""
_MANY = 65_535
"""The header cannot count further; longer files are not held against it. No rate is so high."""


@dataclass(frozen=True)
class C3dFile:
    """A parsed file: the tracks (F, 3) of each person's markers in mm, NaN where not seen.

    ``first`` is the first frame's number, ``up`` the axis that is up, e.g. "+Z", empty where the
    file does not say it; ``stated`` are numbers that Plug-in Gait leaves, the person's sizes.
    """

    people: dict[str, dict[str, Float]]
    first: int
    rate_hz: float
    up: str
    stated: dict[str, float]
    findings: tuple[str, ...]


def read(path: Path, *, mapping: Path | None = None) -> list[Clip | MocapError]:
    """The clips of a C3D file, one a person, or what is wrong with that person's.

    ``mapping`` is a table from joint to markers.
    """
    table = read_mapping(mapping) if mapping else None
    file = parse(path)
    clips: list[Clip | MocapError] = []
    left_out: list[str] = []
    for person, markers in file.people.items():
        named = _joints_of(person, markers, table, sizes_from(file.stated), file.rate_hz)
        if named is None:
            left_out += [person or "markers without a prefix"]
            continue
        joints, marker_set, findings = named
        subject = action = ""
        if marker_set == _CMU:
            subject, action, _, _ = describe_cmu(path)
        if file.up:
            joints = joints @ up_to_y(file.up).T
        clip = Clip(
            name=path.stem if len(file.people) == 1 else f"{path.stem}_{person}".rstrip("_"),
            subject=subject or person,
            action=action,
            frame_rate_hz=file.rate_hz,
            positions_mm=joints.astype(np.float32),
            frames=np.arange(file.first, file.first + len(joints), dtype=np.int64),
            findings=(f"markers: {marker_set}", *file.findings, *findings),
            licence=CMU_LICENCE if subject else "",
        )
        clips.append(checked_or_error(path, clip, up_is_known=bool(file.up)))
    if not clips:
        raise MocapError(path, _nobody_in(file, table))
    if left_out:
        finding = f"left out, not the markers of a person: {', '.join(left_out)}"
        clips = [
            replace(it, findings=(*it.findings, finding)) if isinstance(it, Clip) else it
            for it in clips
        ]
    return clips


def parse(path: Path) -> C3dFile:
    """Read a C3D file; ``MocapError`` where it is not a whole one or ezc3d is not installed."""
    if find_spec("ezc3d") is None:
        raise MocapError(
            path, "C3D files need ezc3d: install posematch with its extra, posematch[mocap]"
        )
    with path.open("rb") as file:
        first, last = _frame_range(path, file)
    found = _in_child(path)
    points, names = found["points"].astype(np.float64), found["names"].tolist()
    cut = last < _MANY and points.shape[1] != last + 1 - first
    if cut or len(names) < len(points) or not points.size:
        raise MocapError(
            path,
            f"not a whole C3D file: {last + 1 - first} frames announced, {points.shape[1]} found; "
            f"{len(points)} markers with {len(names)} names",
        )
    points[(points == 0.0).all(axis=-1)] = np.nan  # how some programs write what was not seen
    unit = str(found["unit"]).lower()
    findings = () if unit in _MM_PER_UNIT else (f"unit of length {unit!r}: mm assumed",)
    people: dict[str, dict[str, Float]] = {}
    for name, track in zip(names, points * _MM_PER_UNIT.get(unit, 1.0), strict=False):
        person, _, marker = name.rpartition(":")
        people.setdefault(person, {}).setdefault(marker.upper(), track)
    rate_hz, up = float(found["rate_hz"]), str(found["up"]).upper()
    return C3dFile(
        people=people,
        first=first,
        rate_hz=rate_hz if 0.0 < rate_hz < _MANY else float("nan"),
        up=up if re.fullmatch(r"[+-]?[XYZ]", up) else "",
        stated=dict(zip(found["stated"].tolist(), found["values"].tolist(), strict=True)),
        findings=findings,
    )


def _in_child(path: Path) -> dict[str, NDArray[Any]]:
    """What ``c3d_child`` finds in a file, or ``MocapError``."""
    command = [sys.executable, "-P", str(Path(__file__).with_name("c3d_child.py")), str(path)]
    try:
        child = subprocess.run(command, capture_output=True, timeout=TIMEOUT_S, check=True)
        with np.load(io.BytesIO(child.stdout), allow_pickle=False) as found:
            return {name: found[name] for name in found.files}
    except subprocess.TimeoutExpired as error:
        raise MocapError(path, f"not a whole C3D file: not read in {TIMEOUT_S:.0f} s") from error
    except subprocess.CalledProcessError as error:
        said = error.stderr.decode(errors="replace").strip().splitlines()
        reason = said[-1] if said and error.returncode > 0 else "ezc3d crashes on it"
        raise MocapError(path, f"not a whole C3D file: {reason}") from error


def _frame_range(path: Path, file: BinaryIO) -> tuple[int, int]:
    """Numbers of the first and last frame by the header, which ezc3d mends where a file is cut."""
    header = file.read(512)
    if len(header) < 512 or not header[0]:
        raise MocapError(path, "not a whole C3D file: it has no header")
    file.seek(512 * (header[0] - 1) + 3)
    if file.read(1) == _MIPS:
        raise MocapError(
            path, "has numbers as MIPS processors write them, which ezc3d does not read: convert it"
        )
    first, last = struct.unpack_from("<HH", header, 6)
    return first, last


def _nobody_in(file: C3dFile, table: JointMapping | None) -> str:
    """Which markers there are, and which were looked for."""
    there = ", ".join(f"{p}:{m}" if p else m for p, ms in file.people.items() for m in ms)
    if table is not None:
        wanted = ", ".join(name for it in table.targets for name in it)
        advice = f"{table.name} names {wanted}"
    else:
        known = "; ".join(f"{known.name} ({' '.join(known.markers)})" for known in MARKER_SETS)
        advice = (
            f"Known sets are {known}. Others need a mapping file: a JSON or TOML table from each "
            "joint to a marker or a list of markers"
        )
    return f"markers are {there[:500] or 'none'}. {advice}"


def _joints_of(
    person: str,
    markers: Mapping[str, Float],
    table: JointMapping | None,
    sizes: Sizes,
    rate_hz: float,
) -> tuple[Float, str, list[str]] | None:
    """Joints (F, 14, 3), the name of the set, findings; None where the markers are not those."""
    marker_set = find_marker_set(frozenset(markers))
    own: list[list[str]] = []
    if table is not None:
        prefix = f"{person}:".upper() if person else ""
        own = [[it.upper().removeprefix(prefix) for it in names] for names in table.targets]
        wanted, name = tuple(it for names in own for it in names), table.name
    elif marker_set is not None:
        wanted, name = marker_set.markers, marker_set.name
    else:
        return None
    if not set(wanted).issubset(markers):
        return None
    longest = round(LONGEST_GAP_S * rate_hz) if np.isfinite(rate_hz) else 0
    filled = {marker: fill_gaps(markers[marker], longest) for marker in wanted}
    n_filled = sum(
        int(np.isnan(markers[marker][:, 0]).sum() - np.isnan(filled[marker][:, 0]).sum())
        for marker in filled
    )
    findings = [f"{counted(n_filled, 'marker position')} in short gaps filled"] if n_filled else []
    if table is not None:
        means = [np.mean([filled[it] for it in names], axis=0) for names in own]
        return np.stack(means, axis=1), name, findings
    assert marker_set is not None
    beside = markers_by_joint(marker_set, filled)
    seen = beside[np.isfinite(beside).all(axis=(1, 2))]
    scale, finding = unit_scale(seen) if len(seen) else (None, "")
    if scale is not None and finding:
        findings.append(finding)
        filled = {marker: scale * track for marker, track in filled.items()}
    return joint_centres(marker_set, filled, sizes), name, findings
