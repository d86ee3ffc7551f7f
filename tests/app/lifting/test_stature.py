import numpy as np
import pytest

from app.lifting.stature import STATURE_PER_SEGMENTS, expected_stature_mm, stature_mm
from library_store.prior import PosePrior


def test_a_straight_body_is_its_height_less_the_feet() -> None:
    pose = np.zeros((14, 3))
    heights = [1700, 1450, 1400, 1100, 850, 1400, 1100, 850, 900, 500, 100, 900, 500, 100]
    pose[:, 1] = heights
    assert stature_mm(pose) == pytest.approx(1600 * STATURE_PER_SEGMENTS)


def test_posture_hardly_matters_and_size_does() -> None:
    poses = PosePrior.load().sample(50, np.random.default_rng(0)).astype(np.float64)
    heights = stature_mm(poses)
    assert ((heights > 1300) & (heights < 2100)).all()
    np.testing.assert_allclose(stature_mm(1.1 * poses), 1.1 * heights)


def test_what_spread_takes_from_a_mean_pose_is_given_back() -> None:
    rng = np.random.default_rng(4)
    pose = PosePrior.load().sample(1, rng)[0]
    still = np.zeros((3, 14, 14))
    assert expected_stature_mm(pose, still) == pytest.approx(float(stature_mm(pose)))
    # Legs that point anywhere: many poses of one height, whose mean has hardly any legs.
    turned = np.repeat(pose[None], 4_000, axis=0)
    for hip, knee, ankle in ((8, 9, 10), (11, 12, 13)):
        for end, start in ((knee, hip), (ankle, knee)):
            away = rng.standard_normal((len(turned), 3))
            away /= np.linalg.norm(away, axis=1, keepdims=True)
            turned[:, end] = turned[:, start] + 400.0 * away
    mean = turned.mean(0)
    apart = turned - mean
    covariance = np.einsum("nja,nka->ajk", apart, apart) / len(turned)
    height = float(stature_mm(turned).mean())
    assert expected_stature_mm(mean, covariance) == pytest.approx(height, rel=0.01)
    assert float(stature_mm(mean)) < 0.7 * height
