"""The `posematch` command, as a user runs it."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import cv2
import numpy as np

from app.schemas import PosesAnswer
from app.version import VERSION
from tests.app.conftest import RENDERS
from tests.app.server import COMMAND, environment
from tests.library_store.importers.files import cmu_bvh, walk


def run(*arguments: object, **settings: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [COMMAND, *map(str, arguments)],
        env=environment(**settings),
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_version() -> None:
    assert run("version").stdout.strip() == VERSION


def test_predict(library_dir: Path, tmp_path: Path) -> None:
    picture = tmp_path / "out.png"
    photo = RENDERS / "000.jpg"
    done = run("predict", photo, "--json", "--image", picture, library_dir=library_dir)
    assert done.returncode == 0, done.stderr
    answer = PosesAnswer.model_validate_json(done.stdout)
    assert answer.people
    drawn = cv2.imread(str(picture))
    assert drawn is not None
    assert drawn.shape == (720, 960 + 720 + 720, 3)
    table = run("predict", photo, library_dir=library_dir)
    assert "head_top" in table.stdout


def test_predict_refuses_what_is_no_photo(library_dir: Path, tmp_path: Path) -> None:
    text = tmp_path / "notes.txt"
    text.write_text("hello")
    done = run("predict", text, library_dir=library_dir)
    assert done.returncode == 1
    assert "image/jpeg" in done.stderr
    assert "Traceback" not in done.stderr


def test_library_import(tmp_path: Path) -> None:
    (tmp_path / "02_01.bvh").write_text(cmu_bvh(walk()))
    (tmp_path / "bad.bvh").write_text("HIERARCHY")
    out = tmp_path / "out" / "clips.npz"
    out.parent.mkdir()
    done = run("library", "import", tmp_path, "--out", out)
    assert done.returncode == 0, done.stderr
    assert "1 clips, 3 poses; 1 files skipped" in done.stdout
    assert "bad.bvh: not a BVH file" in done.stderr
    with np.load(out) as written:
        assert written["positions"].shape == (3, 14, 3)
        assert written["frame"].tolist() == [1, 5, 9]
        assert written["clip_subject"].tolist() == ["cmu_02"]
        assert "CMU" in str(written["license"])
    out.unlink()
    done = run("library", "import", tmp_path, "--out", out, "--strict")
    assert done.returncode == 1
    assert "error:" in done.stderr
    assert "bad.bvh" in done.stderr
    assert not out.exists()


def test_library_commands(library_dir: Path, tmp_path: Path) -> None:
    info = run("library", "info", library_dir=library_dir)
    assert json.loads(info.stdout)["n_exemplars"] == 4000
    assert "whole" in run("library", "verify", library_dir=library_dir).stdout
    built = tmp_path / "tiny"
    done = run("library", "build", "--directory", built, "--poses", 100)
    assert done.returncode == 0, done.stderr
    (built / "cameras.npy").write_bytes(b"oops")
    broken = run("library", "verify", library_dir=built)
    assert broken.returncode == 1
    assert "cameras.npy" in broken.stderr
    assert "Traceback" not in broken.stderr
