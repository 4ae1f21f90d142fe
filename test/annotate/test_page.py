# SPDX-License-Identifier: Apache-2.0
"""The annotation page in a real browser: what a person does with it is on the disk, and stays."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser, Page, ViewportSize

from flowing_puppet_ros.annotate.store import FILE_NAME
from flowing_puppet_ros.model.ds.joints import JOINT_NAMES

pytestmark = pytest.mark.slow

ELBOW = JOINT_NAMES[10].index("left_elbow")
WINDOW = ViewportSize(width=1100, height=700)


class Tool:
    """A running annotation tool; `errors` are what its pages complained of."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.errors: list[str] = []
        self.port = 0
        self.start()

    def start(self) -> None:
        """Start it, the second time at the port of the first."""
        command = [sys.executable, "-m", "flowing_puppet_ros", "annotate", str(self.folder), "--port", str(self.port)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        assert self.process.stdout
        line = self.process.stdout.readline()
        self.url = next(word for word in line.split() if word.startswith("http"))
        self.port = int(self.url.rstrip("/").rpartition(":")[2])

    def stop(self, how: int = signal.SIGINT) -> int:
        os.kill(self.process.pid, how)
        assert self.process.stdout
        self.process.stdout.close()
        return self.process.wait(20)

    def people(self, key: str) -> list[dict[str, Any]]:
        path = self.folder / FILE_NAME
        return list(json.loads(path.read_text())["images"].get(key, [])) if path.exists() else []

    def open(self, context: Any, key: str = "") -> Page:
        page: Page = context.new_page()
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.on("console", lambda said: self.errors.append(said.text) if said.type == "error" else None)
        page.goto(self.url + (f"#{key}" if key else ""))
        page.wait_for_selector("body[data-ready]")
        return page


@pytest.fixture
def tool(tmp_path: Path) -> Iterator[Tool]:
    """Return the tool on a folder of three images."""
    picture = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (240, 320, 3), np.uint8), (0, 0), 2)
    for k in range(3):
        assert cv2.imwrite(str(tmp_path / f"{k}.png"), picture)
    running = Tool(tmp_path)
    yield running
    if running.process.poll() is None:
        running.stop()


@pytest.fixture
def context(browser: Browser) -> Iterator[Any]:
    """Return a fresh window of the browser."""
    window = browser.new_context(viewport=WINDOW)
    yield window
    window.close()


def on_screen(page: Page, size: tuple[int, int], point: tuple[float, float]) -> tuple[float, float]:
    """Return where a pixel of the fitted image of `size` (width, height) is on the page."""
    box = page.locator("#canvas").bounding_box()
    assert box
    zoom = min(box["width"] / size[0], box["height"] / size[1]) * 0.97
    left, top = box["x"] + (box["width"] - zoom * size[0]) / 2, box["y"] + (box["height"] - zoom * size[1]) / 2
    return left + (point[0] + 0.5) * zoom, top + (point[1] + 0.5) * zoom


def drag(page: Page, start: tuple[float, float], end: tuple[float, float]) -> None:
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move(*end, steps=8)
    page.mouse.up()


def wait(page: Page, holds: Callable[[], bool]) -> None:
    """Wait until something holds, at most a minute: where nothing is compiled yet the first flow takes its time."""
    for _ in range(1200):
        if holds():
            return
        page.wait_for_timeout(50)
    raise AssertionError("it did not come to hold")


def add_person(tool: Tool, page: Page, key: str) -> dict[str, Any]:
    page.locator("#canvas").focus()
    page.keyboard.press("a")
    wait(page, lambda: bool(tool.people(key)))
    return tool.people(key)[-1]


def picture_of(page: Page) -> np.ndarray:
    shot = cv2.imdecode(np.frombuffer(page.locator("#canvas").screenshot(), np.uint8), cv2.IMREAD_COLOR)
    assert shot is not None
    return np.asarray(shot, dtype=np.int16)


def test_a_dragged_elbow_moves_the_outline_and_outlives_a_killed_server(tool: Tool, context: Any) -> None:
    page = tool.open(context)
    before = add_person(tool, page, "0.png")["joints"][ELBOW]
    page.wait_for_timeout(300)
    pictured = picture_of(page)
    start = on_screen(page, (320, 240), (before[0], before[1]))
    drag(page, start, (start[0] + 60, start[1] - 40))
    wait(page, lambda: tool.people("0.png")[0]["joints"][ELBOW] != before)
    page.wait_for_timeout(300)
    after = tool.people("0.png")[0]["joints"]
    zoom = on_screen(page, (320, 240), (1, 0))[0] - on_screen(page, (320, 240), (0, 0))[0]
    np.testing.assert_allclose(np.subtract(after[ELBOW], before)[:2], [60 / zoom, -40 / zoom], atol=1)
    # The outline of the arm is drawn well away from the dragged joint's own dot, too.
    changed = np.abs(picture_of(page) - pictured).max(axis=2) > 40
    assert changed.sum() > 1500
    assert tool.stop(signal.SIGKILL) == -signal.SIGKILL
    tool.start()
    again = tool.open(context)
    assert tool.people("0.png")[0]["joints"] == after
    wait(again, lambda: "1 of 3" in (again.locator("#progress").text_content() or ""))
    page.close()
    assert not tool.errors


def test_undo_redo_view_gender_and_visibility(tool: Tool, context: Any) -> None:
    page = tool.open(context)
    first = add_person(tool, page, "0.png")
    page.keyboard.press("f")
    page.keyboard.press("g")
    x, y = on_screen(page, (320, 240), tuple(first["joints"][ELBOW][:2]))
    page.mouse.move(x, y)
    page.keyboard.press("v")
    wait(page, lambda: tool.people("0.png")[0]["joints"][ELBOW][2] == 0)
    assert (tool.people("0.png")[0]["view"], tool.people("0.png")[0]["gender"]) == ("back", "female")
    for _ in range(3):
        page.keyboard.press("Control+z")
    wait(page, lambda: tool.people("0.png") == [first])
    page.keyboard.press("Control+y")
    wait(page, lambda: tool.people("0.png") == [first | {"view": "back"}])
    page.keyboard.press("Delete")
    wait(page, lambda: tool.people("0.png") == [])
    assert not tool.errors


def test_people_are_copied_along_the_images(tool: Tool, context: Any) -> None:
    page = tool.open(context)
    person = add_person(tool, page, "0.png")
    page.keyboard.press("ArrowRight")
    wait(page, lambda: "1.png" in (page.locator("#items li.now").text_content() or ""))
    page.keyboard.press("c")
    wait(page, lambda: len(tool.people("1.png")) == 1)
    moved = np.subtract(tool.people("1.png")[0]["joints"], person["joints"])
    assert np.abs(moved).max() < 1, "the images are the same"
    page.keyboard.press("n")
    wait(page, lambda: "2.png" in (page.locator("#items li.now").text_content() or ""))
    assert not tool.errors


def test_the_second_of_two_windows_is_told_and_loses_nothing(tool: Tool, context: Any) -> None:
    first, second = tool.open(context), tool.open(context)
    theirs = add_person(tool, first, "0.png")
    second.keyboard.press("a")
    wait(second, lambda: "another window" in (second.locator("#state").text_content() or ""))
    assert tool.people("0.png") == [theirs]
    second.keyboard.press("Control+z")
    second.keyboard.press("f")
    wait(second, lambda: tool.people("0.png")[0]["view"] == "back")
    first.evaluate("window.dispatchEvent(new Event('focus'))")
    wait(first, lambda: first.locator("#view").input_value() == "back")
    assert [error for error in tool.errors if "409" not in error] == []


def test_touch_drags_and_two_fingers_zoom(tool: Tool, browser: Browser) -> None:
    context = browser.new_context(viewport=WINDOW, has_touch=True)
    page = tool.open(context)
    before = add_person(tool, page, "0.png")["joints"][ELBOW]
    x, y = on_screen(page, (320, 240), (before[0], before[1]))
    session = context.new_cdp_session(page)

    def touch(kind: str, *points: tuple[float, float]) -> None:
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": [{"x": a, "y": b} for a, b in points]})

    touch("touchStart", (x, y))
    for step in range(1, 6):
        touch("touchMove", (x + 6 * step, y))
    touch("touchEnd")
    wait(page, lambda: tool.people("0.png")[0]["joints"][ELBOW][0] > before[0] + 5)
    pictured = picture_of(page)
    saved = tool.people("0.png")
    touch("touchStart", (500, 350), (560, 350))
    for step in range(1, 6):
        touch("touchMove", (500 - 20 * step, 350), (560 + 20 * step, 350))
    touch("touchEnd")
    page.wait_for_timeout(400)
    assert np.abs(picture_of(page) - pictured).mean() > 5
    assert tool.people("0.png") == saved
    context.close()


def test_a_12_megapixel_image_and_500_images(tmp_path: Path, context: Any) -> None:
    large = cv2.resize(np.random.default_rng(0).integers(0, 255, (30, 40, 3), np.uint8), (4000, 3000))
    assert cv2.imwrite(str(tmp_path / "0.jpg"), large)
    for k in range(1, 500):
        assert cv2.imwrite(str(tmp_path / f"{k}.png"), large[::100, ::100])
    tool = Tool(tmp_path)
    page = tool.open(context)
    assert page.locator("#items li").count() == 500
    before = add_person(tool, page, "0.jpg")["joints"][ELBOW]
    start = on_screen(page, (4000, 3000), (before[0], before[1]))
    drag(page, start, (start[0] + 30, start[1]))
    wait(page, lambda: tool.people("0.jpg")[0]["joints"][ELBOW][0] > before[0] + 50)
    page.locator("#items li").nth(499).click()
    wait(page, lambda: "499.png" in (page.locator("#items li.now").text_content() or ""))
    assert not tool.errors
    assert tool.stop() == 0


def test_a_broken_image_is_said_and_the_others_go_on(tool: Tool, context: Any) -> None:
    (tool.folder / "1.png").write_bytes(b"no image any more")
    page = tool.open(context)
    page.locator("#items li").nth(1).click()
    wait(page, lambda: "cannot be decoded" in (page.locator("#state").text_content() or ""))
    page.locator("#items li").nth(2).click()
    wait(page, lambda: "2.png" in (page.locator("#items li.now").text_content() or ""))


def test_what_cannot_be_served_is_one_sentence(tmp_path: Path, tool: Tool) -> None:
    for arguments, reason in (
        ([str(tool.folder), "--port", "0"], "another run"),
        ([str(tmp_path / "none")], "not a folder"),
        ([str(tool.folder), "--host", "0.0.0.0"], "does not name a machine"),
    ):
        command = [sys.executable, "-m", "flowing_puppet_ros", "annotate", *arguments]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
        assert done.returncode == 2
        assert reason in done.stderr and len(done.stderr.splitlines()) == 1
