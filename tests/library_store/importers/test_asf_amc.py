from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from library_store.anatomy import LENGTHS, measure_lengths
from library_store.importers import MocapError, read
from library_store.importers.asf_amc import bone_ends, find_skeleton, read_asf
from tests.library_store.importers.files import ASF, amc, walk

MM = 25.4 / 0.45


@pytest.fixture
def clip_file(tmp_path: Path) -> Path:
    (tmp_path / "02.asf").write_text(ASF)
    path = tmp_path / "02_01.amc"
    path.write_text(amc(walk()))
    return path


def test_bones_have_the_lengths_of_the_skeleton(clip_file: Path) -> None:
    (clip,) = read(clip_file)
    usual = dict(zip(LENGTHS, measure_lengths(clip.positions_mm.astype(float)).T, strict=True))
    assert_allclose(usual["thigh"], 0.5 * (7.59371 + 7.58734) * MM, atol=0.01)
    assert_allclose(usual["shank"], 0.5 * (7.28717 + 7.21538) * MM, atol=0.01)
    # Elbow to the end of the wrist bone, which is in line with the radius.
    assert_allclose(usual["forearm"], 1.5 * 0.5 * (3.35554 + 3.36431) * MM, atol=0.01)
    assert usual["trunk"].mean() == pytest.approx(540, abs=40)
    assert usual["head"].mean() == pytest.approx(235, abs=15)


def test_at_rest_directions_are_those_of_the_file(clip_file: Path) -> None:
    asf = read_asf(clip_file.with_name("02.asf"))
    rest = {name: np.zeros((1, len(b.dof))) for name, b in asf.bones.items()}
    ends = bone_ends(asf, rest | {"root": np.zeros((1, 6))})
    assert_allclose(ends["ltibia"] - ends["lfemur"], [np.array([0.34202, -0.939693, 0]) * 7.28717])
    assert_allclose(ends["root"], 0.0)


def test_a_root_turned_about_y_turns_the_person(clip_file: Path) -> None:
    asf = read_asf(clip_file.with_name("02.asf"))
    rest = {name: np.zeros((1, len(b.dof))) for name, b in asf.bones.items()}
    turned = bone_ends(asf, rest | {"root": np.array([[0, 0, 0, 0, 90.0, 0]])})
    still = bone_ends(asf, rest | {"root": np.zeros((1, 6))})
    # Anticlockwise about +Y: x goes to -z.
    assert_allclose(turned["lhumerus"][:, 2], -still["lhumerus"][:, 0], atol=1e-9)


def test_the_knee_bends_about_its_own_axis(clip_file: Path) -> None:
    asf = read_asf(clip_file.with_name("02.asf"))
    rest = {name: np.zeros((1, len(b.dof))) for name, b in asf.bones.items()}
    bent = bone_ends(asf, rest | {"root": np.zeros((1, 6)), "ltibia": np.array([[90.0]])})
    # A positive rx of a tibia is flexion: the shank points backwards, away from +Z.
    assert_allclose((bent["ltibia"] - bent["lfemur"])[0], [0, 0, -7.28717], atol=1e-5)


def test_where_it_comes_from_is_kept(clip_file: Path) -> None:
    (clip,) = read(clip_file)
    assert (clip.name, clip.subject, clip.frame_rate_hz) == ("02_01", "cmu_02", 120.0)
    assert_allclose(clip.frames, np.arange(1, 13))
    assert "free for all uses" in clip.licence
    assert clip.positions_mm.dtype == np.float32


def test_subjects_recorded_at_60_hz(clip_file: Path) -> None:
    (clip,) = read(clip_file.rename(clip_file.with_name("60_08.amc")))
    assert clip.frame_rate_hz == 60.0
    assert clip.findings == ("frame rate 60 Hz from the list of CMU subjects",)


@pytest.mark.parametrize("stem", ["20240115_01", "145_01", "00_01", "02_001", "2_1", "02_01_b"])
def test_files_that_others_number_are_not_cmus(clip_file: Path, stem: str) -> None:
    (clip,) = read(clip_file.rename(clip_file.with_name(f"{stem}.amc")))
    assert (clip.subject, clip.licence) == ("", "")
    assert "its name is not CMU's: 120 Hz assumed" in " ".join(clip.findings)


def test_the_index_names_the_action(clip_file: Path) -> None:
    header = '"Subject","Trial #","Motion Description","framerate"\n'
    (clip_file.parent / "cmu_index.csv").write_text(header + '2,1,"walk, then stop",60,343\n')
    (clip,) = read(clip_file)
    assert (clip.action, clip.frame_rate_hz, clip.findings) == ("walk, then stop", 60.0, ())


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("ltibia", "lshin", "lshin"),
        ("rfemur ", "rfemur 1.0 ", "rfemur"),
        ("rfemur ", "rfemur x", "rfemur"),
        ("lradius ", "lradius 1.0 ", "lradius 1.0 .*: 1 value expected"),
        ("lowerback ", "# lowerback ", "lowerback"),
    ],
)
def test_a_malformed_clip_is_refused(clip_file: Path, old: str, new: str, named: str) -> None:
    clip_file.write_text(clip_file.read_text().replace(old, new, 1))
    with pytest.raises(MocapError, match=named) as caught:
        read(clip_file)
    assert str(clip_file) in str(caught.value)


def in_radians(text: str) -> str:
    """An AMC's angles, three to all but the root's last three, in radians."""
    lines = []
    for line in text.splitlines():
        name, *numbers = line.split() or [""]
        if numbers and not line.startswith((":", "#")):
            first = 3 if name == "root" else 0
            turned = [repr(math.radians(float(n))) for n in numbers[first:]]
            line = " ".join([name, *numbers[:first], *turned])
        lines.append(line)
    return "\n".join(lines)


@pytest.mark.parametrize("stated", ["by both", "by the clip", "by the skeleton"])
def test_angles_in_radians(clip_file: Path, stated: str) -> None:
    (truth,) = read(clip_file)
    said = {"by the skeleton": ""}.get(stated, ":RADIANS")
    clip_file.write_text(in_radians(clip_file.read_text()).replace(":DEGREES", said))
    if stated != "by the clip":
        skeleton = re.sub(
            r"axis (\S+) (\S+) (\S+)  XYZ",
            lambda it: (
                "axis " + " ".join(repr(math.radians(float(a))) for a in it.groups()) + " XYZ"
            ),
            ASF.replace("angle deg", "angle rad"),
        )
        clip_file.with_name("02.asf").write_text(skeleton)
    (clip,) = read(clip_file)
    assert_allclose(clip.positions_mm, truth.positions_mm, atol=0.01)


def test_byte_order_marks_and_comments(clip_file: Path) -> None:
    (truth,) = read(clip_file)
    for path in (clip_file, clip_file.with_name("02.asf")):
        path.write_bytes(b"\xef\xbb\xbf# a comment\n" + path.read_bytes())
    clip_file.write_text(clip_file.read_text().replace("\n2\n", "\n 2 # two\n\n"))
    (clip,) = read(clip_file)
    assert_allclose(clip.positions_mm, truth.positions_mm)


@pytest.mark.parametrize(
    ("mm_per_unit", "said"), [(MM, "CMU's units"), (10.0, "centimetres"), (1000.0, "metres")]
)
def test_a_length_that_is_not_the_files_unit(
    clip_file: Path, mm_per_unit: float, said: str
) -> None:
    (truth,) = read(clip_file)
    factor = MM / mm_per_unit
    asf = re.sub(
        r"(?<=     length )\S+", lambda found: f"{float(found[0]) * factor:.9f}", ASF
    ).replace("length 0.45", "length 1.0")
    clip_file.with_name("02.asf").write_text(asf)
    motion = walk()
    motion["root"][:, :3] *= factor
    clip_file.write_text(amc(motion))
    (clip,) = read(clip_file)
    assert_allclose(clip.positions_mm, truth.positions_mm, atol=0.05)
    assert any(said in finding for finding in clip.findings)


@pytest.mark.parametrize("length", ["0", "-0.45", "nan", "inf", "long"])
def test_a_skeleton_without_a_length_is_refused(clip_file: Path, length: str) -> None:
    asf = clip_file.with_name("02.asf")
    asf.write_text(ASF.replace("length 0.45", f"length {length}"))
    with pytest.raises(MocapError, match=r"02\.asf: not a whole ASF"):
        read(clip_file)


def test_a_frame_with_a_number_that_is_none_is_dropped(clip_file: Path) -> None:
    (truth,) = read(clip_file)
    lines = clip_file.read_text().splitlines()
    at = lines.index("4") + 1
    lines[at] = lines[at].replace(lines[at].split()[1], "nan")
    clip_file.write_text("\n".join(lines))
    (clip,) = read(clip_file)
    assert clip.frames.tolist() == [frame for frame in range(1, 13) if frame != 4]
    assert_allclose(clip.positions_mm, truth.positions_mm[truth.frames != 4])


def test_a_cut_clip_is_refused(clip_file: Path) -> None:
    lines = clip_file.read_text().splitlines()
    clip_file.write_text("\n".join(lines[:-3]))
    with pytest.raises(MocapError, match="12 frames"):
        read(clip_file)
    moved = [*lines[:-1], lines[5], lines[-1]]  # a bone twice in the last frame
    clip_file.write_text("\n".join(moved))
    with pytest.raises(MocapError, match="twice"):
        read(clip_file)
    clip_file.write_text("\n".join(lines)[:-60])
    with pytest.raises(MocapError, match=str(clip_file)):
        read(clip_file)


def test_a_skeleton_without_a_bone_is_refused(clip_file: Path) -> None:
    asf = clip_file.with_name("02.asf")
    asf.write_text(ASF.replace("name rwrist", "name rpaw"))
    with pytest.raises(MocapError, match="rwrist"):
        read(clip_file)
    for old, new in (
        ("dof rx ry rz", "dof rx ry rq"),
        ("order TX", "order TQ"),
        ("    lfemur lt", "    lfemu lt"),
    ):
        asf.write_text(ASF.replace(old, new))
        with pytest.raises(MocapError, match=r"02\.asf: not a whole ASF"):
            read(clip_file)
    asf.unlink()
    with pytest.raises(MocapError, match=r"ASF skeleton.*found: none"):
        read(clip_file)


def test_a_skeleton_is_that_of_its_own_subject(clip_file: Path) -> None:
    """All of CMU's files in one folder: 10.asf is not the skeleton of 105_01.amc."""
    folder, text = clip_file.parent, clip_file.read_text()
    (folder / "10.asf").write_text(ASF)
    for stem in ("10", "10_01", "10-dance"):
        assert find_skeleton(folder / f"{stem}.amc") == folder / "10.asf"
    (folder / "105_01.amc").write_text(text)
    with pytest.raises(MocapError, match=r"105_01\.amc: its ASF .* found: 02\.asf, 10\.asf"):
        read(folder / "105_01.amc")


def test_what_is_wrong_is_said_in_words(clip_file: Path) -> None:
    text, asf = clip_file.read_text(), clip_file.with_name("02.asf")
    clip_file.write_text(text.replace("ltibia", "lshin"))
    with pytest.raises(MocapError, match=r"line \d+: 'lshin .*': its skeleton has no such bone"):
        read(clip_file)
    asf.write_text(ASF[: ASF.index(":hierarchy")])
    with pytest.raises(MocapError, match="not a whole ASF skeleton: it has no 'hierarchy'"):
        read(clip_file)
