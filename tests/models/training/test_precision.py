"""bf16 is used where the processor multiplies it itself, only there; needs the train extra."""

import pytest

torch = pytest.importorskip("torch")

from models.training.optimizer import orthogonalise  # noqa: E402
from models.training.precision import has_bf16, mixed_precision  # noqa: E402


@pytest.mark.parametrize(
    ("avx512_bf16", "amx", "native"),
    [(False, False, False), (True, False, True), (False, True, True)],
)
def test_what_the_processor_multiplies_decides(
    monkeypatch: pytest.MonkeyPatch, avx512_bf16: bool, amx: bool, native: bool
) -> None:
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: avx512_bf16)
    monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda: amx)
    assert has_bf16("cpu") is native
    with mixed_precision("cpu"):
        product = torch.ones(4, 4) @ torch.ones(4, 4)
    assert product.dtype == (torch.bfloat16 if native else torch.float32)
    tall = orthogonalise(torch.eye(6, 3))
    assert tall.dtype == torch.float32
    assert torch.linalg.svdvals(tall) == pytest.approx([1.0] * 3, abs=0.35)
