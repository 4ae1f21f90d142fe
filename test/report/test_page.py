# SPDX-License-Identifier: Apache-2.0
"""The report in a real browser: no errors, a 3D view with something in it, a slider that moves everything."""

import base64
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser, BrowserContext, Page

from flowing_puppet_ros.report.report import write_report

pytestmark = pytest.mark.slow

type Replay = Callable[..., tuple[Path, Path]]


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory, write_replay: Replay) -> Path:
    """The page of a made-up replay."""
    folder = tmp_path_factory.mktemp("report")
    path = folder / "report.html"
    write_report(*write_replay(folder), path)
    return path


class Opener:
    """Opens the report; `errors` are what its pages complained of, or asked the network for."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.errors: list[str] = []

    def __call__(self, context: BrowserContext) -> Page:
        page = context.new_page()
        # Where a busy machine draws in 3D without a graphics card everything takes its time.
        page.set_default_timeout(180_000)
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.on("console", lambda said: self.errors.append(said.text) if said.type in ("error", "warning") else None)
        page.on("request", lambda asked: self.errors.append(asked.url) if self.outside(asked.url) else None)
        page.goto(self.path.as_uri())
        page.wait_for_selector(".timeline[data-frame]")
        return page

    def outside(self, url: str) -> bool:
        return url != self.path.as_uri() and not url.startswith("data:")


def shot(page: Page) -> np.ndarray:
    """What the 3D view shows, whatever the page lays over it."""
    address = page.evaluate("document.querySelector('canvas').toDataURL('image/png')")
    data = np.frombuffer(base64.b64decode(address.partition(",")[2]), np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert image is not None
    return np.asarray(image, dtype=np.int16)


def move(page: Page, place: int) -> None:
    page.locator(".scrub input").evaluate(
        "(slider, k) => { slider.value = k; slider.dispatchEvent(new Event('input')) }", place
    )


def test_the_slider_moves_picture_bodies_and_marks(report: Path, drawing_browser: Browser) -> None:
    opener = Opener(report)
    context = drawing_browser.new_context(viewport={"width": 1100, "height": 900})
    page = opener(context)
    first = shot(page)
    background = first[5, 5]
    drawn = np.abs(first - background).max(axis=2) > 30
    assert drawn.mean() > 0.02, "the 3D view is blank"
    assert page.locator(".frame.on figcaption").first.text_content() == "front, 0.00 s"
    marks = page.locator("svg .now")
    before = [marks.nth(k).get_attribute("x1") for k in range(marks.count())]
    move(page, 4)
    assert page.locator("output").text_content() == "0.40 s"
    assert page.locator(".frame.on").count() == 1
    assert page.locator(".frame.on figcaption").first.text_content() == "front, 0.40 s"
    assert np.abs(shot(page) - first).max() > 60, "the body stands where it stood"
    after = [marks.nth(k).get_attribute("x1") for k in range(marks.count())]
    assert len(after) >= 5 and all(float(a or 0) > float(b or 0) for a, b in zip(after, before, strict=True))
    context.close()
    assert opener.errors == []


def test_mouse_wheel_keys_and_boxes_change_the_view(report: Path, drawing_browser: Browser) -> None:
    opener = Opener(report)
    context = drawing_browser.new_context(viewport={"width": 1100, "height": 2400})
    page = opener(context)
    home = shot(page)
    box = page.locator("canvas").bounding_box()
    assert box

    def changed() -> float:
        return float(np.abs(shot(page) - home).max())

    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 90, y + 20, steps=4)
    page.mouse.up()
    assert changed() > 60
    page.get_by_role("button", name="Reset view").click()
    assert changed() == 0
    page.mouse.move(x, y)
    page.mouse.wheel(0, 300)
    page.wait_for_timeout(100)
    assert changed() > 60
    page.locator("canvas").focus()
    page.keyboard.press("Home")
    assert changed() == 0
    for name in ("bodies", "points"):
        page.get_by_label(name, exact=True).uncheck()
        assert changed() > 30
        page.get_by_label(name, exact=True).check()
    page.locator("svg.plot").first.click(position={"x": 700, "y": 60})
    assert int(page.locator(".timeline").get_attribute("data-frame") or 0) >= 3
    page.get_by_role("button", name="Play").click()
    page.wait_for_function("document.querySelector('.timeline').dataset.frame < 3")
    context.close()
    assert opener.errors == []


def test_two_fingers_zoom(report: Path, drawing_browser: Browser) -> None:
    opener = Opener(report)
    context = drawing_browser.new_context(viewport={"width": 390, "height": 800}, has_touch=True)
    page = opener(context)
    page.locator("canvas").scroll_into_view_if_needed()
    box = page.locator("canvas").bounding_box()
    assert box
    before = shot(page)
    session = context.new_cdp_session(page)
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

    def touch(kind: str, *apart: float) -> None:
        points = [{"x": x + sign * gap, "y": y} for gap in apart for sign in (-1, 1)]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    distance = "document.querySelector('.timeline').timeline.scene.distance"
    start = page.evaluate(distance)
    touch("touchStart", 20)
    for gap in (30, 45, 60):
        touch("touchMove", gap)
    touch("touchEnd")
    assert page.evaluate(distance) < 0.6 * start
    assert np.abs(shot(page) - before).max() > 60
    context.close()
    assert opener.errors == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [360, 1300])
def test_narrow_and_wide_light_and_dark(report: Path, drawing_browser: Browser, scheme: Any, width: int) -> None:
    opener = Opener(report)
    context = drawing_browser.new_context(viewport={"width": width, "height": 800}, color_scheme=scheme)
    page = opener(context)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    corner = shot(page)[8, 8]
    assert (corner.mean() > 200) == (scheme == "light")
    context.close()
    assert opener.errors == []


def test_without_webgl_the_still_pictures_are_named(report: Path, browser: Browser) -> None:
    opener = Opener(report)
    context = browser.new_context(viewport={"width": 1100, "height": 900})
    context.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page = opener(context)
    assert page.locator(".no-space").is_visible() and not page.locator("canvas").is_visible()
    move(page, 2)
    assert page.locator(".frame.on figcaption").first.text_content() == "front, 0.20 s"
    context.close()
    assert opener.errors == []


def test_without_scripts_every_picture_is_there(report: Path, browser: Browser) -> None:
    context = browser.new_context(java_script_enabled=False)
    page = context.new_page()
    page.goto(report.as_uri())
    assert page.locator(".frame").count() == 5
    assert all(page.locator(".frame").nth(k).is_visible() for k in range(5))
    assert not page.locator("canvas").is_visible() and not page.locator(".scrub").is_visible()
    assert not re.search("<script[^>]*src=", report.read_text())
    context.close()
