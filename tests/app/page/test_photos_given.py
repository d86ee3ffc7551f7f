"""How photos come to the page, and that the one chosen last counts."""

from __future__ import annotations

import base64
import json
from pathlib import Path

import cv2
import numpy as np
from playwright.sync_api import Browser, Route, expect

from tests.app.conftest import RENDERS, Render
from tests.app.imaging.image_files import STORED, png_with_exif, tiff, webp_with_exif
from tests.app.page.visit import PATIENCE_MS, Visit, answered, colour_share, picture, upload
from tests.app.server import Server


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
