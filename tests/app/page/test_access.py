"""The page by keyboard, by touch and for weak eyes."""

from __future__ import annotations

import numpy as np
import pytest
from playwright.sync_api import Browser, expect

from tests.app.page.visit import Visit, answered
from tests.app.server import Server

PHONE = {"width": 390, "height": 844}


def test_by_keyboard_alone(browser: Browser, server: Server) -> None:
    with Visit(browser, server) as page:
        for _ in range(20):
            page.keyboard.press("Tab")
            if page.evaluate("document.activeElement.dataset.sample !== undefined"):
                break
        page.keyboard.press("Enter")
        answered(page)
        reached = set()
        for _ in range(40):
            page.keyboard.press("Tab")
            reached.add(page.evaluate("document.activeElement.id || document.activeElement.role"))
        assert {"stage", "show-sigma", "radio", "photo"} <= reached
        unnamed = """() => [...document.querySelectorAll("button, input, select, canvas")]
            .filter((it) => it.checkVisibility() && !it.closest("#candidates"))
            .filter((it) => !(it.textContent || it.ariaLabel || it.getAttribute("aria-label")
                || it.labels?.length || it.querySelector("img[alt]"))).map((it) => it.outerHTML)"""
        assert page.evaluate(unnamed) == []


def test_arrows_with_other_keys_are_the_browsers(browser: Browser, server: Server) -> None:
    with Visit(browser, server) as page:
        page.click("[data-sample]")
        answered(page)
        first = page.locator("#candidates [role=radio]").first
        first.focus()
        page.keyboard.press("Alt+ArrowRight")
        expect(first).to_be_focused()
        expect(first).to_have_attribute("aria-checked", "true")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_contrast(browser: Browser, server: Server, scheme: str) -> None:
    """WCAG AA, 4.5, of all text colours on both backgrounds, in both schemes."""
    with Visit(browser, server, color_scheme=scheme) as page:
        names = ["paper", "plate", "ink", "soft", "alarm", "alarm-wash"]
        hexes = page.evaluate(
            "(names) => names.map((name) => getComputedStyle(document.documentElement)"
            ".getPropertyValue('--' + name).trim())",
            names,
        )
        colours = dict(zip(names, map(_luminance, hexes), strict=True))
        pairs = [(text, on) for text in ("ink", "soft") for on in ("paper", "plate")]
        for text, on in [*pairs, ("alarm", "alarm-wash")]:
            low, high = sorted((colours[text], colours[on]))
            assert (high + 0.05) / (low + 0.05) >= 4.5, (scheme, text, on)
        shown = page.evaluate("getComputedStyle(document.body).backgroundColor")
        level = sum(int(part) for part in shown.strip("rgb()").split(",")) / 3
        assert (level < 64) == (scheme == "dark")


def _luminance(colour: str) -> float:
    channels = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def test_on_a_phone(browser: Browser, server: Server) -> None:
    settings = {"viewport": PHONE, "device_scale_factor": 2, "is_mobile": True, "has_touch": True}
    with Visit(browser, server, **settings) as page:
        page.tap("[data-sample]")
        answered(page)
        assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
        sizes = page.evaluate(
            "[...document.querySelectorAll('.tools button, .toggles label, summary')]"
            ".filter((it) => it.checkVisibility()).map((it) => it.getBoundingClientRect().height)"
        )
        assert min(sizes) >= 40
        size = page.evaluate("parseFloat(getComputedStyle(document.body).fontSize)")
        assert size >= 16
        # A finger on the 3D view scrolls the page; it does not trap it.
        assert page.evaluate("document.querySelector('#stage').style.touchAction") == "pan-y"


def test_all_numbers_of_the_joints_fit_on_a_small_phone(browser: Browser, server: Server) -> None:
    with Visit(browser, server, viewport={"width": 360, "height": 740}, is_mobile=True) as page:
        page.click("[data-sample]")
        answered(page)
        width, needed = page.evaluate(
            "(({ clientWidth, scrollWidth }) => [clientWidth, scrollWidth])"
            "(document.querySelector('.scroll'))"
        )
        assert needed <= width, "± mm is not beyond the edge"
        expect(page.locator("#joints tbody td:nth-child(4)").first).not_to_be_empty()
