from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from library_store.anatomy import LENGTHS, Float, measure_lengths
from library_store.importers.markers import (
    MARKER_SETS,
    Sizes,
    fill_gaps,
    find_marker_set,
    joint_centres,
    sizes_from,
)
from library_store.importers.rotation import euler
from library_store.skeleton import LSP14
from tests.library_store.importers.marker_files import standing

CMU, PLUG_IN_GAIT, SACRUM = MARKER_SETS


def joints_of(markers: dict[str, Float], sizes: Sizes | None = None) -> dict[str, Float]:
    marker_set = find_marker_set(frozenset(markers))
    assert marker_set is not None
    rows = {name: place.reshape(-1, 3) for name, place in markers.items()}
    joints = joint_centres(marker_set, rows, sizes or Sizes())
    return dict(zip(LSP14.joint_names, joints[0], strict=True))


def test_sets_are_told_by_their_names() -> None:
    assert find_marker_set(frozenset(standing())) is CMU
    suit = standing(plug_in_gait=True)
    assert find_marker_set(frozenset(suit)) is PLUG_IN_GAIT
    suit["SACR"] = 0.5 * (suit.pop("LPSI") + suit.pop("RPSI"))
    assert find_marker_set(frozenset(suit)) is SACRUM
    del suit["C7"]
    assert find_marker_set(frozenset(suit)) is None


def test_hips_are_harringtons() -> None:
    """PW 250 mm, PD 190 mm, the pelvis level but for 20 mm over its depth."""
    markers = standing()
    for back in ("LBWT", "RBWT"):
        markers[back][1] = 1000.0
    joints = joints_of(markers)
    # Harrington et al. 2007: 0.33 PW + 7.3 outwards, 0.30 PW + 10.9 down, 0.24 PD + 9.9 back.
    assert_allclose(joints["l_hip"], [89.8, 1000 - 85.9, 80 - 55.5], atol=1e-9)
    assert_allclose(joints["r_hip"], [-89.8, 1000 - 85.9, 80 - 55.5], atol=1e-9)


def test_joints_lie_inside_of_their_markers() -> None:
    joints, markers = joints_of(standing()), standing()
    for side in "lr":
        for joint, marker, reach in (("knee", "KNE", 57.0), ("ankle", "ANK", 42.0)):
            offset = joints[f"{side}_{joint}"] - markers[f"{side.upper()}{marker}"]
            assert np.linalg.norm(offset) == pytest.approx(reach)
            assert offset[0] * (1 if side == "l" else -1) < -0.9 * reach, "towards the other leg"
        elbow = joints[f"{side}_elbow"] - markers[f"{side.upper()}ELB"]
        assert np.linalg.norm(elbow) == pytest.approx(47.0)
        assert elbow[0] * (1 if side == "l" else -1) < -35.0, "towards the body"
        wrist = joints[f"{side}_wrist"] - 0.5 * (
            markers[f"{side.upper()}WRA"] + markers[f"{side.upper()}WRB"]
        )
        assert np.linalg.norm(wrist) == pytest.approx(30.0)
        assert wrist[0] * (1 if side == "l" else -1) < -20.0, "palms face the body"
    assert 80.0 < joints["head_top"][1] - 1650.0 < 90.0
    assert joints["neck"][2] > markers["C7"][2]


def test_an_adult_has_an_adults_bones() -> None:
    pose = np.stack(list(joints_of(standing()).values()))
    usual = dict(zip(LENGTHS, measure_lengths(pose), strict=True))
    for name, (low, high) in {
        "trunk": (480, 620),
        "hips": (160, 200),
        "shoulder": (150, 230),
        "head": (190, 290),
        "upper_arm": (230, 320),
        "forearm": (210, 290),
        "thigh": (380, 460),
        "shank": (390, 460),
    }.items():
        assert low < usual[name] < high, name


def test_the_frame_of_the_markers_does_not_matter() -> None:
    turn = euler("zyx", np.array([40.0, -70.0, 100.0]))
    shift = np.array([500.0, -300.0, 90.0])
    moved = {name: turn @ place + shift for name, place in standing().items()}
    joints = joints_of(standing())
    for name, place in joints_of(moved).items():
        assert_allclose(place, turn @ joints[name] + shift, atol=1e-9)


def test_straight_legs_and_arms_have_joints_too() -> None:
    """The hinges' planes vanish there."""
    markers = standing()
    for side, sign in (("L", 1.0), ("R", -1.0)):
        hip = np.array([sign * 89.8, 914.1, 24.5])
        markers[f"{side}KNE"] = 0.5 * (hip + markers[f"{side}ANK"])
        wrist = 0.5 * (markers[f"{side}WRA"] + markers[f"{side}WRB"])
        markers[f"{side}ELB"] = 0.55 * wrist + 0.45 * np.array([sign * 190.0, 1403.0, -10.0])
    joints = joints_of(markers)
    assert all(np.isfinite(place).all() for place in joints.values())
    for side, sign in (("l", 1.0), ("r", -1.0)):
        inwards = joints[f"{side}_knee"][0] - markers[f"{side.upper()}KNE"][0]
        assert sign * inwards < -45.0


def test_stated_sizes_are_used() -> None:
    stated = {"LKneeWidth": 90.0, "RKneeWidth": 94.0, "LAnkleWidth": 0.0, "LShoulderOffset": 50.0}
    assert sizes_from(stated) == Sizes(knee=92.0, shoulder_offset=50.0)
    assert sizes_from({"LElbowWidth": 0.08}) == Sizes(), "metres by mistake: no person's"
    joints = joints_of(standing(), Sizes(knee=92.0))
    reach = np.linalg.norm(joints["l_knee"] - standing()["LKNE"])
    assert reach == pytest.approx(53.0)


def test_short_gaps_are_filled_and_long_ones_left() -> None:
    track = np.arange(30.0)[:, None] * (1.0, 2.0, 0.0)
    gappy = track.copy()
    gappy[[0, 5, 6, *range(12, 20), 29]] = np.nan
    filled = fill_gaps(gappy, 3)
    left = sorted({0, 29, *range(12, 20)})
    assert np.flatnonzero(np.isnan(filled).any(axis=1)).tolist() == left
    kept = np.setdiff1d(np.arange(30), left)
    assert_allclose(filled[kept], track[kept])
