from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from library_store.cell_index import CellIndex, ScanSettings
from library_store.descriptor import normalise, weighted_distance
from library_store.exact import ExactIndex
from library_store.library import Library
from library_store.masked import Correlation, missing_limbs, nearest_masked
from library_store.neighbours import Neighbours
from library_store.skeleton import (
    HEAD_TOP,
    L_ANKLE,
    L_ELBOW,
    L_HIP,
    L_KNEE,
    L_WRIST,
    R_ANKLE,
    R_ELBOW,
    R_HIP,
    R_KNEE,
    R_SHOULDER,
    R_WRIST,
)

MASKS = {
    "wrist": [R_WRIST],
    "arm": [R_ELBOW, R_WRIST],
    "both arms": [R_ELBOW, R_WRIST, L_ELBOW, L_WRIST],
    "leg": [L_KNEE, L_ANKLE],
    "both legs": [L_KNEE, L_ANKLE, R_KNEE, R_ANKLE],
    "right side": [R_SHOULDER, R_ELBOW, R_WRIST, R_HIP, R_KNEE, R_ANKLE],
    "head and wrist": [HEAD_TOP, R_WRIST],
    "hips": [R_HIP, L_HIP],
}


@pytest.fixture(scope="module")
def table(small: Library) -> np.ndarray:
    return small.descriptors(np.arange(len(small)))


@pytest.fixture(scope="module")
def exact(table: np.ndarray) -> ExactIndex:
    return ExactIndex(table)


@pytest.fixture(scope="module")
def cells(table: np.ndarray) -> CellIndex:
    """Scans a part of this small library, whose neighbours are far apart."""
    return CellIndex.build(table, 20, ScanSettings(scanned=2_000, per_neighbour=0))


def test_equally_near_entries_come_in_order(table: np.ndarray) -> None:
    """Whatever order a scan found them in, so that answers are the same on every machine."""
    rng = np.random.default_rng(0)
    entries = rng.permutation(600)
    rows = np.where(entries % 2 == 0, 7, 11)
    weights = np.ones(14)
    weights[R_WRIST] = 0.0
    query = normalise(table[7].reshape(14, 2), weights)
    found = nearest_masked(table[rows], entries, query, weights, 40)
    assert_array_equal(found.entries, np.arange(0, 80, 2))


def noisy_queries(table: np.ndarray, n: int) -> np.ndarray:
    rng = np.random.default_rng(4)
    poses = table[rng.choice(len(table), n, replace=False)].reshape(n, 14, 2)
    return 300.0 + 90.0 * (poses + rng.normal(size=poses.shape) * 0.08)


def weights_without(joints: list[int], n: int = 1) -> np.ndarray:
    weights = np.ones((n, 14))
    weights[:, joints] = 0.0
    return weights


def recall(truth: Neighbours, found: Neighbours) -> float:
    pairs = zip(truth.entries, found.entries, strict=True)
    return float(np.mean([len(np.intersect1d(a, b)) / len(a) for a, b in pairs]))


@pytest.mark.parametrize("mask", MASKS)
def test_recall_by_what_is_missing(
    mask: str, cells: CellIndex, exact: ExactIndex, table: np.ndarray
) -> None:
    queries, weights = noisy_queries(table, 40), weights_without(MASKS[mask], 40)
    truth = exact.query_masked(queries, weights, 10)
    assert recall(truth, cells.query_masked(queries, weights, 10)) >= 0.95


@pytest.mark.parametrize("n_missing", [1, 2, 4, 6])
def test_recall_by_how_many_are_missing(
    n_missing: int, cells: CellIndex, exact: ExactIndex, table: np.ndarray
) -> None:
    rng = np.random.default_rng(n_missing)
    queries, weights = noisy_queries(table, 40), np.ones((40, 14))
    for row in weights:
        row[rng.choice(14, n_missing, replace=False)] = 0.0
    truth = exact.query_masked(queries, weights, 10)
    assert recall(truth, cells.query_masked(queries, weights, 10)) >= 0.95


def test_recall_of_unsure_joints(cells: CellIndex, exact: ExactIndex, table: np.ndarray) -> None:
    queries = noisy_queries(table, 40)
    weights = np.random.default_rng(9).uniform(0.2, 1.0, (40, 14))
    truth = exact.query_masked(queries, weights, 10)
    assert recall(truth, cells.query_masked(queries, weights, 10)) >= 0.95


def test_the_correlation_is_the_masked_distance(table: np.ndarray) -> None:
    point = noisy_queries(table, 1)[0]
    rng = np.random.default_rng(1)
    cases: list[np.ndarray] = [
        np.ones(14),
        weights_without([R_WRIST, L_KNEE])[0],
        rng.uniform(0.1, 1.0, 14),
        0.3 * rng.integers(0, 2, 14) + 0.2,
    ]
    for weights in cases:
        correlation = Correlation(normalise(point, weights), weights)(table)
        distances = weighted_distance(point, weights, table.reshape(-1, 14, 2))
        assert_allclose(28.0 * (1.0 - correlation), distances**2, atol=2e-5)


def test_limbs_that_are_missing_are_counted() -> None:
    assert missing_limbs(np.ones(14)) == 0.0
    assert missing_limbs(weights_without([R_ELBOW, R_WRIST, HEAD_TOP])[0]) == 2.0
    unsure = np.ones(14)
    unsure[[L_KNEE, L_ANKLE]] = 0.25, 0.5
    assert missing_limbs(unsure) == 0.5


def test_what_the_missing_joint_says_does_not_matter(small: Library, table: np.ndarray) -> None:
    query = noisy_queries(table, 1)
    weights = weights_without([R_WRIST])
    found = small.match(query, weights, 10)
    for value in (np.nan, np.inf, 1e9):
        query[0, R_WRIST] = value
        assert_array_equal(small.match(query, weights, 10).entries, found.entries)


def test_a_wrong_joint_is_survived_by_masking_it(small: Library, table: np.ndarray) -> None:
    entries = np.arange(0, 4000, 100)
    queries = normalise(table[entries].reshape(-1, 14, 2))
    queries[:, R_WRIST] += 3.0
    found = small.match(queries, weights_without([R_WRIST], len(queries)), 1)
    assert_array_equal(found.entries[:, 0], entries)
    assert_allclose(found.distances, 0.0, atol=1e-5)
