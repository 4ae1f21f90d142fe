# SPDX-License-Identifier: Apache-2.0
"""`evaluate` runs with what the package itself requires."""

import subprocess
import sys

import pytest

WITHOUT_EXTRAS = """
import sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("sklearn", "body_models"):
            raise ModuleNotFoundError(f"{name} is absent in this test", name=name)
sys.meta_path.insert(0, Absent())
from flowing_puppet_ros.cli import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["joints", "none.json", "--truth", "none.json"], "none.json cannot be read"),
        (["hands", "none.json"], "none.json cannot be read"),
        (["bodies"], "pip install 'flowing_puppet_ros[learn]'"),
    ],
)
def test_no_kind_needs_what_only_learning_needs(arguments: list[str], says: str) -> None:
    command = [sys.executable, "-c", WITHOUT_EXTRAS, "evaluate", *arguments]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2
    (line,) = done.stderr.strip().splitlines()
    assert says in line
