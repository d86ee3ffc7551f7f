from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from library_store.anatomy import Float, root_of
from library_store.importers import Clip, MocapError, read
from library_store.importers.bvh import parse, world_positions
from library_store.importers.joint_tables import TABLES
from library_store.skeleton import LSP14
from tests.library_store.importers.files import ASF, amc, cmu_bvh, walk

TOLERANCE_MM = 0.05
"""Of the made-up person, whose thorax is as long as the upper back. Real clips: 7 mm."""


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def centred(clip: Clip) -> Float:
    positions = clip.positions_mm.astype(np.float64)
    return positions - root_of(positions)[:, None]


@pytest.mark.parametrize("max_names", [False, True])
def test_it_agrees_with_asf_and_amc_of_the_same_clip(tmp_path: Path, max_names: bool) -> None:
    motion = walk()
    write(tmp_path / "02.asf", ASF)
    (truth,) = read(write(tmp_path / "02_01.amc", amc(motion)))
    (clip,) = read(write(tmp_path / "02_01.bvh", cmu_bvh(motion, max_names=max_names)))
    assert_allclose(centred(clip), centred(truth), atol=TOLERANCE_MM)
    assert "thorax of 117 mm above" in " ".join(clip.findings)
    assert "wrist bones" in " ".join(clip.findings)
    if not max_names:  # frame 0 is the T-pose, so the numbers are those of the AMC
        assert "the first frame is a T-pose: dropped" in clip.findings
        assert_allclose(clip.frames, truth.frames)
    assert (clip.subject, clip.frame_rate_hz) == ("cmu_02", 120.0)


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
        ("90 0 0 90 0 0", "90 0 0 nan 0 0", "not finite"),
        ("90 0 0 90 0 0", "90 0 0 x 0 0", "not a whole BVH"),
        ("MOTION", "", "HIERARCHY and MOTION"),
        ("Zrotation Xrotation Y", "Zrotation Xrotation Q", "unknown channels"),
        ("OFFSET 1 0 0", "OFFSET 1 0", "not a whole BVH"),
        ("0.04", "0", "frame time"),
    ],
)
def test_malformed_files_are_refused(tmp_path: Path, old: str, new: str, problem: str) -> None:
    path = write(tmp_path / "bad.bvh", CHAIN.replace(old, new))
    with pytest.raises(MocapError, match=problem) as caught:
        parse(path)
    assert str(path) in str(caught.value)


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


@pytest.mark.parametrize(
    ("content", "problem"),
    [
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


def test_mixamo_names_in_centimetres(tmp_path: Path) -> None:
    text = cmu_bvh(walk()).replace("Spine1", "Spine2").replace("Neck1", "Neck2")
    text = re.sub(r"(ROOT|JOINT) (\w+)", r"\1 mixamorig:\2", text)
    end = text.index("End Site", text.index("mixamorig:Head"))
    close = text.index("}", end)
    offset = text[text.index("OFFSET", end) : close].strip()
    top = f"JOINT mixamorig:HeadTop_End {{\n{offset}\nCHANNELS 0\nEnd Site {{ OFFSET 0 0 0 }} }}"
    text = text[:end] + top + text[close + 1 :]
    (clip,) = read(write(tmp_path / "mixamo.bvh", text))
    assert clip.findings[0] == "joint names: Mixamo"
    assert clip.subject == ""


def test_every_table_has_fourteen_joints() -> None:
    assert all(len(set(table.targets)) == LSP14.n_joints for table in TABLES)
    for table in TABLES:
        assert all(target == target.lower() for target in table.targets)
