"""What the page asks of the service, and what it says when there is no answer."""

from __future__ import annotations

import json
import subprocess

import pytest
from playwright.sync_api import Browser, Route, expect

from tests.app.conftest import API_KEY, RENDERS
from tests.app.page.visit import PATIENCE_MS, Visit, answered, upload
from tests.app.server import Server


def test_refusals_in_words(browser: Browser, server: Server) -> None:
    whole = (RENDERS / "000.jpg").read_bytes()
    with Visit(browser, server) as page:
        refusal = page.locator("#refusal")
        for name, data, said in (
            ("notes.txt", b"hello", "no photo the service reads"),
            ("moving.gif", b"GIF89a" + bytes(60), "GIF"),
            ("cut.jpg", whole[:9000], "damaged"),
            ("empty.jpg", b"", "empty"),
            ("huge.jpg", whole + bytes(3_000_000), "too large"),
        ):
            upload(page, name, data)
            expect(refusal).to_contain_text(said, timeout=PATIENCE_MS)
            expect(page.locator("#findings")).to_be_hidden()
        page.click("[data-sample]")  # and the next photo is answered
        answered(page)
        expect(refusal).to_be_hidden()


def test_options_are_sent_and_checked(browser: Browser, server: Server) -> None:
    with Visit(browser, server) as page:
        page.click("[data-sample]")
        assumed = answered(page)["people"][0]["camera"]
        assert assumed["focal_source"] == "assumed"
        page.click("#options summary")
        page.fill("[name=fov_deg]", "40")
        page.locator("[name=fov_deg]").blur()
        shown = page.locator("#json")
        expect(shown).to_contain_text('"focal_source": "request"', timeout=PATIENCE_MS)
        page.select_option("[name=method]", "paper")
        expect(shown).to_contain_text('"method": "paper"', timeout=PATIENCE_MS)


def test_the_curl_command_gives_the_same(browser: Browser, server: Server) -> None:
    with Visit(browser, server) as page:
        kind = "image/jpeg; of='a b'"
        upload(page, "it's me.jpg", (RENDERS / "006.jpg").read_bytes(), kind)
        people = answered(page)["people"]
        command = page.locator("#curl").text_content() or ""
    assert "'it'\\''s me.jpg'" in command
    assert "of='\\''a b'\\'''" in command
    command = command.replace("'it'\\''s me.jpg'", "006.jpg")
    done = subprocess.run(
        ["bash", "-c", command], cwd=RENDERS, capture_output=True, check=True, timeout=60
    )
    assert json.loads(done.stdout)["people"] == people


def test_a_key_is_asked_for(browser: Browser, keyed_server: Server) -> None:
    with Visit(browser, keyed_server) as page:
        page.click("[data-sample]")
        expect(page.locator("#refusal")).to_contain_text("API key", timeout=PATIENCE_MS)
        field = page.locator("[name=key]")
        expect(field).to_be_focused()
        field.fill(API_KEY)
        field.blur()
        answered(page)
        command = page.locator("#curl").text_content() or ""
        assert API_KEY not in command
        assert "$POSEMATCH_KEY" in command


def test_a_busy_server_is_asked_again(browser: Browser, server: Server) -> None:
    refusals = 0

    def refuse_once(route: Route) -> None:
        nonlocal refusals
        refusals += 1
        if refusals > 1:
            route.continue_()
            return
        problem = {"type": "urn:posematch:problem:overloaded", "title": "Overloaded"}
        route.fulfill(
            status=503,
            headers={"Retry-After": "1", "Content-Type": "application/problem+json"},
            body=json.dumps(problem),
        )

    with Visit(browser, server) as page:
        page.route("**/v1/poses?*", refuse_once)
        page.click("[data-sample]")
        expect(page.locator("#photo-caption")).to_contain_text("asking again")
        answered(page)
    assert refusals == 2


def test_a_lost_server_is_said_and_asked_again(browser: Browser, server: Server) -> None:
    is_lost = True
    with Visit(browser, server) as page:

        def maybe(route: Route) -> None:
            route.abort() if is_lost else route.continue_()

        page.route("**/samples/run.jpg", maybe)
        page.route("**/v1/poses?*", maybe)
        refusal = page.locator("#refusal")
        page.click("[data-sample='run.jpg']")
        expect(refusal).to_contain_text("cannot be reached", timeout=PATIENCE_MS)
        expect(refusal.locator("button")).to_have_count(0)
        page.click("[data-sample='step.jpg']")
        expect(page.locator("#photo")).to_be_visible()
        again = refusal.locator("button")
        expect(again).to_be_visible(timeout=PATIENCE_MS)
        is_lost = False
        again.click()
        answered(page)
        expect(refusal).to_be_hidden()


@pytest.mark.parametrize("how", ["the button", "the keyboard"])
def test_who_will_not_wait_stops_and_asks_again(browser: Browser, server: Server, how: str) -> None:
    held: list[Route] = []
    with Visit(browser, server) as page:
        page.route("**/v1/poses?*", lambda route: held.append(route))
        stop, refusal = page.locator("#stop"), page.locator("#refusal")
        page.keyboard.press("Escape")  # nothing to be stopped yet
        expect(refusal).to_be_hidden()
        with page.expect_event("requestfailed"):
            page.click("[data-sample='step.jpg']")
            expect(stop).to_be_visible()
            stop.click() if how == "the button" else page.keyboard.press("Escape")
        expect(refusal).to_contain_text("Stopped")
        expect(stop).to_be_hidden()
        expect(page.locator("#photo")).to_be_visible()
        again = refusal.locator("button")
        expect(again).to_be_focused()
        page.unroute("**/v1/poses?*")
        page.keyboard.press("Enter")
        answered(page)
        expect(refusal).to_be_hidden()
    assert len(held) == 1


def test_what_is_of_the_last_photo_cannot_be_used(
    browser: Browser, server: Server, two_people: bytes
) -> None:
    held: list[Route] = []
    with Visit(browser, server) as page:
        upload(page, "two.jpg", two_people)
        answered(page)
        page.route("**/v1/poses?*", lambda route: held.append(route))
        upload(page, "next.jpg", (RENDERS / "006.jpg").read_bytes())
        expect(page.locator("#photo-caption")).to_contain_text("next.jpg: asking")
        assert page.evaluate("() => document.querySelector('#findings').inert")
        for picked in ("#people [aria-checked=false]", "#candidates [aria-checked=false]"):
            box = page.locator(picked).first.bounding_box()
            assert box is not None
            page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        held[0].continue_()
        expect(page.locator("#photo-caption")).to_contain_text("one person", timeout=PATIENCE_MS)
        assert not page.evaluate("() => document.querySelector('#findings').inert")
        # And when it is refused there is nobody left in the photo to be picked.
        page.unroute("**/v1/poses?*")
        upload(page, "two.jpg", two_people)
        expect(page.locator("#photo-caption")).to_contain_text("2 people", timeout=PATIENCE_MS)
        chest = json.loads(page.locator("#json").text_content() or "")["people"][1]["joints_2d"][1]
        page.route("**/v1/poses?*", lambda route: route.abort())
        page.click("#options summary")
        page.select_option("[name=method]", "paper")
        expect(page.locator("#refusal")).to_be_visible(timeout=PATIENCE_MS)
        photo = page.locator("#photo").bounding_box()
        assert photo is not None
        scale = photo["width"] / 1280
        page.locator("#photo").click(
            position={"x": scale * chest["x_px"], "y": scale * chest["y_px"]}
        )


def test_the_reference_asks_under_a_path_prefix_too(browser: Browser, server: Server) -> None:
    def without_prefix(route: Route) -> None:
        route.fulfill(response=route.fetch(url=route.request.url.replace("/prefix/", "/")))

    with Visit(browser, server) as page:
        page.route("**/prefix/**", without_prefix)
        page.goto(f"{server.url}/prefix/docs")
        page.locator("#operations-info-get_info_v1_info_get").click()
        page.locator("button.execute").click()
        expect(page.locator(".request-url pre")).to_have_text(f"{server.url}/prefix/v1/info")
        expect(page.locator(".live-responses-table")).to_contain_text("max_batch_images")
