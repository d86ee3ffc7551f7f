from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from library_store.anatomy import root_of
from library_store.importers import MocapError, read, read_all
from library_store.importers.markers import MARKER_SETS, Sizes, joint_centres
from library_store.importers.rotation import about_axis
from library_store.skeleton import LSP14
from tests.library_store.importers.marker_files import standing, turning, write_c3d

TRACKS = turning(standing())
TRUTH = joint_centres(MARKER_SETS[0], TRACKS, Sizes())


def test_markers_become_joints(tmp_path: Path) -> None:
    (clip,) = read(write_c3d(tmp_path / "05_13.c3d", TRACKS))
    assert_allclose(clip.positions_mm, TRUTH, atol=0.02)
    assert clip.findings == ("markers: CMU's 41 markers",)
    assert (clip.name, clip.subject, clip.frame_rate_hz) == ("05_13", "cmu_05", 120.0)
    assert "free for all uses" in clip.licence
    assert clip.frames[0] == 1


def test_plug_in_gait_in_metres_with_stated_sizes(tmp_path: Path) -> None:
    tracks = turning(standing(plug_in_gait=True))
    path = write_c3d(tmp_path / "gait.c3d", tracks, unit="m", stated={"LKneeWidth": 90.0})
    (clip,) = read(path)
    truth = joint_centres(MARKER_SETS[1], tracks, Sizes(knee=90.0))
    assert_allclose(clip.positions_mm, truth, atol=0.05)
    assert clip.findings == ("markers: Plug-in Gait",)
    assert (clip.subject, clip.licence) == ("", "")


@pytest.mark.parametrize(
    ("unit", "unit_mm", "said"),
    [
        ("inches", 25.4, "inches: scaled by 25.4"),
        ("Meters", 1000.0, "metres: scaled by 1000"),
        ("", 10.0, "centimetres: scaled by 10"),
        ("mm", 1000.0, "metres: scaled by 1000"),
    ],
)
def test_a_unit_that_is_not_what_the_file_says(
    tmp_path: Path, unit: str, unit_mm: float, said: str
) -> None:
    """Joints lie so many millimetres beside the markers: the unit must be known before."""
    (clip,) = read(write_c3d(tmp_path / "a.c3d", TRACKS, unit=unit, unit_mm=unit_mm))
    assert_allclose(clip.positions_mm, TRUTH, atol=0.05)
    assert said in " ".join(clip.findings)


def test_two_people_are_two_clips(tmp_path: Path) -> None:
    ann = {f"Ann:{name}": track for name, track in TRACKS.items()}
    beside = np.array([1000.0, 0.0, 0.0])
    bob = {f"Bob:{name}": track + beside for name, track in TRACKS.items()}
    clips = read(write_c3d(tmp_path / "pair.c3d", ann | bob))
    assert [(clip.name, clip.subject) for clip in clips] == [
        ("pair_Ann", "Ann"),
        ("pair_Bob", "Bob"),
    ]
    assert_allclose(clips[1].positions_mm, clips[0].positions_mm + beside, atol=0.01)


def test_names_in_latin_1(tmp_path: Path) -> None:
    path = write_c3d(tmp_path / "a.c3d", {f"J_rg:{name}": it for name, it in TRACKS.items()})
    path.write_bytes(path.read_bytes().replace(b"J_rg", "Jörg".encode("latin-1")))
    (clip,) = read(path)
    assert clip.subject == "Jörg"


def test_who_is_left_out_is_said(tmp_path: Path) -> None:
    ann = {f"Ann:{name}": track for name, track in TRACKS.items()}
    box = {"Box:corner": TRACKS["C7"], "*110": TRACKS["T10"]}
    (clip,) = read(write_c3d(tmp_path / "pair.c3d", ann | box))
    assert (clip.name, clip.subject) == ("pair_Ann", "Ann")
    finding = "left out, not the markers of a person: Box, markers without a prefix"
    assert finding in clip.findings


def test_a_person_never_seen_is_named_and_skipped(tmp_path: Path) -> None:
    """The others of the file are read; strict refuses them all."""
    ann = {f"Ann:{name}": track for name, track in TRACKS.items()}
    bob = {f"Bob:{name}": np.full_like(track, np.nan) for name, track in TRACKS.items()}
    eve = {f"Eve:{name}": track.copy() for name, track in TRACKS.items()}
    eve["Eve:LKNE"][:] = np.nan
    path = write_c3d(tmp_path / "trio.c3d", ann | bob | eve)
    (clip,), skipped = read_all([path])
    assert clip.name == "trio_Ann"
    assert_allclose(clip.positions_mm, TRUTH, atol=0.02)
    assert [str(error).startswith(f"{path}: clip 'trio_") for error in skipped] == [True, True]
    assert "'trio_Bob' has no frame with all 14 joints; never there: head_top" in str(skipped[0])
    assert str(skipped[1]).endswith(
        "'trio_Eve' has no frame with all 14 joints; never there: l_knee, l_ankle"
    )
    with pytest.raises(MocapError, match="trio_Bob"):
        read_all([path], strict=True)
    with pytest.raises(MocapError, match="trio_Bob"):
        read(path)


def test_a_single_gap_is_one(tmp_path: Path) -> None:
    tracks = {name: track.copy() for name, track in TRACKS.items()}
    tracks["LKNE"][10] = np.nan
    (clip,) = read(write_c3d(tmp_path / "a.c3d", tracks))
    assert "1 marker position in short gaps filled" in clip.findings


def test_an_axis_that_is_not_stated_is_found(tmp_path: Path) -> None:
    (clip,) = read(write_c3d(tmp_path / "a.c3d", TRACKS, up=""))
    assert any("turned so that Y is up" in finding for finding in clip.findings)
    assert_allclose(clip.positions_mm[..., 1], TRUTH[..., 1], atol=0.02)


def test_gaps(tmp_path: Path) -> None:
    tracks = {name: track.copy() for name, track in TRACKS.items()}
    tracks["LKNE"][10:15] = np.nan
    tracks["C7"][30:50] = np.nan
    tracks["T10"][31:49] = 0.0  # as some programs write what was not seen
    (clip,) = read(write_c3d(tmp_path / "a.c3d", tracks))
    assert "5 marker positions in short gaps filled" in clip.findings
    assert "20 frames with missing joints dropped" in clip.findings
    assert clip.frames.tolist() == [*range(1, 31), *range(51, 61)]
    assert_allclose(clip.positions_mm[:15], TRUTH[:15], atol=0.5)


def test_a_mapping_file_from_joint_to_markers(tmp_path: Path) -> None:
    path = write_c3d(
        tmp_path / "own.c3d",
        {f"m{i}": TRUTH[:, i] for i in range(14)} | {"far": TRUTH[:, 4] + (0.0, 0.0, 20.0)},
    )
    with pytest.raises(MocapError, match=r"own\.c3d: markers are .*Plug-in Gait.*mapping file"):
        read(path)
    table: dict[str, object] = {joint: f"m{i}" for i, joint in enumerate(LSP14.joint_names)}
    mapping = tmp_path / "mapping.json"
    mapping.write_text(json.dumps(table | {"neck": "m99"}))
    with pytest.raises(MocapError, match=r"markers are M0, .*mapping\.json names m0, m99, m2"):
        read(path, mapping=mapping)
    table["r_wrist"] = ["m4", "far"]
    mapping.write_text(json.dumps(table))
    (clip,) = read(path, mapping=mapping)
    wrist = LSP14.index("r_wrist")
    expected = TRUTH.copy()
    expected[:, wrist, 2] += 10.0
    assert_allclose(clip.positions_mm, expected, atol=0.02)


def test_a_mapping_file_with_prefixes_is_for_who_has_them(tmp_path: Path) -> None:
    tracks = {f"{who}:m{i}": TRUTH[:, i] for who in ("Ann", "Bob") for i in range(14)}
    path = write_c3d(tmp_path / "pair.c3d", tracks)
    mapping = tmp_path / "mapping.json"
    for prefix, names in (("", ["pair_Ann", "pair_Bob"]), ("Ann:", ["pair_Ann"])):
        table = {joint: f"{prefix}m{i}" for i, joint in enumerate(LSP14.joint_names)}
        mapping.write_text(json.dumps(table))
        clips = read(path, mapping=mapping)
        assert [clip.name for clip in clips] == names
        for clip in clips:
            assert_allclose(clip.positions_mm, TRUTH, atol=0.02)
    assert "left out, not the markers of a person: Bob" in clips[0].findings


@pytest.mark.parametrize("size", [0, 100, 700, 5_000])
def test_a_cut_file_is_refused(tmp_path: Path, size: int) -> None:
    path = write_c3d(tmp_path / "cut.c3d", TRACKS)
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(MocapError, match=r"cut\.c3d: not a whole C3D file"):
        read(path)


def test_numbers_of_mips_processors_are_named(tmp_path: Path) -> None:
    """Whole files, of SGI's machines, but none that ezc3d reads."""
    path = write_c3d(tmp_path / "sgi.c3d", TRACKS)
    content = bytearray(path.read_bytes())
    content[512 * (content[0] - 1) + 3] = 86
    path.write_bytes(content)
    with pytest.raises(MocapError, match=r"sgi\.c3d: has numbers as MIPS processors"):
        read(path)


def test_noise_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "noise.c3d"
    path.write_bytes(np.random.default_rng(0).bytes(5_000))
    with pytest.raises(MocapError, match=r"noise\.c3d: not a whole C3D file"):
        read(path)


def test_a_file_that_crashes_the_reader_is_refused_too(tmp_path: Path) -> None:
    path = write_c3d(tmp_path / "bad.c3d", turning(standing(), 4))
    content = bytearray(path.read_bytes())
    content[525] = 255  # a parameter's name is longer than it is
    path.write_bytes(content)
    with pytest.raises(MocapError, match=r"bad\.c3d: not a whole C3D file: ezc3d crashes on it"):
        read(path)


def test_without_the_extra_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_c3d(tmp_path / "a.c3d", TRACKS)
    monkeypatch.setitem(sys.modules, "ezc3d", None)
    with pytest.raises(MocapError, match=r"posematch\[mocap\]"):
        read(path)


REAL = Path(os.environ.get("CMU_MOCAP_RAW", "."))


@pytest.mark.skipif(
    not (REAL / "cmu_c3d" / "05_13.c3d").is_file(), reason="set CMU_MOCAP_RAW to CMU's raw files"
)
def test_a_real_clip_agrees_with_its_asf_and_amc() -> None:
    """CMU turned the laboratory by 90 degrees when it made the AMC."""
    (clip,) = read(REAL / "cmu_c3d" / "05_13.c3d")
    (truth,) = read(REAL / "cmu_asfamc" / "05" / "05_13.amc")
    poses = [c.positions_mm.astype(np.float64) for c in (clip, truth)]
    centred = [p - root_of(p)[:, None] for p in poses]
    error = np.linalg.norm(centred[0] @ about_axis("y", np.array(-90.0)).T - centred[1], axis=-1)
    assert len(clip) == len(truth)
    assert error.mean() < 32.0
    assert error[:, [8, 11]].mean() < 12.0
