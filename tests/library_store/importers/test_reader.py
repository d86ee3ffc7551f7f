from __future__ import annotations

from pathlib import Path

import pytest

from library_store.errors import LibraryError
from library_store.importers import MocapError, read, read_all
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


def test_files_of_other_kinds_and_missing_ones(folder: Path) -> None:
    with pytest.raises(LibraryError, match=r"notes\.txt: not a kind of file"):
        read(folder / "notes.txt")
    with pytest.raises(MocapError, match="cannot be read: No such file"):
        read(folder / "nothing.bvh")
