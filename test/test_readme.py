# SPDX-License-Identifier: Apache-2.0
"""What README and docs show is true: every command names what exists, and blocks fenced as `test` run.

The tested blocks run in the order of their page in one folder that looks like the clone, so relative paths work and
outputs (`out/`) stay out of the clone.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from shown_commands import ROOT, WrongCommand, blocks, check, commands, pages  # type: ignore[import-not-found]

PAGES = pages()
TESTED = [page for page in PAGES if any(info.endswith("test") for info, _ in blocks(page.read_text()))]


def name(page: Path) -> str:
    """Return what a page is called in the list of tests."""
    return str(page.relative_to(ROOT))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with links to everything of the clone but its outputs."""
    made = tmp_path_factory.mktemp("clone")
    for item in ROOT.iterdir():
        if item.name not in ("out", ".git"):
            (made / item.name).symlink_to(item)
    return made


def run(info: str, code: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a block as a reader would paste it, stopping at the first command that fails."""
    clean = {name: value for name, value in os.environ.items() if name != "_ROS_WHEELS_BOOTSTRAP_COMPLETE"}
    shell = ["bash", "-euo", "pipefail", "-c"] if info.startswith("bash") else [sys.executable, "-c"]
    return subprocess.run(
        [*shell, code], cwd=folder, env=clean, stdin=subprocess.DEVNULL, capture_output=True, text=True
    )


def test_blocks_are_found() -> None:
    text = "Intro\n```bash\nmake demo\n```\ntext\n```bash test\necho 1\necho 2\n```\n```python test\nx\n```\n"
    assert blocks(text) == [("bash", "make demo\n"), ("bash test", "echo 1\necho 2\n"), ("python test", "x\n")]


def test_a_block_stops_at_its_first_failure(tmp_path: Path) -> None:
    done = run("bash", "echo before\nfalse\necho after\n", tmp_path)
    assert (done.returncode, done.stdout) == (1, "before\n")


@pytest.mark.parametrize(
    "wrong",
    [
        "flowing-puppet fly a.ply",
        "flowing-puppet fit a.ply --out fits --wings 2",
        "flowing-puppet fit a.ply",
        "body_fitter --ros-args -r ponits:=/cloud",
        "body_fitter --ros-args -p wings:=2",
        "make coffee",
        "ros2 launch flowing_puppet_ros cameras.launch.py camera:=one",
        "frobnicate",
    ],
)
def test_wrong_commands_are_noticed(wrong: str) -> None:
    with pytest.raises(WrongCommand):
        check(next(commands(wrong)))


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_every_block_parses_and_names_what_exists(page: Path) -> None:
    for info, code in blocks(page.read_text()):
        if info.startswith("python"):
            compile(code, name(page), "exec")
            continue
        done = subprocess.run(["bash", "-n"], input=code, capture_output=True, text=True)
        assert done.returncode == 0, f"{code}\n{done.stderr}"
        for words in commands(code):
            check(words)


def test_readme_and_docs_have_blocks_that_run() -> None:
    assert ROOT / "README.md" in TESTED
    assert len(TESTED) > 3


@pytest.mark.slow
@pytest.mark.parametrize("page", TESTED, ids=name)
def test_tested_blocks_run(page: Path, folder: Path) -> None:
    for info, code in blocks(page.read_text()):
        if info.endswith("test"):
            done = run(info, code, folder)
            assert done.returncode == 0, f"{code}\n{done.stdout}\n{done.stderr}"
