"""The service's settings: environment variables ``POSEMATCH_*``, checked before anything starts."""

from __future__ import annotations

import difflib
import os
import re
from pathlib import Path
from typing import Annotated, Any, Literal, Self
from urllib.parse import urlsplit

from pydantic import Field, SecretStr, ValidationError, field_validator, model_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

from app import MAX_DECODABLE_PIXELS
from app.errors import StartupError
from app.lifting import NEIGHBOURS
from library_store.backends import Backend
from models import ProviderChoice

ENV_PREFIX = "POSEMATCH_"
_ORIGIN = re.compile(r"http://[a-z0-9._:\[\]-]+(?<!:80)|https://[a-z0-9._:\[\]-]+(?<!:443)")
"""Lower case, without a path; a scheme's own port is left out."""
LIFTER_OFF = "off"
"""``Settings.lifter`` of a service that lifts by matching alone."""


def default_cache_dir() -> Path:
    """Where built libraries are kept: the user's cache, so that every checkout shares it."""
    try:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    except RuntimeError as error:  # a user without a home, as in some containers
        raise StartupError("this user has no home directory: set POSEMATCH_CACHE_DIR") from error
    return Path(base) / "posematch"


def available_cores() -> int:
    """CPU cores this process may use: its affinity, cut by a container's quota."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    cores = cores or 1
    try:
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text().split()
        cores = min(cores, max(1, round(int(quota) / int(period))))
    except (OSError, ValueError):
        pass  # no cgroup v2, or no quota ("max")
    return cores


class Settings(BaseSettings):
    """All that can be set, each field from the variable POSEMATCH_<NAME>."""

    model_config = SettingsConfigDict(env_prefix=ENV_PREFIX, frozen=True, extra="forbid")

    host: str = Field("127.0.0.1", min_length=1, description="Address to listen on.")
    port: int = Field(8000, ge=0, le=65535, description="TCP port; 0 takes any free one.")
    keep_alive_s: int = Field(
        30, ge=1, le=3600, description="How long an idle connection is kept open."
    )
    shutdown_grace_s: int = Field(
        10, ge=0, le=600, description="How long requests under way may take after SIGTERM."
    )

    max_body_bytes: int = Field(
        15_000_000, ge=1_000, le=1_000_000_000, description="Largest accepted body of one photo."
    )
    max_batch_images: int = Field(
        16, ge=1, le=256, description="Most images in one call of /v1/poses/batch."
    )
    max_batch_body_bytes: int = Field(
        60_000_000, ge=1_000, le=1_000_000_000, description="Largest accepted body of a batch."
    )
    max_pixels: int = Field(
        50_000_000,
        ge=1_000,
        le=MAX_DECODABLE_PIXELS,
        description="Most pixels of an image, read from its header before anything is decoded.",
    )
    upload_timeout_s: float = Field(
        30.0,
        gt=0,
        le=3600,
        description="Longest time a request's head or its body may take to arrive, else 408; also "
        "how long a client may leave its answer unread.",
    )
    upload_memory_bytes: int = Field(
        128_000_000,
        ge=1_000,
        description="Bytes of all bodies held in memory at once; what goes beyond gets a 503.",
    )
    decode_side_px: int = Field(
        1000,
        ge=256,
        le=16384,
        description="Photos are decoded at a reduced scale (1/2, 1/4, 1/8; JPEG only) as long as "
        "their longer side keeps at least this many pixels.",
    )

    workers: int = Field(
        default_factory=available_cores,
        ge=1,
        le=256,
        description="Threads that compute, each one request at a time; the cores available.",
    )
    queue_size: int = Field(
        16, ge=0, le=10_000, description="Most requests waiting for a worker; more get a 503."
    )
    deadline_ms: float = Field(
        200.0,
        gt=0,
        le=600_000,
        description="A request whose wait for a worker would end its answer later than this after "
        "its last body byte is refused with a 503. With a worker free, none is refused.",
    )

    cache_dir: Path = Field(
        default_factory=default_cache_dir,
        description="Where the default library is built on first start and kept.",
    )
    library_dir: Path | None = Field(
        None, description="A built library to serve instead of the default one."
    )
    index: Backend = Field(
        "auto",
        description="What finds neighbours: cells (of every library), exact (every exemplar "
        "compared), hnsw (where the library has a graph) or milvus; auto is the one that "
        "the library was built for.",
    )
    milvus_uri: str | None = Field(
        None, min_length=1, description="Where Milvus is, as http://host:19530."
    )
    milvus_token: SecretStr | None = Field(None, description="Milvus's API key, or user:password.")
    milvus_timeout_ms: float = Field(
        1000.0,
        gt=0,
        le=60_000,
        description="Longest time a search in Milvus may take, retries included; then a 503.",
    )
    shortlist: int = Field(
        30,
        ge=1,
        le=NEIGHBOURS,
        description="Exemplars per person that are resectioned (eq. 4's k).",
    )
    weights_dir: Path = Field(
        Path(__file__).resolve().parent.parent / "models" / "weights",
        description="Directory of the networks' ONNX files and model cards.",
    )
    model: str = Field(
        "auto",
        min_length=1,
        description="Name of the pose network's card; auto takes the most accurate one that this "
        "machine runs within POSEMATCH_MODEL_BUDGET_MS.",
    )
    model_budget_ms: float = Field(
        15.0,
        gt=0,
        description="CPU time a person that POSEMATCH_MODEL=auto may spend, as the cards have it.",
    )
    lifter: str = Field(
        "lifter",
        min_length=1,
        description="Name of the lifting network's card, whose answer the fusion takes in beside "
        "the exemplars; off for matching alone.",
    )
    provider: ProviderChoice = Field(
        "auto",
        description="What runs the networks: auto (the fastest one present), cpu, cuda or "
        "openvino; one that is named but cannot work is refused.",
    )

    api_keys: Annotated[tuple[SecretStr, ...], NoDecode] = Field(
        (),
        description="Comma-separated keys; when there are any, /v1 wants one of them as "
        "'Authorization: Bearer KEY' or 'X-API-Key: KEY'.",
    )
    quota_per_minute: int | None = Field(
        None, ge=1, description="Requests a minute each API key may make; more get a 429."
    )
    cors_origins: Annotated[tuple[str, ...], NoDecode] = Field(
        (), description="Comma-separated origins whose pages may call the API from a browser."
    )
    log_level: Literal["debug", "info", "warning", "error"] = Field(
        "info", description="Least severe log records written (JSON lines on stderr)."
    )

    @field_validator("api_keys", "cors_origins", mode="before")
    @classmethod
    def _split_commas(cls, value: Any) -> Any:
        if isinstance(value, str):
            parts = tuple(part.strip() for part in value.split(",") if part.strip())
            if not parts:  # keys that are none would leave the door open
                raise ValueError("lists nothing; unset it for none")
            return parts
        return value

    @field_validator("api_keys")
    @classmethod
    def _are_keys(cls, keys: tuple[SecretStr, ...]) -> tuple[SecretStr, ...]:
        texts = [key.get_secret_value() for key in keys]
        if any(len(text) < 16 for text in texts):
            raise ValueError("an API key needs at least 16 characters")
        if not all(text.isascii() and text.isprintable() for text in texts):
            raise ValueError("an API key has ASCII characters only: it is sent in a header")
        return keys

    @field_validator("cors_origins")
    @classmethod
    def _are_origins(cls, origins: tuple[str, ...]) -> tuple[str, ...]:
        for origin in origins:
            if origin != "*" and not _ORIGIN.fullmatch(origin):
                raise ValueError(
                    f"{origin!r} is not an origin as browsers send it, like https://example.org"
                )
        return origins

    @field_validator("host")
    @classmethod
    def _may_be_a_host(cls, host: str) -> str:
        host.encode("idna")  # a UnicodeError is a ValueError
        return host

    @field_validator("cache_dir", "library_dir", "weights_dir", mode="before")
    @classmethod
    def _is_a_directory(cls, directory: Any) -> Any:
        if directory == "":  # it would be the current directory
            raise ValueError("is empty; unset it for the default")
        # What a shell does; files of variables, as containers and units have them, know no ~.
        return os.path.expanduser(directory) if isinstance(directory, str) else directory

    @field_validator("milvus_uri")
    @classmethod
    def _is_an_address(cls, uri: str | None) -> str | None:
        if uri is not None:
            parts = urlsplit(uri)  # its port raises ValueError when it is none
            if parts.scheme not in {"http", "https"} or not parts.hostname or parts.port == 0:
                raise ValueError(f"{uri!r} is not an address like http://host:19530")
        return uri

    @model_validator(mode="after")
    def _fit_together(self) -> Self:
        if self.index == "milvus" and self.milvus_uri is None:
            raise ValueError("POSEMATCH_INDEX=milvus needs POSEMATCH_MILVUS_URI")
        if self.quota_per_minute is not None and not self.api_keys:
            raise ValueError(
                "POSEMATCH_QUOTA_PER_MINUTE counts per API key: set POSEMATCH_API_KEYS too"
            )
        if self.max_batch_body_bytes < self.max_body_bytes:
            raise ValueError(
                "POSEMATCH_MAX_BATCH_BODY_BYTES is smaller than POSEMATCH_MAX_BODY_BYTES"
            )
        if self.upload_memory_bytes < self.max_batch_body_bytes:
            raise ValueError(
                "POSEMATCH_UPLOAD_MEMORY_BYTES is smaller than POSEMATCH_MAX_BATCH_BODY_BYTES"
            )
        return self


def load_settings(**overrides: Any) -> Settings:
    """Settings from the environment; ``overrides`` win.

    Raises ``StartupError`` naming every unknown POSEMATCH_* variable or every bad value.
    """
    known = {ENV_PREFIX + name.upper() for name in Settings.model_fields}
    given = {key for key in os.environ if key.upper().startswith(ENV_PREFIX)}
    unknown = sorted(key for key in given if key.upper() not in known)
    if unknown:
        hints = []
        for key in unknown:
            close = difflib.get_close_matches(key.upper(), known, 1)
            hints.append(key + (f" (did you mean {close[0]}?)" if close else ""))
        raise StartupError("unknown settings: " + ", ".join(hints))
    try:
        return Settings(**overrides)
    except ValidationError as error:
        lines = [
            f"{_variable(item['loc'])}: {item['msg'].removeprefix('Value error, ')}"
            for item in error.errors(include_url=False, include_context=False)
        ]
        raise StartupError("bad settings: " + "; ".join(lines)) from error


def _variable(location: tuple[int | str, ...]) -> str:
    return ENV_PREFIX + str(location[0]).upper() if location else "settings"
