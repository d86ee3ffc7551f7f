from __future__ import annotations

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from library_store.anatomy import Float, root_of
from library_store.importers import Clip, MocapError, read, read_all
from library_store.importers.bvh import parse, world_positions
from library_store.importers.joint_tables import CMU_MM_PER_UNIT, TABLES, plain
from library_store.skeleton import HEAD_TOP, LSP14, NECK, R_WRIST
from tests.library_store.importers.files import ASF, amc, cmu_bvh, walk

TOLERANCE_MM = 0.05
"""Of the made-up person, whose thorax is as long as the upper back. Real clips: 7 mm."""


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def centred(clip: Clip) -> Float:
    positions = clip.positions_mm.astype(np.float64)
    return positions - root_of(positions)[:, None]


def scaled(text: str, factor: float) -> str:
    """A BVH file with all its offsets times ``factor``; how the root moves is left."""
    return re.sub(
        r"OFFSET (\S+) (\S+) ([^\s}]+)",
        lambda found: "OFFSET " + " ".join(f"{float(v) * factor:.9f}" for v in found.groups()),
        text,
    )


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


CHAIN = """\
HIERARCHY
ROOT a
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Yrotation Xrotation Zrotation
  JOINT b
  {
    OFFSET 0 2 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 1 0 0
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.04
1 2 3 0 0 0 0 0 0
1 2 3 90 0 0 90 0 0
"""


def test_forward_kinematics_by_hand(tmp_path: Path) -> None:
    places = world_positions(parse(write(tmp_path / "chain.bvh", CHAIN)))
    assert_allclose(places[0], [[1, 2, 3], [1, 4, 3], [2, 4, 3]])
    # b turns x to y; the root's turn about y leaves that where it is.
    assert_allclose(places[1], [[1, 2, 3], [1, 4, 3], [1, 5, 3]], atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("Frames: 2", "Frames: 3", "27|18 values found"),
        ("90 0 0 90 0 0", "90 0 0 90", "values found"),
        ("90 0 0 90 0 0", "90 0 0 x 0 0", "not a whole BVH"),
        ("MOTION", "", "HIERARCHY and MOTION"),
        ("MOTION", "\n" * 200_000, "HIERARCHY and MOTION"),
        ("Zrotation Xrotation Y", "Zrotation Xrotation Q", "unknown channels"),
        ("OFFSET 1 0 0", "OFFSET 1 0", "not a whole BVH"),
        ("CHANNELS 3", "CHANNELS 33333333333", "braces do not match"),
        ("0.04", "-0.04", "frame time"),
        ("0.04", "inf", "frame time"),
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
    assert "1 frames with missing joints dropped" in clip.findings
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


SWORD = "ROOT Sword\n{\nOFFSET 0 0 0\nCHANNELS 3 Xposition Yposition Zposition\n}\n"


def together(*texts: str, prop: str = "") -> str:
    """Files of the same length as one: a ROOT each, behind a thing's that never moves."""
    heads, motions = zip(*(text.split("MOTION\n") for text in texts), strict=True)
    count, time, *_ = motions[0].splitlines()
    rows = zip(*(motion.splitlines()[2:] for motion in motions), strict=True)
    still = "0 0 0 " if prop else ""
    lines = [still + " ".join(row) for row in rows]
    people = "".join(head.removeprefix("HIERARCHY\n") for head in heads)
    return "\n".join([f"HIERARCHY\n{prop}{people}MOTION", count, time, *lines]) + "\n"


@pytest.mark.parametrize("prop", ["", SWORD])
def test_every_root_with_a_persons_joints_is_a_person(tmp_path: Path, prop: str) -> None:
    other = {name: values[::-1] for name, values in walk().items()}
    texts = [cmu_bvh(walk(), max_names=True), cmu_bvh(other, max_names=True)]
    alone = [read(write(tmp_path / f"{n}.bvh", text))[0] for n, text in enumerate(texts)]
    clips = read(write(tmp_path / "duel.bvh", together(*texts, prop=prop)))
    assert [clip.name for clip in clips] == ["duel_1", "duel_2"]
    for clip, truth in zip(clips, alone, strict=True):
        assert_allclose(clip.positions_mm, truth.positions_mm, atol=0.01)
        said = ("left out, not the joints of a person: Sword",) if prop else ()
        assert clip.findings == truth.findings + said
    (one,) = read(write(tmp_path / "solo.bvh", together(texts[0], prop=SWORD)))
    assert one.name == "solo"
    assert "left out, not the joints of a person: Sword" in one.findings


def test_a_person_beyond_use_is_an_error_beside_the_other(tmp_path: Path) -> None:
    giant = scaled(cmu_bvh(walk()), 3.0)
    path = write(tmp_path / "a.bvh", together(cmu_bvh(walk()), giant))
    clips, errors = read_all([path])
    assert [clip.name for clip in clips] == ["a_1"]
    (error,) = errors
    assert re.search(r"a\.bvh: clip 'a_2': .*no person's", str(error))


def test_a_mapping_file_names_the_joints_of_everybody(tmp_path: Path) -> None:
    text = re.sub(r"(ROOT|JOINT) (\w+)", r"\1 my\2", cmu_bvh(walk()))
    own = dict(zip(LSP14.joint_names, TABLES[0].targets, strict=True))
    names = {joint: f"my{name}" for joint, name in own.items()}
    mapping = write(tmp_path / "mapping.json", json.dumps(names))
    both = write(tmp_path / "both.bvh", together(text, text, prop=SWORD))
    assert [clip.name for clip in read(both, mapping=mapping)] == ["both_1", "both_2"]
    with pytest.raises(MocapError, match=r"joint names not known: Sword, myHips"):
        read(both)
    write(mapping, json.dumps(names | {"neck": "myNose"}))
    with pytest.raises(MocapError, match=r"has no joints mynose"):
        read(both, mapping=mapping)


def test_the_joints_of_one_person_on_two_roots(tmp_path: Path) -> None:
    """What no hierarchy has alone is taken from all of them."""
    arm = renamed("{side}{limb}", LIMBS, ("Right", "Left"))
    names = dict(zip(LSP14.joint_names, TABLES[0].targets, strict=True)) | {"neck": "neck9"}
    mapping = write(tmp_path / "mapping.json", json.dumps(names | {"r_wrist": "Glove"}))
    path = write(tmp_path / "a.bvh", together(arm, prop=SWORD.replace("Sword", "Glove")))
    (clip,) = read(path, mapping=mapping)
    assert_allclose(clip.positions_mm[:, R_WRIST], 0.0)  # where the glove lies


def test_unknown_names_are_listed_and_a_mapping_file_helps(tmp_path: Path) -> None:
    text = re.sub(r"(ROOT|JOINT) (\w+)", r"\1 my\2", cmu_bvh(walk()))
    path = write(tmp_path / "dance.bvh", text)
    with pytest.raises(MocapError, match=r"myRightForeArm.*mapping file.*l_ankle"):
        read(path)
    own = dict(zip(LSP14.joint_names, TABLES[0].targets, strict=True))
    mapping = tmp_path / "mapping.json"
    mapping.write_text(json.dumps({joint: f"my{name}" for joint, name in own.items()}))
    (clip,) = read(path, mapping=mapping)
    # Not known to be CMU's: the unit is found, the missing bones are only reported.
    assert any("CMU's units" in finding for finding in clip.findings)
    assert any("wrist bone missing" in finding for finding in clip.findings)


def test_a_mapping_file_in_toml_with_means(tmp_path: Path) -> None:
    text = re.sub(r"(ROOT|JOINT) (\w+)", r"\1 my\2", cmu_bvh(walk()))
    path = write(tmp_path / "dance.bvh", text)
    own = dict(zip(LSP14.joint_names, TABLES[0].targets, strict=True))
    one = "".join(f'{joint} = "my{name}"\n' for joint, name in own.items())
    (clip,) = read(path, mapping=write(tmp_path / "one.toml", one))
    lines = one.replace('neck = "myneck1"', 'neck = ["myNeck1", "mySpine1"]')
    assert lines != one
    (mean,) = read(path, mapping=write(tmp_path / "mean.toml", lines))
    neck = LSP14.index("neck")
    others = [joint for joint in range(14) if joint != neck]
    assert_allclose(mean.positions_mm[:, others], clip.positions_mm[:, others], atol=0.01)
    lower = clip.positions_mm[:, neck, 1] - mean.positions_mm[:, neck, 1]
    assert np.all((lower > 20.0) & (lower < 120.0)), "half of the way from Spine1 to Neck1"
    with pytest.raises(MocapError, match="has no joints mynose"):
        read(path, mapping=write(tmp_path / "bad.toml", one.replace("myneck1", "mynose")))


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ('{"neck": 3}', "joints missing"),
        ("{", "JSON"),
        ("[1]", "object"),
        ('{"neck": "Neck"}', "joints missing: head_top"),
        ('{"nose": "Neck"}', "unknown: nose"),
    ],
)
def test_a_bad_mapping_file_is_named(tmp_path: Path, content: str, problem: str) -> None:
    path = write(tmp_path / "a.bvh", CHAIN)
    mapping = write(tmp_path / "mapping.json", content)
    with pytest.raises(MocapError, match=problem) as caught:
        read(path, mapping=mapping)
    assert str(mapping) in str(caught.value)


LIMBS = ("Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot")
BLENDER = ("upper_arm", "forearm", "hand", "thigh", "shin", "foot")
ROKOKO = ("Arm", "ForeArm", "Hand", "Thigh", "Shin", "Foot")
SMPL_X = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
BIPED = ("UpperArm", "Forearm", "Hand", "Thigh", "Calf", "Foot")


def renamed(pattern: str, limbs: tuple[str, ...], sides: tuple[str, str]) -> str:
    """The walk under other joint names; no thorax is lost, as far as names tell."""
    text = cmu_bvh(walk()).replace("Spine1", "Spine2").replace("Neck1", "Neck9")
    for side, other in zip(("Right", "Left"), sides, strict=True):
        for limb, new in zip(LIMBS, limbs, strict=True):
            name = pattern.format(side=other, limb=new)
            text = re.sub(rf"(ROOT|JOINT) {side}{limb}\b", rf"\1 {name}", text)
    return text


@pytest.mark.parametrize(
    ("table", "pattern", "limbs", "sides"),
    [
        ("MotionBuilder", "mixamorig:{side}{limb}", LIMBS, ("Right", "Left")),
        ("MotionBuilder", "mixamorig1_{side}{limb}", LIMBS, ("Right", "Left")),
        ("MotionBuilder", "Ann|{side}{limb}", LIMBS, ("Right", "Left")),
        ("MotionBuilder", "Character1_{side}{limb}", LIMBS, ("Right", "Left")),
        ("Rokoko", "{side}{limb}", ROKOKO, ("Right", "Left")),
        ("SMPL-X", "{side}_{limb}", SMPL_X, ("right", "left")),
        ("Blender", "{limb}.{side}", BLENDER, ("R", "L")),
        ("Blender", "DEF-{limb}_{side}", BLENDER, ("R", "L")),
        ("Character Studio biped", "Bip01 {side} {limb}", BIPED, ("R", "L")),
    ],
)
def test_names_of_other_programs(
    tmp_path: Path, table: str, pattern: str, limbs: tuple[str, ...], sides: tuple[str, str]
) -> None:
    (truth,) = read(write(tmp_path / "walk.bvh", cmu_bvh(walk())))
    (clip,) = read(write(tmp_path / "a.bvh", renamed(pattern, limbs, sides)))
    assert clip.findings[0] == f"joint names: {table}"
    assert (clip.subject, clip.licence) == ("", "")
    legs = slice(LSP14.index("r_hip"), None)
    assert_allclose(centred(clip)[:, legs], centred(truth)[:, legs], atol=0.05)


JAW = "JOINT Jaw\n{\nOFFSET 0 0.5 0.5\nCHANNELS 0\nEnd Site\n{\nOFFSET 0 0 1\n}\n}\n"


@pytest.mark.parametrize(
    "tip", [JAW, "End Site\n{\nOFFSET 0.000000 0.0 -0.0\n}\n", "End Site\n{\n}\n"]
)
def test_a_head_without_its_top(tmp_path: Path, tip: str) -> None:
    """Other bones hang on it, as in some files of Mixamo, or its end site has no length."""
    text = renamed("mixamorig:{side}{limb}", LIMBS, ("Right", "Left"))
    head = text.index("JOINT Head")
    end = text.index("End Site", head)
    close = text.index("}", end) + 1
    (clip,) = read(write(tmp_path / "a.bvh", text[:end] + tip + text[close:]))
    assert clip.findings[0] == "joint names: MotionBuilder, no head top"
    assert "head top at 0.47 of the trunk beyond the neck assumed" in clip.findings
    positions = clip.positions_mm.astype(np.float64)
    head_mm = np.linalg.norm(positions[:, HEAD_TOP] - positions[:, NECK], axis=1)
    trunk_mm = np.linalg.norm(positions[:, NECK] - root_of(positions), axis=1)
    assert_allclose(head_mm, 0.47 * np.median(trunk_mm), rtol=2e-3)


def test_mixamo_with_a_head_top_in_centimetres(tmp_path: Path) -> None:
    text = cmu_bvh(walk()).replace("Spine1", "Spine2").replace("Neck1", "Neck2")
    text = re.sub(r"(ROOT|JOINT) (\w+)", r"\1 mixamorig:\2", text)
    end = text.index("End Site", text.index("mixamorig:Head"))
    close = text.index("}", end)
    offset = text[text.index("OFFSET", end) : close].strip()
    top = f"JOINT mixamorig:HeadTop_End {{\n{offset}\nCHANNELS 0\nEnd Site {{ OFFSET 0 0 0 }} }}"
    text = text[:end] + top + text[close + 1 :]
    (clip,) = read(write(tmp_path / "mixamo.bvh", text))
    assert clip.findings[0] == "joint names: Mixamo"
    (again,) = read(write(tmp_path / "centimetres.bvh", scaled(text, 2.54 / 0.45)))
    assert any("centimetres" in finding for finding in again.findings)
    assert_allclose(centred(again), centred(clip), atol=0.05)


def test_every_table_has_fourteen_joints() -> None:
    assert all(len(set(table.targets)) == LSP14.n_joints for table in TABLES)
    for table in TABLES:
        assert all(target == plain(target) for target in table.targets)
