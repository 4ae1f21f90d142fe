# SPDX-License-Identifier: Apache-2.0
"""Where compiled kernels are kept from run to run: beside their sources or, where nobody may write there, elsewhere.

Compiling all of them takes a minute. Numba itself tries the package's folders and a home, and fails where there is
neither, as in a container whose file system is read-only.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import MutableMapping
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"
"""Numba reads it when it is imported; who sets it decides."""
_NAME = "flowing_puppet_ros"


def set_cache_folder(package: Path, environment: MutableMapping[str, str]) -> None:
    """Name a folder for the compiled kernels in the environment, if the `package`'s own folder cannot be written."""
    if environment.get(VARIABLE) or os.access(package, os.W_OK):
        return
    for folder in _list_folders(environment):
        if _is_own(folder):
            environment[VARIABLE] = str(folder)
            return


def _list_folders(environment: MutableMapping[str, str]) -> list[Path]:
    """Return the user's folder for caches (XDG Base Directory Specification) and one among temporary files."""
    home = environment.get("XDG_CACHE_HOME") or os.path.join(environment.get("HOME") or "/nonexistent", ".cache")
    return [Path(home) / _NAME, Path(tempfile.gettempdir()) / f"{_NAME}-{os.getuid()}"]


def _is_own(folder: Path) -> bool:
    """Make a folder if it is not there; return whether only this user can write in it: what is in it will be run."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        state = folder.stat(follow_symlinks=False)
    except OSError:
        return False
    return state.st_uid == os.getuid() and not state.st_mode & 0o022 and os.access(folder, os.W_OK | os.X_OK)
