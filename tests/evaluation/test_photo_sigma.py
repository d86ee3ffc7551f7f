"""What the network's doubt adds to sigma_mm: the fit, and the command on photos with truth."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from app.errors import PoseMatchError
from app.lifting.calibration import FUSION_SIGMA, SigmaCalibration
from app.lifting.geometry import normalised_projection
from app.lifting.lifter import LiftingSettings
from app.lifting.types import Intrinsics, LiftedPerson, Observation
from evaluation import photo_sigma
from evaluation.calibration import Served
from evaluation.networks import OFF
from evaluation.photo_sigma import Answers, Seen, fit_doubts
from library_store.build import BuildSettings, build_library
from library_store.prior import PosePrior
from models import PoseEstimator
from models.training.dataset import read_annotations
from tests.evaluation.rendered_set import write_set


def made_up(people: int) -> tuple[Answers, SigmaCalibration]:
    """Answers whose errors a known calibration covers by 68%."""
    rng = np.random.default_rng(4)
    shape = (people, 14)
    truth = SigmaCalibration((1.0,) * 14, 0.0, person_doubt_mm=600.0, joint_doubt_mm=300.0)
    confidence = 1 - rng.uniform(0, 0.5, (people, 1)) * rng.uniform(0, 1, shape)
    answers = Answers(rng.uniform(30, 90, shape), np.zeros(shape), confidence, np.zeros(people))
    # |N(0, 1)| is below 0.994 in 68% of draws.
    error = np.abs(rng.normal(size=shape)) / 0.9945 * answers.sigma_mm(truth)
    return replace(answers, error_mm=error), truth


def test_the_fit_finds_what_the_doubts_are_worth() -> None:
    answers, truth = made_up(3000)
    alone = replace(truth, person_doubt_mm=0.0, joint_doubt_mm=0.0)
    fitted = fit_doubts(answers, alone)
    assert abs(fitted.person_doubt_mm - truth.person_doubt_mm) <= 100
    assert abs(fitted.joint_doubt_mm - truth.joint_doubt_mm) <= 100
    covered = (answers.error_mm <= answers.sigma_mm(fitted)).mean()
    assert covered == pytest.approx(0.68, abs=0.02)
    assert "100%" in photo_sigma.report("fit", replace(answers, error_mm=answers.spread_mm), fitted)


def test_what_is_checked_is_what_is_served(tmp_path: Path) -> None:
    """Also of people with a joint that contradicts the others, which then counts as missing."""
    directory = tmp_path / "tiny"
    build_library(directory, PosePrior.load(), BuildSettings(name="tiny", n_poses=2_000, seed=3))
    served = Served.of(directory, OFF)
    pinhole = Intrinsics(1150.0, (0.0, 0.0), "request")
    poses = PosePrior.load().sample(30, np.random.default_rng(6))
    joints = poses * [1.0, -1.0, -1.0] + [0.0, 0.0, 4000.0]
    points = 1150.0 * normalised_projection(joints)
    points[:15, 4] += 400.0
    confidence = np.random.default_rng(7).uniform(0.1, 1.0, (30, 14))
    people = [
        Seen(Observation(seen, sure), pinhole, truth)
        for seen, sure, truth in zip(points, confidence, joints, strict=True)
    ]
    lifter = served.lifter(LiftingSettings())
    answers = lifter.lift([person.observation for person in people], pinhole)
    lifted = [answer for answer in answers if isinstance(answer, LiftedPerson)]
    assert sum("inconsistent_joints" in person.warnings for person in lifted) > 3
    np.testing.assert_allclose(
        photo_sigma.lift(people, served).sigma_mm(FUSION_SIGMA),
        np.stack([person.sigma_mm for person in lifted if person.sigma_mm is not None]),
    )


def test_where_nobody_can_be_lifted_it_is_said(tmp_path: Path) -> None:
    directory = tmp_path / "tiny"
    build_library(directory, PosePrior.load(), BuildSettings(name="tiny", n_poses=500, seed=3))
    on_one_spot = Observation(np.zeros((14, 2)), np.ones(14))
    nobody = Seen(on_one_spot, Intrinsics(1150.0, (0.0, 0.0), "request"), np.zeros((14, 3)))
    with pytest.raises(PoseMatchError, match="nobody can be lifted, of 2 people"):
        photo_sigma.lift([nobody, nobody], Served.of(directory, OFF))


def test_only_the_joints_of_the_first_people_asked_for_are_found(tmp_path: Path) -> None:
    assert write_set(tmp_path / "photos") > 2
    (tmp_path / "photos" / "annotations.json").write_text(
        json.dumps({"images": [*read_annotations(tmp_path / "photos")[:2], {}]})
    )
    found = photo_sigma.find_joints(tmp_path / "photos", PoseEstimator("cpm-int8"), 2)
    assert len(list(found)) == 2


def test_the_command_measures_photos_with_truth(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photos = tmp_path / "photos"
    people = write_set(photos, times=3)
    library = tmp_path / "tiny"
    build_library(library, PosePrior.load(), BuildSettings(name="tiny", n_poses=2_000, seed=3))
    command = ["--renders", str(photos), "--library", str(library), "--network", "off"]
    photo_sigma.main(command)
    printed = capsys.readouterr().out
    assert f"{people} people, {people} lifted" in printed
    assert printed.count("\n| ") == 5

    write_set(photos, with_3d=False)
    with pytest.raises(SystemExit, match="no 3D truth"):
        photo_sigma.main(command)
