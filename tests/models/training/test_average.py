"""Averaging runs."""

import pytest

torch = pytest.importorskip("torch")

from models.training.average import average  # noqa: E402


def checkpoint(value: float, width: int = 4) -> dict[str, object]:
    ema = {"weight": torch.full((2, width), value), "batches": torch.tensor(int(value))}
    return {"config": {"width": width}, "step": int(value), "size_px": 160, "ema": ema}


def test_the_mean_of_the_weights_and_the_rest_of_the_last_run() -> None:
    mean = average([checkpoint(1.0), checkpoint(4.0)])
    assert torch.equal(mean["ema"]["weight"], torch.full((2, 4), 2.5))
    assert mean["ema"]["batches"] == 4
    assert (mean["step"], mean["config"]) == (4, {"width": 4})


def test_other_architectures_are_refused() -> None:
    with pytest.raises(ValueError, match="another architecture"):
        average([checkpoint(1.0), checkpoint(1.0, width=8)])


def test_runs_from_before_networks_read_depths_go_with_those_that_read_none() -> None:
    later = checkpoint(4.0)
    for depths, fits in ((False, True), (True, False)):
        later["config"] = {"width": 4, "depths": depths}
        if fits:
            assert torch.equal(
                average([checkpoint(1.0), later])["ema"]["weight"], torch.full((2, 4), 2.5)
            )
            continue
        with pytest.raises(ValueError, match="another architecture"):
            average([checkpoint(1.0), later])
