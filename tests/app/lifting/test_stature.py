import numpy as np
import pytest

from app.lifting.stature import STATURE_PER_SEGMENTS, stature_mm
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
