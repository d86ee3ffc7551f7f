from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from library_store import build, publish
from library_store.backends import IndexSettings
from library_store.build import (
    BuildSettings,
    build_key,
    build_library,
    describe_library,
    ensure_default_library,
    verify_library,
)
from library_store.cell_index import CELL_FILES, ENTRIES_FILE
from library_store.errors import LibraryError
from library_store.library import Library, load
from library_store.manifest import CONTENT_FILES, MANIFEST
from library_store.prior import PosePrior
from tests.library_store.conftest import SMALL

TINY = BuildSettings(name="tiny", n_poses=300)

BUILD_AND_STALL = """
import sys, time
from pathlib import Path
from library_store.build import BuildSettings, build_library
from library_store.prior import PosePrior

def stall(stage, fraction):
    if stage == sys.argv[2]:
        print("stalled", flush=True)
        time.sleep(60)

build_library(Path(sys.argv[1]), PosePrior.load(), BuildSettings("tiny", 300, seed=1), stall)
"""

BUILD = """
import sys
from pathlib import Path
from library_store.build import BuildSettings, ensure_default_library
ensure_default_library(Path(sys.argv[1]), settings=BuildSettings("tiny", 300))
"""


@pytest.fixture(scope="module")
def pristine(prior: PosePrior, tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("pristine") / "tiny"
    build_library(directory, prior, TINY)
    return directory


@pytest.fixture
def tiny(pristine: Path, tmp_path: Path) -> Path:
    """A tiny library of the test's own."""
    return Path(shutil.copytree(pristine, tmp_path / "tiny"))


def hidden(directory: Path) -> list[str]:
    return [path.name for path in directory.parent.glob(".*") if not path.name.endswith(".lock")]


def test_two_builds_are_the_same_bytes(
    prior: PosePrior, small: Library, small_directory: Path, tmp_path: Path
) -> None:
    again = build_library(tmp_path / "again", prior, SMALL)
    assert again.sha256 == small.manifest.sha256
    for name in (*CONTENT_FILES, *CELL_FILES, MANIFEST):
        assert (tmp_path / "again" / name).read_bytes() == (small_directory / name).read_bytes()


def test_poses_lie_on_a_grid_that_hides_the_last_bits(pristine: Path) -> None:
    """Or the digest would depend on the machine's maths library."""
    steps = np.load(pristine / "poses.npy").astype(np.float64) / 0.01
    assert np.abs(steps - np.round(steps)).max() < 0.02


def test_the_digest_is_of_the_content_not_of_the_index(
    prior: PosePrior, tiny: Path, tmp_path: Path
) -> None:
    settings = replace(TINY, index=IndexSettings(rows_per_cell=20))
    other = build_library(tmp_path / "other", prior, settings)
    same = describe_library(tiny)
    assert other.files[ENTRIES_FILE] != same.files[ENTRIES_FILE]
    assert other.sha256 == same.sha256
    reseeded = build_library(tmp_path / "other", prior, replace(TINY, seed=1))
    assert reseeded.sha256 != same.sha256


def test_a_smaller_library_is_the_beginning_of_a_larger(tiny: Path, prior: PosePrior) -> None:
    small = load(tiny)
    build_library(tiny.parent / "larger", prior, replace(TINY, n_poses=1_200))
    larger = load(tiny.parent / "larger")
    entries = np.arange(300)
    assert_array_equal(small.poses_mm(entries), larger.poses_mm(entries))
    assert_array_equal(small.descriptors(entries), larger.descriptors(entries))
    assert small.exemplar_id(299) == larger.exemplar_id(299)


def test_several_cameras_see_one_pose(tiny: Path, prior: PosePrior) -> None:
    manifest = build_library(tiny, prior, replace(TINY, n_poses=100, cameras_per_pose=4))
    assert (manifest.n_poses, manifest.n_cameras, manifest.n_exemplars) == (100, 400, 400)
    library = load(tiny)
    assert_array_equal(library.poses_mm(np.arange(4)), library.poses_mm([0, 0, 0, 0]))
    rotation, _ = library.cameras([0, 1])
    assert not np.allclose(rotation[0], rotation[1])
    ids = [library.exemplar_id(entry) for entry in range(400)]
    assert len(set(ids)) == 400
    assert [library.find(name) for name in ids] == list(range(400))


def test_progress_names_stages_and_ends(prior: PosePrior, tmp_path: Path) -> None:
    heard: list[tuple[str, float]] = []
    build_library(tmp_path / "tiny", prior, TINY, lambda stage, done: heard.append((stage, done)))
    stages = list(dict.fromkeys(stage for stage, _ in heard))
    assert stages == ["poses", "descriptors", "index", "checksums"]
    for stage in stages:
        fractions = [done for name, done in heard if name == stage]
        assert fractions == sorted(fractions)
        assert fractions[-1] == 1.0


@pytest.mark.parametrize("stage", ["poses", "index", "checksums"])
def test_a_build_killed_leaves_the_old_library_whole(stage: str, tiny: Path) -> None:
    before = describe_library(tiny).sha256
    builder = subprocess.Popen(
        [sys.executable, "-c", BUILD_AND_STALL, str(tiny), stage], stdout=subprocess.PIPE
    )
    assert builder.stdout is not None
    assert builder.stdout.readline() == b"stalled\n"
    builder.send_signal(signal.SIGKILL)
    builder.wait()
    builder.stdout.close()
    assert verify_library(tiny).sha256 == before
    load(tiny).close()
    assert len(hidden(tiny)) == 1, "the killed build's directory is still there"
    build_library(tiny, PosePrior.load(), replace(TINY, seed=1))
    assert verify_library(tiny).sha256 != before
    assert hidden(tiny) == [], "and swept by the next build"


def test_a_build_that_fails_leaves_the_old_library_whole(tiny: Path, prior: PosePrior) -> None:
    before = describe_library(tiny).sha256

    def fail(stage: str, _fraction: float) -> None:
        if stage == "index":
            raise OSError(28, "No space left on device")

    with pytest.raises(LibraryError, match=r"No space left.*100 MB free"):
        build_library(tiny, prior, replace(TINY, seed=1), fail)
    assert verify_library(tiny).sha256 == before
    assert hidden(tiny) == []


def test_readers_keep_the_library_they_opened(tiny: Path, prior: PosePrior) -> None:
    opened = load(tiny)
    poses = opened.poses_mm(np.arange(300))
    build_library(tiny, prior, replace(TINY, seed=1))
    assert_array_equal(opened.poses_mm(np.arange(300)), poses)
    assert not np.array_equal(load(tiny).poses_mm(np.arange(300)), poses)


def test_a_library_replaced_while_it_is_opened_is_one_of_them(
    tiny: Path, prior: PosePrior, tmp_path: Path
) -> None:
    build_library(tmp_path / "other", prior, replace(TINY, seed=1))
    both = (tiny, tmp_path / "other")
    firsts = {load(path).manifest.sha256: load(path).poses_mm(0) for path in both}
    versions = []
    for number in range(60):  # the same two over and over, but never the same version again
        versions.append(shutil.copytree(both[1 - number % 2], tmp_path / f"version {number}"))
        manifest = replace(describe_library(versions[-1]), version=str(number))
        (versions[-1] / MANIFEST).write_text(manifest.to_json())
    done = threading.Event()

    def publish_on_and_on() -> None:
        for version in versions:
            publish.put_in_place(version, tiny)
            time.sleep(0.02)
        done.set()

    publisher = threading.Thread(target=publish_on_and_on)
    publisher.start()
    try:
        while not done.is_set():
            for library in (load(tiny), load(tiny, verify=False)):
                assert_array_equal(library.poses_mm(0), firsts[library.manifest.sha256])
            assert verify_library(tiny).sha256 in firsts
    finally:
        publisher.join()


def test_two_processes_building_at_once(tmp_path: Path) -> None:
    builders = [subprocess.Popen([sys.executable, "-c", BUILD, str(tmp_path)]) for _ in range(2)]
    assert [builder.wait() for builder in builders] == [0, 0]
    (directory,) = tmp_path.glob("tiny-*")
    verify_library(directory)
    assert hidden(directory) == []


def test_who_waits_for_another_build_is_told(tiny: Path, prior: PosePrior) -> None:
    heard: list[str] = []
    script = "import fcntl,sys,time; f=open(sys.argv[1],'w'); fcntl.flock(f,fcntl.LOCK_EX); "
    script += "print('locked',flush=True); time.sleep(0.5)"
    lock = tiny.parent / f".{tiny.name}.lock"
    holder = subprocess.Popen([sys.executable, "-c", script, str(lock)], stdout=subprocess.PIPE)
    assert holder.stdout is not None
    holder.stdout.readline()
    started = time.monotonic()
    build_library(tiny, prior, TINY, lambda stage, _done: heard.append(stage))
    assert time.monotonic() - started > 0.3
    assert heard[0] == "waiting for another build"
    holder.wait()
    holder.stdout.close()


def test_the_default_library_is_built_once(tmp_path: Path) -> None:
    heard: list[str] = []

    def ensure(settings: BuildSettings) -> Path:
        return ensure_default_library(
            tmp_path, lambda stage, _done: heard.append(stage), settings=settings
        )

    first = ensure(TINY)
    assert heard
    heard.clear()
    assert ensure(TINY) == first
    assert not heard, "nothing was built the second time"
    (first / "poses.npy").write_bytes(b"cut")
    assert ensure(TINY) == first
    verify_library(first)
    assert ensure(replace(TINY, seed=1)) != first
    verify_library(first)


def test_the_key_covers_everything_the_library_is_made_of(prior: PosePrior) -> None:
    keys = {
        build_key(prior, TINY),
        build_key(replace(prior, sha256="0" * 64), TINY),
        build_key(prior, replace(TINY, seed=1)),
        build_key(prior, replace(TINY, n_poses=301)),
        build_key(prior, replace(TINY, cameras_per_pose=2)),
        build_key(prior, replace(TINY, index=IndexSettings(rows_per_cell=20))),
    }
    assert len(keys) == 6


def test_another_recipe_is_another_version(
    tiny: Path, prior: PosePrior, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    version = describe_library(tiny).version
    assert version == f"{prior.card.version}.{build.RECIPE}"
    key = build_key(prior, TINY)
    monkeypatch.setattr(build, "RECIPE", build.RECIPE + 1)
    assert build_key(prior, TINY) != key
    few = BuildSettings(n_poses=9)
    assert build_library(tmp_path / "next", prior, few).version not in ("", version)
    named = replace(few, version="mine")
    assert build_library(tmp_path / "named", prior, named).version == "mine"


def test_settings_that_make_no_library_are_refused() -> None:
    with pytest.raises(ValueError, match="must match"):
        BuildSettings(name="a/b")
    with pytest.raises(ValueError, match="at least one"):
        BuildSettings(n_poses=0)


def test_a_directory_that_cannot_be_written_is_named(prior: PosePrior, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(LibraryError, match=r"cannot be built.*parent directory is writable"):
        build_library(tmp_path / "file" / "library", prior, TINY)


def test_what_is_no_library_is_never_replaced(prior: PosePrior, tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "a.jpg").write_text("precious")
    for target, problem in ((photos, "holds a.jpg"), (photos / "a.jpg", "is a file")):
        with pytest.raises(LibraryError, match=rf"{target} .*{problem}.* would be lost"):
            build_library(target, prior, TINY)
    assert [path.name for path in tmp_path.rglob("*")] == ["photos", "a.jpg"]
    (photos / "a.jpg").rename(photos / "index.html")
    (photos / "manifest.json").write_text("{}")  # a web application has one too
    with pytest.raises(LibraryError, match=r"holds index\.html"):
        build_library(photos, prior, TINY)
    (photos / "index.html").unlink()
    build_library(photos, prior, TINY)
    verify_library(photos)


def test_a_mounted_volume_is_refused_before_the_build(prior: PosePrior) -> None:
    heard: list[str] = []
    with pytest.raises(LibraryError, match="/ is where a volume is mounted"):
        build_library(Path("/"), prior, TINY, lambda stage, _done: heard.append(stage))
    assert heard == []


def test_leftovers_are_swept_whatever_the_directory_is_called(tmp_path: Path) -> None:
    target, leftover = tmp_path / "lib[1]", tmp_path / ".lib[1].building-old"
    leftover.mkdir()
    with publish.replacing(target, "new") as workshop:
        (workshop / "file").touch()
    assert [path.name for path in tmp_path.rglob("*")] == ["lib[1]", "file"]


def test_a_link_stays_a_link(tiny: Path, prior: PosePrior, tmp_path: Path) -> None:
    link = tmp_path / "current"
    link.symlink_to(tiny)
    for seed in (1, 2, 2):
        build_library(link, prior, replace(TINY, seed=seed))
        assert link.readlink() == tiny
        assert verify_library(tiny).build["seed"] == seed


def test_without_an_atomic_exchange_the_old_is_moved_aside(
    tiny: Path, prior: PosePrior, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(publish, "_exchange", lambda _one, _other: False)
    changed = build_library(tiny, prior, replace(TINY, seed=1))
    assert verify_library(tiny) == changed
    assert hidden(tiny) == []


def truncate(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def flip_a_bit(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def remove(path: Path) -> None:
    path.unlink()


def empty(path: Path) -> None:
    path.write_bytes(b"")


@pytest.mark.parametrize("damage", [truncate, flip_a_bit, remove, empty])
@pytest.mark.parametrize("name", [*CONTENT_FILES, *CELL_FILES])
def test_a_damaged_file_is_named(name: str, damage: Callable[[Path], None], tiny: Path) -> None:
    damage(tiny / name)
    with pytest.raises(LibraryError, match=rf"{name}.*delete the directory {tiny}"):
        load(tiny)
    with pytest.raises(LibraryError, match=name):
        verify_library(tiny)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        "{}",
        '{"format": 99}',
        '{"format": 1, "name": "x", "files": {}, "licences": []}',
    ],
)
def test_a_damaged_manifest_is_named(text: str, tiny: Path) -> None:
    (tiny / MANIFEST).write_text(text)
    with pytest.raises(LibraryError, match=r"manifest\.json"):
        load(tiny)


def test_a_manifest_that_contradicts_itself_is_refused(tiny: Path) -> None:
    manifest = describe_library(tiny)
    (tiny / MANIFEST).write_text(replace(manifest, sha256="0" * 64).to_json())
    with pytest.raises(LibraryError, match=r"manifest\.json contradicts itself"):
        load(tiny)
    too_few = replace(manifest, n_poses=299).to_json()
    unlicensed = replace(manifest, licences=()).to_json()
    names = ("index.hnsw", *CELL_FILES)
    files = {name: total for name, total in manifest.files.items() if name not in names}
    index = dict(manifest.index) | {"files": []}
    unlisted = replace(manifest, files=files, index=index).to_json()
    for text, problem in (
        (too_few, r"poses\.npy holds \(300, 14, 3\)"),
        (unlicensed, r"sources\.json names more licences than the 0"),
        (unlisted, r"cannot be opened \('index\.cells\.npz'\)"),
    ):
        (tiny / MANIFEST).write_text(text)
        for opened in (load, verify_library):
            with pytest.raises(LibraryError, match=problem):
                opened(tiny)


@pytest.mark.parametrize(
    ("written", "damaged"),
    [
        ('"backend": ', '"fackend": '),
        ('"backend": "hnsw"', '"backend": "hnsv"'),
        ('"index.codes.npy": {', '"index.coded.npy": {'),
        ('"index.codes.npy",', '"index.coded.npy",'),
    ],
)
def test_a_manifest_whose_index_is_another_is_refused(
    written: str, damaged: str, tiny: Path
) -> None:
    text = (tiny / MANIFEST).read_text()
    assert text.count(written) == 1
    (tiny / MANIFEST).write_text(text.replace(written, damaged))
    for opened in (load, verify_library):
        with pytest.raises(LibraryError, match=r"manifest\.json (contradicts|is not a library)"):
            opened(tiny)


def test_a_manifest_with_a_number_that_is_none_is_that_of_one_library(tiny: Path) -> None:
    text = (tiny / MANIFEST).read_text()
    (tiny / MANIFEST).write_text(text.replace('"seed": 0', '"seed": NaN'))
    assert np.isnan(verify_library(tiny).build["seed"])


def test_no_library_at_all(tmp_path: Path) -> None:
    with pytest.raises(LibraryError, match=r"no pose library in .*posematch library build"):
        load(tmp_path / "nowhere")


def test_files_that_may_not_be_read_are_not_to_be_deleted(tiny: Path) -> None:
    """A ring of links stands for what a user's rights, or a share that is away, refuse."""
    (tiny / "poses.npy").unlink()
    (tiny / "poses.npy").symlink_to("poses.npy")
    with pytest.raises(LibraryError, match=r"poses\.npy cannot be read \(Too many levels") as error:
        verify_library(tiny)
    assert "delete" not in str(error.value)
