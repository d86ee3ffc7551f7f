"""Visits to the page in a browser, and what is read off it."""

from __future__ import annotations

import json
from typing import Any

import cv2
import numpy as np
from playwright.sync_api import Browser, Page, expect

from tests.app.server import Server

PATIENCE_MS = 60_000
"""A busy machine renders 3D in software: be patient, never sleep."""
DESK = {"width": 1280, "height": 900}


class Visit:
    """A visit to the page; leaving it checks that nothing went wrong unnoticed."""

    def __init__(self, browser: Browser, server: Server, **context: Any) -> None:
        self._context = browser.new_context(**{"viewport": DESK, **context})
        self._context.set_default_timeout(PATIENCE_MS)
        self.page: Page = self._context.new_page()
        self.complaints: list[str] = []
        self.hosts: set[str] = set()
        self.server = server
        self.page.on("console", self._on_console)
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", self._on_request)
        self.page.goto(server.url)

    def _on_console(self, message: Any) -> None:
        # Chromium reports refused requests itself; what the page makes of them is tested.
        is_status = message.text.startswith("Failed to load resource")
        if message.type in ("error", "warning") and not is_status:
            self.complaints.append(message.text)

    def _on_request(self, request: Any) -> None:
        if not request.url.startswith("blob:"):
            self.hosts.add("/".join(request.url.split("/")[:3]))

    def __enter__(self) -> Page:
        return self.page

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._context.close()
        if kind is None:
            assert self.complaints == []
            assert self.hosts == {self.server.url}


def answered(page: Page) -> dict[str, Any]:
    """Wait for the answer; the JSON that the page shows."""
    expect(page.locator("#summary")).not_to_be_empty(timeout=PATIENCE_MS)
    expect(page.locator("#photo-caption")).to_contain_text(" ms", timeout=PATIENCE_MS)
    shown: dict[str, Any] = json.loads(page.locator("#json").text_content() or "")
    return shown


def upload(page: Page, name: str, data: bytes, kind: str = "image/jpeg") -> None:
    page.locator("#file").set_input_files({"name": name, "mimeType": kind, "buffer": data})


def picture(page: Page, selector: str) -> np.ndarray[Any, Any]:
    """What is seen of an element, as (H, W, 3) int."""
    shot = np.frombuffer(page.locator(selector).screenshot(), np.uint8)
    decoded = cv2.imdecode(shot, cv2.IMREAD_COLOR)
    assert decoded is not None
    return decoded.astype(int)


def colour_share(pixels: np.ndarray[Any, Any], bgr: tuple[int, int, int]) -> float:
    """Share of the pixels near a colour."""
    return float((np.abs(pixels - np.array(bgr)).max(axis=2) < 40).mean())
