from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from library_store.skeleton import L_HIP, L_SHOULDER, LSP14, R_HIP, R_SHOULDER
from models.card import WEIGHTS_DIR, read_card
from models.errors import ModelError
from models.heatmaps import sub_cell_peaks
from models.looks import FURTHER, Look, Seen, belief, leans, looked_at, upright

CELLS, SIZE = 40, 160
STRIDE = SIZE // CELLS


def gaussians(joints_cells: NDArray[np.float64], top: float = -1.5) -> NDArray[np.float32]:
    """Logits (1, 15, CELLS, CELLS) with a peak of that height on each joint; doubtful ones."""
    y, x = np.mgrid[:CELLS, :CELLS]
    distance2 = (x - joints_cells[:, 0, None, None]) ** 2 + (
        y - joints_cells[:, 1, None, None]
    ) ** 2
    maps = np.concatenate([top - distance2 / 4, np.zeros((1, CELLS, CELLS))])
    return maps[None].astype(np.float32)


def leaning(angle_deg: float) -> NDArray[np.float64]:
    """Joints (14, 2) in cells whose trunk leans clockwise by the angle."""
    rng = np.random.default_rng(1)
    upright = rng.uniform(-9, 9, (14, 2))
    upright[[R_SHOULDER, L_SHOULDER, R_HIP, L_HIP]] = [(-4, -8), (4, -8), (-3, 6), (3, 6)]
    a = np.deg2rad(angle_deg)
    turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    joints: NDArray[np.float64] = upright @ turn.T + (CELLS - 1) / 2
    return joints


@pytest.mark.parametrize("angle_deg", [0, 30, -75, 140, 180])
def test_the_lean_is_read_off_the_maps(angle_deg: float) -> None:
    found = np.rad2deg(leans(gaussians(leaning(angle_deg))))[0]
    assert abs((found - angle_deg + 180) % 360 - 180) < 5


def test_a_trunk_that_points_at_the_camera_is_not_turned() -> None:
    joints = leaning(0)
    joints[[R_SHOULDER, L_SHOULDER, R_HIP, L_HIP]] = [(12, 20), (26, 20), (15, 20), (23, 20)]
    np.testing.assert_array_equal(leans(gaussians(joints)), 0.0)


@pytest.mark.parametrize("look", FURTHER)
@pytest.mark.parametrize("angle_deg", [0, 30, -75, 140, 180])
def test_further_views_are_upright(look: Look, angle_deg: float) -> None:
    joints = leaning(angle_deg)
    matrix = upright(look, np.deg2rad(angle_deg), CELLS)
    seen = joints @ matrix[:, :2].T + matrix[:, 2]
    trunk = seen[[R_SHOULDER, L_SHOULDER]].mean(0) - seen[[R_HIP, L_HIP]].mean(0)
    assert abs(trunk[0]) < 1e-9
    assert trunk[1] < 0
    assert np.linalg.det(matrix[:, :2]) == pytest.approx(look.zoom**2 * (-1) ** look.mirrored)
    back = (seen - matrix[:, 2]) @ np.linalg.inv(matrix[:, :2]).T
    np.testing.assert_allclose(back, joints)


@pytest.mark.parametrize("looks", [2, 3])
@pytest.mark.parametrize("angle_deg", [0, 30, -75, 140, 180])
def test_looks_that_agree_change_nothing(angle_deg: float, looks: int) -> None:
    """A network that finds the joints in every view: the mean is where they are."""
    joints = leaning(angle_deg)
    views: list[NDArray[np.uint8]] = []

    depths = np.random.default_rng(1).uniform(-0.3, 0.3, (1, 14)).astype(np.float32)

    def see(images: NDArray[np.uint8]) -> Seen:
        views.append(images)
        if len(views) == 1:
            return Seen(gaussians(joints), depths)
        look = FURTHER[len(views) - 2]
        matrix = upright(look, leans(gaussians(joints))[0], CELLS)
        seen = joints @ matrix[:, :2].T + matrix[:, 2]
        names = list(LSP14.mirror) if look.mirrored else list(range(14))
        return Seen(gaussians(seen[names]), depths[:, names] * np.float32(look.zoom))

    image = np.random.default_rng(0).integers(0, 255, (1, SIZE, SIZE, 3)).astype(np.uint8)
    mean = looked_at(see, image, looks)
    assert len(views) == looks
    found, _ = sub_cell_peaks(np.exp(mean.maps[:, :14]))
    np.testing.assert_allclose(found[0], joints, atol=0.15)
    assert mean.depths is not None
    np.testing.assert_allclose(mean.depths, depths, rtol=1e-5)


def test_one_look_is_the_network_itself() -> None:
    maps = gaussians(leaning(20))
    seen = looked_at(lambda _: Seen(maps), np.zeros((1, SIZE, SIZE, 3), np.uint8), 1)
    assert seen.maps is maps
    assert seen.depths is None


def test_what_only_the_first_look_sees_stays_its_own() -> None:
    """Turned by 45 degrees, the corners of the crop fall outside the second view."""
    first = gaussians(leaning(45))

    calls = iter([first, np.full_like(first, 7.0)])
    both = looked_at(lambda _: Seen(next(calls)), np.zeros((1, SIZE, SIZE, 3), np.uint8), 2).maps
    np.testing.assert_array_equal(both[..., 0, 0], first[..., 0, 0])
    middle = CELLS // 2
    np.testing.assert_allclose(
        both[..., middle, middle], (first[..., middle, middle] + 7) / 2, rtol=1e-6
    )


def test_who_is_seen_clearly_is_not_looked_at_again() -> None:
    clear, doubtful = gaussians(leaning(20), top=2.0), gaussians(leaning(20))
    seen: list[int] = []

    def see(images: NDArray[np.uint8]) -> Seen:
        seen.append(len(images))
        first = np.concatenate([clear, doubtful, clear])
        return Seen(first if len(seen) == 1 else np.full_like(doubtful, 7.0))

    both = looked_at(see, np.zeros((3, SIZE, SIZE, 3), np.uint8), 2).maps
    assert seen == [3, 1]
    np.testing.assert_array_equal(both[[0, 2]], np.concatenate([clear, clear]))
    assert not np.array_equal(both[1], doubtful[0])


def test_every_look_counts_the_same_and_is_taken_at_the_doubtful_only() -> None:
    """Beliefs of 0.04, 0.36 and 0.88: looked at thrice, twice and once."""
    heights = {3: -3.0, 2: -0.5, 1: 2.0}
    first = np.concatenate([gaussians(leaning(0), top) for top in heights.values()])
    asked: list[int] = []

    def see(images: NDArray[np.uint8]) -> Seen:
        asked.append(len(images))
        depths = np.full((len(images), 14), len(asked), np.float32)
        if len(asked) == 1:
            return Seen(first, depths)
        maps = np.full_like(first[: len(images)], 0.0 if len(asked) == 2 else -9.0)
        return Seen(maps, depths * np.float32(FURTHER[len(asked) - 2].zoom))

    both = looked_at(see, np.zeros((3, SIZE, SIZE, 3), np.uint8), 3)
    seen = both.maps
    assert asked == [3, 2, 1]
    middle = (..., CELLS // 2, CELLS // 2)
    np.testing.assert_allclose(seen[0][middle], (first[0][middle] + 0 - 9) / 3, atol=1e-5)
    np.testing.assert_allclose(seen[1][middle], first[1][middle] / 2, atol=1e-5)
    np.testing.assert_array_equal(seen[2], first[2])
    assert both.depths is not None
    np.testing.assert_allclose(both.depths, [[2.0] * 14, [1.5] * 14, [1.0] * 14])


def test_the_third_view_cuts_no_corner_off() -> None:
    corners = np.array([[0, 0], [SIZE - 1, 0], [0, SIZE - 1], [SIZE - 1, SIZE - 1]])
    matrix = upright(FURTHER[1], np.deg2rad(45), SIZE)
    seen = corners @ matrix[:, :2].T + matrix[:, 2]
    assert seen.min() >= -0.5
    assert seen.max() <= SIZE - 0.5


def test_beliefs_of_extreme_logits_are_numbers() -> None:
    """Warnings are errors here: an exponential of a hundred is no float32."""
    np.testing.assert_allclose(belief(np.full((1, 15, 4, 4), -200, np.float32)), 0, atol=1e-9)


def test_a_card_cannot_ask_for_several_looks_at_beliefs(tmp_path: Path) -> None:
    card = (WEIGHTS_DIR / "cpm-int8.json").read_text()
    assert '"looks": 3' in card
    path = tmp_path / "cpm-int8.json"
    path.write_text(card.replace('"maps": "logits"', '"maps": "beliefs"'))
    with pytest.raises(ModelError, match="looks 3 needs maps logits"):
        read_card(path)
