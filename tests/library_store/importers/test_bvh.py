"""BVH: the text, its numbers and rates, and CMU's conversions."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from library_store.importers import MocapError, read
from library_store.importers.bvh import parse, world_positions
from library_store.importers.joint_tables import CMU_MM_PER_UNIT, TABLES
from library_store.skeleton import LSP14
from tests.library_store.importers.bvh_files import (
    CHAIN,
    JAW,
    LIMBS,
    centred,
    renamed,
    scaled,
    write,
)
from tests.library_store.importers.files import ASF, amc, cmu_bvh, walk

TOLERANCE_MM = 0.05
"""Of the made-up person, whose thorax is as long as the upper back. Real clips: 7 mm."""


@pytest.mark.parametrize("max_names", [False, True])
def test_it_agrees_with_asf_and_amc_of_the_same_clip(tmp_path: Path, max_names: bool) -> None:
    motion = walk()
    write(tmp_path / "02.asf", ASF)
    (truth,) = read(write(tmp_path / "02_01.amc", amc(motion)))
    (clip,) = read(write(tmp_path / "02_01.bvh", cmu_bvh(motion, max_names=max_names)))
    assert_allclose(centred(clip), centred(truth), atol=TOLERANCE_MM)
    assert "thorax above" in " ".join(clip.findings)
    assert "wrist bones" in " ".join(clip.findings)
    if not max_names:  # frame 0 is the T-pose, so the numbers are those of the AMC
        assert "the first frame is a T-pose: dropped" in clip.findings
        assert_allclose(clip.frames, truth.frames)
    assert (clip.subject, clip.frame_rate_hz) == ("cmu_02", 120.0)


@pytest.mark.parametrize("max_names", [False, True])
@pytest.mark.parametrize(
    ("mm_per_unit", "said"),
    [(1.0, "put back"), (10.0, "centimetres"), (25.4, "inches"), (1000.0, "metres")],
)
def test_a_conversion_of_cmus_that_was_written_anew_in_another_unit(
    tmp_path: Path, max_names: bool, mm_per_unit: float, said: str
) -> None:
    text = cmu_bvh(walk(), max_names=max_names)
    (truth,) = read(write(tmp_path / "02_01.bvh", text))
    again = scaled(text, CMU_MM_PER_UNIT / mm_per_unit)
    (clip,) = read(write(tmp_path / "again.bvh", again))
    assert_allclose(centred(clip), centred(truth), atol=TOLERANCE_MM)
    assert said in " ".join(clip.findings)


REAL = Path(os.environ.get("CMU_MOCAP_RAW", "."))


@pytest.mark.skipif(
    not (REAL / "cmu_bvh_cgspeed").is_dir(), reason="set CMU_MOCAP_RAW to CMU's raw files"
)
@pytest.mark.parametrize("name", ["02_01", "05_13", "35_01", "49_18"])
def test_real_conversions_agree_with_asf_and_amc(name: str) -> None:
    (clip,) = read(REAL / "cmu_bvh_cgspeed" / f"{name}.bvh")
    (truth,) = read(REAL / "cmu_asfamc" / name[:2] / f"{name}.amc")
    n = min(len(clip), len(truth))
    error = np.linalg.norm(centred(clip)[:n] - centred(truth)[:n], axis=-1)
    assert error.mean() < 4.0
    assert error.max() < 12.0


def test_a_rate_that_contradicts_the_index_is_reported(tmp_path: Path) -> None:
    (clip,) = read(write(tmp_path / "61_02.bvh", cmu_bvh(walk())))
    assert clip.frame_rate_hz == 60.0
    assert any("the file says 120 Hz" in finding for finding in clip.findings)


def test_forward_kinematics_by_hand(tmp_path: Path) -> None:
    places = world_positions(parse(write(tmp_path / "chain.bvh", CHAIN)))
    assert_allclose(places[0], [[1, 2, 3], [1, 4, 3], [2, 4, 3]])
    # b turns x to y; the root's turn about y leaves that where it is.
    assert_allclose(places[1], [[1, 2, 3], [1, 4, 3], [1, 5, 3]], atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("Frames: 2", "Frames: 3", "27|18 values found"),
        ("Frames: 2", "Frames: 1", "bad.bvh: 1 frame of 9 channels expected"),
        ("90 0 0 90 0 0", "90 0 0 90", "values found"),
        ("90 0 0 90 0 0", "90 0 0 x 0 0", "not a whole BVH"),
        ("MOTION", "", "HIERARCHY and MOTION"),
        ("MOTION", "\n" * 200_000, "HIERARCHY and MOTION"),
        ("Zrotation Xrotation Y", "Zrotation Xrotation Q", "unknown channels"),
        ("OFFSET 1 0 0", "OFFSET 1 0", "not a whole BVH"),
        ("CHANNELS 3", "CHANNELS 33333333333", "braces do not match"),
        ("0.04", "-0.04", "frame time"),
        ("0.04", "inf", "frame time"),
        ("0.04", "120", "if it is frames a second, write 0.00833333"),
        ("0.04", "0,04", "float: '0,04'"),
        ("\n}\nMOTION", "\nMOTION", "the hierarchy does not end"),
        ("\nMOTION", "\n}\nMOTION", "braces do not match"),
    ],
)
def test_malformed_files_are_refused(tmp_path: Path, old: str, new: str, problem: str) -> None:
    path = write(tmp_path / "bad.bvh", CHAIN.replace(old, new))
    with pytest.raises(MocapError, match=problem) as caught:
        parse(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("\n", "\r\n"),
        ("\n", "\r"),
        (" ", "\t"),
        ("HIERARCHY", "\ufeffHIERARCHY"),
        ("MOTION\n", "MOTION\n\n"),
        ("Frames: 2\n", "Frames:\t2 \n\n"),
        ("\n{", " {"),
        ("JOINT b\n  {", "JOINT b{"),
        ("End Site", "END SITE"),
        ("      OFFSET 1 0 0", "      OFFSET 1 0 0\n      CHANNELS 0"),
        ("OFFSET 0 2 0", "OFFSET 0 2.0e+00 0"),
        ("ROOT a", "ROOT LocoMOTION 体"),
    ],
)
def test_the_same_motion_written_another_way(tmp_path: Path, old: str, new: str) -> None:
    path = tmp_path / "chain.bvh"
    path.write_bytes(CHAIN.replace(old, new).encode())
    plain_file = parse(write(tmp_path / "plain.bvh", CHAIN))
    assert_allclose(world_positions(parse(path)), world_positions(plain_file))


def test_names_in_any_script(tmp_path: Path) -> None:
    own = dict(zip(LSP14.joint_names, TABLES[0].targets, strict=True)) | {"neck": "頸"}
    text = cmu_bvh(walk()).replace("JOINT Neck1", "JOINT 頸")
    path, mapping = tmp_path / "tanz.bvh", tmp_path / "mapping.json"
    path.write_bytes(text.encode())
    mapping.write_bytes(b"\xef\xbb\xbf" + json.dumps(own, ensure_ascii=False).encode())
    assert len(read(path, mapping=mapping)[0]) == 12
    path.write_bytes(text.replace("頸", "Köper").encode("latin-1"))
    assert "Köper" in {joint.name for joint in parse(path).joints}


@pytest.mark.parametrize("codec", ["utf-16-le", "utf-16-be"])
def test_utf_16_as_windows_editors_save_it(tmp_path: Path, codec: str) -> None:
    path = tmp_path / "chain.bvh"
    text = ("\ufeff" + CHAIN.replace("ROOT a", "ROOT 体")).encode(codec)
    path.write_bytes(text)
    found = parse(path)
    assert found.joints[0].name == "体"
    plain_file = parse(write(tmp_path / "plain.bvh", CHAIN))
    assert_allclose(world_positions(found), world_positions(plain_file))
    path.write_bytes(text[:-1])
    with pytest.raises(MocapError, match="begins as UTF-16 text, but is none: truncated"):
        parse(path)


def test_a_frame_rate_is_the_files_where_the_name_is_not_cmus(tmp_path: Path) -> None:
    text = cmu_bvh(walk()).replace("Frame Time: .0083333", "Frame Time: 0.04")
    (clip,) = read(write(tmp_path / "dance.bvh", text))
    assert clip.frame_rate_hz == 25.0
    assert not any("frame rate" in finding for finding in clip.findings)


def test_a_frame_time_of_zero_is_no_rate(tmp_path: Path) -> None:
    text = cmu_bvh(walk()).replace("Frame Time: .0083333", "Frame Time: 0.0")
    (clip,) = read(write(tmp_path / "pose.bvh", text))
    assert np.isnan(clip.frame_rate_hz)
    assert any("frame rate is not known" in finding for finding in clip.findings)
    assert clip.thinned(30.0) is clip
    (known,) = read(write(tmp_path / "02_01.bvh", text))
    assert known.frame_rate_hz == 120.0
    assert any("the file says no rate" in finding for finding in known.findings)


@pytest.mark.parametrize("value", ["nan", "-inf"])
def test_a_frame_with_a_number_that_is_none_is_dropped(tmp_path: Path, value: str) -> None:
    text = renamed("{side}{limb}", LIMBS, ("Right", "Left"))
    end = text.index("End Site", text.index("JOINT Head"))
    text = text[:end] + JAW + text[text.index("}", end) + 1 :]  # its head top is reckoned
    lines = text.splitlines()
    words = lines[-4].split()
    lines[-4] = " ".join([*words[:7], value, *words[8:]])
    (truth,) = read(write(tmp_path / "whole.bvh", text))
    (clip,) = read(write(tmp_path / "gap.bvh", "\n".join(lines)))
    assert "1 frame with missing joints dropped" in clip.findings
    kept = np.isin(truth.frames, clip.frames)
    assert np.count_nonzero(~kept) == 1
    assert_allclose(clip.positions_mm, truth.positions_mm[kept], atol=0.5)


def with_places(text: str, *, idle: bool) -> str:
    """The motion with six channels at every joint: its offset each time, or zeros."""
    head, motion = text.split("MOTION\n")
    count, time, *rows = motion.splitlines()
    offsets = [
        found.groups()
        for found in re.finditer(r"OFFSET (\S+) (\S+) (\S+)\n\s*CHANNELS", head, re.MULTILINE)
    ]
    lines = []
    for row in rows:
        words = row.split()
        wide = words[:6]
        for number, offset in enumerate(offsets[1:], 1):
            turns = words[3 + 3 * number : 6 + 3 * number]
            wide += [*(("0", "-0.0", "0") if idle else offset), *turns]
        lines.append(" ".join(wide))
    head = head.replace("CHANNELS 3", "CHANNELS 6 Xposition Yposition Zposition")
    if not idle:
        head = re.sub(r"OFFSET .*(?=\n\s*CHANNELS)", "OFFSET 0 0 0", head)
    return "\n".join([f"{head}MOTION", count, time, *lines]) + "\n"


@pytest.mark.parametrize("idle", [False, True])
def test_places_at_every_joint(tmp_path: Path, idle: bool) -> None:
    """Some programs write them instead of offsets, others as zeros beside them."""
    text = cmu_bvh(walk()).replace("Spine1", "Spine2")
    truth = parse(write(tmp_path / "plain.bvh", text))
    found = parse(write(tmp_path / "six.bvh", with_places(text, idle=idle)))
    assert_allclose(world_positions(found), world_positions(truth), atol=1e-6)


def test_offsets_of_zero_beside_places_are_no_lost_thorax(tmp_path: Path) -> None:
    text = cmu_bvh(walk())
    whole = text.replace("OFFSET 0.00000000 0.00000000 0.00000000", "OFFSET 0 2.06523 0")
    for file in (text, whole):
        (clip,) = read(write(tmp_path / "six.bvh", with_places(file, idle=False)))
        assert clip.findings[0] == "joint names: MotionBuilder"
    (again,) = read(write(tmp_path / "02_01.bvh", with_places(text, idle=True)))
    assert "thorax above" in " ".join(again.findings)
