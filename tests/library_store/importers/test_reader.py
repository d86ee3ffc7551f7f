from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from library_store.errors import LibraryError
from library_store.importers import Clip, MocapError, find_files, read, read_all
from tests.library_store.importers.files import ASF, amc, cmu_bvh, walk


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "02").mkdir()
    (tmp_path / "02" / "02.asf").write_text(ASF)
    (tmp_path / "02" / "02_01.amc").write_text(amc(walk()))
    (tmp_path / "02" / "02_02.amc").write_text(amc(walk())[:-40])
    (tmp_path / "02_01.BVH").write_text(cmu_bvh(walk()))
    (tmp_path / "notes.txt").write_text("not mocap")
    return tmp_path


def test_a_malformed_file_is_named_and_skipped(folder: Path) -> None:
    clips, skipped = read_all([folder])
    assert [clip.name for clip in clips] == ["02_01", "02_01"]
    assert [str(error).split(":")[0] for error in skipped] == [str(folder / "02" / "02_02.amc")]


def test_strict_refuses_it(folder: Path) -> None:
    with pytest.raises(MocapError, match="02_02"):
        read_all([folder], strict=True)


def test_what_macos_keeps_beside_files_is_none_of_them(folder: Path) -> None:
    (folder / "02" / "02_02.amc").unlink()
    (folder / "02" / "02.asf").rename(folder / "02" / "person.asf")
    for name in ("02/._02_01.amc", "02/._person.asf", "._02_01.BVH"):
        (folder / name).write_bytes(b"\x00\x05\x16\x07\x00\x02\x00\x00Mac OS X")
    clips, skipped = read_all([folder], strict=True)
    assert [clip.name for clip in clips] == ["02_01", "02_01"]
    assert skipped == []


def test_a_bad_mapping_file_is_not_every_files_fault(folder: Path) -> None:
    mapping = folder / "mapping.json"
    mapping.write_text("{}")
    with pytest.raises(MocapError, match=r"mapping\.json: joints missing"):
        read_all([folder], mapping=mapping)


def test_files_of_other_kinds_and_missing_ones(folder: Path) -> None:
    with pytest.raises(LibraryError, match=r"notes\.txt: not a kind of file"):
        read(folder / "notes.txt")
    with pytest.raises(MocapError, match="cannot be read: No such file"):
        read(folder / "nothing.bvh")


def test_an_archive_is_to_be_unpacked(tmp_path: Path) -> None:
    (tmp_path / "clips.zip").write_bytes(b"PK")
    with pytest.raises(MocapError, match=r"clips\.zip: not a kind of file .*; unpack it first"):
        read(tmp_path / "clips.zip")


def test_links_to_folders_are_followed_and_rings_end(folder: Path, tmp_path: Path) -> None:
    top = tmp_path / "top"
    (top / "walk.bvh").mkdir(parents=True)  # a folder, whatever it is called
    (top / "walk.bvh" / "inner.bvh").write_text(cmu_bvh(walk()))
    (top / "linked").symlink_to(folder / "02")
    (top / "walk.bvh" / "ring").symlink_to(top)
    names = [path.relative_to(top).as_posix() for path in find_files([top])]
    assert names == ["linked/02_01.amc", "linked/02_02.amc", "walk.bvh/inner.bvh"]


def test_folders_that_cannot_be_read_are_named(folder: Path) -> None:
    name, depth = "x" * 200, 25
    opened = [os.open(folder, os.O_RDONLY)]
    for _ in range(depth):  # longer than any path may be: root may read everything else
        os.mkdir(name, dir_fd=opened[-1])
        opened.append(os.open(name, os.O_RDONLY, dir_fd=opened[-1]))
    clips, skipped = read_all([folder])
    assert len(clips) == 2
    assert len(skipped) == 2
    assert str(skipped[1]).endswith(f"{name}: cannot be read: File name too long")
    with pytest.raises(MocapError, match="is no file"):
        read(folder / "02")
    for number in opened:
        os.close(number)


def test_a_pipe_is_not_waited_for(folder: Path) -> None:
    os.mkfifo(folder / "pipe.bvh")
    _, skipped = read_all([folder])
    assert str(skipped[1]) == f"{folder / 'pipe.bvh'}: is no file"


@pytest.mark.parametrize(
    ("rate_hz", "wanted_hz", "step"),
    [(120.0, 30.0, 4), (119.98, 30.0, 4), (50.0, 30.0, 1), (100.0, 30.0, 3), (np.nan, 30.0, 1)],
)
def test_thinning(rate_hz: float, wanted_hz: float, step: int) -> None:
    positions = np.zeros((10, 14, 3), dtype=np.float32)
    clip = Clip("a", "", "", rate_hz, positions, np.arange(10)).thinned(wanted_hz)
    assert list(clip.frames) == list(range(0, 10, step))
    assert clip.frame_rate_hz == pytest.approx(rate_hz / step, nan_ok=True)
    assert len(clip.positions_mm) == len(clip)
