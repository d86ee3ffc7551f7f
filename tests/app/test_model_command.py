"""``posematch model``: cards and checks of what ships; training only with its extra."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from app.cli import cli
from models import ModelError
from models.card import WEIGHTS_DIR, read_card
from models.providers import cpu_name
from tests.models.caffe import caffe_files
from tests.models.training import user_files


def invoke(*arguments: object) -> Result:
    return CliRunner().invoke(cli, ["model", *map(str, arguments)])


@pytest.fixture
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The person network alone: quick to run."""
    for file in WEIGHTS_DIR.glob("person.*"):
        shutil.copy(file, tmp_path)
    monkeypatch.setenv("POSEMATCH_WEIGHTS_DIR", str(tmp_path))
    return tmp_path


def test_the_cards_that_ship_are_listed_and_the_served_ones_marked() -> None:
    result = invoke("card", "--json")
    assert result.exit_code == 0, result.output
    names = {card["name"] for card in json.loads(result.stdout)}
    assert names == {path.stem for path in WEIGHTS_DIR.glob("*.json")}
    starred = [line for line in invoke("card").stdout.splitlines() if "*" in line]
    assert len(starred) == 4, "one pose network, one person network and both lifters serve"


def test_one_card_says_what_it_learned_from_and_its_licence() -> None:
    shown = " ".join(invoke("card", "cpm").stdout.split())
    card = read_card(WEIGHTS_DIR / "cpm.json")
    assert card.version in shown
    assert "Leeds Sports Pose" in shown
    assert "Apache-2.0" in shown
    assert json.loads(invoke("card", "cpm", "--json").stdout) == card.model_dump(mode="json")


def test_a_card_that_is_not_there_is_named_with_those_that_are() -> None:
    result = invoke("card", "cpm-huge")
    assert isinstance(result.exception, ModelError)
    assert "there are: cpm" in str(result.exception)


def test_check_measures_and_may_write_the_cost_into_the_card(weights: Path) -> None:
    before = read_card(weights / "person.json")
    assert invoke("check", "person").exit_code == 0
    assert read_card(weights / "person.json") == before
    assert invoke("check", "person", "--provider", "cpu", "--save").exit_code == 0
    after = read_card(weights / "person.json")
    assert 0 < after.cost_ms["cpu/fp32"] < 1000
    assert after.cost_cpu["cpu/fp32"].startswith(cpu_name())
    assert cpu_name() in " ".join(invoke("card", "person").stdout.split())


def test_check_refuses_a_file_that_is_not_its_cards(weights: Path) -> None:
    (weights / "person.onnx").write_bytes(b"something else")
    result = invoke("check", "person")
    assert isinstance(result.exception, ModelError)
    assert "sha256 differs" in str(result.exception)


def test_finetune_wants_one_kind_of_labels(tmp_path: Path) -> None:
    for given in ([], ["--human36m", tmp_path, "--images", tmp_path], ["--images", tmp_path]):
        assert invoke("finetune", "--out", tmp_path / "out", *given).exit_code == 2


def test_finetune_refuses_a_seed_that_torch_does_not_take(tmp_path: Path) -> None:
    path = user_files.write(tmp_path / "labels.json", user_files.coco(tmp_path / "images", 1))
    given = ["--coco", path, "--images", tmp_path / "images", "--out", tmp_path / "out"]
    result = invoke("finetune", *given, "--seed", 2**63)
    assert result.exit_code == 2
    assert "--seed" in result.output


def test_import_caffe_makes_a_directory_that_can_be_served(tmp_path: Path, weights: Path) -> None:
    steps = caffe_files.vgg_like(divide=64, n_stages=2)
    paths = caffe_files.write(tmp_path, steps, caffe_files.random_weights(steps), 64)
    out = tmp_path / "original"
    result = invoke("import-caffe", *paths, "--out", out)
    assert result.exit_code == 0, result.exception
    assert "non-commercial" in " ".join(result.stdout.split())
    assert {p.name for p in out.iterdir()} == {
        *("cpm-original.json", "cpm-original.onnx", "person.json", "person.onnx")
    }
    assert read_card(out / "person.json") == read_card(weights / "person.json")


def test_import_caffe_says_what_is_wrong_with_the_files(tmp_path: Path) -> None:
    (tmp_path / "deploy.prototxt").write_text("layer { type: 'Data' }")
    (tmp_path / "pose.caffemodel").write_text("<html>404</html>")
    result = invoke(
        "import-caffe",
        tmp_path / "deploy.prototxt",
        tmp_path / "pose.caffemodel",
        "--out",
        tmp_path,
    )
    assert isinstance(result.exception, ModelError)
    assert "pose.caffemodel is no caffemodel" in str(result.exception)


@pytest.mark.parametrize("command", ["finetune", "export"])
def test_without_the_extra_training_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    for name in [name for name in sys.modules if name.startswith("models.training")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.setitem(sys.modules, "onnx", None)
    path = user_files.write(tmp_path / "labels.json", user_files.coco(tmp_path / "images", 1))
    arguments = {
        "finetune": ["--coco", path, "--images", tmp_path / "images", "--out", tmp_path],
        "export": [path, "--version", "1", "--out", tmp_path],
    }[command]
    result = invoke(command, *arguments)
    assert isinstance(result.exception, ModelError), result.output
    assert "pip install 'posematch[train]'" in str(result.exception)


@pytest.mark.parametrize("name", ["a/b", "..", "auto", ""])
def test_a_name_that_no_card_can_have_is_refused_before_anything_is_done(
    tmp_path: Path, name: str
) -> None:
    files = [tmp_path / "in.json", tmp_path / "in.prototxt", tmp_path / "in.caffemodel"]
    for file in files:
        file.touch()
    coco, prototxt, caffemodel = files
    out = tmp_path / "out"
    for command in (
        ("finetune", "--coco", coco, "--images", tmp_path, "--out", out),
        ("export", coco, "--version", "1", "--out", out),
        ("import-caffe", prototxt, caffemodel, "--out", out),
    ):
        result = invoke(*command, "--name", name)
        assert result.exit_code == 2
        assert "are wanted, and not the word auto" in " ".join(result.output.split())
    assert not out.exists()
