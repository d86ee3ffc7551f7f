"""The `posematch` command, as a user runs it."""

from __future__ import annotations

import json
import os
import re
import resource
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner, Result

from app.cli import cli
from app.commands.bench import measure
from app.commands.predict import picture_targets, read_photo
from app.engine import load_engine
from app.errors import InvalidInputError
from app.schemas import BatchItem, PosesAnswer
from app.settings import Settings
from app.version import VERSION
from library_store.errors import LibraryError
from tests.app.conftest import RENDERS
from tests.app.server import COMMAND, environment
from tests.library_store.clips import clip, write_clips
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


def invoke(*arguments: object) -> Result:
    """In this process: much faster, for what needs no engine."""
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


def test_version() -> None:
    assert run("version").stdout.strip() == VERSION


def test_help_has_examples() -> None:
    assert "doctor" in invoke("--help").stdout
    for command in ("serve", "predict", "evaluate", "bench", "doctor"):
        said = invoke(command, "--help").stdout
        # On a line of its own: help is not wrapped there.
        assert re.search(rf"^ +(\w+=\S+ )*posematch {command}", said, re.M), said


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


def test_predict_a_folder_and_a_file(library_dir: Path, tmp_path: Path) -> None:
    """Every photo is answered or complained about; pictures have names of their own."""
    photos = tmp_path / "photos"
    (photos / "deeper").mkdir(parents=True)
    shutil.copy(RENDERS / "000.jpg", photos / "a.jpg")
    shutil.copy(RENDERS / "006.jpg", photos / "deeper" / "a.JPG")
    (photos / "cut.jpg").write_bytes((RENDERS / "014.jpg").read_bytes()[:5000])
    (photos / "notes.txt").write_text("not looked at")
    pictures = tmp_path / "pictures"
    done = run(
        *("predict", photos, photos / "a.jpg", RENDERS / "022.jpg", "--json", "--max-people", 1),
        *("--image", pictures, "--image-type", "svg"),
        library_dir=library_dir,
    )
    assert done.returncode == 1
    assert "3 of 4 photos answered" in done.stderr
    (complaint,) = [line for line in done.stderr.splitlines() if "error:" in line]
    assert "cut.jpg" in complaint
    items = [BatchItem.model_validate_json(line) for line in done.stdout.splitlines()]
    expected = ["a.jpg", "cut.jpg", "deeper/a.JPG"]
    assert [it.name for it in items[:3]] == [str(photos / name) for name in expected]
    assert [it.answer is None for it in items] == [False, True, False, False]
    assert items[1].problem is not None
    assert items[1].problem.type.endswith("undecodable-image")
    assert {it.name for it in pictures.iterdir()} == {"a.svg", "a-2.svg", "022.svg"}


def test_predict_says_what_is_wrong_with_the_command(tmp_path: Path) -> None:
    photo = RENDERS / "000.jpg"
    for arguments, said in (
        ((tmp_path,), "no .jpg"),
        ((tmp_path / "none.jpg",), "does not exist"),
        ((photo, "--image", tmp_path / "out.gif"), ".svg"),
        ((photo, RENDERS / "006.jpg", "--image", photo), "folder"),
        ((photo, "--image", photo), "would be lost"),
        ((RENDERS, "--image", RENDERS, "--image-type", "jpg"), "would be lost"),
        ((photo, "--method", "magic"), "fusion"),
    ):
        done = invoke("predict", *arguments)
        assert done.exit_code == 2, arguments
        assert said in done.stderr


def test_pictures_have_names_of_their_own(tmp_path: Path) -> None:
    photos = [tmp_path / name for name in ("a-2.jpg", "a.jpg", "a.png", "b/a.jpg", "b/c.jpg")]
    targets = picture_targets(photos, tmp_path / "out", "svg")
    names = ["a-2.svg", "a.svg", "a-3.svg", "a-4.svg", "c.svg"]
    assert targets == [tmp_path / "out" / name for name in names]


def test_predict_refuses_what_is_no_photo(library_dir: Path, tmp_path: Path) -> None:
    text = tmp_path / "notes.txt"
    text.write_text("hello")
    done = run("predict", text, library_dir=library_dir)
    assert done.returncode == 1
    assert "image/jpeg" in done.stderr
    assert "Traceback" not in done.stderr
    done = run("predict", RENDERS / "000.jpg", library_dir=library_dir, max_body_bytes=1000)
    assert done.returncode == 1
    assert "1000 bytes" in done.stderr


def test_a_picture_is_written_whole_or_not_at_all(library_dir: Path, tmp_path: Path) -> None:
    picture = tmp_path / "out.png"
    picture.write_text("the picture of yesterday")
    done = subprocess.run(
        [COMMAND, "predict", RENDERS / "000.jpg", "--image", picture],
        env=environment(library_dir=library_dir),
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000)),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert "File too large" in done.stderr
    assert list(tmp_path.iterdir()) == [picture]
    assert picture.read_text() == "the picture of yesterday"


def test_predict_reads_no_more_than_a_photo_may_have() -> None:
    photo = RENDERS / "000.jpg"
    for path in (Path("/dev/zero"), photo):
        with pytest.raises(InvalidInputError, match="larger than 10000 bytes"):
            read_photo(path, 10_000)
    size_bytes = photo.stat().st_size
    assert len(read_photo(photo, size_bytes)) == size_bytes


def test_names_and_terminals_without_the_letters(library_dir: Path, tmp_path: Path) -> None:
    photos = [tmp_path / "fotö.jpg", Path(os.fsdecode(bytes(tmp_path) + b"/\xff.jpg"))]
    for photo in photos:
        shutil.copy(RENDERS / "000.jpg", photo)
    plain = environment(library_dir=library_dir) | {"PYTHONIOENCODING": "ascii"}
    for arguments in (photos, [photos[0], "--json"], [*photos, "--json"]):
        done = subprocess.run(
            [COMMAND, "predict", *arguments], env=plain, capture_output=True, check=False
        )
        assert done.returncode == 0, done.stderr
        if len(arguments) == 3:
            names = [BatchItem.model_validate_json(line).name for line in done.stdout.splitlines()]
            assert names == [str(photos[0]), f"{tmp_path}/\N{REPLACEMENT CHARACTER}.jpg"]
        elif "--json" in arguments:
            assert PosesAnswer.model_validate_json(done.stdout).request_id == "fotö.jpg"
        else:
            assert b"fot\\xf6.jpg: 640 x 480 px" in done.stdout


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
@pytest.mark.parametrize("arguments", [["version"], ["evaluate"], ["--help"]])
def test_a_full_disk_under_what_is_printed(arguments: list[str]) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [COMMAND, *arguments], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert done.returncode == 1
    assert done.stderr == "error: the output: No space left on device\n"


def test_bench(library_dir: Path) -> None:
    done = run("bench", "--seconds", 0.2, "--json", library_dir=library_dir, workers=2)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert [it["threads"] for it in report["runs"]] == [1, 2]
    for speed in report["runs"]:
        assert {"decode", "detect", "pose", "match", "camera", "warp"} <= speed["stages_ms"].keys()
        assert 0 < speed["stages_ms"]["pose"] < speed["median_ms"] <= speed["p95_ms"]
        assert speed["cpu_ms_per_photo"] > 0
        assert speed["people"] == 1
    table = run("bench", "--seconds", 0.2, library_dir=library_dir, workers=1)
    assert "photos a second" in table.stdout


def test_bench_measures_once_however_little_time_there_is(library_dir: Path, photo: bytes) -> None:
    engine = load_engine(Settings(library_dir=library_dir))
    speed = measure(engine, photo, threads=2, seconds=0.0)
    assert speed.photos == 2
    assert 0 < speed.median_ms <= speed.p95_ms


def test_evaluate_lists_and_runs_programs(library_dir: Path, tmp_path: Path) -> None:
    listed = invoke("evaluate")
    assert listed.exit_code == 0
    names = {line.split()[0] for line in listed.stdout.splitlines()}
    assert {"lifting", "paper", "pose2d", "renders"} <= names
    assert "metrics" not in names, "no program"
    measured = run("evaluate", "renders", "--data", RENDERS, library_dir=library_dir)
    assert "mean (4 of 4 lifted)" in measured.stdout, measured.stderr
    for program in ("renders", "paper"):
        helped = run("evaluate", program, "--help")
        assert helped.returncode == 0
        assert f"posematch evaluate {program}" in helped.stdout
    nothing = run("evaluate", "conversion", "--data", tmp_path)
    assert nothing.returncode == 2
    assert "photos_a.tar" in nothing.stderr
    unknown = invoke("evaluate", "luck")
    assert unknown.exit_code == 2
    assert "lifting" in unknown.stderr


def test_paths_that_are_not_there_or_no_directories(tmp_path: Path) -> None:
    absent = run("evaluate", "renders", "--data", tmp_path / "none")
    assert absent.returncode == 1
    assert absent.stderr.strip().startswith("error: ")
    assert absent.stderr.strip().endswith("No such file or directory")
    file = tmp_path / "file"
    file.touch()
    wrong = run("library", "info", file)
    assert wrong.returncode == 1
    assert "is that the directory of a library" in wrong.stderr.replace(str(file), "that")
    assert "delete" not in wrong.stderr


def test_library_import(tmp_path: Path) -> None:
    (tmp_path / "02_01.bvh").write_text(cmu_bvh(walk()))
    (tmp_path / "bad.bvh").write_text("HIERARCHY")
    out = tmp_path / "out" / "clips.npz"
    early = invoke("library", "import", tmp_path, "--out", out)
    assert (early.exit_code, "there is no folder" in early.stderr) == (2, True)
    out.parent.mkdir()
    done = run("library", "import", tmp_path, "--out", out)
    assert done.returncode == 0, done.stderr
    assert "1 clip, 3 poses; 1 skipped" in done.stdout
    assert "bad.bvh: not a BVH file" in done.stderr
    with np.load(out) as written:
        assert written["positions"].shape == (3, 14, 3)
        assert written["frame"].tolist() == [1, 5, 9]
        assert written["clip_subject"].tolist() == ["cmu_02"]
        assert "CMU" in str(written["license"])
    again = invoke("library", "import", tmp_path, "--out", out)
    assert (again.exit_code, "is among what is read" in again.stderr) == (2, True)
    out.unlink()
    done = run("library", "import", tmp_path, "--out", out, "--strict")
    assert done.returncode == 1
    assert "error:" in done.stderr
    assert "bad.bvh" in done.stderr
    assert not out.exists()


def test_library_commands(library_dir: Path, tmp_path: Path) -> None:
    info = run("library", "info", "--json", library_dir=library_dir)
    assert json.loads(info.stdout)["n_exemplars"] == 4000
    said = run("library", "info", library_dir).stdout
    assert "licence of CMU Graphics Lab" in said
    assert json.loads(info.stdout)["sha256"] in "".join(said.split()), "folded, not cut"
    assert "whole" in run("library", "verify", library_dir=library_dir).stdout
    built = tmp_path / "tiny"
    done = run("library", "build", "--directory", built, "--size", 100)
    assert done.returncode == 0, done.stderr
    assert "poses ...\n" in done.stderr, "no bars: this is no terminal"
    (built / "cameras.npy").write_bytes(b"oops")
    broken = run("library", "verify", built)
    assert broken.returncode == 1
    assert "error:" in broken.stderr
    assert "cameras.npy" in broken.stderr
    assert "Traceback" not in broken.stderr
    assert "needs --directory" in run("library", "build", "--size", 9).stderr


def test_a_library_in_service_is_not_replaced_unasked(tmp_path: Path) -> None:
    own = tmp_path / "own"
    assert run("library", "build", "--directory", own, "--size", 60).returncode == 0
    refused = run("library", "build", library_dir=own)
    assert refused.returncode == 2
    said = " ".join(refused.stderr.replace("│", " ").split())
    assert "holds a library, which poses of the default prior would replace" in said
    assert json.loads(run("library", "info", own, "--json").stdout)["n_exemplars"] == 60
    assert run("library", "build", "--size", 70, library_dir=own).returncode == 0
    assert json.loads(run("library", "info", own, "--json").stdout)["n_exemplars"] == 70


@pytest.mark.parametrize("option", ["--rate", "--radius-mm", "--fps", "--size"])
@pytest.mark.parametrize("value", ["inf", "nan", "1e300", "-1", "1000000000000"])
def test_numbers_that_make_no_sense_are_refused(option: str, value: str, tmp_path: Path) -> None:
    file = tmp_path / "a.npz"
    write_clips(file, clip("dance", 120, 1, licence="ours"))
    if option == "--fps":
        refused = invoke("library", "import", file, "--out", tmp_path / "out.npz", option, value)
    else:
        build = ("library", "build", "--from", file, "--directory", tmp_path / "own")
        refused = invoke(*build, option, value)
    assert (refused.exit_code, option in refused.stderr) == (2, True)
    assert [path.name for path in tmp_path.iterdir()] == ["a.npz"]


def test_a_library_of_ones_own(tmp_path: Path) -> None:
    """Build, look, merge: what the documentation shows."""
    files = {name: tmp_path / f"{name}.npz" for name in "ab"}
    write_clips(files["a"], clip("dance", 120, 1, licence=""))
    write_clips(files["b"], clip("walk", 90, 2, licence="CC BY 4.0"))
    own = tmp_path / "own"
    build = ("library", "build", "--directory", own, "--from", files["a"], "--from", files["b"])
    refused = run(*build, "--size", 500)
    assert refused.returncode == 1
    assert "a.npz: does not say under which licence clip 'dance'" in refused.stderr
    (tmp_path / "walk.bvh").write_text("HIERARCHY")
    unread = invoke(*build, "--from", tmp_path / "walk.bvh", "--licence", "ours")
    assert unread.exit_code == 2
    assert "`posematch library import`" in unread.stderr
    done = invoke(*build, "--size", 500, "--licence", "ours", "--radius-mm", 5)
    assert done.exit_code == 0, done.stderr
    assert "licence of a.npz: ours\nlicence of b.npz: CC BY 4.0" in done.stdout
    info = invoke("library", "info", own).stdout
    assert "radius_mm 5.0" in info
    assert "licence of b.npz: CC BY 4.0" in info
    sheet = tmp_path / "sheet.png"
    sampled = invoke("library", "sample", own, "--out", sheet, "--count", 6, "--kind", "composed")
    assert "6 of 500 exemplars" in sampled.stdout
    picture = cv2.imread(str(sheet))
    assert picture is not None
    for option, value in (("--kind", "dreamt"), ("--out", tmp_path / "sheet.txt")):
        wrong = invoke("library", "sample", own, option, value)
        assert (wrong.exit_code, option in wrong.stderr) == (2, True)
    damaged = shutil.copytree(own, tmp_path / "damaged") / "descriptors.npy"
    damaged.write_bytes(damaged.read_bytes().replace(b")", b",", 1))  # in the header
    broken = invoke("library", "sample", damaged.parent, "--out", sheet)
    assert isinstance(broken.exception, LibraryError)
    other = tmp_path / "other"
    both = (*build[:3], other, "--from", files["b"], "--prior", "default", "--size", 200)
    assert invoke(*both).exit_code == 0
    merged = tmp_path / "merged"
    done = invoke("library", "merge", own, other, "--directory", merged)
    assert done.exit_code == 0, done.stderr
    manifest = json.loads(invoke("library", "info", merged, "--json").stdout)
    assert manifest["n_exemplars"] == 700
    assert {it["licence"] for it in manifest["licences"]} >= {"ours", "CC BY 4.0"}
