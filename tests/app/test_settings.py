"""Settings: what the environment may say, and what refuses to start."""

from __future__ import annotations

from pathlib import Path

import pytest

from app.errors import StartupError
from app.settings import Settings, load_settings


def test_values_come_from_the_environment() -> None:
    settings = load_settings(
        {
            "POSEMATCH_PORT": "9000",
            "POSEMATCH_LIBRARY_DIR": "/srv/library",
            "POSEMATCH_API_KEYS": "first-key-long-enough, second-key-long-enough",
            "POSEMATCH_CORS_ORIGINS": "https://a.example,http://localhost:3000",
            "PATH": "/bin",
        }
    )
    assert settings.port == 9000
    assert settings.library_dir == Path("/srv/library")
    assert len(settings.api_keys) == 2
    assert settings.cors_origins == ("https://a.example", "http://localhost:3000")
    assert "first-key" not in repr(settings)


def test_overrides_win() -> None:
    assert load_settings({"POSEMATCH_PORT": "9000"}, {"port": 9001}).port == 9001


def test_unknown_settings_are_refused_with_a_hint() -> None:
    with pytest.raises(StartupError, match=r"POSEMATCH_PROT .did you mean POSEMATCH_PORT\?"):
        load_settings({"POSEMATCH_PROT": "9000"})


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
        ("CORS_ORIGINS", "example.org"),
        ("CORS_ORIGINS", "https://example.org/path"),
        ("QUOTA_PER_MINUTE", "10"),
        ("LOG_LEVEL", "chatty"),
    ],
)
def test_nonsense_refuses_to_start(name: str, value: str) -> None:
    with pytest.raises(StartupError):
        load_settings({f"POSEMATCH_{name}": value})


def test_every_setting_is_described() -> None:
    for name, field in Settings.model_fields.items():
        assert field.description, name
