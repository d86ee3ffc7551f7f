"""Human3.6M: its documented layout and the published skeleton of its 32 joints."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from cdflib import cdfwrite
from numpy.testing import assert_allclose

from library_store.anatomy import LENGTHS, Float, measure_lengths
from library_store.importers import MocapError, read
from library_store.importers.h36m import CAMERAS, camera_rotation
from library_store.skeleton import LSP14
from tests.library_store.importers.files import nested

# The skeleton that users of the data set publish (32 joints): parents and lengths in mm. The
# directions are ours: somebody who stands with the arms to the sides.
PARENTS = (
    *(-1, 0, 1, 2, 3, 4, 0, 6, 7, 8, 9, 0, 11, 12, 13, 14, 12),
    *(16, 17, 18, 19, 20, 19, 22, 12, 24, 25, 26, 27, 28, 27, 30),
)
BONES_MM: dict[int, tuple[float, float, float]] = {
    **{1: (-132.949, 0, 0), 2: (0, -442.895, 0), 3: (0, -454.206, 0), 4: (0, 0, 162.767)},
    **{6: (132.949, 0, 0), 7: (0, -442.894, 0), 8: (0, -454.207, 0), 9: (0, 0, 162.767)},
    **{12: (0, 233.383, 0), 13: (0, 257.078, 0), 14: (0, 121.135, 0), 15: (0, 115.002, 0)},
    **{16: (0, 257.078, 0), 17: (151.034, 0, 0), 18: (278.883, 0, 0), 19: (251.733, 0, 0)},
    **{24: (0, 257.078, 0), 25: (-151.031, 0, 0), 26: (-278.893, 0, 0), 27: (-251.729, 0, 0)},
}
PUBLISHED_MM = {
    **{"trunk": 490.5, "hips": 265.9, "shoulder": 151.0, "head": 236.1},
    **{"upper_arm": 278.9, "forearm": 251.7, "thigh": 442.9, "shank": 454.2},
}


def standing(n_frames: int = 60) -> Float:
    """(F, 32, 3) mm, Y up: the published skeleton, turning, arms to the sides."""
    joints = np.zeros((32, 3))
    for joint in range(1, 32):
        joints[joint] = joints[PARENTS[joint]] + BONES_MM.get(joint, (0.0, 0.0, 0.0))
    angle = np.linspace(0.0, 1.0, n_frames)
    turned = np.stack([joints] * n_frames)
    turned[..., 0] = joints[:, 0] * np.cos(angle)[:, None] + joints[:, 2] * np.sin(angle)[:, None]
    turned[..., 2] = joints[:, 2] * np.cos(angle)[:, None] - joints[:, 0] * np.sin(angle)[:, None]
    place = np.array([200.0, 940.0, -300.0])
    moved: Float = turned + place
    return moved


def in_world(y_up: Float) -> Float:
    """The data set's world has Z up."""
    world: Float = y_up[..., [0, 2, 1]] * (1.0, -1.0, 1.0)
    return world


def write_cdf(path: Path, poses: Float, variable: str = "Pose") -> Path:
    """(F, 32, D) as the release has it: one record (F, 32 D) of doubles."""
    path.parent.mkdir(parents=True, exist_ok=True)
    flat = poses.reshape(1, len(poses), -1)
    file = cdfwrite.CDF(str(path), cdf_spec={"Majority": "row_major"}, delete=True)
    spec = {
        **{"Variable": variable, "Data_Type": 45, "Num_Elements": 1, "Rec_Vary": True},
        **{"Var_Type": "zVariable", "Dim_Sizes": list(flat.shape[1:]), "Compress": 0},
    }
    file.write_var(spec, var_data=flat)
    file.close()
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "S9" / "MyPoseFeatures"


def test_world_poses(folder: Path) -> None:
    truth = standing()
    (clip,) = read(write_cdf(folder / "D3_Positions" / "Walking 1.cdf", in_world(truth)))
    assert (clip.name, clip.subject, clip.action) == ("S9_Walking_1", "S9", "Walking 1")
    assert clip.frame_rate_hz == 50.0
    assert clip.licence == "Human3.6M licence: academic use only"
    usual = np.median(measure_lengths(clip.positions_mm.astype(float)), axis=0)
    assert dict(zip(LENGTHS, usual.round(1).tolist(), strict=True)) == pytest.approx(
        PUBLISHED_MM, abs=0.2
    )
    heights = dict(zip(LSP14.joint_names, clip.positions_mm[0, :, 1], strict=True))
    assert heights["head_top"] > heights["neck"] > heights["r_hip"] > heights["r_ankle"]
    left, right = (clip.positions_mm[0, LSP14.index(f"{side}_wrist"), 0] for side in "lr")
    assert left > right, "the person faces +Z, so their left is at +x"


def test_the_common_npz_is_the_same_clip(folder: Path, tmp_path: Path) -> None:
    """Others pack the same 32 joints in metres."""
    truth = standing()
    (original,) = read(write_cdf(folder / "D3_Positions" / "Walking 1.cdf", in_world(truth)))
    values = (in_world(truth) / 1000.0).astype(np.float32)
    (packed,) = read(nested(tmp_path / "data_3d_h36m.npz", {"S9": {"Walking 1": values}}))
    assert_allclose(packed.positions_mm, original.positions_mm, atol=0.05)
    assert (packed.name, packed.subject) == (original.name, original.subject)


ANGLES = {("S9", CAMERAS[1]): (1.6, -0.04, 2.9), ("S1", CAMERAS[3]): (1.5, 0.3, -2.2)}


def metadata(path: Path) -> Path:
    """``metadata.xml``: w0 has 6 numbers a camera and subject, then 9 a camera."""
    w0 = np.zeros(6 * 4 * 11 + 9 * 4)
    for (subject, camera), angles in ANGLES.items():
        start = 6 * (CAMERAS.index(camera) * 11 + int(subject[1:]) - 1)
        w0[start : start + 3] = angles
    text = " ".join(f"{value:.6g}" for value in w0)
    path.write_text(f"<metadata><mapping/><w0>[{text}]</w0></metadata>")
    return path


def test_poses_of_a_camera_are_turned_upright(folder: Path, tmp_path: Path) -> None:
    truth = standing()
    rotation = camera_rotation(metadata(tmp_path / "metadata.xml"), "S9", CAMERAS[1])
    # Rx(a) Ry(b) Rz(c), by hand.
    (a, b, c) = ANGLES["S9", CAMERAS[1]]
    expected = (
        np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
        @ np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
        @ np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    )
    assert_allclose(rotation, expected, atol=1e-12)
    place = np.array([2000.0, -3000.0, 1500.0])
    seen = (in_world(truth) - place) @ rotation.T
    name = f"Walking 1.{CAMERAS[1]}.cdf"
    for features in ("D3_Positions_mono", "D3_Positions_mono_universal"):
        (clip,) = read(write_cdf(folder / features / name, seen))
        (world,) = read(write_cdf(folder / "D3_Positions" / "Walking 1.cdf", in_world(truth)))
        shift = world.positions_mm[0, 0] - clip.positions_mm[0, 0]
        assert_allclose(clip.positions_mm + shift, world.positions_mm, atol=0.05)
        assert clip.name == f"S9_Walking_1_{CAMERAS[1]}"
    (tmp_path / "metadata.xml").unlink()
    with pytest.raises(MocapError, match=r"need metadata\.xml"):
        read(folder / "D3_Positions_mono" / name)


@pytest.mark.parametrize("text", ["", "<a/>", "<a><w0>[1 2]</w0></a>", "<a><w0>[x]</w0></a>"])
def test_bad_metadata_is_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "metadata.xml"
    path.write_text(text)
    with pytest.raises(MocapError, match=r"metadata\.xml: no cameras of S9"):
        camera_rotation(path, "S9", CAMERAS[1])


def test_other_files_of_the_release_are_refused(folder: Path) -> None:
    with pytest.raises(MocapError, match=r"\(1, F, 96\)"):
        read(write_cdf(folder / "D2_Positions" / f"A.{CAMERAS[0]}.cdf", np.ones((5, 32, 2))))
    with pytest.raises(MocapError, match="'D3_Angles' does not hold 3D positions"):
        read(write_cdf(folder / "D3_Angles" / "A.cdf", standing()))
    with pytest.raises(MocapError, match="must end in one of 54138969"):
        read(write_cdf(folder / "D3_Positions_mono" / "A.cdf", standing()))
    with pytest.raises(MocapError, match="variable Pose"):
        read(write_cdf(folder / "D3_Positions" / "A.cdf", standing(), variable="Angles"))


def test_numbers_beyond_all_bounds_are_dropped_frames(folder: Path) -> None:
    poses = in_world(standing())
    poses[7] = 1e200
    poses[9, 3, 2] = np.nan
    (clip,) = read(write_cdf(folder / "D3_Positions" / "A.cdf", poses))
    assert "2 frames with missing joints dropped" in clip.findings
    assert 7 not in clip.frames
    assert 9 not in clip.frames


@pytest.mark.parametrize("keep", [0, 10, 400, 3_000])
def test_cut_files_are_refused(folder: Path, keep: int) -> None:
    path = write_cdf(folder / "D3_Positions" / "A.cdf", in_world(standing()))
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(MocapError, match=r"A\.cdf: not a CDF file"):
        read(path)


def test_without_the_extra_it_says_what_to_install(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_cdf(folder / "D3_Positions" / "A.cdf", in_world(standing()))
    monkeypatch.setitem(sys.modules, "cdflib", None)
    with pytest.raises(MocapError, match=r"posematch\[mocap\]"):
        read(path)
