# SPDX-License-Identifier: Apache-2.0
"""Resolve requirements/*.txt again and write the exact versions to requirements/lock.txt (`make lock`)."""

import json
import subprocess
import sys
from pathlib import Path

FOLDER = Path(__file__).resolve().parent.parent / "requirements"
HEADER = """# SPDX-License-Identifier: Apache-2.0
# Exact versions of what `make venv` installs; `make lock` writes this file.
"""


def main() -> None:
    """Write down what pip would install into an empty environment."""
    extras = ("annotate", "cluster", "learn", "neural", "report", "scans", "video")
    names = ("runtime", *extras, "dev", "docs", "build", "ros")
    lists = [part for name in names for part in ("-r", str(FOLDER / f"{name}.txt"))]
    command = [sys.executable, "-m", "pip", "install", "--dry-run", "--quiet", "--ignore-installed", "--report", "-"]
    report = json.loads(subprocess.run([*command, *lists], check=True, capture_output=True, text=True).stdout)
    pins = sorted(f"{item['metadata']['name'].lower()}=={item['metadata']['version']}" for item in report["install"])
    (FOLDER / "lock.txt").write_text(HEADER + "".join(f"{pin}\n" for pin in pins))


if __name__ == "__main__":
    main()
