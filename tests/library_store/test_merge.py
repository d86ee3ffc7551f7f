from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from library_store.build import BuildSettings, Mocap, build_library, verify_library
from library_store.errors import LibraryError
from library_store.library import Library, load
from library_store.manifest import MANIFEST
from library_store.merge import merge_libraries
from library_store.mocap import MocapSettings
from library_store.prior import PosePrior
from library_store.sheet import TILE_PX, contact_sheet, draw_entries
from tests.library_store.clips import clip, write_clips


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, prior: PosePrior) -> Path:
    """Three libraries: two from clips of the same name, one sampled."""
    folder = tmp_path_factory.mktemp("parts")
    for name, n_poses, licence in (("first", 300, "free"), ("second", 200, "research only")):
        file = write_clips(folder / f"{name}.npz", clip("walk", 80, n_poses, licence=licence))
        mocap = Mocap((file,), MocapSettings(radius_mm=0.0))
        settings = BuildSettings(name=name, n_poses=n_poses)
        build_library(folder / name, None, settings, mocap=mocap)
    settings = BuildSettings(name="third", n_poses=100)
    build_library(folder / "third", prior, settings)
    return folder


@pytest.fixture(scope="module")
def parts(folder: Path) -> list[Library]:
    return [load(folder / name) for name in ("first", "second", "third")]


@pytest.fixture(scope="module")
def merged(folder: Path, parts: list[Library]) -> Library:
    heard: list[str] = []
    merge_libraries(
        folder / "all",
        [part.directory for part in parts],
        name="all",
        version="2",
        progress=lambda stage, _done: heard.append(stage),
    )
    assert list(dict.fromkeys(heard)) == ["checking", "joining", "index", "checksums"]
    verify_library(folder / "all")
    return load(folder / "all")


def test_everything_is_taken_over(merged: Library, parts: list[Library]) -> None:
    assert len(merged) == sum(map(len, parts)) == 600
    assert merged.manifest.version == "2"
    first = 0
    for part in parts:
        own, there = np.arange(len(part)), np.arange(first, first + len(part))
        assert_array_equal(merged.poses_mm(there), part.poses_mm(own))
        assert_array_equal(merged.descriptors(there), part.descriptors(own))
        for ours, theirs in zip(merged.cameras(there), part.cameras(own), strict=True):
            assert_array_equal(ours, theirs)
        first += len(part)


def test_entries_find_themselves(merged: Library) -> None:
    entries = np.arange(0, 600, 7)
    rotation, translation = merged.cameras(entries)
    seen = np.einsum("nij,nkj->nki", rotation, merged.poses_mm(entries)) + translation[:, None]
    found = merged.match(seen[..., :2] / seen[..., 2:], None, 1)
    assert_array_equal(found.entries[:, 0], entries)


def test_sources_and_licences_stay_what_they_were(merged: Library, parts: list[Library]) -> None:
    names = {0: "walk", 1: "walk-2"}
    first = 0
    for number, part in enumerate(parts):
        for entry in range(len(part)):
            before, after = part.source(entry), merged.source(first + entry)
            assert (before.kind, before.frame, before.index) == (
                after.kind,
                after.frame,
                after.index,
            )
            assert merged.licences(first + entry) == part.licences(entry)
            if before.kind == "mocap":
                assert after.clip == names[number]
            for was, now in zip(before.parts, after.parts, strict=True):
                assert (now.clip, now.frame, now.mirrored) == (
                    names[number],
                    was.frame,
                    was.mirrored,
                )
        first += len(part)
    terms = [licence.licence for licence in merged.manifest.licences]
    assert terms[:2] == ["free", "research only"]
    assert len(terms) == 3


def test_ids_of_the_merged_library(merged: Library, parts: list[Library]) -> None:
    ids = [merged.exemplar_id(entry) for entry in range(600)]
    assert [merged.find(name) for name in ids] == list(range(600))
    assert any(name.startswith("all:mocap:walk-2~mirrored:") for name in ids)
    assert merged.manifest.build["merged"] == [
        {"name": m.name, "version": m.version, "sha256": m.sha256}
        for m in (part.manifest for part in parts)
    ]


def test_a_merged_library_can_be_merged(
    merged: Library, parts: list[Library], prior: PosePrior, tmp_path: Path
) -> None:
    settings = BuildSettings(name="more", n_poses=50, seed=9)
    build_library(tmp_path / "more", prior, settings)
    both = [merged.directory, tmp_path / "more"]
    merge_libraries(tmp_path / "again", both, name="again")
    again = load(tmp_path / "again")
    assert len(again) == 650
    sampled = {again.source(entry).prior for entry in again.entries_of("sampled")}
    prior_name = parts[2].source(0).prior
    assert sampled == {prior_name, f"{prior_name}-2"}


def test_parts_that_cannot_be_merged(folder: Path, tmp_path: Path) -> None:
    first, out = folder / "first", tmp_path / "out"
    for parts in ([first], [first, first]):
        with pytest.raises(LibraryError, match="at least two libraries"):
            merge_libraries(out, parts, name="out")
    with pytest.raises(LibraryError, match="no pose library in"):
        merge_libraries(out, [first, tmp_path], name="out")
    with pytest.raises(ValueError, match="must match"):
        merge_libraries(out, [first, folder / "second"], name="a b")
    assert not out.exists()
    (tmp_path / "a.jpg").write_text("precious")
    with pytest.raises(LibraryError, match=r"holds a\.jpg, .* would be lost"):
        merge_libraries(tmp_path, [first, folder / "second"], name="both")


def test_a_part_is_not_replaced_by_the_merged_library(folder: Path) -> None:
    before = load(folder / "second").manifest
    for directory in (folder / "second", folder / "first" / ".." / "second"):
        with pytest.raises(LibraryError, match="one of the libraries to merge"):
            merge_libraries(directory, [folder / "first", folder / "second"], name="both")
    assert load(folder / "second").manifest == before


def test_a_part_built_anew_meanwhile_is_not_merged(
    folder: Path, prior: PosePrior, tmp_path: Path
) -> None:
    part = tmp_path / "part"
    build_library(part, prior, BuildSettings(name="part", n_poses=60))

    def rebuild(stage: str, done: float) -> None:
        if (stage, done) == ("checking", 1.0):
            build_library(part, prior, BuildSettings(name="part", n_poses=60, seed=1))

    both, out = [folder / "third", part], tmp_path / "out"
    with pytest.raises(LibraryError, match=r"part was built anew while it was merged"):
        merge_libraries(out, both, name="out", progress=rebuild)
    assert not out.exists()
    merge_libraries(out, both, name="out")
    assert_array_equal(load(out).poses_mm(100), load(part).poses_mm(0))


def test_a_part_that_is_not_what_it_says_is_not_merged(
    folder: Path, prior: PosePrior, tmp_path: Path
) -> None:
    part = tmp_path / "part"
    manifest = build_library(part, prior, BuildSettings(name="part", n_poses=60))
    (part / MANIFEST).write_text(replace(manifest, n_poses=59).to_json())
    with pytest.raises(LibraryError, match=r"poses\.npy holds \(60, 14, 3\)"):
        merge_libraries(tmp_path / "out", [part, folder / "third"], name="out")


def test_a_contact_sheet_shows_what_is_asked_for(merged: Library) -> None:
    composed = draw_entries(merged, 10, "composed")
    assert len(composed) == 10
    assert {merged.source(entry).kind for entry in composed} == {"composed"}
    assert draw_entries(merged, 10, "composed", seed=1) != composed
    assert draw_entries(merged, 1_000) == list(range(600))
    sheet = contact_sheet(merged, composed, columns=4)
    assert sheet.shape == (3 * TILE_PX, 4 * TILE_PX, 3)
    for number in range(12):
        top, left = TILE_PX * (number // 4), TILE_PX * (number % 4)
        tile = sheet[top : top + TILE_PX, left : left + TILE_PX]
        assert (np.ptp(tile.reshape(-1, 3), axis=0).max() > 100) == (number < 10)
