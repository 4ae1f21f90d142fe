# SPDX-License-Identifier: Apache-2.0
"""How high a sensor is over a floor that it does not see: as given, as last seen, or by the people who stand there.

Among walls that are near, all rays of a LiDAR at a man's height end above the floor, and what they hit lowest is no
floor. But people are of a known build: on the right floor upright bodies explain them best.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.body.segmentation.candidates import SceneHeights

STEP_M, MAX_BELOW_M = 0.2, 1.3  # between the heights that are tried, and how far below the lowest thing that is seen
WIDTH_M, PRECISION_M = 0.2, 0.01  # of the window in which heights support one another, and to which the best is told
ASKED, INTERVAL_NS = 3, 2_000_000_000
"""Scans of a stream that tell the height by the people in them, and time between two that are asked."""


class SensorHeight:
    """The height of one sensor over the floor in the scans of a stream.

    Attributes:
        is_known: whether the last scan showed a floor, or its height is known otherwise; else people's heights are
            only as likely as their build.
    """

    def __init__(self) -> None:
        """Know nothing."""
        self.reset()

    def reset(self) -> None:
        """Forget the stream."""
        self.is_known = True
        self._seen: float | None = None
        self._support: dict[int, float] = {}
        self._told, self._asked = 0, -INTERVAL_NS

    def lay_floor(
        self,
        points: F64,
        viewpoint: F64,
        stamp: int,
        given: float | None,
        rate: Callable[[SceneHeights], float],
    ) -> SceneHeights:
        """Return a scan's heights over the floor.

        Args:
            points: (N, 3) m, z up, N > 0.
            viewpoint: (3,) m, where the sensor is.
            stamp: of the scan in nanoseconds.
            given: metres, height of the sensor over the floor where it is known.
            rate: tells how well upright people explain what stands on a floor.
        """
        scene = SceneHeights.of(points, viewpoint, given)
        self.is_known = scene.floor.is_seen or given is not None
        if scene.floor.is_seen:
            self._seen = float(viewpoint[2]) - scene.floor.locate(*viewpoint[:2])
        if self.is_known:
            return scene
        if self._seen is not None:
            self.is_known = True
            return scene.lay_below(viewpoint, self._seen)
        if self._told < ASKED and not 0 <= stamp - self._asked < INTERVAL_NS:
            self._asked = stamp
            self._ask(scene, viewpoint, rate)
        height = self._find_best()
        return scene if height is None else scene.lay_below(viewpoint, height)

    def _ask(self, scene: SceneHeights, viewpoint: F64, rate: Callable[[SceneHeights], float]) -> None:
        """Add how well the people in a scan stand at heights below the lowest thing in it."""
        least = float(viewpoint[2]) - scene.floor.locate(*viewpoint[:2])
        tried = range(max(int(np.floor(least / STEP_M)), 1), int(np.ceil((least + MAX_BELOW_M) / STEP_M)))
        told = self._told
        for step in tried:
            support = rate(scene.lay_below(viewpoint, step * STEP_M))
            if support:
                self._support[step] = self._support.get(step, 0.0) + support
                self._told = told + 1

    def _find_best(self) -> float | None:
        """Return the height (m) with the most support so far, None without any."""
        if not self._support:
            return None
        order = sorted(self._support)
        steps, support = STEP_M * np.array(order), np.array([self._support[step] for step in order])
        heights = np.arange(steps[0], steps[-1] + PRECISION_M, PRECISION_M)
        window = np.exp(-0.5 * ((heights[:, None] - steps) / WIDTH_M) ** 2)
        return float(heights[(window @ support).argmax()])
