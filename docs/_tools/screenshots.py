# SPDX-License-Identifier: Apache-2.0
"""Photograph the report and the annotation page for the pages: `make screenshots`, after `make demo-rgbd`."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from flowing_puppet_ros.annotate.store import FILE_NAME  # noqa: E402
from flowing_puppet_ros.bag.reader import open_bag  # noqa: E402
from flowing_puppet_ros.draw.pictures import save  # noqa: E402
from flowing_puppet_ros.stream.messages.images import decode_image  # noqa: E402
from flowing_puppet_ros.stream.messages.message_types import COMPRESSED_IMAGE, IMAGE  # noqa: E402
from scripts.ensure_browser import NAMES  # noqa: E402

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

FOLDER = ROOT / "docs" / "drawn"
RECORDING, REPORT = ROOT / "bags" / "cache" / "rgbd", ROOT / "out" / "rgbd.html"
WIDE, HIGH = 1200, 860  # px, of the window
WIDTH = 760  # px, of the pictures
DRAWN_IN_3D = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")
PATIENCE_MS = 180_000


def photograph_report(browser: Browser) -> bytes:
    """Return a picture of the middle of the report's recording."""
    page = open_page(browser, REPORT.as_uri(), ".timeline[data-frame]")
    page.locator(".scrub input").evaluate(
        "slider => { slider.value = slider.max / 2; slider.dispatchEvent(new Event('input')) }"
    )
    page.evaluate("document.querySelector('canvas').scrollIntoView({block: 'center'})")
    page.wait_for_timeout(3000)
    return page.screenshot()


def photograph_annotation(browser: Browser) -> bytes:
    """Return a picture of the annotation page on an image of the recording, with the people that it finds."""
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / "photos"
        folder.mkdir()
        image = next(
            decode_image(record.message)
            for record in open_bag(RECORDING).messages()
            if record.type in (IMAGE, COMPRESSED_IMAGE) and "color" in record.topic
        )
        save(image, folder / "people.png")
        command = [sys.executable, "-m", "flowing_puppet_ros", "annotate", str(folder), "--port", "0"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as tool:
            assert tool.stdout is not None
            address = next(word for word in tool.stdout.readline().split() if word.startswith("http"))
            try:
                page = open_page(browser, address, "body[data-ready]")
                page.get_by_text("Find people").click()
                while not (folder / FILE_NAME).is_file():
                    page.wait_for_timeout(1000)
                return page.screenshot()
            finally:
                tool.terminate()


def open_page(browser: Browser, address: str, ready: str) -> Page:
    """Return a page as soon as it has what the selector `ready` finds."""
    page = browser.new_page(viewport={"width": WIDE, "height": HIGH})
    page.set_default_timeout(PATIENCE_MS)
    page.goto(address)
    page.wait_for_selector(ready)
    return page


PICTURES: dict[str, Callable[[Browser], bytes]] = {
    "page_report": photograph_report,
    "page_annotate": photograph_annotation,
}


def main() -> int:
    """Write all pictures into docs/drawn; return the exit status."""
    program = next(filter(None, map(shutil.which, NAMES)), None)
    if program is None or not REPORT.is_file():
        print("screenshots need Chromium, and the report of `make demo-rgbd`", file=sys.stderr)
        return 2
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=list(DRAWN_IN_3D))
        for name, photograph in PICTURES.items():
            shot = cv2.imdecode(np.frombuffer(photograph(browser), np.uint8), cv2.IMREAD_COLOR)
            assert shot is not None
            height = round(shot.shape[0] * WIDTH / shot.shape[1])
            small = cv2.resize(shot, (WIDTH, height), interpolation=cv2.INTER_AREA)
            cv2.imwrite(str(FOLDER / f"{name}.png"), small, [cv2.IMWRITE_PNG_COMPRESSION, 9])
        browser.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
