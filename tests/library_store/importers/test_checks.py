from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from library_store.anatomy import Float, root_of, unit
from library_store.importers import Clip, MocapError
from library_store.importers.checks import MAX_SPEED_MM_S, MM_PER_UNIT, checked
from library_store.skeleton import (
    L_ELBOW,
    L_KNEE,
    L_WRIST,
    LSP14,
    NECK,
    R_ELBOW,
    R_KNEE,
    R_WRIST,
)
from tests.library_store.importers.files import people

FILE = Path("some.npz")


def clip_of(positions: Float, rate_hz: float = 60.0) -> Clip:
    return Clip(
        name="some",
        subject="",
        action="",
        frame_rate_hz=rate_hz,
        positions_mm=positions.astype(np.float32),
        frames=np.arange(len(positions)),
    )


@pytest.fixture(scope="module")
def standing() -> Float:
    """A person who stands with bent knees, so that all checks have something to look at."""
    for seed in range(200):
        poses = people(seed=seed)
        stance = poses[:, NECK] - 0.5 * (poses[:, 10] + poses[:, 13])
        upright = stance[0, 1] / np.linalg.norm(stance[0]) > 0.97
        knees = [0.5 * (poses[0, k - 1] + poses[0, k + 1]) - poses[0, k] for k in (R_KNEE, L_KNEE)]
        if upright and min(np.linalg.norm(knee) for knee in knees) > 60.0:
            return poses
    raise AssertionError("the prior has nobody who stands with bent knees")


def test_sound_poses_pass_unchanged(standing: Float) -> None:
    clip = checked(FILE, clip_of(standing))
    assert clip.findings == ()
    assert_allclose(clip.positions_mm, standing, rtol=1e-6, atol=1e-3)


@pytest.mark.parametrize("unit", MM_PER_UNIT)
def test_units_are_found_by_the_persons_size(standing: Float, unit: str) -> None:
    clip = checked(FILE, clip_of(standing / MM_PER_UNIT[unit]))
    assert_allclose(clip.positions_mm, standing, rtol=1e-4, atol=0.1)
    assert any(unit in finding for finding in clip.findings)


@pytest.mark.parametrize("factor", [0.3, 3.0, 1e-9, 1e5, 0.0])
def test_a_size_that_no_unit_explains_is_refused(standing: Float, factor: float) -> None:
    with pytest.raises(MocapError, match=r"some\.npz.*no person's"):
        checked(FILE, clip_of(standing * factor))


@pytest.mark.parametrize(
    ("order", "sign", "name"),
    [
        ((0, 2, 1), (1, -1, 1), r"\+Z"),
        ((0, 1, 2), (1, -1, -1), "-Y"),
        ((0, 2, 1), (1, 1, -1), "-Z"),
        ((1, 0, 2), (1, -1, 1), r"\+X"),
    ],
)
def test_another_up_axis_is_turned(
    standing: Float, order: tuple[int, ...], sign: tuple[int, ...], name: str
) -> None:
    clip = checked(FILE, clip_of(standing[..., list(order)] * sign))
    positions = clip.positions_mm.astype(float)
    assert any("turned so that Y is up" in finding for finding in clip.findings)
    assert_allclose(
        (positions - root_of(positions)[:, None])[..., 1],
        (standing - root_of(standing)[:, None])[..., 1],
        atol=0.1,
    )
    assert not any("exchanged" in finding for finding in clip.findings), name


def test_somebody_lying_is_believed_where_the_file_says_y_is_up(standing: Float) -> None:
    lying = standing[..., [0, 2, 1]] * (1, -1, 1)
    clip = checked(FILE, clip_of(lying), up_is_known=True)
    assert_allclose(clip.positions_mm, lying, atol=0.1)
    assert any("left as it is" in finding for finding in clip.findings)


def test_swapped_sides_are_exchanged(standing: Float) -> None:
    clip = checked(FILE, clip_of(standing[:, LSP14.mirror]))
    assert clip.findings == ("the knees bend backwards: left and right exchanged",)
    assert_allclose(clip.positions_mm, standing, atol=0.1)


def test_somebody_who_sits_and_bends_down_to_the_feet_keeps_their_sides() -> None:
    """Knees stick out upwards then, and away from the chest."""
    left = {
        "shoulder": (180, 700, 430),
        "elbow": (200, 430, 480),
        "wrist": (160, 200, 520),
        "hip": (90, 480, 0),
        "knee": (130, 500, 420),
        "ankle": (130, 80, 400),
    }
    places = {f"l_{name}": place for name, place in left.items()}
    places |= {f"r_{name}": (-x, y, z) for name, (x, y, z) in left.items()}
    places |= {"neck": (0, 720, 460), "head_top": (0, 780, 720)}
    pose = np.array([places[name] for name in LSP14.joint_names], dtype=float)
    seated = pose + np.linspace(0.0, 100.0, 40)[:, None, None]
    clip = checked(FILE, clip_of(seated), up_is_known=True)
    assert_allclose(clip.positions_mm, seated, atol=0.1)
    swapped = checked(FILE, clip_of(seated[:, LSP14.mirror]), up_is_known=True)
    assert_allclose(swapped.positions_mm, seated, atol=0.1)


@pytest.mark.parametrize("rate_hz", [0.0, -30.0, np.inf])
def test_a_frame_rate_that_is_none_is_not_known(standing: Float, rate_hz: float) -> None:
    clip = checked(FILE, clip_of(standing, rate_hz))
    assert np.isnan(clip.frame_rate_hz)
    assert any("is taken as not known" in finding for finding in clip.findings)
    assert len(clip.thinned(1.0)) == len(standing)


def test_frames_without_joints_are_dropped(standing: Float) -> None:
    gaps = standing.copy()
    gaps[[3, 7], 5] = np.nan
    clip = checked(FILE, clip_of(gaps))
    assert clip.findings == ("2 frames with missing joints dropped",)
    assert_allclose(clip.frames, [i for i in range(40) if i not in (3, 7)])
    with pytest.raises(MocapError, match="no frame with all 14 joints"):
        checked(FILE, clip_of(np.full_like(standing, np.nan)))


def test_glitches_are_dropped(standing: Float) -> None:
    stretched, jumping = standing.copy(), standing.copy()
    stretched[5, R_WRIST] += (400.0, 300.0, 0.0)
    jumping[9, [L_ELBOW, L_WRIST]] = 2.0 * jumping[9, L_ELBOW - 1] - jumping[9, [L_ELBOW, L_WRIST]]
    for poses, frame in ((stretched, 5), (jumping, 9)):
        clip = checked(FILE, clip_of(poses, rate_hz=120.0))
        assert clip.findings[0].startswith("1 of 40 frames")
        assert frame not in clip.frames
    mixed = standing.copy()
    mixed[::2, R_ELBOW] += 500.0
    mixed[1::4, L_ELBOW] += 900.0
    with pytest.raises(MocapError, match="no one skeleton"):
        checked(FILE, clip_of(mixed))


def test_numbers_of_every_nth_frame_make_nothing_slower(standing: Float) -> None:
    """The rate is that of the poses: a jump is one, however its frames are numbered."""
    poses = standing.copy()
    poses[9, [L_ELBOW, L_WRIST]] = 2.0 * poses[9, L_ELBOW - 1] - poses[9, [L_ELBOW, L_WRIST]]
    numbered = [
        replace(clip_of(poses, rate_hz=120.0), frames=n * np.arange(len(poses))) for n in (1, 40)
    ]
    for clip in numbered:
        assert len(checked(FILE, clip)) == len(poses) - 1


def test_a_throw_is_no_glitch(standing: Float) -> None:
    """Faster than 15 m/s, but there is no way back."""
    poses, axis = standing.copy(), np.array([0.0, 0.0, 1.0])
    forearm = poses[:, R_WRIST] - poses[:, R_ELBOW]
    across = unit(np.cross(axis, forearm)) * np.linalg.norm(forearm, axis=-1, keepdims=True)
    angle = np.clip(np.arange(len(poses)) - 9, 0, 3)[:, None] * 0.6
    poses[:, R_WRIST] = poses[:, R_ELBOW] + np.cos(angle) * forearm + np.sin(angle) * across
    step = np.linalg.norm(np.diff(poses[:, R_WRIST], axis=0), axis=-1)[9:12]
    assert (step * 120.0 > MAX_SPEED_MM_S).all()
    assert len(checked(FILE, clip_of(poses, rate_hz=120.0))) == len(poses)


@pytest.mark.parametrize(("n", "refused"), [(9, False), (12, True)])
def test_a_clip_that_loses_most_of_its_frames_is_refused(
    standing: Float, n: int, refused: bool
) -> None:
    poses = standing.copy()
    poses[5 : 5 + n, R_ELBOW] += 500.0
    poses[20 : 20 + n, L_ELBOW] += 500.0
    if refused:
        with pytest.raises(MocapError, match="24 of 40 frames"):
            checked(FILE, clip_of(poses))
    else:
        assert len(checked(FILE, clip_of(poses))) == 40 - 2 * n


def test_a_t_pose_as_the_first_frame_is_dropped(standing: Float) -> None:
    """Left by conversions, also once they are packed as arrays."""
    t_pose = standing[0].copy()
    for shoulder, elbow, wrist in ((2, 3, 4), (5, 6, 7)):
        out = unit(t_pose[shoulder] - t_pose[7 - shoulder])
        upper = np.linalg.norm(t_pose[elbow] - t_pose[shoulder])
        fore = np.linalg.norm(t_pose[wrist] - t_pose[elbow])
        t_pose[elbow] = t_pose[shoulder] + upper * out
        t_pose[wrist] = t_pose[elbow] + fore * out
    clip = checked(FILE, clip_of(np.concatenate([t_pose[None], standing])))
    assert clip.findings == ("the first frame is a T-pose: dropped",)
    assert_allclose(clip.positions_mm, standing, atol=0.01)
    assert clip.frames[0] == 1
    still = np.stack([t_pose] * 10)
    assert len(checked(FILE, clip_of(still))) == 10, "somebody who stands so all the time"


def test_missing_wrist_and_thorax_are_noticed(standing: Float) -> None:
    short = standing.copy()
    for elbow, wrist in ((R_ELBOW, R_WRIST), (L_ELBOW, L_WRIST)):
        short[:, wrist] = short[:, elbow] + (short[:, wrist] - short[:, elbow]) * 0.62
    trunk = short[:, NECK] - root_of(short)
    short[:, : R_WRIST + 4] -= (trunk * 0.27)[:, None]
    findings = " ".join(checked(FILE, clip_of(short)).findings)
    assert "wrist bone missing" in findings
    assert "thorax bone missing" in findings


def test_uneven_sides_are_noticed(standing: Float) -> None:
    uneven = standing.copy()
    uneven[:, L_WRIST] = uneven[:, L_ELBOW] + 0.7 * (uneven[:, L_WRIST] - uneven[:, L_ELBOW])
    assert any("differs by" in finding for finding in checked(FILE, clip_of(uneven)).findings)
