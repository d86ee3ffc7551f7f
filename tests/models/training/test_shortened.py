"""People whom the photo's edge cuts off, as the pose network meets them."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from library_store.skeleton import L_ANKLE, R_ANKLE, R_HIP
from models.training import augment
from models.training.augment import random_view
from models.training.shortened import (
    FEWEST,
    FURNISHED,
    GUESSED,
    LARGEST_GROWTH,
    LEAST_JOINTS,
    MOST,
    Shortened,
    piece_of,
    seen_box,
    shortened,
)
from tests.models.training import crops

Floats = NDArray[np.float64]

PERSON = crops.standing()
JOINTS = PERSON.joints_px.astype(np.float64)
ALL = np.ones(14, np.bool_)
BLACK = np.zeros((40, 60, 3), np.uint8)


def box(known: NDArray[np.bool_], *photo: float) -> Floats:
    found = seen_box(JOINTS, known, np.array(photo))
    assert found is not None
    return found


def test_a_box_reaches_as_far_as_the_photo_shows_a_limb() -> None:
    np.testing.assert_allclose(box(ALL, 0, 0, 120, 120), [40, 10, 80, 110])
    # Hips at 66, knees at 88: the photo's last row shows thighs.
    np.testing.assert_allclose(box(ALL, 0, 0, 120, 77), [40, 10, 80, 77], atol=1.0)
    np.testing.assert_allclose(box(ALL, 60, 0, 120, 120), [60, 10, 80, 110], atol=1.0)
    without_legs = ALL.copy()
    without_legs[8:] = False
    np.testing.assert_allclose(box(without_legs, 0, 0, 120, 77), [40, 10, 80, 66], atol=0.1)


def test_of_a_head_alone_there_is_no_box() -> None:
    assert seen_box(JOINTS, ALL, np.array([0.0, 0.0, 120.0, 28.0])) is None


@pytest.fixture(scope="module")
def cuts() -> list[Shortened]:
    """Three hundred; two joints of this person are level now and then, and too few are left."""
    tries = [shortened(PERSON, BLACK, np.random.default_rng(seed)) for seed in range(320)]
    found = [one for one in tries if one is not None]
    assert len(found) > 280
    return found


def test_what_lies_beyond_the_edge_is_black_and_hardly_trusted(cuts: list[Shortened]) -> None:
    for one in cuts:
        # Edges lie between pixels: a joint within half of one may be on either side.
        assert LEAST_JOINTS <= (~one.beyond).sum() <= MOST + 1
        x, y = np.rint(PERSON.joints_px).astype(int).T
        assert (one.crop.image[y, x].max(1)[one.beyond] == 0).all()
        assert (one.crop.image[y, x] == PERSON.image[y, x]).all(1)[~one.beyond].all()
        np.testing.assert_allclose(
            one.crop.weight, np.where(one.beyond, GUESSED, 1) * PERSON.weight, rtol=1e-6
        )
        np.testing.assert_array_equal(one.crop.visible, np.where(one.beyond, 0, PERSON.visible))
        np.testing.assert_array_equal(one.crop.joints_px, PERSON.joints_px)
    assert PERSON.image.max() > 0, "the person's own picture stays as it is"


def test_something_else_than_black_may_end_a_person() -> None:
    table = np.full((40, 60, 3), (20, 90, 200), np.uint8)
    x, y = np.rint(PERSON.joints_px).astype(int).T
    furnished = tries = 0
    for seed in range(320):
        one = shortened(PERSON, table, np.random.default_rng(seed))
        if one is None:
            continue
        gone = one.crop.image[y, x][one.beyond]
        behind = bool((gone == table[0, 0]).all())
        assert behind or not gone.any()
        tries, furnished = tries + 1, furnished + behind
    assert 0.7 * FURNISHED < furnished / tries < 1.3 * FURNISHED


@pytest.mark.parametrize("size", [(160, 10), (1, 160), (7, 3)])
def test_pieces_of_pictures_of_any_size_fill_it(size: tuple[int, int]) -> None:
    for picture in (BLACK + 9, np.full((1, 1, 3), 9, np.uint8)):
        piece = piece_of(picture, size, np.random.default_rng(0))
        assert piece.shape == (size[1], size[0], 3)
        assert (piece == 9).all()


def test_who_stands_loses_feet_most_often_and_any_joint_now_and_then(
    cuts: list[Shortened],
) -> None:
    lost = np.array([one.beyond for one in cuts])
    assert 0.65 < lost[:, [R_ANKLE, L_ANKLE]].all(1).mean() < 0.9
    assert (lost.mean(0) > 0.02).all()


def test_views_are_of_what_is_seen_or_of_the_whole_person_beyond_the_edge(
    cuts: list[Shortened],
) -> None:
    as_seen = grown = 0
    for one in cuts:
        if not one.beyond[[R_ANKLE, L_ANKLE]].all() or one.beyond[:8].any():
            continue
        top = float(one.center_px[1]) - one.extent_px / 2
        lowest = float(JOINTS[~one.beyond, 1].max())
        end = np.flatnonzero(one.crop.image.max((1, 2)) > 0).max()
        assert lowest <= end + 0.5
        if one.extent_px <= end - 10 + 1 and one.center_px[1] <= (10 + end) / 2 + 1:
            as_seen += 1
        else:
            grown += 1
            assert top == pytest.approx(10, abs=1.0), "it grows downwards"
            assert one.extent_px < LARGEST_GROWTH * (end - 10 + 1) + 1
    assert 0.4 < as_seen / (as_seen + grown) < 0.8


def test_of_whom_too_little_is_known_nothing_is_cut_off() -> None:
    weight = PERSON.weight.copy()
    weight[FEWEST:] = 0
    assert shortened(replace(PERSON, weight=weight), BLACK, np.random.default_rng(0)) is None


def test_in_a_view_joints_beyond_the_edge_are_absent(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whichever way it is mirrored: whose foot cannot be seen is told by its own map."""
    monkeypatch.setattr(augment, "SHORTENED_SHARE", 1.0)
    monkeypatch.setattr(augment, "COMPANY_SHARE", 0.0)
    absent = np.zeros(14)
    for seed in range(200):
        sample = random_view(PERSON, PERSON, 96, np.random.default_rng(seed))
        seen = sample.presence > 0
        assert (sample.weight[seen] > GUESSED).all()
        assert set(np.unique(sample.presence)) <= {-1.0, 0.0, 1.0}
        absent += sample.presence == 0
    assert absent[[R_ANKLE, L_ANKLE]].min() > absent[R_HIP] > 0
    again = random_view(PERSON, PERSON, 96, np.random.default_rng(7))
    np.testing.assert_array_equal(
        again.image, random_view(PERSON, PERSON, 96, np.random.default_rng(7)).image
    )
