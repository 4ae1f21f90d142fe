# SPDX-License-Identifier: Apache-2.0
"""`python without_packages.py PACKAGES VERB ...`: run a verb where packages (a,b,c) are not installed.

The top-level packages that were imported are printed at the end, as one line on stderr.
"""

import sys
from importlib.machinery import ModuleSpec, PathFinder
from typing import Any


def hide(names: set[str]) -> None:
    """Let Python find no package of these names."""
    find = PathFinder.find_spec

    def find_others(name: str, *where: Any) -> ModuleSpec | None:
        return None if name.partition(".")[0] in names else find(name, *where)

    PathFinder.find_spec = find_others  # type: ignore[assignment]


if __name__ == "__main__":
    hide(set(sys.argv[1].split(",")))
    from flowing_puppet_ros.cli import main

    status = main(sys.argv[2:])
    print("imported", *sorted({name.partition(".")[0] for name in sys.modules}), file=sys.stderr)
    sys.exit(status)
