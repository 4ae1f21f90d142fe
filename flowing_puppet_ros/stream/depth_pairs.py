# SPDX-License-Identifier: Apache-2.0
"""Depth images paired with their calibration."""

from __future__ import annotations

from typing import Any

from flowing_puppet_ros.stream.messages.geometry import stamp_ns
from flowing_puppet_ros.stream.stamp_buffer import PendingQueue, StampBuffer


class DepthPairs:
    """Pairs depth images with their camera_info by the stamp.

    A depth image whose own camera_info has not come when the next depth image does is paired with the newest there is:
    some drivers stamp it apart or send it once, and calibrations stay.
    """

    def __init__(self) -> None:
        """Start empty."""
        self._images = PendingQueue()
        self._infos = StampBuffer()
        self._newest: Any = None

    def reset(self) -> None:
        """Forget the images that wait; the calibration stays."""
        self._images.clear()
        self._infos.clear()

    def add(self, port: str, message: Any) -> list[tuple[Any, Any]]:
        """Take a message of `depth` or `camera_info`; return the pairs (image, info or None) that are complete."""
        if port == "depth":
            self._images.waiting.append((stamp_ns(message), message))
        else:
            self._newest = message
            self._infos.put(stamp_ns(message), message)
        return self._complete(final=False)

    def flush(self) -> list[tuple[Any, Any]]:
        """Return the pairs of the images that still wait."""
        return self._complete(final=True)

    def _complete(self, final: bool) -> list[tuple[Any, Any]]:
        pairs = []
        while self._images.waiting:
            stamp, image = self._images.waiting[0]
            info = self._infos.get(stamp)
            if info is None and len(self._images.waiting) < 2 and not final:
                break
            self._images.pop()
            self._infos.drop_until(stamp)
            pairs.append((image, info or self._newest))
        return pairs
