from __future__ import annotations

import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from library_store.anatomy import Float, root_of
from library_store.importers import Clip, MocapError, read, read_all
from library_store.importers.h36m import H36M_32
from library_store.importers.npz import H36M_17, HUMANEVA_15, SMPL, states_licence, write
from library_store.skeleton import HEAD_TOP, LSP14, NECK
from tests.library_store.importers.files import nested, people

# The published joint orders, as names, to hold the index tables against.
H36M_NAMES = {
    **{0: "hip", 1: "r_hip", 2: "r_knee", 3: "r_ankle", 6: "l_hip", 7: "l_knee", 8: "l_ankle"},
    **{12: "spine", 13: "neck", 14: "nose", 15: "head_top", 17: "l_shoulder", 18: "l_elbow"},
    **{19: "l_wrist", 25: "r_shoulder", 26: "r_elbow", 27: "r_wrist"},
}
SMPL_NAMES = (
    *("pelvis", "l_hip", "r_hip", "spine1", "l_knee", "r_knee", "spine2", "l_ankle", "r_ankle"),
    *("spine3", "l_foot", "r_foot", "neck", "l_collar", "r_collar", "head"),
    *("l_shoulder", "r_shoulder", "l_elbow", "r_elbow", "l_wrist", "r_wrist"),
)
HUMANEVA_NAMES = (
    *("pelvis", "neck", "l_shoulder", "l_elbow", "l_wrist", "r_shoulder", "r_elbow", "r_wrist"),
    *("l_hip", "l_knee", "l_ankle", "r_hip", "r_knee", "r_ankle", "head_top"),
)


@pytest.fixture(scope="module")
def poses() -> Float:
    return people()


def spread(poses: Float, order: tuple[int, ...], n_joints: int) -> Float:
    """Poses in metres with Z up, on another skeleton."""
    joints = np.zeros((len(poses), n_joints, 3))
    joints[:, list(order)] = poses[..., [0, 2, 1]] * (0.001, -0.001, 0.001)
    return joints


def test_joint_orders_are_the_published_ones() -> None:
    assert tuple(H36M_NAMES[i] for i in H36M_32) == LSP14.joint_names
    assert tuple(H36M_NAMES[sorted(H36M_NAMES)[i]] for i in H36M_17) == LSP14.joint_names
    assert tuple(HUMANEVA_NAMES[i] for i in HUMANEVA_15) == LSP14.joint_names
    assert tuple(SMPL_NAMES[i] for i in SMPL) == ("head", *LSP14.joint_names[1:])


@pytest.mark.parametrize(
    ("order", "n_joints", "rate_hz"), [(H36M_32, 32, 50), (H36M_17, 17, 50), (HUMANEVA_15, 15, 60)]
)
def test_nested_positions(
    tmp_path: Path, poses: Float, order: tuple[int, ...], n_joints: int, rate_hz: float
) -> None:
    values = spread(poses, order, n_joints).astype(np.float32)
    path = nested(tmp_path / "data_3d.npz", {"S1": {"Walking 1": values, "Eating": values[:9]}})
    clips = read(path)
    assert [(c.name, c.subject, c.action) for c in clips] == [
        ("S1_Walking_1", "S1", "Walking 1"),
        ("S1_Eating", "S1", "Eating"),
    ]
    assert_allclose(clips[0].positions_mm, poses, atol=0.01)
    assert clips[0].frame_rate_hz == rate_hz
    assert "only" in clips[0].licence


def test_nested_positions_in_millimetres_are_seen_to_be_so(tmp_path: Path, poses: Float) -> None:
    values = 1000 * spread(poses, H36M_32, 32)
    values[0, 3] = np.nan
    (clip,) = read(nested(tmp_path / "data_3d.npz", {"S1": {"Walking": values}}))
    assert_allclose(clip.positions_mm, poses[1:], atol=0.01)
    assert any("millimetres" in finding for finding in clip.findings)


def test_a_clip_of_nobody_does_not_cost_the_others(tmp_path: Path, poses: Float) -> None:
    values = spread(poses, H36M_32, 32)
    clips = {"Eating": np.full_like(values, np.nan), "Walking": values, "Waiting": values * 3e-4}
    (clip,), skipped = read_all([nested(tmp_path / "data_3d.npz", {"S1": clips})])
    assert clip.action == "Walking"
    assert "clip 'S1_Eating' has no frame" in str(skipped[0])
    assert "clip 'S1_Waiting': trunk + thigh + shank is" in str(skipped[1])
    generic = tmp_path / "clips.npz"
    number = np.repeat([0, 1], len(poses))
    np.savez(generic, positions=np.concatenate([poses, np.nan * poses]), clip=number)
    (clip,), (error,) = read_all([generic])
    assert clip.name == "clips_0"
    assert "clip 'clips_1' has no frame" in str(error)


class _Evil:
    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.file,)


def test_foreign_code_is_not_run(tmp_path: Path) -> None:
    touched = tmp_path / "touched"
    path = nested(tmp_path / "evil.npz", {"S1": {"Walking": _Evil(touched)}})
    with pytest.raises(MocapError, match=r"evil\.npz.*which is not part of an array"):
        read(path)
    assert not touched.exists()
    with np.load(path, allow_pickle=True) as careless:
        careless["positions_3d"]
    assert touched.exists()


@pytest.mark.parametrize(
    "value", [3, {}, {"S1": {}}, {"S1": 4}, {"S1": {"a": np.zeros((5, 9, 3))}}, {"S1": {"a": "b"}}]
)
def test_nested_values_of_other_kinds_are_refused(tmp_path: Path, value: Any) -> None:
    with pytest.raises(MocapError, match=r"data\.npz"):
        read(nested(tmp_path / "data.npz", value))


def test_generic_files_are_written_and_read(tmp_path: Path, poses: Float) -> None:
    frames = np.arange(0, 160, 4)
    clips = [
        Clip("01_01", "cmu_01", "walk", 120.0, poses.astype(np.float32), frames, licence="free"),
        Clip("b", "", "", 60.0, poses[:5].astype(np.float32), frames[:5], ("a finding",), "own"),
    ]
    path = tmp_path / "clips.npz"
    write(path, clips)
    again = read(path)
    for clip, other in zip(clips, again, strict=True):
        for name in ("name", "subject", "action", "frame_rate_hz", "licence"):
            assert getattr(clip, name) == getattr(other, name)
        assert other.findings[: len(clip.findings)] == clip.findings
        assert_allclose(clip.positions_mm, other.positions_mm)
        assert_allclose(clip.frames, other.frames)
    with np.load(path) as held:  # nothing in it needs a pickle
        assert str(held["license"]) == "free; own"


def test_recordings_strung_together_are_not_taken_for_one(tmp_path: Path, poses: Float) -> None:
    """The second one would be lost: a library keeps each frame of a clip once."""
    path, frame = tmp_path / "two.npz", np.r_[np.arange(20), np.arange(20)]
    np.savez(path, positions=poses, frame=frame)
    with pytest.raises(MocapError, match=r"'two' has several poses under one .* clips of their"):
        read(path)
    np.savez(path, positions=poses, frame=frame, clip=np.repeat([0, 1], 20))
    assert [len(clip) for clip in read(path)] == [20, 20]
    np.savez(path, positions=np.r_[poses[:20], poses[:20]], frame=frame)
    assert len(read(path)[0]) == 40, "the same poses twice are no doubt which is which"


def test_strings_that_became_bytes_are_strings(tmp_path: Path, poses: Float) -> None:
    """On their way through HDF5, MATLAB or Python 2."""
    np.savez(
        tmp_path / "a.npz",
        positions=poses,
        joint_names=np.array(LSP14.joint_names, dtype=bytes),
        clip_name=np.array(["Läufer".encode()]),
        clip_fps=np.array([b"50"]),
        up_axis=np.array(b"Y"),
        license=np.array(b"CC0"),
    )
    (clip,) = read(tmp_path / "a.npz")
    assert_allclose(clip.positions_mm, poses, atol=0.01)
    assert (clip.name, clip.frame_rate_hz, clip.licence) == ("Läufer", 50.0, "CC0")


def test_a_clip_without_a_licence_does_not_get_that_of_another(
    tmp_path: Path, poses: Float
) -> None:
    positions, frames = poses.astype(np.float32), np.arange(len(poses))
    stated = Clip("a", "", "", 30.0, positions, frames, licence="free for all uses")
    path = tmp_path / "clips.npz"
    write(path, [stated, replace(stated, name="b", licence="")])
    assert [clip.licence for clip in read(path)] == ["free for all uses", ""]
    assert not states_licence(path)


def test_what_cannot_be_written_is_named(tmp_path: Path, poses: Float) -> None:
    frames = np.arange(len(poses))
    clip = Clip("a", "", "", 30.0, poses.astype(np.float32), frames)
    with pytest.raises(MocapError, match=r"no/clips\.npz: cannot be written"):
        write(tmp_path / "no" / "clips.npz", [clip])
    with pytest.raises(MocapError, match="no clips"):
        write(tmp_path / "clips.npz", [])
    assert list(tmp_path.iterdir()) == []


def test_a_single_clip_may_be_described_by_single_values(tmp_path: Path, poses: Float) -> None:
    np.savez(tmp_path / "a.npz", positions=poses, clip_name="walk", clip_fps=100)
    (clip,) = read(tmp_path / "a.npz")
    assert (clip.name, clip.frame_rate_hz) == ("walk", 100.0)


def test_generic_files_in_another_joint_order(tmp_path: Path, poses: Float) -> None:
    path = tmp_path / "other.npz"
    order = np.random.default_rng(0).permutation(14)
    names = np.array(LSP14.joint_names)[order]
    np.savez(path, positions=poses[:, order], joint_names=names, up_axis="Y")
    (clip,) = read(path)
    assert_allclose(clip.positions_mm, poses, atol=0.01)
    assert (clip.name, clip.subject) == ("other", "")
    np.savez(path, positions=poses, joint_names=np.array([*names[1:], "nose"]))
    with pytest.raises(MocapError, match="nose"):
        read(path)


@pytest.mark.parametrize(
    ("arrays", "problem"),
    [
        ({"positions": np.zeros((4, 13, 3))}, "wanted is"),
        ({"positions": np.zeros((0, 14, 3))}, "wanted is"),
        ({"positions": np.array(["a"])}, "numbers"),
        ({"positions": np.array(7)}, r"are \(\)"),
        ({"positions": np.ones((4, 14, 3)), "clip": np.zeros(3, int)}, "clip must be 4"),
        ({"positions": np.ones((4, 14, 3)), "frame": np.arange(4) - 1}, "no frame numbers"),
        ({"positions": np.ones((4, 14, 3)), "frame": np.arange(4) + 2**31}, "no frame numbers"),
        ({"positions": np.ones((4, 14, 3)), "clip_fps": np.array(["fast"])}, "clip_fps 'fast'"),
        ({"positions": np.ones((4, 14, 3)), "clip_name": np.array([["a"]])}, "one dimension"),
        (
            {
                "positions": np.ones((2, 14, 3)),
                "clip": np.arange(2),
                "clip_name": np.array(["a"]),
            },
            "not all named",
        ),
        ({"positions": np.ones((4, 14, 3)), "up_axis": np.array("N")}, "up_axis"),
        ({"joints": np.ones((4, 17, 3))}, "22 or more"),
        ({"poses": np.ones(3), "betas": np.ones(3)}, "body model"),
        ({"keypoints": np.ones(3)}, "has arrays keypoints"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, arrays: dict[str, Any], problem: str) -> None:
    path = tmp_path / "bad.npz"
    np.savez(path, **arrays)
    with pytest.raises(MocapError, match=problem) as caught:
        read(path)
    assert str(path) in str(caught.value)


def test_damaged_files_are_refused(tmp_path: Path, poses: Float) -> None:
    path = tmp_path / "bad.npz"
    np.savez(path, positions=poses)
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(MocapError, match="not an npz"):
        read(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("positions.npy", b"\x93NUMPY\x01\x00")
    with pytest.raises(MocapError, match="cannot be read"):
        read(path)


def test_a_gap_in_smpl_joints_costs_its_frames_only(tmp_path: Path, poses: Float) -> None:
    joints = spread(poses, SMPL, 24)
    np.savez(tmp_path / "whole.npz", joints=joints)
    joints[3] = np.nan
    np.savez(tmp_path / "gap.npz", joints=joints)
    (whole,), (gap,) = read(tmp_path / "whole.npz"), read(tmp_path / "gap.npz")
    assert gap.frames.tolist() == [frame for frame in range(len(poses)) if frame != 3]
    assert_allclose(gap.positions_mm, whole.positions_mm[gap.frames], atol=0.1)
    np.savez(tmp_path / "none.npz", joints=joints * np.nan)
    with pytest.raises(MocapError, match="has no frame with all 14 joints"):
        read(tmp_path / "none.npz")


def test_smpl_joints(tmp_path: Path, poses: Float) -> None:
    joints = spread(poses, SMPL, 24)
    neck, top = joints[:, SMPL[NECK]], joints[:, SMPL[HEAD_TOP]]
    joints[:, SMPL[HEAD_TOP]] = neck + 0.4 * (top - neck)  # the skull's base
    path = tmp_path / "stand.npz"
    np.savez(path, joints=joints, mocap_framerate=120.0)
    (clip,) = read(path)
    assert clip.frame_rate_hz == 120.0
    positions = clip.positions_mm.astype(float)
    assert_allclose(positions[:, 1:], poses[:, 1:], atol=0.01)
    trunk = np.linalg.norm(positions[:, NECK] - root_of(positions), axis=-1)
    head = np.linalg.norm(positions[:, HEAD_TOP] - positions[:, NECK], axis=-1)
    assert_allclose(head, 0.47 * trunk, rtol=1e-4)
    assert "head top" in clip.findings[0]
