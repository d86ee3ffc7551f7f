"""The page as a person uses it, in a real headless Chromium (``scripts/browser`` finds one)."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser, Page, Playwright, Route, expect, sync_playwright

from tests.app.conftest import API_KEY, RENDERS, Render
from tests.app.imaging.test_decode import STORED, png_with_exif, tiff, webp_with_exif
from tests.app.server import Server

PATIENCE_MS = 60_000
"""A busy machine renders 3D in software: be patient, never sleep."""
DESK = {"width": 1280, "height": 900}
PHONE = {"width": 390, "height": 844}
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


# Of this module, not of the session: Playwright keeps an event loop running in this thread.
@pytest.fixture(scope="module")
def playwright() -> Iterator[Playwright]:
    with sync_playwright() as running:
        yield running


@pytest.fixture(scope="module")
def browser(playwright: Playwright) -> Iterator[Browser]:
    path = find_chromium(playwright)
    # Chromium's own sandbox refuses root, which containers and CI run as.
    sandboxed = os.geteuid() != 0
    started = playwright.chromium.launch(
        executable_path=path, args=_ARGUMENTS, chromium_sandbox=sandboxed
    )
    yield started
    started.close()


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


@pytest.fixture(scope="module")
def two_people(renders: list[Render]) -> bytes:
    """Two renders side by side."""
    halves = [
        cv2.imdecode(np.frombuffer(render.data, np.uint8), cv2.IMREAD_COLOR)
        for render in (renders[0], renders[3])
    ]
    encoded = cv2.imencode(".jpg", np.hstack([half for half in halves if half is not None]))[1]
    return encoded.tobytes()


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


def test_upload_drop_and_paste(browser: Browser, server: Server, renders: list[Render]) -> None:
    give = """([kind, data]) => {
        const bytes = Uint8Array.from(atob(data), (c) => c.charCodeAt(0));
        const files = new DataTransfer();
        files.items.add(new File([bytes], `${kind}.jpg`, { type: "image/jpeg" }));
        const event = kind === "drop"
            ? new DragEvent("drop", { dataTransfer: files, bubbles: true, cancelable: true })
            : new ClipboardEvent("paste", { clipboardData: files, bubbles: true });
        document.querySelector("#photo-frame").dispatchEvent(event);
    }"""
    with Visit(browser, server) as page:
        upload(page, "mine.jpg", renders[0].data)
        first = answered(page)
        assert first["image"] == {"width_px": 640, "height_px": 480, "orientation_applied": 1}
        for kind, render in (("drop", renders[1]), ("paste", renders[3])):
            page.evaluate(give, [kind, base64.b64encode(render.data).decode()])
            expect(page.locator("#photo-caption")).to_contain_text(f"{kind}.jpg", timeout=9000)
            expect(page.locator("#photo-caption")).to_contain_text(" ms", timeout=PATIENCE_MS)
            shown = json.loads(page.locator("#json").text_content() or "")
            assert shown["people"][0]["box_px"] != first["people"][0]["box_px"]


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


def test_the_camera(browser: Browser, server: Server) -> None:
    with Visit(browser, server) as page:  # of the browser's own test pattern
        page.click("#shoot")
        snap = page.locator("#snap")
        expect(snap).to_be_enabled(timeout=PATIENCE_MS)
        snap.click()
        answer = answered(page)
        expect(page.locator("#camera")).to_be_hidden()
        assert answer["image"]["width_px"] >= 320
        if not answer["people"]:
            expect(page.locator("#summary")).to_contain_text("Nobody was found")
        assert page.evaluate("document.querySelector('#video').srcObject") is None


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
            # Three.js says so on the console too, rightly.
            assert visit.complaints
            assert all("WebGL" in complaint for complaint in visit.complaints)
            visit.complaints.clear()
    finally:
        started.close()


_WATCH_DECODING = """() => {
    const decode = createImageBitmap;
    window.decoded = [];
    window.createImageBitmap = async (...photo) => {
        const bitmap = await decode(...photo);
        decoded.push(bitmap);
        if (decoded.length === 1) await new Promise((go) => { window.goOn = go; });
        return bitmap;
    };
}"""


def test_the_photo_chosen_last_counts(
    browser: Browser, server: Server, renders: list[Render]
) -> None:
    with Visit(browser, server) as page:
        page.evaluate(_WATCH_DECODING)
        upload(page, "slow.jpg", renders[0].data)
        expect(page.locator("#photo-caption")).to_contain_text("slow.jpg")
        upload(page, "quick.jpg", renders[1].data)
        answered(page)
        page.evaluate("() => goOn()")
        # What is decoded too late is let go of: neither view can come to show it.
        assert page.evaluate("() => decoded.map((it) => it.width)") == [0, 640]
        expect(page.locator("#photo-caption")).to_contain_text("quick.jpg")


def test_a_sample_that_comes_late_is_not_shown(browser: Browser, server: Server) -> None:
    held: list[Route] = []
    with Visit(browser, server) as page:
        page.route("**/dance.jpg", lambda route: held.append(route))
        # The pictures on the buttons are the browser's already; the photo is fetched anew.
        page.click("[data-sample='dance.jpg']")
        page.click("[data-sample='step.jpg']")
        answered(page)
        expect(page.locator("#photo-caption")).to_contain_text("step.jpg")
        with page.expect_response("**/dance.jpg"):
            held[0].continue_()
        page.wait_for_timeout(500)
        expect(page.locator("#photo-caption")).to_contain_text("step.jpg")


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


def test_a_file_that_has_gone_is_said(browser: Browser, server: Server, tmp_path: Path) -> None:
    file = tmp_path / "mine.jpg"
    file.write_bytes((RENDERS / "006.jpg").read_bytes())
    with Visit(browser, server) as page:
        page.locator("#file").set_input_files(file)
        answered(page)
        file.unlink()
        page.click("#options summary")
        page.select_option("[name=method]", "paper")
        expect(page.locator("#refusal")).to_contain_text("file cannot be read")
        expect(page.locator("#refusal button")).to_have_count(0)


def test_every_camera_is_let_go_of(browser: Browser, server: Server) -> None:
    watch = """() => {
        const devices = navigator.mediaDevices;
        const open = devices.getUserMedia.bind(devices);
        window.opened = [];
        devices.getUserMedia = async (wanted) => {
            const stream = await open(wanted);
            opened.push(...stream.getTracks());
            return stream;
        };
    }"""
    with Visit(browser, server) as page:
        page.evaluate(watch)
        page.click("#shoot")
        page.evaluate(
            "() => { for (let i = 0; i < 2; i++) document.querySelector('#flip').click() }"
        )
        expect(page.locator("#snap")).to_be_enabled(timeout=PATIENCE_MS)
        expect(page.locator("#camera-notice")).to_be_hidden()
        page.click("#close")
        expect(page.locator("#camera")).to_be_hidden()
        page.wait_for_timeout(500)  # the dialog says a little later that it is closed
        states = page.evaluate("() => opened.map((track) => track.readyState)")
        assert states == ["ended"] * 3


def test_arrows_with_other_keys_are_the_browsers(browser: Browser, server: Server) -> None:
    with Visit(browser, server) as page:
        page.click("[data-sample]")
        answered(page)
        first = page.locator("#candidates [role=radio]").first
        first.focus()
        page.keyboard.press("Alt+ArrowRight")
        expect(first).to_be_focused()
        expect(first).to_have_attribute("aria-checked", "true")


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


def test_a_photo_that_only_the_service_can_decode(browser: Browser, server: Server) -> None:
    """As HEIC in most browsers: its joints are drawn all the same."""
    blind = "() => { window.createImageBitmap = () => Promise.reject(new Error()) }"
    with Visit(browser, server) as page:
        page.evaluate(blind)
        upload(page, "strange.jpg", (RENDERS / "006.jpg").read_bytes())
        answered(page)
        expect(page.locator("#welcome")).to_be_hidden()
        photo = picture(page, "#photo")
        assert colour_share(photo, (0x33, 0x7A, 0xFF)) > 0.002
        assert colour_share(photo, (0xFF, 0xA8, 0x4A)) > 0.002
        upload(page, "notes.txt", b"hello")
        expect(page.locator("#refusal")).to_be_visible(timeout=PATIENCE_MS)
        expect(page.locator("#photo")).to_be_hidden()
        expect(page.locator("#welcome")).to_be_visible()


def test_photos_lie_upright_under_their_joints(browser: Browser, server: Server) -> None:
    """Chromium turns neither WebPs nor PNGs whose EXIF comes last; other browsers may."""
    upright = cv2.imread(str(RENDERS / "006.jpg"))
    assert upright is not None
    shown = []
    with Visit(browser, server) as page:
        for orientation in (1, 2, 3, 4, 5, 6, 7, 8, -6):
            stored = STORED[abs(orientation)](upright)
            block = tiff(abs(orientation))
            if orientation > 0:
                webp = cv2.imencode(".webp", stored, [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()
                data = webp_with_exif(webp, block, stored.shape[1], stored.shape[0])
            else:
                png = cv2.imencode(".png", stored)[1].tobytes()
                exif = png_with_exif(png, block)[33 : 33 + 12 + len(block)]
                data = png[:-12] + exif + png[-12:]
            name = f"{orientation}.photo"
            upload(page, name, data, "")  # a name or type may say nothing, or something else
            expect(page.locator("#photo-caption")).to_contain_text(f"{name}:")
            expect(page.locator("#photo-caption")).to_contain_text(" ms", timeout=PATIENCE_MS)
            shown.append(picture(page, "#photo"))
        # Asked about once more it stays as it is.
        page.click("#options summary")
        page.fill("[name=fov_deg]", "50")
        with page.expect_response("**/v1/poses?*"):
            page.locator("[name=fov_deg]").press("Enter")
        expect(page.locator("#photo-caption")).to_contain_text(" ms", timeout=PATIENCE_MS)
        shown.append(picture(page, "#photo"))
    for other in shown[1:]:
        assert other.shape == shown[0].shape
        assert np.abs(other - shown[0]).mean() < 1
