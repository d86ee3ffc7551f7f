from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from library_store.descriptor import describe, weighted_distance
from library_store.library import Library, load
from library_store.prior import PosePrior


def projections(library: Library, entries: np.ndarray) -> np.ndarray:
    rotation, translation = library.cameras(entries)
    seen = np.einsum("nij,nkj->nki", rotation, library.poses_mm(entries)) + translation[:, None]
    image: np.ndarray = seen[..., :2] / seen[..., 2:]
    return image


def test_a_library_entry_queried_returns_itself(small: Library) -> None:
    entries = np.arange(0, len(small), 13)
    points = 640.0 + 1150.0 * projections(small, entries)
    found = small.match(points, None, 3)
    assert_array_equal(found.entries[:, 0], entries)
    assert_allclose(found.distances[:, 0], 0.0, atol=1e-5)
    assert np.all(np.diff(found.distances, axis=1) >= 0)


def test_descriptors_are_those_of_the_projections(small: Library) -> None:
    entries = np.arange(200)
    assert_allclose(small.descriptors(entries), describe(projections(small, entries)), atol=1e-6)


def test_one_entry_or_an_array_of_them(small: Library) -> None:
    assert small.poses_mm(3).shape == (14, 3)
    grid = np.arange(6).reshape(2, 3)
    assert small.poses_mm(grid).shape == (2, 3, 14, 3)
    rotation, translation = small.cameras(grid)
    assert rotation.shape == (2, 3, 3, 3)
    assert translation.shape == (2, 3, 3)
    assert small.poses_mm(grid).dtype == np.float64


def test_equal_weights_are_no_weights(small: Library) -> None:
    points = projections(small, np.arange(5))
    plain = small.match(points, None, 10)
    for weight in (1.0, 0.5):
        weighted = small.match(points, np.full((5, 14), weight), 10)
        assert_array_equal(weighted.entries, plain.entries)


def test_a_complete_query_of_unequal_weights_is_weighted(small: Library) -> None:
    entries = np.arange(0, len(small), 97)
    points = projections(small, entries)
    points += np.random.default_rng(0).normal(size=points.shape) * 0.1 * np.ptp(points)
    weights = np.random.default_rng(1).uniform(0.05, 1.0, points.shape[:2])
    found = small.match(points, weights, 5)
    for row in range(len(entries)):
        poses = small.descriptors(found.entries[row]).reshape(-1, 14, 2)
        expected = weighted_distance(points[row], weights[row], poses)
        assert_allclose(found.distances[row], expected, rtol=1e-4)


def test_masked_and_complete_queries_mix(small: Library) -> None:
    points = projections(small, np.arange(4))
    weights = np.ones((4, 14))
    weights[1, 4] = 0.0
    weights[3] = np.linspace(0.3, 1.0, 14)
    together = small.match(points, weights, 7)
    for row in range(4):
        alone = small.match(points[row : row + 1], weights[row : row + 1], 7)
        assert_array_equal(alone.entries[0], together.entries[row])
    assert_array_equal(together.entries[:, 0], np.arange(4))


def test_more_matches_than_there_are_entries(small: Library) -> None:
    points = projections(small, np.arange(1))
    assert small.match(points, None, 10**6).entries.shape == (1, len(small))
    weights = np.ones((1, 14))
    weights[0, 0] = 0.0
    assert small.match(points, weights, 10**6).entries.shape == (1, len(small))
    assert small.match(points[:0], None, 5).entries.shape == (0, 5)


def test_queries_that_make_no_sense_are_refused(small: Library) -> None:
    points = projections(small, np.arange(1))
    with pytest.raises(ValueError, match="k must be positive"):
        small.match(points, None, 0)
    with pytest.raises(ValueError, match="two joints"):
        small.match(points, np.zeros((1, 14)), 5)
    with pytest.raises(ValueError, match="distinct"):
        small.match(np.zeros((1, 14, 2)), None, 5)


def test_exemplar_ids_go_there_and_back(small: Library) -> None:
    entries = [0, 1, 17, len(small) - 1]
    ids = [small.exemplar_id(entry) for entry in entries]
    assert [small.find(name) for name in ids] == entries
    for name in ids:
        assert quote(name, safe=":") == name


@pytest.mark.parametrize(
    "change",
    [
        lambda _name: "",
        lambda name: name + ":0",
        lambda name: "other" + name[5:],
        lambda name: name.replace(":17:17", ":17:18"),
        lambda name: name.replace(":17:17", ":+17:17"),
        lambda name: name.replace(":17:17", ":017:17"),
        lambda name: name.replace(":17:17", ":-1:17"),
        lambda name: name.replace(":17:17", ":99999999999999999999:17"),
        lambda name: name.replace(":17:17", ":17:x"),
        lambda name: name.replace("sampled", "mocap"),
    ],
)
def test_unknown_ids_are_key_errors(small: Library, change: object) -> None:
    assert callable(change)
    with pytest.raises(KeyError):
        small.find(change(small.exemplar_id(17)))


def test_sources_say_where_a_pose_comes_from(small: Library, prior: PosePrior) -> None:
    source = small.source(17)
    assert (source.kind, source.index, source.clip, source.frame) == ("sampled", 17, None, None)
    assert source.prior == f"{prior.card.name}-{prior.sha256[:8]}"


def test_the_manifest_says_what_the_library_is(small: Library, prior: PosePrior) -> None:
    manifest = small.manifest
    assert (manifest.name, manifest.skeleton) == ("small", "lsp14")
    assert manifest.n_exemplars == manifest.n_poses == len(small) == 4000
    assert manifest.build["seed"] == 7
    assert manifest.build["prior"]["sha256"] == prior.sha256
    assert manifest.licences[0].credit.startswith("The data used in this project")
    assert json.loads(manifest.to_json())["format"] == 4


def test_the_exact_index_can_be_asked_for(small: Library, small_directory: Path) -> None:
    exact = load(small_directory, backend="exact")
    assert (exact.index_backend, small.index_backend) == ("exact", "hnsw")
    points = projections(small, np.arange(0, 4000, 400))
    assert_array_equal(exact.match(points, None, 1).entries, small.match(points, None, 1).entries)
    exact.close()


def test_threads_may_match_at_once(small: Library) -> None:
    points = projections(small, np.arange(8))
    weights = np.ones((8, 14))
    weights[::2, 3] = 0.0
    alone = small.match(points, weights, 20).entries
    with ThreadPoolExecutor(4) as pool:
        for found in pool.map(lambda _: small.match(points, weights, 20).entries, range(12)):
            assert_array_equal(found, alone)


def test_the_tables_are_mapped_not_read(small: Library) -> None:
    with pytest.raises(ValueError, match="read-only"):
        small._poses[0, 0, 0] = 1.0
