"""A small real library, sample renders with their ground truth, and running servers."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from library_store.build import BuildSettings, build_library
from library_store.prior import DEFAULT_PRIOR, PosePrior
from tests.app.server import Server

RENDERS = Path(__file__).parent.parent / "data" / "renders"
API_KEY = "a-key-of-thirty-two-characters-00"


@dataclass(frozen=True)
class Render:
    """A rendered person: the photo's bytes and its exact geometry (camera frame mm, pixels)."""

    name: str
    data: bytes
    width_px: int
    height_px: int
    focal_length_px: float
    joints_px: npt.NDArray[np.float64]
    joints_mm: npt.NDArray[np.float64]
    visible: npt.NDArray[np.bool_]

    def box_px(self) -> str:
        """The joints' extent as the query parameter wants it."""
        low, size = self.joints_px.min(axis=0), np.ptp(self.joints_px, axis=0)
        return ",".join(f"{value:.2f}" for value in (*low, *size))


@pytest.fixture(scope="session")
def renders() -> list[Render]:
    truth = json.loads((RENDERS / "ground_truth.json").read_text())
    return [
        Render(
            name=item["file"],
            data=(RENDERS / item["file"]).read_bytes(),
            width_px=item["width"],
            height_px=item["height"],
            focal_length_px=item["K"][0][0],
            joints_px=np.array(item["joints_2d_px"]),
            joints_mm=np.array(item["joints_3d_mm"]),
            visible=np.array(item["visible"], bool),
        )
        for item in truth["images"]
    ]


@pytest.fixture(scope="session")
def photo(renders: list[Render]) -> bytes:
    """A 640x480 JPEG of one person."""
    return renders[0].data


@pytest.fixture(scope="session")
def library_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("libraries") / "small"
    prior = PosePrior.load(DEFAULT_PRIOR)
    build_library(directory, prior, BuildSettings(name="small", n_poses=4000))
    return directory


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory, library_dir: Path) -> Iterator[Server]:
    """A server that refuses nothing for want of time, with small limits."""
    log = tmp_path_factory.mktemp("server") / "log"
    with Server(
        log,
        library_dir=library_dir,
        max_body_bytes=2_000_000,
        max_batch_body_bytes=4_000_000,
        max_batch_images=4,
        max_pixels=4_000_000,
        upload_timeout_s=1.5,
        deadline_ms=60_000,
        queue_size=64,
    ) as running:
        yield running


@pytest.fixture(scope="session")
def keyed_server(tmp_path_factory: pytest.TempPathFactory, library_dir: Path) -> Iterator[Server]:
    """A server with API keys, a quota and one allowed origin."""
    log = tmp_path_factory.mktemp("keyed") / "log"
    with Server(
        log,
        library_dir=library_dir,
        api_keys=f"{API_KEY}, another-key-with-enough-characters",
        quota_per_minute=6,
        cors_origins="https://example.org",
    ) as running:
        yield running


@pytest.fixture(scope="session")
def narrow_server(tmp_path_factory: pytest.TempPathFactory, library_dir: Path) -> Iterator[Server]:
    """A server with one worker and next to no queue."""
    log = tmp_path_factory.mktemp("narrow") / "log"
    with Server(
        log,
        library_dir=library_dir,
        workers=1,
        queue_size=1,
        deadline_ms=60_000,
        max_pixels=60_000_000,
    ) as running:
        yield running
