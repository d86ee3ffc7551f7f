"""The training loop's schedule; needs torch, so it runs where the training extra is installed."""

from __future__ import annotations

import argparse
import json
import sys
import threading
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")

from models.errors import ModelError  # noqa: E402
from models.training import loop, train, train_people  # noqa: E402
from models.training.network import ConvolutionalPoseMachine, CpmConfig  # noqa: E402
from models.training.onnx_graph import pose_model  # noqa: E402


def test_input_grows_at_its_share_of_the_run_whatever_the_evaluations(tmp_path: Path) -> None:
    parser = argparse.ArgumentParser()
    loop.add_arguments(parser)
    options = "--steps 20 --every 50 --batch 4 --threads 1 --optimizer adamw"
    args = parser.parse_args(["--data", "x", "--out", str(tmp_path), *options.split()])
    sizes = []
    threads = threading.active_count()

    def loss_of(model: Any, batch: loop.Batch) -> Any:
        sizes.append(batch[0].shape[-1])
        return model(batch[0]).pow(2).mean()

    loop.fit(
        torch.nn.Conv2d(3, 4, 3),
        args,
        sizes=[(0.3, 8), (1.0, 16)],
        make_batch=lambda _, size: (torch.zeros(4, 3, size, size),),
        loss_of=loss_of,
        evaluate=lambda _, __: {},
        config={},
    )
    assert sizes == [8] * 7 + [16] * 13
    lines = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [(line["step"], line["size_px"]) for line in lines] == [(7, 8), (20, 16)]
    assert threading.active_count() == threads


def test_a_run_whose_loss_is_no_number_stops_and_goes_on_from_before(tmp_path: Path) -> None:
    parser = argparse.ArgumentParser()
    loop.add_arguments(parser)
    options = "--steps 6 --every 2 --batch 4 --threads 1 --optimizer adamw --device cpu"
    args = parser.parse_args(["--data", "x", "--out", str(tmp_path), *options.split()])

    def run(spoiled: int) -> None:
        steps = iter(range(6))

        def loss_of(model: Any, batch: loop.Batch) -> Any:
            factor = float("nan") if next(steps) == spoiled else 1.0
            return factor * model(batch[0]).pow(2).mean()

        loop.fit(
            torch.nn.Conv2d(3, 4, 3),
            args,
            sizes=[(1.0, 8)],
            make_batch=lambda _, size: (torch.ones(4, 3, size, size),),
            loss_of=loss_of,
            evaluate=lambda _, __: {},
            config={},
        )

    threads = threading.active_count()
    with pytest.raises(ModelError, match=r"loss of step 3 is nan: .*--lr"):
        run(spoiled=3)
    assert threading.active_count() == threads
    kept = loop.read_checkpoint(tmp_path / "last.pt")
    assert kept["step"] == 2
    assert all(torch.isfinite(value).all() for value in kept["model"].values())
    run(spoiled=-1)
    assert loop.read_checkpoint(tmp_path / "last.pt")["step"] == 6


def test_what_is_added_to_a_network_may_be_new_to_it(tmp_path: Path) -> None:
    old = torch.nn.ModuleDict({"a": torch.nn.Linear(2, 2)})
    new = torch.nn.ModuleDict({"a": torch.nn.Linear(2, 2), "b": torch.nn.Linear(2, 2)})
    new.ADDED = r"b\."
    torch.save({"ema": old.state_dict(), "config": {}, "step": 1}, tmp_path / "old.pt")
    loop._start_from(tmp_path / "old.pt", new, {})
    assert torch.equal(new["a"].weight, old["a"].weight)
    torch.save({"ema": new.state_dict(), "config": {}, "step": 1}, tmp_path / "new.pt")
    with pytest.raises(SystemExit, match=r"has .*b\.weight"):
        loop._start_from(tmp_path / "new.pt", old, {})
    torch.save({"ema": old["a"].state_dict(), "config": {}, "step": 1}, tmp_path / "other.pt")
    with pytest.raises(SystemExit, match=r"lacks .*a\.weight"):
        loop._start_from(tmp_path / "other.pt", new, {})


def test_a_network_grows_deeper_without_a_change_of_its_answers(tmp_path: Path) -> None:
    cfg = CpmConfig(width=8, blocks=(1, 1, 2, 1), stage_width=8, n_stages=2)
    deeper = replace(cfg, blocks=(1, 1, 4, 2))
    old, new = ConvolutionalPoseMachine(cfg).eval(), ConvolutionalPoseMachine(deeper).eval()
    path = tmp_path / "last.pt"
    torch.save({"ema": old.state_dict(), "config": cfg.as_dict(), "step": 1}, path)
    loop._start_from(path, new, deeper.as_dict())
    image = torch.rand(2, 3, 64, 64)
    with torch.no_grad():
        for stage, deeper_stage in zip(old(image), new(image), strict=True):
            assert torch.equal(stage, deeper_stage)
    cut = {k: v for k, v in old.state_dict().items() if not k.startswith("backbone.c16.1.b.0")}
    torch.save({"ema": cut, "config": cfg.as_dict(), "step": 1}, path)
    with pytest.raises(SystemExit, match=r"lacks .*backbone\.c16\.1\.b\.0\.weight"):
        loop._start_from(path, new, deeper.as_dict())
    torch.save({"ema": new.state_dict(), "config": deeper.as_dict(), "step": 1}, path)
    with pytest.raises(SystemExit, match=r"has .*backbone\.c16\.2.*too"):
        loop._start_from(path, old, cfg.as_dict())


def test_weights_of_other_sizes_are_named_with_the_sizes_they_were_made_with(
    tmp_path: Path,
) -> None:
    narrow = CpmConfig(width=8, blocks=(1, 1, 1, 1), stage_width=8, n_stages=2)
    wide = replace(narrow, width=16)
    made = ConvolutionalPoseMachine(wide)
    path, exported = tmp_path / "last.pt", tmp_path / "wide.onnx"
    torch.save({"ema": made.state_dict(), "config": wide.as_dict(), "step": 1}, path)
    onnx.save(pose_model(made.eval(), 64), str(exported))
    shapes = r"stem\.1\.0\.weight of \(16, 48, 3, 3\), not of \(8, 48, 3, 3\)"
    for file in (path, exported):
        said = rf"{file.name} is of another architecture: .*{shapes} \(made with width 16\)$"
        with pytest.raises(SystemExit, match=said):
            loop._start_from(file, ConvolutionalPoseMachine(narrow), narrow.as_dict())
    longer = replace(narrow, n_stages=3)
    with pytest.raises(SystemExit, match=r"lacks .*stages\.2.*\(made with width 16, n_stages 2\)$"):
        loop._start_from(path, ConvolutionalPoseMachine(longer), longer.as_dict())


def test_a_run_is_resumed_as_it_was_started_or_not_at_all(tmp_path: Path) -> None:
    parser = argparse.ArgumentParser()
    loop.add_arguments(parser)

    def run(steps: int, width: int = 4, optimizer: str = "adamw", added: bool = False) -> None:
        options = f"--steps {steps} --batch 4 --threads 1 --optimizer {optimizer} --device cpu"
        args = parser.parse_args(["--data", "x", "--out", str(tmp_path), *options.split()])
        model = torch.nn.ModuleDict({"seen": torch.nn.Conv2d(3, width, 3)})
        model.ADDED = r"depth\."
        if added:
            model["depth"] = torch.nn.Conv2d(3, 1, 3)
        loop.fit(
            model,
            args,
            sizes=[(1.0, 8)],
            make_batch=lambda _, size: (torch.ones(4, 3, size, size),),
            loss_of=lambda model, batch: model["seen"](batch[0]).pow(2).mean(),
            evaluate=lambda _, __: {},
            config={"width": width},
        )

    run(1)
    shapes = r"seen\.weight of \(4, 3, 3, 3\), not of \(5, 3, 3, 3\) \(made with width 4\)$"
    with pytest.raises(SystemExit, match=rf"last\.pt is of another architecture: it has {shapes}"):
        run(2, width=5)
    # A new run may start from such weights (--init), the averages of an old one do not have them.
    with pytest.raises(SystemExit, match=r"last\.pt is of another architecture: it lacks .*depth"):
        run(2, added=True)
    with pytest.raises(SystemExit, match=r"last\.pt .* another optimizer than muon: .*--optimizer"):
        run(2, optimizer="muon")
    assert loop.read_checkpoint(tmp_path / "last.pt")["step"] == 1
    run(2)
    assert loop.read_checkpoint(tmp_path / "last.pt")["step"] == 2


def test_what_only_averages_is_a_start_and_no_run_to_resume(tmp_path: Path) -> None:
    parser = argparse.ArgumentParser()
    loop.add_arguments(parser)
    model = torch.nn.Conv2d(3, 4, 3)
    averages = {"ema": model.state_dict(), "config": {}, "step": 1}
    torch.save(averages, tmp_path / "last.pt")

    def run(out: Path, *options: str) -> None:
        line = ["--data", "x", "--out", str(out), "--steps", "1", "--threads", "1", *options]
        loop.fit(
            torch.nn.Conv2d(3, 4, 3),
            parser.parse_args([*line, "--device", "cpu", "--optimizer", "adamw"]),
            sizes=[(1.0, 8)],
            make_batch=lambda _, size: (torch.ones(4, 3, size, size),),
            loss_of=lambda model, batch: model(batch[0]).pow(2).mean(),
            evaluate=lambda _, __: {},
            config={},
        )

    said = r"last\.pt cannot be resumed: no model, optimizers, spent_s; .*--init"
    with pytest.raises(SystemExit, match=said):
        run(tmp_path)
    run(tmp_path / "anew", "--init", str(tmp_path / "last.pt"))
    assert loop.read_checkpoint(tmp_path / "anew" / "last.pt")["step"] == 1


def test_sizes_are_multiples_of_the_coarsest_stride_up_to_ascending_shares() -> None:
    assert loop.parse_sizes("96:0.3,128:1") == [(0.3, 96), (1.0, 128)]
    for wrong in ("", "96", "96:", "100:1", "0:1", "96:x", "96:nan", "96:0", "96:2", "96:1,64:0.5"):
        with pytest.raises(argparse.ArgumentTypeError, match=f"'{wrong}' is not like 96:0.3,128:1"):
            loop.parse_sizes(wrong)


@pytest.mark.parametrize(
    ("program", "option"),
    [
        (train, "--sizes 100:1"),
        (train, "--blocks 2,3"),
        (train_people, "--scenes-labels x --canvas 10x10"),
    ],
)
def test_programs_refuse_other_sizes_in_one_line(
    program: ModuleType,
    option: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "argv", ["", "--data", "x", "--out", "x", *option.split()])
    with pytest.raises(SystemExit) as refused:
        program.main()
    assert refused.value.code == 2
    *_, name, value = option.split()
    assert f"error: argument {name}: '{value}' is not " in capsys.readouterr().err.splitlines()[-1]
