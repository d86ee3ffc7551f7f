"""Settings: what the environment may say, and what refuses to start."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from app.errors import StartupError
from app.lifting.lifter import LiftingSettings
from app.settings import Settings, load_settings
from models.card import WEIGHTS_DIR, read_card, write_card
from models.choice import choose


@pytest.fixture(autouse=True)
def _no_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    for key in os.environ:
        if key.startswith("POSEMATCH_"):
            monkeypatch.delenv(key)


def test_values_come_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("POSEMATCH_PORT", "9000")
    monkeypatch.setenv("POSEMATCH_LIBRARY_DIR", "/srv/library")
    monkeypatch.setenv("POSEMATCH_CACHE_DIR", "~/poses")
    monkeypatch.setenv("POSEMATCH_API_KEYS", "first-key-long-enough, second-key-long-enough")
    monkeypatch.setenv("POSEMATCH_CORS_ORIGINS", "https://a.example,http://localhost:3000")
    settings = load_settings()
    assert settings.port == 9000
    assert settings.library_dir == Path("/srv/library")
    assert settings.cache_dir == Path.home() / "poses", "no folder called ~"
    assert len(settings.api_keys) == 2
    assert settings.cors_origins == ("https://a.example", "http://localhost:3000")
    assert "first-key" not in repr(settings)


def test_overrides_win(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("POSEMATCH_PORT", "9000")
    assert load_settings(port=9001).port == 9001


def test_unknown_settings_are_refused_with_a_hint(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("POSEMATCH_PROT", "9000")
    with pytest.raises(StartupError, match=r"POSEMATCH_PROT .did you mean POSEMATCH_PORT\?"):
        load_settings()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("PORT", "70000"),
        ("PORT", "http"),
        ("WORKERS", "0"),
        ("QUEUE_SIZE", "-1"),
        ("DEADLINE_MS", "0"),
        ("DEADLINE_MS", "inf"),
        ("UPLOAD_TIMEOUT_S", "nan"),
        ("MAX_PIXELS", "1000000000000"),
        ("MAX_BODY_BYTES", "100000000"),
        ("API_KEYS", "short"),
        ("API_KEYS", " , "),
        ("API_KEYS", ""),
        ("API_KEYS", "nöt-for-a-header-0123456789"),
        ("CORS_ORIGINS", "example.org"),
        ("CORS_ORIGINS", "https://example.org/path"),
        ("CORS_ORIGINS", "https://Example.org"),
        ("CORS_ORIGINS", "https://example.org:443"),
        ("CORS_ORIGINS", "https://a b"),
        ("HOST", "no..name"),
        ("HOST", "a" * 70),
        ("CACHE_DIR", ""),
        ("LIBRARY_DIR", ""),
        ("WEIGHTS_DIR", ""),
        ("QUOTA_PER_MINUTE", "10"),
        ("LOG_LEVEL", "chatty"),
        ("MILVUS_URI", "milvus"),
        ("MILVUS_URI", "milvus:19530"),
        ("MILVUS_URI", "http://:19530"),
        ("MILVUS_URI", "http://milvus:port"),
    ],
)
def test_nonsense_refuses_to_start(name: str, value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(f"POSEMATCH_{name}", value)
    with pytest.raises(StartupError):
        load_settings()


@pytest.mark.parametrize("origin", ["*", "http://[::1]:8080", "https://a-b.example:80"])
def test_origins_as_browsers_send_them(origin: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("POSEMATCH_CORS_ORIGINS", origin)
    assert load_settings().cors_origins == (origin,)


def test_a_user_without_a_home(monkeypatch: pytest.MonkeyPatch) -> None:
    def nowhere() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", nowhere)
    with pytest.raises(StartupError, match="POSEMATCH_CACHE_DIR"):
        load_settings()
    assert load_settings(cache_dir=Path("cache")).cache_dir == Path("cache")


def test_the_shortlist_is_of_the_neighbours_that_are_looked_up() -> None:
    most = LiftingSettings().neighbours
    assert load_settings(shortlist=most).shortlist == most
    with pytest.raises(StartupError, match="POSEMATCH_SHORTLIST"):
        load_settings(shortlist=most + 1)


@pytest.mark.parametrize("fp32_ms", [12.0, 12.9])
def test_the_budget_suffices_for_all_looks_without_vnni(tmp_path: Path, fp32_ms: float) -> None:
    """Costs of a CPU that has AVX2 alone, as ``posematch model check --save`` wrote them there."""
    for name, cost_ms in {"cpm": {"cpu/fp32": fp32_ms}, "cpm-int8": {"cpu/int8": 13.6}}.items():
        card = read_card(WEIGHTS_DIR / f"{name}.json")
        write_card(tmp_path / f"{name}.json", card.model_copy(update={"cost_ms": cost_ms}))
    budget_ms, features = Settings().model_budget_ms, frozenset({"avx2"})
    chosen = choose(tmp_path, "pose", provider="cpu", budget_ms=budget_ms, features=features)
    assert chosen == "cpm-int8"


def test_every_setting_is_described() -> None:
    for name, field in Settings.model_fields.items():
        assert field.description, name
