"""Fine-tuning from an exported network on a user's images; needs the train extra."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

torch = pytest.importorskip("torch")
pytest.importorskip("onnx")

from app.cli import cli  # noqa: E402
from models import ModelError, PoseEstimator  # noqa: E402
from models.card import WEIGHTS_DIR, read_card  # noqa: E402
from models.choice import cards_of, choose  # noqa: E402
from models.errors import AnnotationError  # noqa: E402
from models.person_detector import PersonBox  # noqa: E402
from models.training import export  # noqa: E402
from models.training.dataset import LabelledCrop  # noqa: E402
from models.training.finetune import (  # noqa: E402
    FinetuneResult,
    FinetuneSettings,
    finetune,
    split,
)
from models.training.network import (  # noqa: E402
    ConvolutionalPoseMachine,
    CpmConfig,
    PersonConfig,
    PersonNetwork,
)
from models.training.onnx_graph import pose_model  # noqa: E402
from models.training.users_coco import read_coco  # noqa: E402
from tests.models import tiny_onnx  # noqa: E402
from tests.models.training import user_files  # noqa: E402

SIZE_PX = 64


@pytest.fixture
def start(tmp_path: Path) -> Path:
    """A directory with the card of an untrained network."""
    torch.manual_seed(0)
    config = CpmConfig(width=16, blocks=(1, 1, 1, 1), stage_width=16, n_stages=2)
    network = ConvolutionalPoseMachine(config).eval()
    card = export.pose_card(network, "start", "1", SIZE_PX)
    export.publish(pose_model(network, SIZE_PX), card, tmp_path / "weights")
    return tmp_path / "weights"


def test_it_learns_a_users_people_and_serves_by_card(start: Path, tmp_path: Path) -> None:
    records = user_files.coco(tmp_path / "images", 24)
    crops = read_coco(user_files.write(tmp_path / "l.json", records), tmp_path / "images")
    result = finetune(
        crops,
        weights_dir=start,
        start="start",
        out=tmp_path / "out",
        name="ours",
        source=os.fsdecode(b"dessins d'\xe9t\xe9"),
        settings=FinetuneSettings(steps=60, lr=4e-3, hold_out=0.25, threads=1),
    )
    assert result.n_trained + result.n_held_out <= len(crops)
    assert result.after > result.before + 0.15, "people of one kind are learned quickly"
    assert result.card.measured["pck_0.2/held_out/after"] == round(result.after, 4)
    assert result.card.training_data[-1] == "dessins d'?t?", "a name that is no UTF-8"
    estimator = PoseEstimator("ours", weights_dir=tmp_path / "out")
    joints = estimator.estimate(np.zeros((80, 80, 3), np.uint8), [PersonBox(8, 8, 60, 60, 1.0)])
    assert joints[0].positions_px.shape == (14, 2)


def test_human36m_by_the_command_holds_out_whole_clips(
    start: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "h36m"
    for i in range(4):
        pose = user_files.human36m_clip(root, f"Walking {i}", 20)
        np.savez(root / "S1" / "MyPoseFeatures" / "D2_Positions" / f"Walking {i}.npz", Pose=pose)
    for file in WEIGHTS_DIR.glob("person.*"):
        shutil.copy(file, start)
    monkeypatch.setenv("POSEMATCH_WEIGHTS_DIR", str(start))
    arguments = ["--human36m", root, "--subject", "S1", "--frames-apart", 2, "--start", "start"]
    arguments += ["--out", tmp_path / "out", "--name", "studio", "--steps", 3, "--threads", 1]
    result = CliRunner().invoke(cli, ["model", "finetune", *map(str, arguments)])
    assert result.exit_code == 0, result.exception
    assert "30 people trained on, 10 held out" in result.stdout
    assert "Human3.6M, S1 (academic use only)" in (tmp_path / "out" / "studio.json").read_text()
    assert (tmp_path / "out" / "person.onnx").exists(), "the directory can be served"


def test_an_exported_person_network_is_the_one_that_is_served(tmp_path: Path) -> None:
    torch.manual_seed(0)
    config = PersonConfig(width=16, blocks=(1, 1, 1))
    network = PersonNetwork(config)
    checkpoint = tmp_path / "last.pt"
    torch.save({"config": config.as_dict(), "ema": network.state_dict(), "step": 1}, checkpoint)
    out = tmp_path / "out"
    arguments = ["export", checkpoint, "--kind", "person", "--version", "1", "--out", out]
    result = CliRunner().invoke(cli, ["model", *map(str, arguments)])
    assert result.exit_code == 0, result.exception
    assert choose(out, "people") == "person"
    assert read_card(out / "person.json").version == "1"
    shipped = [card.name for card in cards_of(WEIGHTS_DIR, "pose")]
    assert [card.name for card in cards_of(out, "pose")] == shipped
    assert cards_of(out, "lift")


def test_a_run_goes_on_with_what_it_began_with_only(start: Path, tmp_path: Path) -> None:
    """Whom another seed holds out may have been trained on: the figures would flatter."""
    records = user_files.coco(tmp_path / "images", 24)
    crops = read_coco(user_files.write(tmp_path / "l.json", records), tmp_path / "images")
    out = tmp_path / "out"

    def run(crops: list[LabelledCrop], steps: int, seed: int = 0) -> FinetuneResult:
        settings = FinetuneSettings(steps=steps, seed=seed, hold_out=0.25, threads=1)
        labels = {"weights_dir": start, "start": "start", "source": "drawings"}
        return finetune(crops, out=out, name="ours", settings=settings, **labels)  # type: ignore[arg-type]

    run(crops, 1)
    assert run(crops, 2).card.measured["training_steps"] == 2
    for others, seed in ((crops, 1), (crops[:-1], 0)):
        with pytest.raises(ModelError, match="give another --out, or delete it"):
            run(others, 3, seed)
    checkpoint = out / "run" / "last.pt"
    checkpoint.write_bytes(checkpoint.read_bytes()[:5_000])
    with pytest.raises(ModelError, match=r"last\.pt cannot be read as a training run's"):
        run(crops, 3)


def on_from(weights: Path, start: str, out: Path) -> FinetuneResult:
    """Without labels: what is wrong with the start is said before."""
    settings = FinetuneSettings()
    return finetune(
        [], weights_dir=weights, start=start, out=out, name="ours", source="", settings=settings
    )


def test_a_network_of_another_architecture_is_refused(tmp_path: Path) -> None:
    weights = tmp_path / "weights"
    tiny_onnx.write(weights, "foreign", tiny_onnx.model(tiny_onnx.planes()))
    with pytest.raises(ModelError, match=r"foreign cannot be trained on: it has no .fine_score"):
        on_from(weights, "foreign", tmp_path / "out")


@pytest.mark.parametrize(
    ("damage", "said"), [("gone", "are missing"), ("cut", r"do not match .*sha256 differs")]
)
def test_weights_that_are_not_their_cards_are_refused(
    start: Path, tmp_path: Path, damage: str, said: str
) -> None:
    data = (start / "start.onnx").read_bytes()
    (start / "start.onnx").unlink()
    if damage == "cut":
        (start / "start.onnx").write_bytes(data[: len(data) // 2])
    with pytest.raises(ModelError, match=rf"start\.onnx {said}"):
        on_from(start, "start", tmp_path / "out")


def test_what_cannot_be_trained_on_is_refused(tmp_path: Path) -> None:
    records = user_files.coco(tmp_path / "images", 3)
    crops = read_coco(user_files.write(tmp_path / "l.json", records), tmp_path / "images")
    with pytest.raises(AnnotationError, match="label more images"):
        split(crops, 0.15, 0)
    with pytest.raises(ModelError, match="name an fp32 pose network"):
        finetune(
            crops,
            weights_dir=WEIGHTS_DIR,
            start="person",
            out=tmp_path / "out",
            name="ours",
            source="",
            settings=FinetuneSettings(),
        )


def test_the_network_it_starts_from_is_not_overwritten(start: Path, tmp_path: Path) -> None:
    records = user_files.coco(tmp_path / "images", 24)
    crops = read_coco(user_files.write(tmp_path / "l.json", records), tmp_path / "images")
    before = (start / "start.onnx").read_bytes()
    with pytest.raises(ModelError, match="would be overwritten: give another --name or --out"):
        finetune(
            crops,
            weights_dir=start,
            start="start",
            out=start / "run" / "..",
            name="start",
            source="",
            settings=FinetuneSettings(steps=1, threads=1),
        )
    assert (start / "start.onnx").read_bytes() == before


def test_people_of_one_image_stay_on_one_side(tmp_path: Path) -> None:
    records = user_files.coco(tmp_path / "images", 40)
    crops = read_coco(user_files.write(tmp_path / "l.json", records), tmp_path / "images")
    train, held = split(crops, 0.3, 0)
    assert not {c.group for c in train} & {c.group for c in held}
