from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from library_store.descriptor import normalise, weighted_distance
from library_store.library import Library
from library_store.masked import MaskedSearch, MaskedSettings
from library_store.skeleton import (
    HEAD_TOP,
    L_ANKLE,
    L_KNEE,
    R_ANKLE,
    R_ELBOW,
    R_KNEE,
    R_WRIST,
)

MASKS = {
    "wrist": [R_WRIST],
    "arm": [R_ELBOW, R_WRIST],
    "leg": [L_KNEE, L_ANKLE],
    "both legs": [L_KNEE, L_ANKLE, R_KNEE, R_ANKLE],
    "head and wrist": [HEAD_TOP, R_WRIST],
}


@pytest.fixture(scope="module")
def table(small: Library) -> np.ndarray:
    return small.descriptors(np.arange(len(small)))


@pytest.fixture(scope="module")
def search(table: np.ndarray) -> MaskedSearch:
    """A search that scans little of this small library, whose neighbours are far apart."""
    settings = MaskedSettings(rows_per_cell=20, share=0.2, share_per_joint=0.05, least_scanned=0)
    return MaskedSearch(table, settings)


def noisy_queries(table: np.ndarray, n: int) -> np.ndarray:
    rng = np.random.default_rng(4)
    poses = table[rng.choice(len(table), n, replace=False)].reshape(n, 14, 2)
    return 300.0 + 90.0 * (poses + rng.normal(size=poses.shape) * 0.08)


def weights_without(joints: list[int]) -> np.ndarray:
    weights = np.ones(14)
    weights[joints] = 0.0
    return weights


def test_exact_is_the_sorted_distance(search: MaskedSearch, table: np.ndarray) -> None:
    query, weights = noisy_queries(table, 1)[0], weights_without([R_WRIST])
    weights[L_KNEE] = 0.4
    distances = weighted_distance(query, weights, table.reshape(-1, 14, 2))
    found = search.exact(query, weights, 25)
    assert_array_equal(found.entries, np.argsort(distances, kind="stable")[:25])
    assert_allclose(found.distances, np.sort(distances)[:25])


@pytest.mark.parametrize("mask", MASKS)
def test_masked_recall_at_10(mask: str, search: MaskedSearch, table: np.ndarray) -> None:
    weights = weights_without(MASKS[mask])
    recall = []
    for query in noisy_queries(table, 40):
        truth, found = search.exact(query, weights, 10), search.query(query, weights, 10)
        recall.append(len(np.intersect1d(truth.entries, found.entries)) / 10)
    assert np.mean(recall) >= 0.95


def test_weighted_recall_at_10(search: MaskedSearch, table: np.ndarray) -> None:
    rng = np.random.default_rng(9)
    recall = []
    for query in noisy_queries(table, 40):
        weights = rng.uniform(0.2, 1.0, 14)
        truth, found = search.exact(query, weights, 10), search.query(query, weights, 10)
        recall.append(len(np.intersect1d(truth.entries, found.entries)) / 10)
    assert np.mean(recall) >= 0.95


def test_what_the_missing_joint_says_does_not_matter(small: Library, table: np.ndarray) -> None:
    query = noisy_queries(table, 1)
    weights = weights_without([R_WRIST])[None]
    found = small.match(query, weights, 10)
    for value in (np.nan, np.inf, 1e9):
        query[0, R_WRIST] = value
        assert_array_equal(small.match(query, weights, 10).entries, found.entries)


def test_a_wrong_joint_is_survived_by_masking_it(small: Library, table: np.ndarray) -> None:
    entries = np.arange(0, 4000, 100)
    queries = normalise(table[entries].reshape(-1, 14, 2))
    queries[:, R_WRIST] += 3.0
    weights = np.broadcast_to(weights_without([R_WRIST]), (len(queries), 14))
    found = small.match(queries, weights, 1)
    assert_array_equal(found.entries[:, 0], entries)
    assert_allclose(found.distances, 0.0, atol=1e-5)
