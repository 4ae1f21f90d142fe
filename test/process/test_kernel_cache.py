# SPDX-License-Identifier: Apache-2.0
"""Where compiled kernels go when the package's folder cannot be written; /proc cannot, even by root."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from flowing_puppet_ros.process.kernel_cache import VARIABLE, set_cache_folder

READ_ONLY = Path("/proc/self")


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    return tmp_path / "temporary"


def chosen(package: Path, **environment: str) -> str:
    set_cache_folder(package, environment)
    return environment.get(VARIABLE, "")


def test_a_folder_that_can_be_written_keeps_its_own(tmp_path: Path) -> None:
    assert chosen(tmp_path, HOME="/proc") == ""


def test_who_names_a_folder_decides() -> None:
    assert chosen(READ_ONLY, **{VARIABLE: "/elsewhere"}) == "/elsewhere"


def test_the_users_cache_comes_first_then_temporary_files(tmp_path: Path, temporary: Path) -> None:
    assert chosen(READ_ONLY, HOME=str(tmp_path)) == str(tmp_path / ".cache/flowing_puppet_ros")
    assert chosen(READ_ONLY, HOME="/proc", XDG_CACHE_HOME=str(tmp_path)) == str(tmp_path / "flowing_puppet_ros")
    private = temporary / f"flowing_puppet_ros-{os.getuid()}"
    assert chosen(READ_ONLY, HOME="/proc") == str(private)
    assert private.stat().st_mode & 0o777 == 0o700


def test_a_folder_in_which_others_can_write_is_not_used(temporary: Path) -> None:
    private = temporary / f"flowing_puppet_ros-{os.getuid()}"
    private.mkdir(parents=True)
    private.chmod(0o777)
    assert chosen(READ_ONLY, HOME="/proc") == ""
    private.rmdir()
    private.symlink_to("/")
    assert chosen(READ_ONLY, HOME="/proc") == ""


@pytest.mark.slow
def test_kernels_are_compiled_and_kept_there(tmp_path: Path) -> None:
    """Numba finds the folder in the environment and puts a kernel's files into it."""
    code = "import numpy, flowing_puppet_ros.draw.flow_colour as c; c.flow_to_rgb(numpy.ones((4, 4, 2), 'f4'), 1)"
    subprocess.run([sys.executable, "-c", code], env=os.environ | {VARIABLE: str(tmp_path)}, check=True)
    assert list(tmp_path.rglob("*.nbc"))
