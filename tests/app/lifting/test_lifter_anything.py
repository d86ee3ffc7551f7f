"""Whatever is asked within the API's limits is answered with numbers that hold, or refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from app.lifting.geometry import Floats, project
from app.lifting.lifter import Lifter
from app.lifting.types import Intrinsics, LiftedPerson, Method, NotLiftable, Observation
from library_store.library import Library
from models.pose_lifter import PoseLifter
from tests.app.lifting.conftest import METHODS
from tests.rotations import rotation_exponential

MOST_PX = 1e6
"""Of coordinates and focal lengths; ``app.schemas`` refuses larger ones."""


@pytest.fixture(scope="module")
def lifter(library: Library) -> Lifter:
    return Lifter(library, network=PoseLifter())


def somebody(library: Library, rng: np.random.Generator, camera: Intrinsics, near: float) -> Floats:
    """A pose of the library, turned anyhow, as much as 85° off the axis, 10^``near`` mm away."""
    (turn,) = rotation_exponential(rng.normal(0, 2, (1, 3)))
    pose = library.poses_mm(rng.integers(len(library))) @ turn.T
    off, about = np.radians(rng.uniform(0, 85)), rng.uniform(0, 2 * np.pi)
    towards = np.array([np.sin(off) * np.cos(about), np.sin(off) * np.sin(about), np.cos(off)])
    seen = pose + 10**near * towards
    seen[:, 2] = np.maximum(seen[:, 2], 1.0)
    return project(seen, camera.focal_length_px, np.array(camera.principal_point_px))


def scattered(rng: np.random.Generator, camera: Intrinsics, spread: float) -> Floats:
    """Joints that nobody has, 10^``spread`` focal lengths apart."""
    drawn: Floats = camera.principal_point_px + camera.focal_length_px * 10**spread * rng.normal(
        size=(14, 2)
    )
    return drawn


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    focal=st.floats(0, 6),
    apart=st.one_of(st.none(), st.floats(-6, 1)),
    near=st.floats(2.6, 7),
    doubtful=st.booleans(),
    noise=st.one_of(st.none(), st.floats(-3, 4)),
    method=st.sampled_from(METHODS),
    height_mm=st.one_of(st.none(), st.floats(300, 3000)),
)
@example(215, 4.0, None, 2.6, False, None, "fusion", None)
@example(215, 4.0, None, 2.6, False, None, "paper", None)
def test_answers_are_finite_and_before_the_camera(
    library: Library,
    lifter: Lifter,
    seed: int,
    focal: float,
    apart: float | None,
    near: float,
    doubtful: bool,
    noise: float | None,
    method: Method,
    height_mm: float | None,
) -> None:
    rng = np.random.default_rng(seed)
    centre = rng.uniform(-1, 1, 2) * 10 ** rng.uniform(0, 6)
    camera = Intrinsics(10**focal, (float(centre[0]), float(centre[1])), "request")
    joints_px = (
        somebody(library, rng, camera, near) if apart is None else scattered(rng, camera, apart)
    )
    confidence = rng.choice([0.0, 1e-9, 0.3, 1.0], 14, p=[0.15, 0.05, 0.2, 0.6])
    covariance_px2 = depths_px = None
    if noise is not None:
        root = 10**noise * rng.normal(size=(14, 2, 2))
        covariance_px2 = root @ root.transpose(0, 2, 1)
        depths_px = rng.normal(size=14) * 10**focal
    person = Observation(
        np.clip(joints_px, -MOST_PX, MOST_PX),
        confidence if doubtful else np.ones(14),
        covariance_px2,
        depths_px,
    )
    (answer,) = lifter.lift(
        [person], camera, method=method, subject_height_mm=height_mm, n_candidates=50
    )
    if isinstance(answer, NotLiftable):
        return
    assert isinstance(answer, LiftedPerson)
    for joints_mm in (answer.joints_3d_mm, answer.warped_mm, answer.exemplar.joints_mm):
        assert np.isfinite(joints_mm).all()
        assert (joints_mm[:, 2] > 0).all()
    if answer.sigma_mm is not None:
        assert np.isfinite(answer.sigma_mm).all()
        assert (answer.sigma_mm > 0).all()
    assert sum(each.probability for each in answer.candidates) == pytest.approx(1.0)
    for each in answer.candidates:
        assert np.isfinite(each.joints_mm).all()
        assert np.isfinite([each.scale, each.distance, each.reprojection_error_px]).all()
        np.testing.assert_allclose(each.rotation @ each.rotation.T, np.eye(3), atol=1e-9)
