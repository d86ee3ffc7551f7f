"""Calibration of a network's confidence and spread, by its command, on a small data set."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from models.card import WEIGHTS_DIR, PoseOutput, read_card
from models.training import calibrate
from models.training.calibrate import calibration_error, fit_confidence
from tests.models.training.data_files import write_tar


def test_the_logistic_fit_finds_what_made_the_data() -> None:
    rng = np.random.default_rng(0)
    features = rng.normal(0, 1, (4_000, 2, 3))
    truth = np.array([[0.5, 1.0, -2.0, 0.0], [-1.0, 1.0, -2.0, 0.0]])
    chance = 1 / (1 + np.exp(-(truth[:, 0] + (features * truth[:, 1:]).sum(-1))))
    near = rng.random(chance.shape) < chance
    known = np.ones_like(near)
    data = calibrate.Readings(features, known * 1.0, known * 1.0, near, known, known)
    np.testing.assert_allclose(fit_confidence(data), truth, atol=0.15)


def test_the_calibration_error_is_the_gap_between_said_and_seen() -> None:
    said = np.repeat([0.15, 0.95], 1_000)
    seen = np.concatenate([np.arange(1_000) < 350, np.arange(1_000) < 950])
    assert calibration_error(said, seen) == pytest.approx(0.1)


def test_every_test_set_named_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    for name, count in (("photos_x", 60), ("mine", 3), ("yours", 3)):
        images = rng.integers(0, 256, (count, 64, 64, 3)).astype(np.uint8)
        write_tar(tmp_path / f"{name}.tar", images, rng.uniform(10, 54, (count, 14, 2)))
    for file in ("cpm.onnx", "cpm.json"):
        shutil.copy(WEIGHTS_DIR / file, tmp_path)
    arguments = ["--data", tmp_path, "--weights", tmp_path, "--train", "photos_x"]
    monkeypatch.setattr(sys, "argv", ["", *map(str, arguments), "--test", "mine,yours"])
    threads = cv2.getNumThreads()
    calibrate.main()
    cv2.setNumThreads(threads)
    card = read_card(tmp_path / "cpm.json")
    for name in ("mine", "yours", "photos_dev"):
        shares = [card.measured[f"pck_0.2/{name}/{n}"] for n in ("14_joints", "12_limb_joints")]
        assert all(isinstance(share, float) and 0 <= share <= 1 for share in shares)
    output = card.output
    assert isinstance(output, PoseOutput)
    assert output.confidence is not None
    assert output.spread is not None
    assert len(output.confidence.coefficients) == len(output.spread.factor) == 14
    before = json.loads((WEIGHTS_DIR / "cpm.json").read_text())
    assert output.spread.factor != before["output"]["spread"]["factor"]
