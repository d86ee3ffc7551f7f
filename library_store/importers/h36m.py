"""Human3.6M as its authors distribute it: CDF files of poses, and the cameras' ``metadata.xml``.

A file holds one zVariable ``Pose``, (1, F, 96): 32 joints of x, y, z in mm at 50 Hz. The folder it
lies in says what it is: ``<subject>/MyPoseFeatures/<features>``, or ``<subject>/Poses_<features>``
as some tools unpack the archives.

* ``D3_Positions``: in the world, Z up.
* ``D3_Positions_mono``, ``D3_Positions_mono_universal``: in the frame of a camera, whose number is
  in the file's name (``Walking 1.54138969.cdf``), OpenCV axes; the latter on one skeleton for all.
  They are turned upright with the camera's rotation from ``metadata.xml`` of the authors' code
  release, which must lie in the file's folder or one above.

In ``metadata.xml`` the element ``w0`` holds, camera by camera and subject by subject (S1 to S11),
six numbers: angles a, b, c in radians and the camera's place T in mm, so that
X_camera = R (X_world - T) with R = Rx(a) Ry(b) Rz(c). Intrinsics follow and are not needed here.
Other files of the release (2D positions, angles) are refused.

Reading needs cdflib, of the extra ``mocap``.
"""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from library_store.importers.checks import checked
from library_store.importers.clip import Clip, Float, MocapError
from library_store.importers.rotation import euler, up_to_y

H36M_32 = (15, 13, 25, 26, 27, 17, 18, 19, 1, 2, 3, 6, 7, 8)
"""Index of each lsp14 joint among the 32. The neck is 13, where the shoulders meet."""

H36M_HZ = 50.0
H36M_LICENCE = "Human3.6M licence: academic use only"
METADATA = "metadata.xml"
CAMERAS = ("54138969", "55011271", "58860488", "60457274")
"""Serial numbers in the files' names, in the order of ``w0``."""
N_SUBJECTS = 11

_WORLD = "D3_Positions"
_CAMERA = ("D3_Positions_mono", "D3_Positions_mono_universal")


def read(path: Path) -> Clip:
    """The clip of a CDF file of 3D positions."""
    features = path.parent.name.removeprefix("Poses_")
    poses = _poses(path)
    subject = next((part for part in reversed(path.parts) if re.fullmatch(r"S\d{1,2}", part)), "")
    action, _, camera = path.stem.partition(".")
    findings = [f"Human3.6M {features}: mm"]
    positions = poses[:, H36M_32]
    if features in _CAMERA:
        if camera not in CAMERAS or not subject:
            raise MocapError(
                path,
                f"poses in a camera's frame: the file's name must end in one of "
                f"{', '.join(CAMERAS)} and lie in its subject's folder, S1 to S11",
            )
        rotation = camera_rotation(_metadata(path), subject, camera)
        # Row vectors: X_world = R' X_camera, up to the camera's place.
        positions = positions @ rotation
        findings.append(f"turned upright by camera {camera} of {METADATA}")
    elif features != _WORLD:
        raise MocapError(
            path, f"folder {features!r} does not hold 3D positions: {', '.join((_WORLD, *_CAMERA))}"
        )
    clip = Clip(
        name="_".join(filter(None, (subject, action.replace(" ", "_"), camera))),
        subject=subject,
        action=action,
        frame_rate_hz=H36M_HZ,
        positions_mm=(positions @ up_to_y("+Z").T).astype(np.float32),
        frames=np.arange(len(positions), dtype=np.int64),
        findings=tuple(findings),
        licence=H36M_LICENCE,
    )
    return checked(path, clip, up_is_known=True, bones_are_known=True)


def camera_rotation(metadata: Path, subject: str, camera: str) -> Float:
    """R (3, 3) of X_camera = R (X_world - T) for a subject S1..S11 and a camera's serial number."""
    try:
        text = ElementTree.parse(metadata).getroot().findtext("w0", "")
        numbers = np.array(text.strip().strip("[]").split(), dtype=np.float64)
        start = 6 * (CAMERAS.index(camera) * N_SUBJECTS + int(subject.removeprefix("S")) - 1)
        angles = numbers[start : start + 3]
        if len(angles) != 3 or not np.isfinite(angles).all():
            raise ValueError(f"w0 has {numbers.size} numbers")
    except (OSError, ElementTree.ParseError, ValueError) as error:
        raise MocapError(metadata, f"no cameras of {subject} can be read: {error}") from error
    return euler("xyz", np.rad2deg(angles))


def _metadata(path: Path) -> Path:
    for folder in path.resolve().parents:
        if (folder / METADATA).is_file():
            return folder / METADATA
    raise MocapError(
        path,
        f"poses in a camera's frame need {METADATA} of Human3.6M's code release in the same folder "
        f"or one above; the files of {_WORLD} need none",
    )


def _poses(path: Path) -> Float:
    """``Pose`` of a CDF file as (F, 32, 3)."""
    try:
        from cdflib import CDF
    except ImportError as error:
        raise MocapError(
            path, "CDF files need cdflib: install posematch with its extra, posematch[mocap]"
        ) from error
    if not path.is_file():
        raise FileNotFoundError(2, "No such file", str(path))
    try:
        values = np.asarray(CDF(path).varget("Pose"), dtype=np.float64)
    except Exception as error:  # a reader of foreign bytes fails in every way
        raise MocapError(path, f"not a CDF file with a variable Pose: {error!r}") from error
    if values.size == 0 or values.shape[-1] != 96:
        raise MocapError(path, f"Pose is {values.shape}; wanted is (1, F, 96), 32 joints in 3D")
    return values.reshape(-1, 32, 3)
