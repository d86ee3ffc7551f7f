"""Frames of Human3.6M's videos with its own 2D poses, as the paper trained on.

The layout is that of the authors' archives, unpacked side by side::

    ROOT/S1/MyPoseFeatures/D2_Positions/Walking 1.54138969.cdf   Pose (1, F, 64): 32 joints, pixels
    ROOT/S1/Videos/Walking 1.54138969.mp4                        the same frames, 50 Hz

An ``.npz`` with an array ``Pose`` of (F, 64) or (F, 32, 2) may stand for the ``.cdf``, whose
reading needs cdflib, of the extra ``mocap``.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from library_store.importers.h36m import H36M_32
from models.errors import AnnotationError
from models.training.dataset import Image, LabelledCrop
from models.training.users_coco import cut_out

FEATURES, VIDEOS = Path("MyPoseFeatures") / "D2_Positions", "Videos"
FRAMES_APART = 25
"""Half a second: closer frames show the same pose again."""
VISIBLE = 2
"""Positions come from markers: whether a joint is hidden is not known, it is taken for seen."""


def read_human36m(
    root: Path, subjects: tuple[str, ...] = (), frames_apart: int = FRAMES_APART
) -> list[LabelledCrop]:
    """Every ``frames_apart``-th frame of every clip, grouped by take.

    A take is what several cameras filmed at once: the same poses, of which one may not be held out
    while another is trained on. ``subjects`` (S1, S5, ...) default to all there are. Raises
    ``AnnotationError`` when a clip has no video, or one of other length, and when one of the
    subjects, or anybody at all, has no clip.
    """
    folders = sorted(path for path in root.glob(f"S*/{FEATURES}") if path.is_dir())
    clips = sorted(
        file
        for folder in folders
        if not subjects or folder.parents[1].name in subjects
        for file in folder.iterdir()
        if file.suffix in {".cdf", ".npz"}
    )
    missing = sorted(set(subjects) - {clip.parents[2].name for clip in clips})
    if missing or not clips:
        raise AnnotationError(
            f"{root}: no {FEATURES}/*.cdf or *.npz in a folder "
            f"{' or '.join(missing) or 'S1, S5, ...'}; unpack Human3.6M's archives there"
        )
    crops = []
    takes: dict[tuple[Path, str], int] = {}
    for clip in clips:
        group = takes.setdefault(
            (clip.parent, clip.stem.rpartition(".")[0] or clip.stem), len(takes)
        )
        video = clip.parents[2] / VIDEOS / f"{clip.stem}.mp4"
        if not video.is_file():
            raise AnnotationError(f"{clip}: its video {video} is missing")
        poses = _poses(clip)
        for index, image in _frames(video, len(poses), frames_apart):
            points = np.concatenate(
                [poses[index, H36M_32], np.full((len(H36M_32), 1), VISIBLE)], axis=1
            )
            crops.append(cut_out(f"{clip.stem}/{index}", group, image, points))
    return crops


def _poses(path: Path) -> NDArray[np.float64]:
    """(F, 32, 2) pixels."""
    if path.suffix == ".npz":
        try:
            with path.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
                values = np.asarray(arrays["Pose"], np.float64)
        except Exception as error:  # a reader of foreign bytes fails in every way
            raise AnnotationError(f"{path}: no array Pose can be read: {error!r}") from error
    else:
        try:
            from cdflib import CDF
        except ImportError as error:
            raise AnnotationError(
                f"{path}: CDF files need cdflib: install posematch with its extra, posematch[mocap]"
            ) from error
        try:
            values = np.asarray(CDF(path).varget("Pose"), np.float64)
        except Exception as error:  # a reader of foreign bytes fails in every way
            raise AnnotationError(f"{path}: no CDF file with a variable Pose: {error!r}") from error
    if values.size == 0 or (values.shape[-1:] != (64,) and values.shape[-2:] != (32, 2)):
        raise AnnotationError(
            f"{path}: Pose is {values.shape}; wanted is (F, 64), 32 joints in pixels. "
            "3D positions are for 'posematch library import'"
        )
    poses: NDArray[np.float64] = values.reshape(-1, 32, 2)
    if not np.isfinite(poses).all():
        raise AnnotationError(f"{path}: Pose has values that are no numbers")
    return poses


def _frames(video: Path, n_poses: int, apart: int) -> Iterator[tuple[int, Image]]:
    """Every ``apart``-th frame that has a pose."""
    capture = cv2.VideoCapture(str(video))
    try:
        index = 0
        while index < n_poses and capture.grab():
            if index % apart == 0:
                ok, frame = capture.retrieve()
                if not ok:
                    break
                yield index, np.asarray(frame, np.uint8)
            index += 1
    finally:
        capture.release()
    # The authors' files differ by a frame or two at the end.
    if index < n_poses - 5:
        raise AnnotationError(
            f"{video}: can be read up to frame {index} only, but has {n_poses} poses"
        )
