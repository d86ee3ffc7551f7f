"""Where the poses of a library come from, pose by pose.

Poses lie in groups, each ascending in its frames:

- ``mocap``: frames of one clip, as captured or mirrored;
- ``composed``: legs of one frame under the upper body of another, which ``parts.npy`` names;
- ``sampled``: draws from a pose prior.

``sources.json`` lists the groups and the clips that groups and parts refer to; ``frames.npy`` holds
each pose's frame in its clip, or its number among the composed or sampled ones.
"""

from __future__ import annotations

import json
import re
from bisect import bisect_right
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Kind = Literal["mocap", "composed", "sampled"]
PartName = Literal["legs", "upper_body"]

SOURCES_FILE, FRAMES_FILE, PARTS_FILE = "sources.json", "frames.npy", "parts.npy"

NAME_PATTERN = re.compile(r"[A-Za-z0-9._~-]+")
"""What names of libraries, clips and priors are made of, so that exemplar ids are URL-safe."""

MIRRORED = "~mirrored"
"""Ends the name of a mirrored clip's group. Clips' own names have no ``~``."""

PART_NAMES: tuple[PartName, ...] = ("legs", "upper_body")
"""In ``parts.npy``'s order; that is (composed poses, 2, 3) int32: clip number, frame, mirrored."""


@dataclass(frozen=True)
class SourceClip:
    """A clip: its name in ids, who and what it shows, and its licences' numbers in the manifest."""

    name: str
    subject: str = ""
    action: str = ""
    licences: tuple[int, ...] = ()


@dataclass(frozen=True)
class SourceGroup:
    """A run of poses of one clip, of one composition or one prior, in ascending order of frame.

    ``clip`` and ``mirrored`` are a mocap group's; ``first_part`` is the row of ``parts.npy`` of a
    composed group's first pose. ``licences`` are numbers in the manifest's list: a composed group
    has those of all clips it may draw from; each of its poses those of its parts.
    """

    kind: Kind
    name: str
    first_pose: int
    n_poses: int
    licences: tuple[int, ...] = ()
    clip: int | None = None
    mirrored: bool = False
    first_part: int | None = None


@dataclass(frozen=True)
class Part:
    """A part of a composed pose: which, and the frame of the clip that it was taken from."""

    name: PartName
    clip: str
    frame: int
    mirrored: bool


@dataclass(frozen=True)
class Source:
    """Where a pose comes from.

    ``kind`` ``mocap``: ``clip``, ``frame``, ``mirrored``, and ``subject`` and ``action`` as far as
    known; ``composed``: ``index``, the number of the composition, and ``parts``; ``sampled``:
    ``prior`` and ``index``, the number of the sample. The other fields are None or empty.
    ``licences`` are numbers in the manifest's list.
    """

    kind: Kind
    clip: str | None = None
    frame: int | None = None
    prior: str | None = None
    index: int | None = None
    mirrored: bool = False
    subject: str = ""
    action: str = ""
    parts: tuple[Part, ...] = ()
    licences: tuple[int, ...] = ()


class Sources:
    """All sources of a library. ``frames`` (P,) and ``parts`` (n, 2, 3) may be memory-mapped."""

    def __init__(
        self,
        groups: Sequence[SourceGroup],
        clips: Sequence[SourceClip],
        frames: NDArray[np.int32],
        parts: NDArray[np.int32],
    ) -> None:
        self.groups, self.clips = tuple(groups), tuple(clips)
        self.frames, self.parts = frames, parts
        self._firsts = [group.first_pose for group in self.groups]
        self._by_name = {(group.kind, group.name): group for group in self.groups}
        if len(self._by_name) != len(self.groups) or self._firsts != sorted(self._firsts):
            raise ValueError("groups of poses have the same name or are out of order")

    def of(self, pose: int) -> Source:
        """Where pose number ``pose`` comes from."""
        group = self._group_of(pose)
        frame = int(self.frames[pose])
        if group.kind == "sampled":
            return Source("sampled", prior=group.name, index=frame, licences=group.licences)
        if group.kind == "composed":
            assert group.first_part is not None
            rows = self.parts[group.first_part + pose - group.first_pose].tolist()
            parts = tuple(
                Part(name, self.clips[clip].name, number, bool(mirrored))
                for name, (clip, number, mirrored) in zip(PART_NAMES, rows, strict=True)
            )
            licences = sorted({number for row in rows for number in self.clips[row[0]].licences})
            return Source("composed", index=frame, parts=parts, licences=tuple(licences))
        assert group.clip is not None
        clip = self.clips[group.clip]
        return Source(
            "mocap",
            clip=clip.name,
            frame=frame,
            mirrored=group.mirrored,
            subject=clip.subject,
            action=clip.action,
            licences=group.licences,
        )

    def name_of(self, pose: int) -> str:
        """``<kind>:<group>:<frame>``, the middle of the ids of the pose's exemplars."""
        group = self._group_of(pose)
        return f"{group.kind}:{group.name}:{int(self.frames[pose])}"

    def find(self, kind: str, name: str, frame: int) -> int:
        """The pose of that group and frame; ``KeyError`` where there is none."""
        group = self._by_name[kind, name]  # type: ignore[index]
        frames = self.frames[group.first_pose : group.first_pose + group.n_poses]
        at = int(np.searchsorted(frames, frame))
        if at == len(frames) or frames[at] != frame:
            raise KeyError(frame)
        return group.first_pose + at

    def counts(self) -> dict[Kind, int]:
        """How many poses there are of each kind."""
        kinds: tuple[Kind, ...] = ("mocap", "composed", "sampled")
        sizes = {kind: sum(g.n_poses for g in self.groups if g.kind == kind) for kind in kinds}
        return {kind: size for kind, size in sizes.items() if size}

    def _group_of(self, pose: int) -> SourceGroup:
        return self.groups[bisect_right(self._firsts, pose) - 1]


def write_sources(path: Path, groups: Sequence[SourceGroup], clips: Sequence[SourceClip]) -> None:
    """Write ``sources.json``."""
    content = {"groups": [asdict(it) for it in groups], "clips": [asdict(it) for it in clips]}
    text = json.dumps(content, ensure_ascii=False) + "\n"
    path.write_text(text, encoding="utf-8", errors="replace")  # names of files may be any bytes


def read_sources(path: Path, frames: NDArray[np.int32], parts: NDArray[np.int32]) -> Sources:
    """Read ``sources.json``; raises ``ValueError``, ``TypeError`` or ``KeyError`` if it is none."""
    content = json.loads(path.read_text(encoding="utf-8"))

    def with_tuples(fields: dict[str, Any]) -> dict[str, Any]:
        return fields | {"licences": tuple(fields["licences"])}

    return Sources(
        groups=tuple(SourceGroup(**with_tuples(fields)) for fields in content["groups"]),
        clips=tuple(SourceClip(**with_tuples(fields)) for fields in content["clips"]),
        frames=frames,
        parts=parts,
    )


def unique_name(wanted: str, taken: Collection[str]) -> str:
    """A clip's name as ids can have it: URL-safe, without ``~``, and not among ``taken``."""
    name = re.sub(r"[^A-Za-z0-9._-]+", "_", wanted).strip("_") or "clip"
    candidate, number = name, 2
    while candidate in taken:
        candidate, number = f"{name}-{number}", number + 1
    return candidate


def moved(
    group: SourceGroup,
    *,
    poses: int,
    parts: int,
    clips: int = 0,
    licences: Sequence[int] | None = None,
) -> SourceGroup:
    """A group behind so many other ``poses``, ``parts`` and ``clips``.

    ``licences`` are the new numbers of its licences, where they change.
    """
    return replace(
        group,
        first_pose=group.first_pose + poses,
        first_part=None if group.first_part is None else group.first_part + parts,
        clip=None if group.clip is None else group.clip + clips,
        licences=group.licences
        if licences is None
        else tuple(licences[number] for number in group.licences),
    )
