"""What is loaded, and let go when it cannot be used."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import pytest

from app import engine
from app.engine import load_engine, load_networks, reload_engine
from app.settings import Settings
from library_store.build import BuildSettings, build_library
from library_store.library import Library, load
from library_store.prior import PosePrior
from models.card import WEIGHTS_DIR
from tests.cuda import claim_cuda


def test_networks_are_chosen_anew_where_cuda_does_not_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As onnxruntime's GPU build does without a driver: it has CUDA, and falls back silently."""
    for name in ("cpm.onnx", "cpm.json", "person.onnx", "person.json"):
        shutil.copy(WEIGHTS_DIR / name, tmp_path)
    card = json.loads((tmp_path / "cpm.json").read_text())
    dear = card | {"name": "dear", "accuracy": 0.9, "cost_ms": {"cpu/fp32": 1e4}}
    (tmp_path / "dear.json").write_text(json.dumps(dear))
    claim_cuda(monkeypatch)
    settings = Settings(weights_dir=tmp_path)
    assert engine.chosen_networks(settings) == ("dear", "person"), "on CUDA it would cost nothing"
    estimator, detector = load_networks(settings)
    assert (estimator.card.name, str(estimator.runtime)) == ("cpm", "cpu/fp32")
    assert detector.runtime.provider == "cpu"


def test_a_library_that_fails_its_warm_up_is_closed(
    tmp_path: Path, library_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[Library] = []
    real = load

    def noted(directory: Path, **options: Any) -> Library:
        opened.append(real(directory, **options))
        return opened[-1]

    monkeypatch.setattr("app.engine.load_library", noted)
    served = load_engine(Settings(library_dir=library_dir))
    build_library(tmp_path / "new", PosePrior.load(), BuildSettings(name="new", n_poses=500))
    # A made-up photo of no pixels fails as nothing else does without a server for the index.
    broken = Settings(library_dir=tmp_path / "new").model_copy(update={"max_pixels": 0})
    with pytest.raises(cv2.error):
        reload_engine(served, broken)
    assert [len(library) for library in opened] == [len(served.library), 0]
