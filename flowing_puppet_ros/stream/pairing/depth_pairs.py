# SPDX-License-Identifier: Apache-2.0
"""Depth images paired with their calibration."""

from __future__ import annotations

from typing import Any

from flowing_puppet_ros.reporting import Report
from flowing_puppet_ros.stream.messages.geometry import stamp_ns
from flowing_puppet_ros.stream.pairing.stamp_buffer import PendingQueue, StampBuffer


class DepthPairs:
    """Pairs depth images with their camera_info by the stamp.

    A depth image without a camera_info of its stamp is paired with the newest camera_info once the next depth image
    arrives: some drivers stamp it differently or send it only once, and calibrations rarely change. How many are so is
    counted in the report, which is told by how much the stamps differ.
    """

    def __init__(self, report: Report | None = None) -> None:
        """Start with nothing that waits."""
        self._report = report or Report()
        self._images = PendingQueue()
        self._infos = StampBuffer()
        self._newest_info: Any = None

    def reset(self) -> None:
        """Drop the images that wait; keep the newest calibration."""
        self._images.clear()
        self._infos.clear()

    def add(self, port: str, message: Any) -> list[tuple[Any, Any]]:
        """Add a message of `depth` or `camera_info`; return the pairs (image, info or None) that are now complete."""
        if port == "depth":
            self._images.waiting.append((stamp_ns(message), message))
        else:
            self._newest_info = message
            self._infos.put(stamp_ns(message), message)
        return self._pop_pairs(final=False)

    def flush(self) -> list[tuple[Any, Any]]:
        """Return the pairs of the images that still wait."""
        return self._pop_pairs(final=True)

    def _pop_pairs(self, final: bool) -> list[tuple[Any, Any]]:
        pairs = []
        while self._images.waiting:
            stamp, image = self._images.waiting[0]
            info = self._infos.get(stamp)
            if info is None and len(self._images.waiting) < 2 and not final:
                break
            self._images.pop()
            self._infos.drop_until(stamp)
            if info is None and self._newest_info is not None:
                self._tell(stamp, self._newest_info)
            pairs.append((image, info or self._newest_info))
        return pairs

    def _tell(self, stamp: int, info: Any) -> None:
        self._report.counters["depth with camera_info of another stamp"] += 1
        self._report.warn(
            f"a depth image has no camera_info of its stamp: it is used with one whose stamp differs by "
            f"{abs(stamp_ns(info) - stamp) * 1e-6:.0f} ms"
        )
