"""BVH: several people in a file, and things beside them."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from numpy.testing import assert_allclose

from library_store.importers import MocapError, read, read_all
from library_store.importers.joint_tables import TABLES
from library_store.skeleton import LSP14, R_WRIST
from tests.library_store.importers.bvh_files import LIMBS, renamed, scaled, write
from tests.library_store.importers.files import cmu_bvh, walk

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
