# SPDX-License-Identifier: Apache-2.0
"""Resolve requirements/*.txt again and write the exact versions to lock.txt and lock-noble.txt there (`make lock`)."""

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

FOLDER = Path(__file__).resolve().parent.parent / "requirements"
EXTRAS = ("annotate", "cluster", "learn", "neural", "report", "scans", "video")
LOCKS: dict[str, tuple[Sequence[str], Sequence[str]]] = {
    "lock.txt": (("runtime", *EXTRAS, "dev", "docs", "build", "ros"), ()),
    "lock-noble.txt": (("runtime", "neural", "dev", "build", "ros"), ("noble",)),
}
"""The files with the lists that they lock, and with lists of versions to keep to."""
HEADER = """# SPDX-License-Identifier: Apache-2.0
# Exact versions of what {target} installs; `make lock` writes this file.
"""
TARGETS = {"lock.txt": "`make venv`", "lock-noble.txt": "`make test-noble`"}


def resolve(names: Sequence[str], constraints: Sequence[str]) -> list[str]:
    """Return what pip would install into an empty environment, as `name==version`."""
    lists = [part for name in names for part in ("-r", str(FOLDER / f"{name}.txt"))]
    lists += [part for name in constraints for part in ("-c", str(FOLDER / f"{name}.txt"))]
    command = [sys.executable, "-m", "pip", "install", "--dry-run", "--quiet", "--ignore-installed", "--report", "-"]
    report = json.loads(subprocess.run([*command, *lists], check=True, capture_output=True, text=True).stdout)
    return sorted(f"{item['metadata']['name'].lower()}=={item['metadata']['version']}" for item in report["install"])


def main() -> None:
    """Write down what pip would install into empty environments."""
    for name in sys.argv[1:] or LOCKS:
        pins = resolve(*LOCKS[name])
        (FOLDER / name).write_text(HEADER.format(target=TARGETS[name]) + "".join(f"{pin}\n" for pin in pins))


if __name__ == "__main__":
    main()
