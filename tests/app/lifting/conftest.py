"""A small real library and people to lift with it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest

from app.lifting.geometry import Floats, project
from app.lifting.lifter import Lifter
from app.lifting.proportions import SYMMETRIC_SEGMENTS
from app.lifting.types import Intrinsics, LiftedPerson, Method, Observation
from library_store.build import BuildSettings, build_library
from library_store.library import Library, load
from library_store.prior import PosePrior

INTRINSICS = Intrinsics(1150.0, (320.0, 240.0), "request")
METHODS: tuple[Method, ...] = ("fusion", "paper")


@pytest.fixture(scope="session")
def library(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Library]:
    directory = tmp_path_factory.mktemp("lifting") / "small"
    settings = BuildSettings(name="small", n_poses=4_000, seed=11)
    build_library(directory, PosePrior.load(), settings)
    library = load(directory)
    yield library
    library.close()


@pytest.fixture(scope="session")
def lifter(library: Library) -> Lifter:
    return Lifter(library)


def asymmetry(joints_mm: Floats) -> Floats:
    """Log ratios (5,) right to left of the paired segments of a pose (14, 3)."""
    starts, ends = np.moveaxis(np.array(SYMMETRIC_SEGMENTS), 2, 0)
    lengths = np.linalg.norm(joints_mm[ends] - joints_mm[starts], axis=-1)
    ratios: Floats = np.log(lengths[:, 0] / lengths[:, 1])
    return ratios


@dataclass(frozen=True)
class People:
    """(N, 14, 3) camera-frame mm and their projections (N, 14, 2) px by ``INTRINSICS``."""

    joints_mm: Floats
    joints_px: Floats

    def observation(self, index: int) -> Observation:
        return observe(self.joints_px[index])


@pytest.fixture(scope="session")
def people() -> People:
    """Poses of the prior that are not in the library, 4.5 m in front of a level camera."""
    poses = PosePrior.load().sample(40, np.random.default_rng(99)).astype(np.float64)
    turned = poses * [1.0, -1.0, -1.0]
    turned -= turned[:, [8, 11]].mean(1, keepdims=True)
    joints_mm = turned + np.array([0.0, 0.0, 4500.0])
    return People(joints_mm, project_px(joints_mm))


def project_px(joints_mm: Floats) -> Floats:
    return project(joints_mm, INTRINSICS.focal_length_px, np.array(INTRINSICS.principal_point_px))


def observe(joints_px: Floats, missing: tuple[int, ...] = ()) -> Observation:
    confidence = np.ones(14)
    confidence[list(missing)] = 0.0
    return Observation(joints_px, confidence)


def lift_one(
    lifter: Lifter,
    observation: Observation,
    intrinsics: Intrinsics = INTRINSICS,
    method: Method = "fusion",
    subject_height_mm: float | None = None,
    n_candidates: int = 3,
) -> LiftedPerson:
    (person,) = lifter.lift(
        [observation],
        intrinsics,
        method=method,
        subject_height_mm=subject_height_mm,
        n_candidates=n_candidates,
    )
    assert isinstance(person, LiftedPerson)
    return person


def same(a: LiftedPerson, b: LiftedPerson) -> bool:
    """Whether two people are answered with the same bytes."""

    def answer(person: LiftedPerson) -> tuple[object, ...]:
        sigma = None if person.sigma_mm is None else person.sigma_mm.tobytes()
        exemplar = person.exemplar
        return (
            person.joints_3d_mm.tobytes(),
            person.warped_mm.tobytes(),
            (exemplar.exemplar_id, exemplar.probability, exemplar.rotation.tobytes()),
            sigma,
            person.warnings,
        )

    return answer(a) == answer(b)
