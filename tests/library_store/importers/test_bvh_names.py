"""BVH: whose joints they are, by the names that programs and mapping files give."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from library_store.anatomy import root_of
from library_store.importers import MocapError, read
from library_store.importers.joint_tables import TABLES, plain
from library_store.skeleton import HEAD_TOP, LSP14, NECK
from tests.library_store.importers.bvh_files import (
    CHAIN,
    JAW,
    LIMBS,
    centred,
    renamed,
    scaled,
    write,
)
from tests.library_store.importers.files import cmu_bvh, walk


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


BLENDER = ("upper_arm", "forearm", "hand", "thigh", "shin", "foot")
ROKOKO = ("Arm", "ForeArm", "Hand", "Thigh", "Shin", "Foot")
SMPL_X = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
BIPED = ("UpperArm", "Forearm", "Hand", "Thigh", "Calf", "Foot")


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
