"""The page as a person uses it, in a real headless Chromium (``scripts/browser`` finds one)."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser, Playwright, sync_playwright

from tests.app.conftest import Render

_ARGUMENTS = [
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--use-fake-device-for-media-stream",
    "--use-fake-ui-for-media-stream",
]


def find_chromium(playwright: Playwright) -> str:
    """A browser's path, or a skip that says how to get one."""
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
    candidates = [os.environ.get("CHROMIUM"), *map(shutil.which, names)]
    candidates.append(playwright.chromium.executable_path)
    for candidate in candidates:
        if candidate and Path(candidate).exists():
            return candidate
    pytest.skip("no Chromium here: run scripts/browser, or set CHROMIUM=/path/to/it")


# Of these tests, not of the session: Playwright keeps an event loop running in this thread.
@pytest.fixture(scope="package")
def playwright() -> Iterator[Playwright]:
    with sync_playwright() as running:
        yield running


@pytest.fixture(scope="package")
def browser(playwright: Playwright) -> Iterator[Browser]:
    path = find_chromium(playwright)
    # Chromium's own sandbox refuses root, which containers and CI run as.
    sandboxed = os.geteuid() != 0
    started = playwright.chromium.launch(
        executable_path=path, args=_ARGUMENTS, chromium_sandbox=sandboxed
    )
    yield started
    started.close()


@pytest.fixture(scope="package")
def two_people(renders: list[Render]) -> bytes:
    """Two renders side by side."""
    halves = [
        cv2.imdecode(np.frombuffer(render.data, np.uint8), cv2.IMREAD_COLOR)
        for render in (renders[0], renders[3])
    ]
    encoded = cv2.imencode(".jpg", np.hstack([half for half in halves if half is not None]))[1]
    return encoded.tobytes()
