"""Limbs given to the wrong person: the pictures that are made, and how they are counted."""

import numpy as np

from evaluation.overlap import Pair, alone, pair, pairs_of, score
from library_store.skeleton import LSP14
from models.training.dataset import LabelledCrop
from tests.models.training.crops import standing


def some_pairs(n: int = 20) -> list[Pair]:
    return pairs_of([standing(40), standing(200)], n, np.random.default_rng(0))


def test_the_one_in_front_is_seen_and_hides_some_of_the_other() -> None:
    pairs = some_pairs()
    behind, front = (np.array([p.seen[i] for p in pairs]) for i in (0, 1))
    assert front.mean() > 0.9
    assert 0.3 < behind.mean() < front.mean()
    for two in pairs:
        a, b = two.people
        assert a.image is b.image
        assert np.linalg.norm(a.extent_px[0] - b.extent_px[0]) > 0.1 * a.extent_px[1]


def test_the_cut_out_person_is_where_the_joints_say() -> None:
    made = pair(standing(40), standing(200), np.random.default_rng(1))
    front = made.people[1]
    x, y = np.rint(front.joints_px).astype(int).T
    assert (front.image[y, x].min(axis=1) > 150).mean() > 0.9


def test_a_perfect_network_exchanges_nothing_and_one_that_sees_the_other_everything() -> None:
    pairs = some_pairs()
    partner = {
        (id(two.people[i].image), two.people[i].joints_px.tobytes()): two.people[1 - i].joints_px
        for two in pairs
        for i in (0, 1)
    }

    def perfect(crop: LabelledCrop) -> np.ndarray:
        return crop.joints_px.astype(np.float64)

    def other(crop: LabelledCrop) -> np.ndarray:
        return partner[id(crop.image), crop.joints_px.tobytes()].astype(np.float64)

    best, worst = score(alone(perfect), pairs, "perfect"), score(alone(other), pairs, "other")
    assert (best.right, best.exchanged) == (100.0, 0.0)
    assert worst.exchanged > 60
    assert worst.right + worst.exchanged == 100


def test_sides_of_the_other_person_do_not_matter() -> None:
    pairs = some_pairs(4)
    mirror = list(LSP14.mirror)
    partner = {id(two.people[0].image): two for two in pairs}

    def other_way_round(crop: LabelledCrop) -> np.ndarray:
        two = partner[id(crop.image)]
        mine = 0 if np.array_equal(two.people[0].joints_px, crop.joints_px) else 1
        return two.people[1 - mine].joints_px[mirror].astype(np.float64)

    assert score(alone(other_way_round), pairs, "mirrored").exchanged > 60
