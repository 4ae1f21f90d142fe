# SPDX-License-Identifier: Apache-2.0
"""What every test runs under: an own ROS domain on this machine only, one thread a library, one browser."""

import fcntl
import os
import shutil
import signal
import tempfile
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

import hypothesis
import pytest

from scripts.ensure_browser import NAMES

if TYPE_CHECKING:
    from playwright.sync_api import Browser

    from flowing_puppet_ros.model.sp import StitchedPuppet


def lock_ros_domain() -> int:
    """Return a ROS domain that no other test process of this machine uses; a lock holds it until this one ends."""
    # Below 102 no domain's ports meet the ports that Linux gives to other programs.
    for number in range(os.getpid(), os.getpid() + 100):
        domain = 1 + number % 100
        try:
            path = f"{tempfile.gettempdir()}/flowing_puppet_ros_domain_{domain}.lock"
            lock = os.open(path, os.O_CREAT | os.O_RDWR, 0o666)
        except PermissionError:
            continue
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(lock)
        else:
            return domain
    raise RuntimeError("every ROS domain from 1 to 100 is in use by tests")


os.environ["ROS_DOMAIN_ID"] = str(lock_ros_domain())
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
# A shell's background job ignores interrupts, and so would the programs that the tests start and interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)

# How long an example takes depends on what else the machine does.
hypothesis.settings.register_profile("here", deadline=None)
hypothesis.settings.load_profile("here")

# Without these Chromium asks its maker's servers for updates, and needs a sandbox that root has not got.
BROWSER_FLAGS = (
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)


# Drawn in 3D by the processor, since a test machine may have no graphics card.
DRAWING_FLAGS = (
    *(flag for flag in BROWSER_FLAGS if flag != "--disable-gpu"),
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"),
)


@pytest.fixture(scope="session")
def model() -> "StitchedPuppet":
    """Return the shipped neutral model, which cannot be changed."""
    # Not at the top: Numba reads the number of threads, set above, when it is first imported.
    from flowing_puppet_ros.model.sp import StitchedPuppet

    return StitchedPuppet.load("neutral")


@pytest.fixture(scope="session")
def chromium() -> Iterator[Callable[[Sequence[str]], "Browser"]]:
    """Return what starts a headless Chromium with some flags."""
    program = next(filter(None, map(shutil.which, NAMES)), None)
    if program is None:
        pytest.skip("no Chromium on this machine")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        yield lambda flags: playwright.chromium.launch(executable_path=program, args=list(flags))


@pytest.fixture(scope="session")
def browser(chromium: Callable[[Sequence[str]], "Browser"]) -> Iterator["Browser"]:
    """Return a headless Chromium."""
    started = chromium(BROWSER_FLAGS)
    yield started
    started.close()


@pytest.fixture(scope="session")
def drawing_browser(chromium: Callable[[Sequence[str]], "Browser"]) -> Iterator["Browser"]:
    """Return a headless Chromium that has WebGL."""
    started = chromium(DRAWING_FLAGS)
    yield started
    started.close()
