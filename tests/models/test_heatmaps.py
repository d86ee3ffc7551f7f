import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from models.heatmaps import (
    Floats,
    Maps,
    calibrated,
    marginals,
    peak_beliefs,
    pooled,
    read_maps,
    spread,
    sub_cell_peaks,
    without_residue,
)
from models.rivals import shares

CELLS = 40
STRIDE = 4.0


def gaussian(x: float, y: float, sigma_x: float, sigma_y: float, rho: float = 0.0) -> np.ndarray:
    """Log of an (unnormalised) Gaussian on the cell grid, (CELLS, CELLS)."""
    v, u = np.mgrid[0:CELLS, 0:CELLS]
    a, b = (u - x) / sigma_x, (v - y) / sigma_y
    log_density: np.ndarray = -(a * a - 2 * rho * a * b + b * b) / (2 * (1 - rho * rho))
    return log_density


@settings(max_examples=60, deadline=None)
@given(
    x=st.floats(2, CELLS - 3),
    y=st.floats(2, CELLS - 3),
    sigma=st.floats(0.8, 4.0),
    ratio=st.floats(0.6, 1.6),
    rho=st.floats(-0.5, 0.5),
)
@example(x=2.1875, y=2.5625, sigma=1.0, ratio=0.625, rho=0.5)
def test_peak_of_a_gaussian_is_found_to_a_tenth_of_an_input_pixel(
    x: float, y: float, sigma: float, ratio: float, rho: float
) -> None:
    maps = gaussian(x, y, sigma, sigma * ratio, rho)[None, None].astype(np.float32)
    at, _ = sub_cell_peaks(marginals(maps, "logits"))
    assert np.abs(at[0, 0] - (x, y)).max() * STRIDE < 0.1


@settings(max_examples=60, deadline=None)
@given(
    u=st.floats(0, 1),
    v=st.floats(0, 1),
    sigma=st.floats(1.0, 3.0),  # a narrower one is more than its samples tell
    ratio=st.floats(0.8, 1.6),
    rho=st.floats(-0.5, 0.5),
)
@example(u=0.0, v=1.0, sigma=3.0, ratio=1.6, rho=0.5)
def test_pooling_leaves_a_gaussian_where_it_is(
    u: float, v: float, sigma: float, ratio: float, rho: float
) -> None:
    # Away from the border, by as much as the wider it is.
    margin = 4 + 1.5 * sigma * max(1.0, ratio)
    x, y = margin + np.array([u, v]) * (CELLS - 1 - 2 * margin)
    maps = gaussian(x, y, sigma, sigma * ratio, rho)[None, None].astype(np.float32)
    at, _ = sub_cell_peaks(pooled(marginals(maps, "logits")))
    assert np.abs(at[0, 0] - (x, y)).max() * STRIDE < 0.1


@pytest.mark.parametrize("x", [0.0, 1.0, 2.0, 3.0])
def test_pooled_peaks_at_the_border_move_inwards_by_less_than_a_cell(x: float) -> None:
    maps = gaussian(x, CELLS - 1 - x, 1.5, 1.5)[None, None].astype(np.float32)
    at, _ = sub_cell_peaks(pooled(marginals(maps, "logits")))
    off = (at[0, 0] - (x, CELLS - 1 - x)) * (1, -1)
    assert (off > -0.01).all()
    assert (off < 0.8).all()


def test_a_hill_is_believed_before_a_sharper_peak_of_less_belief() -> None:
    hill = 0.7 * np.exp(gaussian(10, 20, 2.0, 2.0)) / 2.0**2
    peak = 0.3 * np.exp(gaussian(30, 20, 0.8, 0.8)) / 0.8**2
    assert peak.max() > hill.max()
    maps = np.stack([hill + peak, np.zeros_like(hill)])[None].astype(np.float32)
    read = read_maps(maps, 1, "beliefs", target_sigma_cells=1.0)
    np.testing.assert_allclose(read.at[0, 0], (10, 20), atol=0.1)
    assert read.peak[0, 0] == pytest.approx(maps[0, 0, 20, 10]), "of that place, not of the sharper"


def test_what_is_lost_to_others_counts_against_the_joint_not_for_its_place() -> None:
    maps = gaussian(17.3, 22.6, 2.0, 2.0)[None, None].repeat(2, axis=1).astype(np.float32)
    alone = read_maps(maps, 1, "logits", target_sigma_cells=1.0)
    halved = read_maps(maps, 1, "logits", 1.0, own=lambda p, _: np.full_like(p, 0.5))
    np.testing.assert_allclose(halved.at, alone.at, atol=1e-6)
    np.testing.assert_allclose(halved.covariance, alone.covariance, rtol=1e-5)
    near_peak = 2
    np.testing.assert_allclose(
        halved.features[..., near_peak], 0.5 * alone.features[..., near_peak], rtol=1e-6
    )


def test_beliefs_and_logits_give_the_same_place() -> None:
    log_map = gaussian(17.3, 22.6, 1.5, 2.0)
    logits, _ = sub_cell_peaks(marginals(log_map[None, None].astype(np.float32), "logits"))
    beliefs, _ = sub_cell_peaks(
        marginals(np.exp(log_map)[None, None].astype(np.float32), "beliefs")
    )
    np.testing.assert_allclose(logits, beliefs, atol=0.01)


def test_what_a_regression_leaves_everywhere_is_no_spread() -> None:
    belief = 0.7 * np.exp(gaussian(17.3, 22.6, 2.0, 2.0))
    noise = np.random.default_rng(0).uniform(0, 0.02, belief.shape)
    maps = np.stack([belief + noise, 1 - belief])[None].astype(np.float32)
    read = read_maps(maps, 1, "beliefs", target_sigma_cells=1.0)
    np.testing.assert_allclose(read.at[0, 0], (17.3, 22.6), atol=0.2)
    # 2² less the blur of the targets; all that lies below the residue's level is lost.
    np.testing.assert_allclose(read.covariance[0, 0], 3 * np.eye(2), atol=1.0)
    np.testing.assert_allclose(without_residue(maps).sum((-1, -2)), 1, rtol=1e-6)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(["logits", "beliefs"]),
    scale=st.floats(-3, 3),
    middle=st.sampled_from([-1.0, -0.01, 0.0, 0.01, 1.0]),
    flat=st.integers(0, 14),
    people=st.integers(1, 3),
)
@example(seed=0, kind="beliefs", scale=-2.0, middle=-0.01, flat=14, people=2)
def test_whatever_the_maps_are_joints_lie_in_them_and_all_is_finite(
    seed: int, kind: str, scale: float, middle: float, flat: int, people: int
) -> None:
    rng = np.random.default_rng(seed)
    maps = (10**scale * rng.normal(middle, 1, (people, 15, 12, 12))).astype(np.float32)
    maps[-1, :flat] = middle  # one of them has joints of which nothing is seen
    origin = rng.uniform(0, 60, (people, 2))

    def own(p: Maps, belief: Floats) -> Maps:
        return shares(p, belief, rng.uniform(0.5, 2, people), origin, STRIDE)

    read = read_maps(maps, 14, kind, 1.0, own if people > 1 else None)
    assert ((read.at >= -0.5) & (read.at <= 11.5)).all()
    assert (np.linalg.eigvalsh(read.covariance) > 0).all()
    assert ((read.peak >= 0) & (read.peak <= 1)).all()
    assert np.isfinite(read.features).all()


def test_marginals_sum_to_one_even_for_extreme_maps() -> None:
    rng = np.random.default_rng(0)
    maps = rng.normal(0, 200, (3, 14, 12, 12)).astype(np.float32)
    np.testing.assert_allclose(marginals(maps, "logits").sum((-1, -2)), 1)
    np.testing.assert_allclose(marginals(np.zeros_like(maps), "beliefs").sum((-1, -2)), 1)


def test_spread_is_the_covariance_less_the_blur_of_the_targets() -> None:
    sigma_x, sigma_y, rho, blur = 2.5, 1.8, 0.4, 1.2
    maps = gaussian(20, 20, sigma_x, sigma_y, rho)[None, None].astype(np.float32)
    p = marginals(maps, "logits")
    at, _ = sub_cell_peaks(p)
    cross = rho * sigma_x * sigma_y
    expected = np.array([[sigma_x**2, cross], [cross, sigma_y**2]]) - blur**2 * np.eye(2)
    np.testing.assert_allclose(spread(p, at, blur)[0, 0], expected, rtol=0.02, atol=0.02)


def test_spread_stays_invertible_for_a_single_sharp_cell() -> None:
    maps = np.full((1, 1, 16, 16), -50, np.float32)
    maps[0, 0, 3, 5] = 50
    p = marginals(maps, "logits")
    at, _ = sub_cell_peaks(p)
    np.testing.assert_allclose(at[0, 0], (5, 3))
    assert np.linalg.eigvalsh(spread(p, at, 1.2)[0, 0]).min() > 0


def test_two_far_peaks_show_as_a_wide_spread() -> None:
    one = np.exp(gaussian(8, 20, 1.5, 1.5))
    both = one + 0.9 * np.exp(gaussian(30, 20, 1.5, 1.5))
    maps = np.log(np.stack([one, both])[None] + 1e-9).astype(np.float32)
    p = marginals(maps, "logits")
    at, _ = sub_cell_peaks(p)
    traces = np.trace(spread(p, at, 1.2), axis1=-2, axis2=-1)[0]
    assert traces[1] > 20 * traces[0]


@pytest.mark.parametrize("corner", [(0, 0), (0, CELLS - 1), (CELLS - 1, 0), (CELLS - 1, CELLS - 1)])
def test_peaks_at_the_border_stay_in_the_map(corner: tuple[int, int]) -> None:
    maps = gaussian(*corner, 1.5, 1.5)[None, None].astype(np.float32)
    at, best = sub_cell_peaks(marginals(maps, "logits"))
    assert np.abs(at[0, 0] - corner).max() <= 0.75
    assert peak_beliefs(maps, best, "beliefs").shape == (1, 1)


def test_confidence_grows_with_its_evidence() -> None:
    coefficients = np.array([[0.5, 2.0]])
    stated = calibrated(np.array([[[-3.0]], [[0.0]], [[3.0]]]), coefficients)[:, 0]
    assert (np.diff(stated) > 0).all()
    assert ((stated > 0) & (stated < 1)).all()
