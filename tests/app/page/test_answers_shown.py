"""What the page shows of an answer: photo, pose, exemplars and joints."""

from __future__ import annotations

import os

import numpy as np
from playwright.sync_api import Browser, Playwright, expect

from tests.app.page.conftest import find_chromium
from tests.app.page.visit import Visit, answered, colour_share, picture, upload
from tests.app.server import Server


def test_a_sample_is_answered_in_full(browser: Browser, server: Server) -> None:
    with Visit(browser, server) as page:
        before = picture(page, "#stage")
        page.click("[data-sample]")
        answer = answered(page)
        person = answer["people"][0]
        expect(page.locator("#candidates [role=radio]")).to_have_count(10)
        expect(page.locator("#joints tbody tr")).to_have_count(14)
        expect(page.locator("#photo-caption")).to_contain_text("one person")
        expect(page.locator("#warnings li")).to_have_count(len(person["warnings"]))
        expect(page.locator("#warnings")).not_to_contain_text("assumed_focal")  # in words
        expect(page.locator("#summary")).to_contain_text("4,000 exemplars")
        # Right and left limbs are drawn over the photo, and the scene has changed.
        photo = picture(page, "#photo")
        assert colour_share(photo, (0x33, 0x7A, 0xFF)) > 0.002
        assert colour_share(photo, (0xFF, 0xA8, 0x4A)) > 0.002
        expect(page.locator("#stage-caption")).not_to_be_empty()
        assert np.abs(picture(page, "#stage") - before).max() > 60


def test_orbit(browser: Browser, server: Server) -> None:
    with Visit(browser, server, reduced_motion="reduce") as page:
        page.click("[data-sample]")
        answered(page)
        caption = page.locator("#stage-caption")
        expect(caption).to_contain_text("From 38° to the right, 14° above")
        still = picture(page, "#stage")
        box = page.locator("#stage").bounding_box()
        assert box is not None
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x - 120, y - 40, steps=4)
        page.mouse.up()
        expect(caption).not_to_contain_text("From 38°")
        assert np.abs(picture(page, "#stage") - still).max() > 60
        assert page.locator("[data-view][aria-pressed=true]").count() == 0
        # The photo's own view, then turned and zoomed by keys.
        page.click("[data-view=photo]")
        expect(caption).to_contain_text("camera sees it")
        page.locator("#stage").focus()
        page.keyboard.press("ArrowRight")
        expect(caption).to_contain_text("From 6° to the right")
        near = picture(page, "#stage")
        page.keyboard.press("-")
        page.keyboard.press("-")
        page.wait_for_timeout(300)
        assert np.abs(picture(page, "#stage") - near).max() > 40
        page.keyboard.press("0")
        expect(caption).to_contain_text("From 38°")


def test_toggles_candidates_and_joints(browser: Browser, server: Server) -> None:
    with Visit(browser, server, reduced_motion="reduce") as page:
        page.click("[data-sample]")
        answered(page)
        for name in ("camera", "exemplar", "sigma"):
            before = picture(page, "#stage")
            page.locator(f"#show-{name}").click()
            page.wait_for_timeout(300)
            assert np.abs(picture(page, "#stage") - before).max() > 20, name
        first = page.locator("#candidates [role=radio]").first
        first.focus()
        page.keyboard.press("ArrowRight")
        chosen = page.locator("#candidates [aria-checked=true]")
        expect(chosen).to_have_count(1)
        expect(chosen).to_have_accessible_name("Exemplar 2, " + (chosen.text_content() or ""))
        expect(page.locator("#candidate-caption")).to_contain_text("px off the joints")
        page.locator("#joints tbody tr").nth(3).hover()
        expect(page.locator("#joints tbody tr.lit")).to_have_count(1)


def test_several_people(browser: Browser, server: Server, two_people: bytes) -> None:
    with Visit(browser, server) as page:
        upload(page, "two.jpg", two_people)
        answer = answered(page)
        assert len(answer["people"]) == 2
        radios = page.locator("#people [role=radio]")
        expect(radios).to_have_count(2)
        summary = page.locator("#summary").text_content()
        radios.first.focus()
        page.keyboard.press("ArrowRight")
        expect(radios.nth(1)).to_have_attribute("aria-checked", "true")
        assert page.locator("#summary").text_content() != summary
        # And by a click on the first one's chest in the photo.
        neck = answer["people"][0]["joints_2d"][1]
        photo = page.locator("#photo").bounding_box()
        assert photo is not None
        scale = photo["width"] / answer["image"]["width_px"]
        page.locator("#photo").click(
            position={"x": scale * neck["x_px"], "y": scale * neck["y_px"]}
        )
        expect(radios.first).to_have_attribute("aria-checked", "true")


def test_without_webgl(playwright: Playwright, server: Server) -> None:
    started = playwright.chromium.launch(
        executable_path=find_chromium(playwright),
        args=["--disable-3d-apis"],
        chromium_sandbox=os.geteuid() != 0,
    )
    try:
        visit = Visit(started, server)
        with visit as page:
            page.click("[data-sample]")
            answered(page)
            expect(page.locator("#stage-notice")).to_contain_text("WebGL")
            for name in ("View", "Shown in 3D"):
                group = page.get_by_role("group", name=name)
                for control in group.locator("button, input").all():
                    expect(control).to_be_disabled()
            # Three.js says so on the console too, rightly.
            assert visit.complaints
            assert all("WebGL" in complaint for complaint in visit.complaints)
            visit.complaints.clear()
    finally:
        started.close()
