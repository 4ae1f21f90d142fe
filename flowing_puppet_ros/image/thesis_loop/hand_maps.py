# SPDX-License-Identifier: Apache-2.0
"""Hand maps around one person: the evidence of a window, and the flow on the same pixels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flowing_puppet_ros.arrays import Flow
from flowing_puppet_ros.evidence.image.hands import HandDetectors, HandMaps
from flowing_puppet_ros.evidence.image.likelihood import ImageEvidence
from flowing_puppet_ros.flow.estimate import resize_flow
from flowing_puppet_ros.image.pose.evidence import PersonWindow
from flowing_puppet_ros.image.tracking.propagation import ImageScale


def make_hand_maps(
    detectors: HandDetectors, window: PersonWindow, flows: Sequence[Flow], grid: ImageScale, scale: float
) -> HandMaps | None:
    """Make the maps of the hands of a person of `scale` px/m, to be queried in pixels of the image.

    `flows` lead away from the image, on the working grid of `grid`. None if the window's evidence has no skin map.
    """
    evidence = window.evidence
    if not isinstance(evidence, ImageEvidence):
        return None
    size = np.array(evidence.features.image.shape[1::-1])
    low = np.clip(np.rint(grid.to_work(window.corner)), 0, np.array(grid.work) - 1).astype(int)
    high = np.clip(np.rint(grid.to_work(window.corner + size / window.factor)), low + 1, grid.work).astype(int)
    width, height = (int(side) for side in size)
    crops = [
        resize_flow(np.ascontiguousarray(flow[low[1] : high[1], low[0] : high[0]]), (width, height)) for flow in flows
    ]
    return HandMaps.of(detectors, evidence, crops, scale * window.factor, window.corner, window.factor)
