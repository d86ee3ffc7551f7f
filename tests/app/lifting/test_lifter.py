"""What lifting answers with: exemplar, camera, warp, fusion; on a small real library."""

from __future__ import annotations

import numpy as np
import pytest

from app.lifting.geometry import rotation_onto_axis
from app.lifting.lifter import Lifter
from app.lifting.stature import stature_mm
from app.lifting.types import LiftedPerson, Method
from app.lifting.warp import warp_weak_perspective
from evaluation.metrics import rigid_error_mm
from library_store.library import Library
from library_store.skeleton import L_HIP, R_HIP
from tests.app.lifting.conftest import (
    INTRINSICS,
    METHODS,
    People,
    lift_one,
    observe,
    project_px,
    same,
)


@pytest.mark.parametrize("method", METHODS)
def test_an_exemplar_seen_by_its_own_camera_is_found(
    library: Library, lifter: Lifter, method: Method
) -> None:
    for entry in (0, 1234, 3999):
        rotation, translation = library.cameras(entry)
        placed = library.poses_mm(entry) @ rotation.T + translation
        person = lift_one(lifter, observe(project_px(placed)), method=method, n_candidates=50)
        assert person.exemplar.entry == entry
        assert library.find(person.exemplar.exemplar_id) == entry
        assert person.exemplar.reprojection_error_px < 0.05
        np.testing.assert_allclose(person.exemplar.joints_mm, placed, atol=2.0)
        probabilities = [candidate.probability for candidate in person.candidates]
        assert sum(probabilities) == pytest.approx(1.0)
        assert np.isfinite(probabilities).all()
        assert probabilities == sorted(probabilities, reverse=True)
        assert person.candidates[0] is person.exemplar


def test_camera_places_the_exemplar(library: Library, lifter: Lifter, people: People) -> None:
    best = lift_one(lifter, people.observation(0)).exemplar
    placed = library.poses_mm(best.entry) @ best.rotation.T + best.translation_mm
    np.testing.assert_allclose(best.joints_mm, placed, atol=1e-6)
    error = ((project_px(placed) - people.joints_px[0]) ** 2).sum(1)
    assert best.reprojection_error_px == pytest.approx(np.sqrt(error.mean()))


def test_paper_answer_is_equation_6_on_axis(lifter: Lifter, people: People) -> None:
    # A person whose joints centre on the principal point needs no turning.
    pixels = people.joints_px[3]
    person = lift_one(lifter, observe(pixels), method="paper")
    np.testing.assert_array_equal(person.joints_3d_mm, person.warped_mm)
    assert person.sigma_mm is None
    rays = np.c_[(pixels - INTRINSICS.principal_point_px) / INTRINSICS.focal_length_px, np.ones(14)]
    turn = rotation_onto_axis((rays / np.linalg.norm(rays, axis=1, keepdims=True)).sum(0))
    turned = rays @ turn.T
    exemplar = person.exemplar.joints_mm @ turn.T
    expected = warp_weak_perspective(exemplar, turned[:, :2] / turned[:, 2:], np.ones(14, bool))
    np.testing.assert_allclose(person.joints_3d_mm, expected @ turn, atol=1e-6)


def test_fusions_warped_exemplar_reprojects_exactly(lifter: Lifter, people: People) -> None:
    person = lift_one(lifter, people.observation(5))
    np.testing.assert_allclose(project_px(person.warped_mm), people.joints_px[5], atol=1e-9)


def test_fusion_beats_the_paper(lifter: Lifter, people: People) -> None:
    errors = {}
    for method in METHODS:
        lifted = [
            lift_one(lifter, people.observation(i), method=method).joints_3d_mm
            for i in range(len(people.joints_px))
        ]
        errors[method] = rigid_error_mm(np.stack(lifted), people.joints_mm).mean()
    assert errors["fusion"] < 0.9 * errors["paper"]


@pytest.mark.parametrize("method", METHODS)
def test_the_same_bytes_whatever_is_asked_beside(
    lifter: Lifter, people: People, method: Method
) -> None:
    observations = [people.observation(i) for i in range(6)]
    together = lifter.lift(observations, INTRINSICS, method=method, n_candidates=7)
    for observation, one in zip(observations, together, strict=True):
        assert isinstance(one, LiftedPerson)
        assert len(one.candidates) == 7
        assert same(one, lift_one(lifter, observation, method=method, n_candidates=0))
        assert same(one, lift_one(lifter, observation, method=method, n_candidates=50))


@pytest.mark.parametrize("method", METHODS)
def test_subject_height_is_met_exactly_and_changes_no_image(
    lifter: Lifter, people: People, method: Method
) -> None:
    plain = lift_one(lifter, people.observation(2), method=method)
    scaled = lift_one(lifter, people.observation(2), method=method, subject_height_mm=1900.0)
    assert (plain.scale_source, scaled.scale_source) == ("library", "request")
    for joints in (scaled.joints_3d_mm, scaled.warped_mm, scaled.exemplar.joints_mm):
        assert stature_mm(joints) == pytest.approx(1900.0)
    np.testing.assert_allclose(
        project_px(scaled.joints_3d_mm), project_px(plain.joints_3d_mm), atol=1e-8
    )
    ratio = scaled.joints_3d_mm / plain.joints_3d_mm
    np.testing.assert_allclose(ratio, ratio[0, 2])
    for person in (plain, scaled):
        np.testing.assert_allclose(person.root_mm, person.joints_3d_mm[[R_HIP, L_HIP]].mean(0))
    assert (plain.sigma_mm is None) == (scaled.sigma_mm is None) == (method == "paper")
    if plain.sigma_mm is not None and scaled.sigma_mm is not None:
        np.testing.assert_allclose(scaled.sigma_mm, ratio[0, 2] * plain.sigma_mm)


def test_camera_places_the_exemplar_at_a_given_height(
    library: Library, lifter: Lifter, people: People
) -> None:
    for height_mm in (None, 1250.0):
        person = lift_one(lifter, people.observation(2), subject_height_mm=height_mm)
        for one in person.candidates:
            placed = one.scale * (library.poses_mm(one.entry) @ one.rotation.T) + one.translation_mm
            np.testing.assert_allclose(one.joints_mm, placed, atol=1e-6)
            assert (one.scale == 1.0) == (height_mm is None)
