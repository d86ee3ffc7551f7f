from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from library_store.descriptor import describe, normalise
from library_store.exact import ExactIndex
from library_store.imputation import guesses, n_guesses
from library_store.library import Library
from tests.library_store.test_masked import MASKS, noisy_queries, weights_without


@pytest.fixture(scope="module")
def table(small: Library) -> np.ndarray:
    return small.descriptors(np.arange(len(small)))


def test_a_complete_pose_is_guessed_as_it_is(table: np.ndarray) -> None:
    query = normalise(noisy_queries(table, 1)[0])
    found = guesses(table, query, np.ones(14), 3)
    assert_allclose(found, np.broadcast_to(describe(query), (3, 28)), atol=1e-6)


def test_visible_joints_keep_their_shape(table: np.ndarray) -> None:
    weights = weights_without(MASKS["arm"])[0]
    query = normalise(noisy_queries(table, 1)[0], weights)
    for guess in guesses(table, query, weights, 10):
        again = normalise(guess.reshape(14, 2), weights)
        assert_allclose(again[weights > 0], query[weights > 0], atol=1e-5)


def test_an_entry_without_a_limb_is_guessed_as_itself(table: np.ndarray) -> None:
    weights = weights_without(MASKS["both legs"])[0]
    for entry in range(0, 4000, 500):
        query = normalise(table[entry].reshape(14, 2), weights)
        assert_allclose(guesses(table, query, weights, 1)[0], table[entry], atol=1e-5)


@pytest.mark.parametrize("mask", MASKS)
def test_recall_with_an_engine_that_knows_complete_poses(mask: str, table: np.ndarray) -> None:
    engine, weights = ExactIndex(table), weights_without(MASKS[mask])[0]
    n = n_guesses(len(table), weights)
    recall = []
    for point in noisy_queries(table, 20):
        truth = engine.query_masked(point[None], weights[None], 10).entries[0]
        guessed = guesses(table[::4], normalise(point, weights), weights, n)
        found = engine.query(guessed, 64).entries
        recall.append(np.isin(truth, found).mean())
    assert np.mean(recall) >= 0.95


def test_more_is_guessed_where_more_is_missing_and_in_larger_libraries() -> None:
    numbers = [n_guesses(200_000, weights_without(MASKS[m])[0]) for m in ("hips", "wrist", "arm")]
    assert_array_equal(numbers, [8, 16, 32])
    legs = weights_without(MASKS["both legs"])[0]
    assert_array_equal([n_guesses(n, legs) for n in (5_000, 200_000, 1_600_000)], [64, 64, 128])


def test_a_joint_of_half_the_weight_or_more_is_taken_as_it_is(table: np.ndarray) -> None:
    for weight, taken in ((0.5, True), (0.25, False)):
        weights = np.ones(14)
        weights[4] = weight
        query = normalise(noisy_queries(table, 1)[0], weights)
        off = np.abs(guesses(table, query, weights, 3) - describe(query)).max(axis=1)
        assert (off < 1e-6).all() == taken
