"""Finding Human3.6M, HumanEva and CMU in a user's folders; the scenes of the paper's protocols.

``DIR`` may hold, at any depth,

* ``data_3d_h36m.npz``, or the authors' own ``S*/MyPoseFeatures/D3_Positions/*.cdf`` (also
  ``D3_Positions_mono``, ``..._mono_universal``, and folders ``Poses_D3_...``);
* ``metadata.xml`` of the authors' code release: the real cameras. Without it four virtual ones
  stand around the person, and videos cannot be used;
* ``S*/Videos/*.mp4``, for the rows with 2D from the photo;
* ``data_3d_humaneva15.npz`` (any ``data_3d_humaneva*.npz``).

Whatever is not there is said in the report, and the tables that need it are left out.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from app.lifting.geometry import Floats
from app.lifting.types import Intrinsics
from evaluation.paper.published import ACTIONS, HUMANEVA_ACTIONS
from evaluation.paper.views import Scene, SceneCamera, virtual_cameras
from library_store.importers.clip import Clip, MocapError
from library_store.importers.h36m import CAMERAS, METADATA, N_SUBJECTS, camera_rotation
from library_store.importers.reader import read_all
from library_store.importers.rotation import up_to_y

H36M_NPZ, HUMANEVA_NPZ = "data_3d_h36m.npz", "data_3d_humaneva*.npz"
CDF_FOLDERS = ("D3_Positions", "D3_Positions_mono", "D3_Positions_mono_universal")
P1_TRAIN, P1_TEST = ("S1", "S5", "S6", "S7", "S8", "S9"), ("S11",)
P2_TRAIN, P2_TEST = ("S1", "S5", "S6", "S7", "S8"), ("S9", "S11")
CMU_HELD_OUT = ("05", "35", "49", "131", "135")

_H36M_COLUMNS = {
    **{"directions": "Direction", "discussion": "Discuss", "eating": "Eat", "greeting": "Greet"},
    **{"phoning": "Phone", "posing": "Pose", "purchases": "Purchase", "sitting": "Sit"},
    **{"sittingdown": "SitDown", "smoking": "Smoke", "photo": "Photo", "takingphoto": "Photo"},
    **{"waiting": "Wait", "walking": "Walk", "walkdog": "WalkDog", "walkingdog": "WalkDog"},
    **{"walktogether": "WalkPair"},
}
_HUMANEVA_COLUMNS = {
    **{"walking": "Walk", "jog": "Jog", "throwcatch": "ThrowCatch", "gestures": "Gestures"},
    **{"box": "Box"},
}
_CMU_COLUMNS = (
    *(("dance", "Dance"), ("cartwheel", "Cartwheel"), ("acrobatics", "Acrobatics")),
    *(("heian", "Karate"), ("balance", "Balance"), ("run", "Run"), ("jump", "Jump")),
    *(("hop", "Jump"), ("walk", "Walk")),
)
"""The first word that an action of CMU's held-out subjects has."""

_NEITHER_TRAINED_NOR_TESTED = "expmap"
"""``cmu_expmap_skel`` is several actors on one skeleton, maybe the held-out ones too."""
_FOCAL_NUMBERS = 9
"""Per camera, after the extrinsics: f (2), c (2), distortion (5)."""


@dataclass
class Found:
    """What a folder holds: scenes by subject, and what is missing or left out, in words.

    ``noticed``: what the importer assumed, mended or dropped, and in how many clips.
    """

    scenes: list[Scene] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    noticed: list[str] = field(default_factory=list)
    columns: tuple[str, ...] = ()
    real_cameras: bool = False

    def of(self, subjects: Iterable[str]) -> list[Scene]:
        """The scenes of some subjects."""
        wanted = set(subjects)
        return [scene for scene in self.scenes if scene.clip.subject in wanted]

    @property
    def subjects(self) -> set[str]:
        """Who is there."""
        return {scene.clip.subject for scene in self.scenes}


def find_h36m(root: Path) -> Found:
    """Human3.6M under ``root``; nothing but words in ``missing`` where it is not there."""
    found = Found(columns=ACTIONS)
    clips = _h36m_clips(root, found)
    metadata = next(iter(sorted(root.rglob(METADATA))), None)
    if clips and metadata is None:
        found.missing.append(
            f"{METADATA} (the cameras): four virtual cameras stand around the person instead"
        )
    found.real_cameras = metadata is not None
    rng = np.random.default_rng(0)
    for clip in clips:
        column = h36m_column(clip.action)
        if column is None:
            found.missing.append(f"action {clip.action!r}: not in the paper, left out")
            continue
        try:
            cameras = virtual_cameras(rng) if metadata is None else h36m_cameras(metadata, clip)
        except (MocapError, ValueError) as error:
            found.missing.append(f"{clip.name}: {error}")
            continue
        found.scenes.append(Scene(clip, column, cameras))
    if clips:
        for subject in sorted(set(P1_TRAIN + P1_TEST) - found.subjects):
            found.missing.append(f"Human3.6M subject {subject}")
    return found


def h36m_column(action: str) -> str | None:
    """The paper's name of an action of Human3.6M, however it is spelt; None if it has none."""
    return _H36M_COLUMNS.get(_bare(action))


def h36m_cameras(metadata: Path, clip: Clip) -> tuple[SceneCamera, ...]:
    """The four real cameras of a clip's subject, or the one whose frame its poses were in.

    Those poses were turned upright by the importer, the camera stayed their origin. The two focal
    lengths of a camera, which differ by 0.1%, become their mean; lens distortion is left out.
    """
    numbers = _w0(metadata)
    own = next((serial for serial in CAMERAS if clip.name.endswith(f"_{serial}")), None)
    cameras = []
    for index, serial in enumerate(CAMERAS):
        if own not in (None, serial):
            continue
        start = 6 * (index * N_SUBJECTS + int(clip.subject.removeprefix("S")) - 1)
        place = numbers[start + 3 : start + 6] if own is None else np.zeros(3)
        lens = 6 * N_SUBJECTS * len(CAMERAS) + _FOCAL_NUMBERS * index
        focal, centre = numbers[lens : lens + 2], numbers[lens + 2 : lens + 4]
        to_y = up_to_y("+Z")
        cameras.append(
            SceneCamera(
                serial,
                camera_rotation(metadata, clip.subject, serial) @ to_y.T,
                to_y @ place,
                Intrinsics(float(focal.mean()), (float(centre[0]), float(centre[1])), "request"),
            )
        )
    return tuple(cameras)


def find_humaneva(root: Path) -> Found:
    """HumanEva-I under ``root``: the validation part where the file says which that is."""
    found = Found(columns=HUMANEVA_ACTIONS)
    files = sorted(root.rglob(HUMANEVA_NPZ))
    if not files:
        found.missing.append(f"HumanEva-I: no {HUMANEVA_NPZ} under {root}")
        return found
    clips = _read(files[:1], found)
    validation = [clip for clip in clips if clip.subject.lower().startswith("validate")]
    rng = np.random.default_rng(0)
    for clip in validation or clips:
        column = _HUMANEVA_COLUMNS.get(_bare(clip.action))
        if column is not None:
            found.scenes.append(Scene(clip, column, virtual_cameras(rng)[:3]))
    if not found.scenes:
        found.missing.append(f"{files[0]}: none of {', '.join(HUMANEVA_ACTIONS)}")
    return found


def find_cmu(mocap: Path, held_out: Sequence[str] = CMU_HELD_OUT) -> tuple[Found, tuple[str, ...]]:
    """CMU's poses (generic npz, ``library_store.importers.npz``), and who is held out of them."""
    found = Found()
    rng = np.random.default_rng(0)
    for clip in _read([mocap], found):
        if _NEITHER_TRAINED_NOR_TESTED in clip.subject:
            continue
        action = clip.action.lower()
        column = next((name for word, name in _CMU_COLUMNS if word in action), "Other")
        found.scenes.append(Scene(clip, column, virtual_cameras(rng)))
    test = tuple(f"cmu_{number}" for number in held_out)
    found.missing += [f"CMU subject {name}" for name in test if name not in found.subjects]
    present = {scene.action for scene in found.of(test)}
    found.columns = tuple(dict.fromkeys(n for _, n in _CMU_COLUMNS if n in present))
    found.columns += ("Other",) if "Other" in present else ()
    return found, test


def _h36m_clips(root: Path, found: Found) -> list[Clip]:
    packed = sorted(root.rglob(H36M_NPZ))
    if packed:
        return _read(packed[:1], found)
    for features in CDF_FOLDERS:
        files = [
            path
            for path in sorted(root.rglob("*.cdf"))
            if path.parent.name.removeprefix("Poses_") == features
        ]
        if files:
            return _read(files, found)
    found.missing.append(f"Human3.6M: no {H36M_NPZ} and no {CDF_FOLDERS[0]}/*.cdf under {root}")
    return []


def _read(files: Sequence[Path], found: Found) -> list[Clip]:
    """The clips of all files; files and clips that cannot be read are said to be missing."""
    clips, skipped = read_all(files)
    found.missing += map(str, skipped)
    findings = Counter(finding for clip in clips for finding in clip.findings)
    found.noticed += [f"{finding} (clips: {n})" for finding, n in findings.items()]
    return clips


def _w0(metadata: Path) -> Floats:
    """All numbers of the cameras; ``MocapError`` when there are too few."""
    try:
        text = ElementTree.parse(metadata).getroot().findtext("w0", "")
        numbers = np.array(text.strip().strip("[]").split(), dtype=np.float64)
    except (OSError, ElementTree.ParseError, ValueError) as error:
        raise MocapError(metadata, f"no cameras can be read: {error}") from error
    needed = len(CAMERAS) * (6 * N_SUBJECTS + _FOCAL_NUMBERS)
    if len(numbers) < needed:
        raise MocapError(metadata, f"w0 has {len(numbers)} numbers, {needed} are needed")
    return numbers


def _bare(action: str) -> str:
    """The action without camera, number and part: ``WalkingDog 1`` -> walkingdog."""
    name = re.split(r"[ ._]\d|[ ._]chunk", action)[0]
    return re.sub(r"[^a-z]", "", name.lower())
