# SPDX-License-Identifier: Apache-2.0
"""Point clouds or silhouettes in, fitted bodies out; the action fit_body fits one cloud on request."""

from __future__ import annotations

import sys

from flowing_puppet_ros.node.runner import run


def main(arguments: list[str] | None = None) -> int:
    """Run the node until it is interrupted; return the exit status."""
    return run("body_fitter", __doc__, "flowing_puppet_ros.node.body_fitter_node", arguments)


if __name__ == "__main__":
    sys.exit(main())
