# SPDX-License-Identifier: Apache-2.0
"""Runs the verb `fit` in this process, with settings so fast that limbs may be wrong."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from flowing_puppet_ros.cli import main

FAST = ["--particles", "4", "--iterations", "3", "--local-particles", "4", "--local-iterations", "0", "--restarts", "0"]
FAST += ["--levenberg-steps", "2", "--gauss-newton-steps", "10", "--max-points", "1500", "--no-nonrigid"]
FAST += ["--max-limb-repairs", "0"]


def fitted(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> tuple[int, list[dict[str, Any]], list[str]]:
    """Return the exit status, the JSON objects and the sentences on stderr."""
    status = main(["fit", *map(str, arguments), "--json"])
    output = capsys.readouterr()
    sentences = [line for line in output.err.replace("\r", "\n").splitlines() if "flowing-puppet fit:" in line]
    assert "Traceback" not in output.err
    return status, [json.loads(line) for line in output.out.splitlines()], sentences
