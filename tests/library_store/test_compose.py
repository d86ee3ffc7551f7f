from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from library_store.anatomy import LENGTHS, BodyParts, decode
from library_store.compose import reaching_arms, sitting_legs, two_bones
from library_store.population import Population, even_proportions
from library_store.prior import PosePrior
from library_store.skeleton import HEAD_TOP, L_WRIST, NECK, R_WRIST


def test_two_bones_reach_their_target() -> None:
    rng = np.random.default_rng(0)
    first, second = np.full((200, 1), 300.0), np.full((200, 1), 250.0)
    target = rng.normal(0.0, 1.0, (200, 3))
    target *= rng.uniform(150.0, 530.0, (200, 1)) / np.linalg.norm(target, axis=1, keepdims=True)
    pole = rng.normal(0.0, 1.0, (200, 3))
    bones = two_bones(target, first, second, pole)
    upper, lower = bones[:, :3], bones[:, 3:]
    assert_allclose(np.linalg.norm(upper, axis=1), 1.0)
    assert_allclose(np.linalg.norm(lower, axis=1), 1.0)
    assert_allclose(first * upper + second * lower, target, atol=1e-6)
    # The joint lies on the pole's side of the line to the target.
    along = target / np.linalg.norm(target, axis=1, keepdims=True)
    across = pole - (pole * along).sum(1, keepdims=True) * along
    assert np.all((upper * across).sum(1) > 0)


def test_two_bones_point_at_what_is_out_of_reach() -> None:
    target = np.array([[0.0, 900.0, 0.0], [0.0, 0.0, 1.0]])
    bones = two_bones(target, np.full((2, 1), 300.0), np.full((2, 1), 250.0), np.ones((2, 3)))
    reached = 300.0 * bones[:, :3] + 250.0 * bones[:, 3:]
    assert_allclose(reached, [[0.0, 0.99 * 550.0, 0.0], [0.0, 0.0, 50.0 + 62.5]], atol=1e-6)


def test_sitting_legs_are_unit_directions_alike_on_both_sides() -> None:
    legs = sitting_legs(4000, np.random.default_rng(1)).reshape(4000, 5, 3)
    assert_allclose(np.linalg.norm(legs, axis=-1), 1.0)
    right, left = legs[:, :2].mean(axis=0), legs[:, 2:4].mean(axis=0)
    assert_allclose(right * (-1.0, 1.0, 1.0), left, atol=0.03)
    up = legs[:, 4]
    level = np.abs((legs[:, 0] * up).sum(axis=-1))
    assert np.mean(level < 0.45) > 0.7, "most thighs are within 27 degrees of the horizontal"


def test_reaching_moves_arms_alone_and_brings_hands_to_the_body(prior: PosePrior) -> None:
    rng = np.random.default_rng(2)
    rows = rng.integers(len(prior.exemplars.upper), size=3000)
    upper = prior.exemplars.upper[rows]
    lengths = prior.exemplars.lengths_mm[prior.exemplars.subjects[rows]]
    reached = reaching_arms(upper, lengths, rng)
    still = np.r_[0:8, 20:23]
    assert_array_equal(reached[:, still], upper[:, still])
    moved = [(reached[:, at : at + 6] != upper[:, at : at + 6]).any(axis=1) for at in (8, 14)]
    assert np.all(moved[0] | moved[1])
    assert 0.2 < np.mean(moved[0] & moved[1]) < 0.6

    poses = decode(BodyParts(prior.exemplars.legs[rows], reached), lengths)
    head = 0.5 * (poses[:, NECK] + poses[:, HEAD_TOP])
    near_head = [
        np.linalg.norm(poses[:, wrist] - head, axis=1)[hand] < 250.0
        for wrist, hand in zip((R_WRIST, L_WRIST), moved, strict=True)
    ]
    assert np.mean(np.concatenate(near_head)) > 0.3


def test_children_have_large_heads_and_short_legs() -> None:
    adults = np.tile([541.0, 178.0, 188.0, 252.0, 292.0, 273.0, 401.0, 433.0], (4000, 1))
    grown = Population(children=0.0).draw(adults, np.random.default_rng(3))
    assert_allclose(np.log(grown).mean(axis=0), np.log(adults[0]), atol=0.005)
    small = Population(children=1.0).draw(adults, np.random.default_rng(3))
    head, thigh, trunk = (LENGTHS.index(name) for name in ("head", "thigh", "trunk"))
    assert np.median(small[:, head] / small[:, trunk]) > 1.05 * 252.0 / 541.0
    assert np.median(small[:, thigh] / small[:, trunk]) < 0.97 * 401.0 / 541.0
    assert 0.5 < np.median(small[:, trunk]) / 541.0 < 0.95


def test_even_proportions_keep_everybodys_height() -> None:
    people = np.random.default_rng(6).uniform(150.0, 500.0, (9, len(LENGTHS)))
    evened = even_proportions(people)
    tall = [LENGTHS.index(name) for name in ("trunk", "head", "thigh", "shank")]
    assert_allclose(evened[:, tall].sum(axis=1), people[:, tall].sum(axis=1))
    assert_allclose(evened / evened[:, :1], np.tile(evened[0] / evened[0, 0], (9, 1)))
    assert_allclose(even_proportions(people[:1]), people[:1])
