# SPDX-License-Identifier: Apache-2.0
"""Images, part labels and puppets of calibrated cameras in; silhouettes, joints and visual hull out."""

from __future__ import annotations

import sys

from flowing_puppet_ros.node.runner import run


def main(arguments: list[str] | None = None) -> int:
    """Run the node until it is interrupted; return the exit status."""
    return run("visual_hull", __doc__, "flowing_puppet_ros.node.component_node", arguments)


if __name__ == "__main__":
    sys.exit(main())
