"""How unsure joints are lifted: stated covariance, noise that is found, confidence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from app.lifting.geometry import rotation_onto_axis
from app.lifting.lifter import Lifter, LiftingSettings
from app.lifting.posterior import STANDARD_PX_PER_MM
from app.lifting.types import Observation
from library_store.library import Library
from library_store.skeleton import L_HIP, R_HIP
from tests.app.lifting.conftest import INTRINSICS, People, lift_one, observe, project_px


def test_stated_covariance_is_used(lifter: Lifter, people: People) -> None:
    pixels = people.joints_px[4].copy()
    pixels[4] += [60.0, 0.0]
    covariance = np.broadcast_to(np.eye(2), (14, 2, 2)).copy()
    sure = lift_one(lifter, Observation(pixels, np.ones(14), covariance))
    covariance[4] = 90.0**2 * np.eye(2)
    unsure = lift_one(lifter, Observation(pixels, np.ones(14), covariance))
    truth = project_px(people.joints_mm[4])[4]
    moved = [np.linalg.norm(project_px(p.joints_3d_mm)[4] - truth) for p in (sure, unsure)]
    assert moved[1] < moved[0]


def test_noise_that_is_stated_is_not_found_again(lifter: Lifter, people: People) -> None:
    rng = np.random.default_rng(0)
    noise_px = 12.0
    found: dict[bool, list[float]] = {False: [], True: []}
    for index in range(20):
        pixels = people.joints_px[index] + rng.normal(0, noise_px, (14, 2))
        stated = np.tile(noise_px**2 * np.eye(2), (14, 1, 1))
        for is_stated, covariance in ((False, None), (True, stated)):
            person = lift_one(lifter, Observation(pixels, np.ones(14), covariance))
            assert person.noise_px is not None
            found[is_stated].append(person.noise_px)
    assert np.mean(found[True]) < 0.6 * np.mean(found[False])


def test_candidates_of_noisy_joints_are_told_apart_as_poorly_as_stated(
    library: Library, people: People
) -> None:
    """A covariance in the photo's pixels counts as one in standard pixels at the person's depth."""
    noise_px = 60.0
    by_default = LiftingSettings(sigma_2d_px=noise_px)
    for index in range(4):
        pixels = people.joints_px[index]
        wanted = lift_one(Lifter(library, by_default), observe(pixels), n_candidates=50)
        depths_mm = [one.joints_mm[[R_HIP, L_HIP], 2].mean() for one in wanted.candidates]
        to_photo = INTRINSICS.focal_length_px / (STANDARD_PX_PER_MM * np.median(depths_mm))
        stated = np.tile((to_photo * noise_px) ** 2 * np.eye(2), (14, 1, 1))
        told = Observation(pixels, np.ones(14), stated)
        person = lift_one(Lifter(library), told, n_candidates=50)
        probable = {one.entry: one.probability for one in wanted.candidates}
        assert {one.entry: one.probability for one in person.candidates} == pytest.approx(
            probable, rel=0.02
        )


def test_the_camera_follows_unsure_joints_less(lifter: Lifter, people: People) -> None:
    """Eq. 5 weighs joints by confidence."""
    wrist = 4
    pixels = people.joints_px[4].copy()
    pixels[wrist] += [60.0, 0.0]
    off_px = []
    for confidence in (1.0, 0.25):
        sure = np.ones(14)
        sure[wrist] = confidence
        person = lift_one(lifter, Observation(pixels, sure), method="paper", n_candidates=10)
        by_entry = {
            one.entry: np.linalg.norm(project_px(one.joints_mm)[wrist] - pixels[wrist])
            for one in person.candidates
        }
        off_px.append(by_entry)
    assert off_px[0].keys() == off_px[1].keys()
    further = [off_px[1][entry] > off_px[0][entry] for entry in off_px[0]]
    assert np.mean(further) > 0.8


def test_neighbours_stand_by_all_joints_alike_however_sure(lifter: Lifter, people: People) -> None:
    """Confidence tells which joint is elsewhere; how far joints scatter, covariances do."""
    for index in range(4):
        pixels = people.joints_px[index]
        rays = np.column_stack(
            [(pixels - INTRINSICS.principal_point_px) / INTRINSICS.focal_length_px, np.ones(14)]
        )
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        # Confidences of the same centre: the camera is turned onto it.
        across = (rays @ rotation_onto_axis(rays.sum(axis=0)).T)[:, :2]
        apart = np.linalg.svd(across.T)[2][-1]
        unsure = 0.85 + 0.15 * apart / np.abs(apart).max()
        person = lift_one(lifter, Observation(pixels, unsure))
        alike = lift_one(lifter, observe(pixels))
        np.testing.assert_allclose(person.joints_3d_mm, alike.joints_3d_mm, atol=1e-3)


def test_who_was_seen_with_doubt_is_answered_with_doubt(lifter: Lifter, people: People) -> None:
    """The joints may be those of an exchanged leg, which no spread about them tells."""
    sure = lift_one(lifter, people.observation(5))
    seen = people.observation(5)
    unsure = lift_one(lifter, replace(seen, confidence=np.full(14, 0.7)))
    assert sure.sigma_mm is not None
    assert unsure.sigma_mm is not None
    assert (unsure.sigma_mm > sure.sigma_mm + 50).all()
