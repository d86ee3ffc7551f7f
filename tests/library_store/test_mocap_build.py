"""Libraries built from captured poses: what is in them, and builds that are killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from library_store import recombine
from library_store.anatomy import measure_lengths
from library_store.build import BuildSettings, Mocap, build_library, verify_library
from library_store.clean import face_ahead
from library_store.errors import LibraryError
from library_store.importers import MocapError, read
from library_store.library import Library, load
from library_store.manifest import CONTENT_FILES, MANIFEST
from library_store.mocap import MocapSettings
from library_store.prior import PosePrior
from library_store.recombine import mirror
from library_store.skeleton import R_HIP
from library_store.sources import Source
from library_store.steps import LEDGER
from tests.library_store.clips import clip, write_clips
from tests.library_store.conftest import ONE_THREAD

SETTINGS = BuildSettings(name="own", n_poses=2_000, seed=3, index=ONE_THREAD)
EVERY_FRAME = MocapSettings(radius_mm=0.0)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ...]:
    folder = tmp_path_factory.mktemp("clips")
    return (
        write_clips(folder / "a.npz", clip("01_01", 150, 1), clip("Walking 1", 90, 2)),
        write_clips(folder / "b.npz", clip("01_01", 120, 3, licence="research only")),
    )


@pytest.fixture(scope="module")
def mocap(files: tuple[Path, ...]) -> Mocap:
    return Mocap(files, EVERY_FRAME)


@pytest.fixture(scope="module")
def directory(mocap: Mocap, tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("libraries") / "own"
    build_library(directory, None, SETTINGS, mocap=mocap)
    return directory


@pytest.fixture(scope="module")
def own(directory: Path) -> Library:
    return load(directory)


def sources(library: Library) -> list[Source]:
    return [library.source(entry) for entry in range(len(library))]


def test_the_plan_is_kept(own: Library, directory: Path) -> None:
    assert len(own) == 2_000
    kinds = [source.kind for source in sources(own)]
    assert kinds == ["mocap"] * 1_000 + ["composed"] * 1_000
    seen = [s for s in sources(own) if s.kind == "mocap"]
    mirrored = [s.mirrored for s in seen]
    assert mirrored == sorted(mirrored)
    per_pose = np.unique([f"{s.clip} {s.frame} {s.mirrored}" for s in seen], return_counts=True)[1]
    assert len(per_pose) == 2 * 360, "all frames and their mirror images"
    assert set(per_pose) == {1, 2}
    assert {path.name for path in directory.iterdir()} == {*own.manifest.files, MANIFEST}


def test_captured_poses_are_the_files(own: Library, files: tuple[Path, ...]) -> None:
    clips = {f"{c.name} {c.licence}": c for file in files for c in read(file)}
    names = {
        "01_01": "01_01 free for all uses",
        "Walking_1": "Walking 1 free for all uses",
        "01_01-2": "01_01 research only",
    }
    for entry in range(0, 1_000, 37):
        source = own.source(entry)
        captured = clips[names[str(source.clip)]]
        (row,) = np.flatnonzero(captured.frames == source.frame)
        truth = face_ahead(captured.positions_mm[row : row + 1].astype(np.float64))
        truth = mirror(truth) if source.mirrored else truth
        assert_allclose(own.poses_mm(entry), truth[0], atol=0.02)
        assert (source.subject, source.action) == (captured.subject, captured.action)


def test_composed_poses_have_the_parts_they_name(own: Library) -> None:
    by_name = {
        (s.clip, s.frame): own.poses_mm(entry)
        for entry, s in enumerate(sources(own))
        if s.kind == "mocap" and not s.mirrored
    }
    for entry in range(1_000, 2_000, 41):
        source = own.source(entry)
        assert [part.name for part in source.parts] == ["legs", "upper_body"]
        legs = source.parts[0]
        truth = by_name[legs.clip, legs.frame][None]
        truth = mirror(truth) if legs.mirrored else truth
        pose = own.poses_mm(entry)[None]
        directions = [np.diff(p[0, R_HIP:], axis=0) for p in (truth, pose)]
        for bone in (0, 1, 3, 4):  # thighs and shanks, of another length
            a, b = (d[bone] / np.linalg.norm(d[bone]) for d in directions)
            assert a @ b == pytest.approx(1.0, abs=1e-6)
        ratio = measure_lengths(pose) / measure_lengths(truth)
        assert np.all((ratio > 0.7) & (ratio < 1.4))


def test_licences_are_those_of_the_sources(own: Library) -> None:
    terms = [licence.licence for licence in own.manifest.licences]
    assert terms == ["free for all uses", "research only"]
    assert [licence.source for licence in own.manifest.licences] == ["a.npz", "b.npz"]
    both = 0
    for entry, source in enumerate(sources(own)):
        clips = {source.clip} if source.kind == "mocap" else {p.clip for p in source.parts}
        expected = {"research only" if c == "01_01-2" else "free for all uses" for c in clips}
        assert {licence.licence for licence in own.licences(entry)} == expected
        both += len(expected) == 2
    assert both > 100


def test_ids_go_there_and_back_and_say_the_kind(own: Library) -> None:
    ids = [own.exemplar_id(entry) for entry in range(len(own))]
    assert len(set(ids)) == len(ids)
    assert [own.find(name) for name in ids] == list(range(len(ids)))
    assert ids[0] == "own:mocap:01_01:0:0"
    assert any(name.startswith("own:mocap:Walking_1~mirrored:") for name in ids)
    assert ids[1_000].startswith("own:composed:mix-")
    assert ids[1_000].endswith(":0:1000")
    for wrong in ("own:mocap:01_01:1:0", "own:mocap:01_01:9999:0", "own:composed:mix:0:1000"):
        with pytest.raises(KeyError):
            own.find(wrong)


def test_two_builds_are_the_same_bytes(mocap: Mocap, directory: Path, tmp_path: Path) -> None:
    build_library(tmp_path / "own", None, SETTINGS, mocap=mocap)
    for name in (*CONTENT_FILES, MANIFEST):
        assert (tmp_path / "own" / name).read_bytes() == (directory / name).read_bytes()


def test_names_that_are_no_text_are_kept_readable(tmp_path: Path) -> None:
    """File names on Linux may be any bytes, and actions and subjects come of them."""
    name = os.fsdecode(b"caf\xe9")
    odd = replace(clip(name, 40, 1), subject=name, action=name)
    mocap = Mocap((write_clips(tmp_path / f"{name}.npz", odd),), EVERY_FRAME)
    build_library(tmp_path / "odd", None, replace(SETTINGS, n_poses=40), mocap=mocap)
    library = load(tmp_path / "odd")
    source = library.source(0)
    assert (source.clip, source.subject, source.action) == ("caf", "caf?", "caf?")
    assert [it.source for it in library.licences(0)] == ["caf?.npz"]
    verify_library(tmp_path / "odd")


def test_the_manifest_has_the_parameters_of_every_step(own: Library) -> None:
    build = own.manifest.build
    assert [source["file"] for source in build["sources"]] == ["a.npz", "b.npz"]
    assert all(len(source["sha256"]) == 64 for source in build["sources"])
    steps = build["steps"]
    assert steps["clean"] == {"rate_hz": 30.0, "clips": 3, "poses": 360}
    assert steps["thin"] == {"radius_mm": 0.0, "kept": 360}
    assert steps["captured"] == {"exemplars": 1_000, "mirrored_too": True}
    assert steps["recombine"]["exemplars"] == 1_000
    assert steps["recombine"]["stature_sd"] == 0.05


def test_composed_poses_do_not_depend_on_how_many(
    mocap: Mocap, own: Library, tmp_path: Path
) -> None:
    build_library(tmp_path / "own", None, replace(SETTINGS, n_poses=400), mocap=mocap)
    few = load(tmp_path / "own")
    assert_array_equal(few.poses_mm(np.arange(200, 400)), own.poses_mm(np.arange(1_000, 1_200)))
    assert few.exemplar_id(200).split(":")[:4] == own.exemplar_id(1_000).split(":")[:4]
    kinds = [source.kind for source in sources(few)]
    assert kinds.count("mocap") == 200, "of 720 poses some are left out"


def test_a_prior_joins(mocap: Mocap, prior: PosePrior, tmp_path: Path) -> None:
    joined = replace(mocap, prior_share=0.25)
    manifest = build_library(tmp_path / "own", prior, SETTINGS, mocap=joined)
    library = load(tmp_path / "own")
    kinds = [source.kind for source in sources(library)]
    assert {kind: kinds.count(kind) for kind in kinds} == {
        "mocap": 750,
        "composed": 750,
        "sampled": 500,
    }
    assert manifest.build["prior"]["exemplars"] == 500
    assert library.licences(1_999)[0].licence.startswith("free for all uses")
    assert len(manifest.licences) == 3


def test_thinning_and_no_mirroring(mocap: Mocap, tmp_path: Path) -> None:
    sparse = MocapSettings(radius_mm=60.0, mirror=False, recombined=0.0)
    manifest = build_library(
        tmp_path / "own", None, SETTINGS, mocap=replace(mocap, settings=sparse)
    )
    kept = manifest.build["steps"]["thin"]["kept"]
    assert 20 < kept < 300
    assert manifest.n_poses == kept
    library = load(tmp_path / "own")
    poses = library.poses_mm(np.unique(library._projections[:, 0], return_index=True)[1])
    gaps = np.sqrt(((poses[:, None] - poses[None]) ** 2).sum(-1).mean(-1))
    assert gaps[~np.eye(kept, dtype=bool)].min() > 59.9
    assert all(not source.mirrored and source.kind == "mocap" for source in sources(library))


BUILD = """
import os, signal, sys
from pathlib import Path
from library_store.backends import IndexSettings
from library_store.build import BuildSettings, Mocap, build_library
from library_store.hnsw import HnswSettings
from library_store.mocap import MocapSettings

def stall(stage, done):
    if stage == sys.argv[2]:
        os.kill(os.getpid(), signal.SIGKILL)

index = IndexSettings(hnsw=HnswSettings(threads=1))
settings = BuildSettings(name="own", n_poses=2_000, seed=3, index=index)
mocap = Mocap(tuple(map(Path, sys.argv[3:])), MocapSettings(radius_mm=0.0))
build_library(Path(sys.argv[1]), None, settings, stall, mocap=mocap)
"""
STAGES = ("reading", "thinning", "poses", "descriptors", "index", "checksums")


@pytest.mark.parametrize("stage", ["reading", "poses", "index", "checksums"])
def test_a_killed_build_goes_on_after_its_last_step(
    stage: str, mocap: Mocap, directory: Path, tmp_path: Path
) -> None:
    target = tmp_path / "own"
    command = [sys.executable, "-c", BUILD, str(target), stage, *map(str, mocap.files)]
    assert subprocess.run(command, check=False).returncode == -signal.SIGKILL
    (left,) = tmp_path.glob(".own.building-*")
    done = json.loads((left / LEDGER).read_text()) if (left / LEDGER).exists() else {}
    names = ("clean", "thin", "poses", "descriptors", "index")
    assert tuple(done) == names[: STAGES.index(stage)]
    assert not target.exists()
    written = {
        file: (left / file).stat().st_mtime_ns for step in done.values() for file in step["files"]
    }
    heard: list[str] = []
    build_library(target, None, SETTINGS, lambda stage, _done: heard.append(stage), mocap=mocap)
    assert tuple(dict.fromkeys(heard)) == STAGES[STAGES.index(stage) :]
    for name in (*CONTENT_FILES, MANIFEST):
        assert (target / name).read_bytes() == (directory / name).read_bytes()
    for file, when in written.items():
        assert not (target / file).exists() or (target / file).stat().st_mtime_ns == when
    verify_library(target)
    assert list(tmp_path.glob(".own.building-*")) == []


def test_an_interrupted_build_is_kept_and_a_failed_one_removed(
    mocap: Mocap, tmp_path: Path
) -> None:
    for error, kept in ((KeyboardInterrupt(), 1), (OSError(28, "No space left on device"), 0)):

        def fail(stage: str, _done: float, error: BaseException = error) -> None:
            if stage == "index":
                raise error

        with pytest.raises((KeyboardInterrupt, LibraryError)):
            build_library(tmp_path / "own", None, SETTINGS, fail, mocap=mocap)
        assert len(list(tmp_path.glob(".own.building-*"))) == kept


def test_inputs_that_cannot_be_used_are_named(
    mocap: Mocap, files: tuple[Path, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    missing = Mocap((tmp_path / "none.npz",))
    with pytest.raises(LibraryError, match=r"none\.npz cannot be read: No such file"):
        build_library(tmp_path / "own", None, SETTINGS, mocap=missing)
    bad = tmp_path / "bad.npz"
    bad.write_bytes(files[0].read_bytes()[:1000])
    with pytest.raises(MocapError, match=r"bad\.npz"):
        build_library(tmp_path / "own", None, SETTINGS, mocap=Mocap((files[0], bad)))
    monkeypatch.setattr(recombine, "_ROUNDS", 2)
    impossible = replace(mocap.settings, limit_quantile=0.49)
    with pytest.raises(
        LibraryError, match=r"^[0-9]+ poses cannot be recombined: .* --recombined 0"
    ):
        build_library(tmp_path / "own", None, SETTINGS, mocap=replace(mocap, settings=impossible))
    with pytest.raises(ValueError, match="prior, from mocap or from both"):
        build_library(tmp_path / "own", None, SETTINGS)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".own.lock", "bad.npz"]
