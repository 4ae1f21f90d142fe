# SPDX-License-Identifier: Apache-2.0
"""Install Chromium for the browser tests, by apt if we are root; `make test` runs this."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
COMMAND = ("apt-get", "install", "-y", "--no-install-recommends", "chromium")


def main() -> None:
    """Install Chromium if it is missing and can be installed; without it, the browser tests are skipped."""
    if any(map(shutil.which, NAMES)):
        return
    if os.geteuid() == 0 and shutil.which("apt-get"):
        print("installing chromium for the browser tests ...", file=sys.stderr)
        environment = os.environ | {"DEBIAN_FRONTEND": "noninteractive"}
        for command in (("apt-get", "update"), COMMAND):
            subprocess.run(command, env=environment, capture_output=True)
    if not any(map(shutil.which, NAMES)):
        print("No Chromium: the browser tests are skipped; install it with your package manager.", file=sys.stderr)


if __name__ == "__main__":
    main()
