# SPDX-License-Identifier: Apache-2.0
"""What the README shows is true: every bash block parses, and those fenced as `bash test` run.

The tested blocks run in order in one folder that looks like the clone, so relative paths work and outputs (`out/`)
stay out of the clone.
"""

import os
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FENCE = re.compile(r"^```(bash(?: test)?)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks(text: str) -> list[tuple[str, str]]:
    """Return (info string, code) of the bash blocks of a Markdown text."""
    return [(match[1], match[2]) for match in FENCE.finditer(text)]


def readme_blocks() -> list[tuple[str, str]]:
    """Return the bash blocks of the README."""
    return blocks((ROOT / "README.md").read_text())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with links to everything of the clone but its outputs."""
    made = tmp_path_factory.mktemp("readme")
    for item in ROOT.iterdir():
        if item.name not in ("out", ".git"):
            (made / item.name).symlink_to(item)
    return made


def run(code: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a block as a reader would paste it, stopping at the first command that fails."""
    clean = {name: value for name, value in os.environ.items() if name != "_ROS_WHEELS_BOOTSTRAP_COMPLETE"}
    command = ["bash", "-euo", "pipefail", "-c", code]
    return subprocess.run(command, cwd=folder, env=clean, stdin=subprocess.DEVNULL, capture_output=True, text=True)


def test_blocks_are_found() -> None:
    text = "Intro\n```bash\nmake demo\n```\ntext\n```bash test\necho 1\necho 2\n```\n```python\nx\n```\n"
    assert blocks(text) == [("bash", "make demo\n"), ("bash test", "echo 1\necho 2\n")]


def test_a_block_stops_at_its_first_failure(tmp_path: Path) -> None:
    done = run("echo before\nfalse\necho after\n", tmp_path)
    assert (done.returncode, done.stdout) == (1, "before\n")


def test_every_block_parses() -> None:
    for _, code in readme_blocks():
        done = subprocess.run(["bash", "-n"], input=code, capture_output=True, text=True)
        assert done.returncode == 0, f"{code}\n{done.stderr}"


def test_named_launch_files_exist() -> None:
    named = set(re.findall(r"[a-z_]+\.launch\.py", (ROOT / "README.md").read_text()))
    assert named <= {path.name for path in (ROOT / "launch").iterdir()}


def test_tested_blocks_run(folder: Path) -> None:
    tested = [code for info, code in readme_blocks() if info == "bash test"]
    assert tested, "README.md has no block fenced as `bash test`"
    for code in tested:
        done = run(code, folder)
        assert done.returncode == 0, f"{code}\n{done.stdout}\n{done.stderr}"
