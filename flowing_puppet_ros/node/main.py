# SPDX-License-Identifier: Apache-2.0
"""The programs that start the nodes: one function each, which runs its node until it is interrupted.

`python -m flowing_puppet_ros.node.main NAME` starts the node NAME if its program is not installed.
"""

from __future__ import annotations

import sys

from flowing_puppet_ros.node.runner import run

_COMPONENT_NODE = "flowing_puppet_ros.node.component_node"


def optical_flow(arguments: list[str] | None = None) -> int:
    """Estimate dense forward and backward optical flow between images."""
    return run("optical_flow", optical_flow.__doc__, _COMPONENT_NODE, arguments)


def puppet_tracker(arguments: list[str] | None = None) -> int:
    """Track people in images, with or without detections, as flowing puppets."""
    return run("puppet_tracker", puppet_tracker.__doc__, _COMPONENT_NODE, arguments)


def visual_hull(arguments: list[str] | None = None) -> int:
    """Carve the visual hull of a person from images, part labels and puppets of calibrated cameras."""
    return run("visual_hull", visual_hull.__doc__, _COMPONENT_NODE, arguments)


def body_fitter(arguments: list[str] | None = None) -> int:
    """Fit bodies to point clouds, depth images or silhouettes; the action fit_body fits one cloud on request."""
    return run("body_fitter", body_fitter.__doc__, "flowing_puppet_ros.node.body_fitter_node", arguments)


if __name__ == "__main__":
    sys.exit(globals()[sys.argv[1]](sys.argv[2:]))
