import numpy as np
import pytest

from evaluation.metrics import (
    Floats,
    align,
    rigid_error_mm,
    root_centred_error_mm,
    similarity_error_mm,
    summarise,
)
from models.pck import correct_keypoints, torso_px
from tests.rotations import rotation_exponential

RNG = np.random.default_rng(4)
TRUTH = RNG.normal(size=(30, 14, 3)) * 400
ROTATION = rotation_exponential(RNG.normal(size=(30, 3)))
SHIFT = RNG.normal(size=(30, 1, 3)) * 1000


def test_each_protocol_forgives_what_it_should() -> None:
    rigid = TRUTH @ np.swapaxes(ROTATION, 1, 2) + SHIFT
    assert rigid_error_mm(rigid, TRUTH).max() < 1e-6
    assert similarity_error_mm(1.3 * rigid, TRUTH).max() < 1e-6
    assert root_centred_error_mm(TRUTH + SHIFT, TRUTH).max() < 1e-6
    assert rigid_error_mm(1.3 * rigid, TRUTH).mean() > 50
    assert root_centred_error_mm(rigid, TRUTH).mean() > 50


def test_alignment_never_reflects() -> None:
    mirrored = TRUTH * [-1, 1, 1]
    assert similarity_error_mm(mirrored, TRUTH).mean() > 50


def test_more_freedom_never_fits_worse() -> None:
    predicted = TRUTH + RNG.normal(size=TRUTH.shape) * 60

    def squared(points: Floats) -> Floats:
        total: Floats = ((points - TRUTH) ** 2).sum((1, 2))
        return total

    centred = predicted - predicted.mean(1, keepdims=True) + TRUTH.mean(1, keepdims=True)
    rigid, similar = (squared(align(predicted, TRUTH, scale=s)) for s in (False, True))
    assert (rigid <= squared(centred) + 1e-6).all()
    assert (similar <= rigid + 1e-6).all()


def test_alignment_agrees_with_scipy() -> None:
    spatial = pytest.importorskip("scipy.spatial.transform")
    predicted = TRUTH + RNG.normal(size=TRUTH.shape) * 60
    for a, b, ours in zip(predicted, TRUTH, align(predicted, TRUTH, scale=False), strict=True):
        centre = a.mean(0)
        rotation, _ = spatial.Rotation.align_vectors(b - b.mean(0), a - centre)
        np.testing.assert_allclose(ours, rotation.apply(a - centre) + b.mean(0), atol=1e-6)


def test_pck_counts_in_torso_lengths() -> None:
    truth = RNG.normal(size=(5, 14, 2)) * 100
    torso = torso_px(truth)
    predicted = truth.copy()
    predicted[:, 4, 0] += 0.19 * torso
    predicted[:, 7, 1] += 0.21 * torso
    correct = correct_keypoints(predicted, truth)
    assert correct[:, 4].all()
    assert not correct[:, 7].any()
    assert correct.sum() == 5 * 13


def test_summary_is_mean_and_median_of_people() -> None:
    predicted = TRUTH.copy()
    predicted[0] += RNG.normal(size=(14, 3)) * 100
    summary = summarise(predicted, TRUTH)
    assert summary.p2_median < 1e-6 < summary.p2_mean
    assert summarise(predicted, TRUTH, joints=[2, 3]).p2_mean != summary.p2_mean
