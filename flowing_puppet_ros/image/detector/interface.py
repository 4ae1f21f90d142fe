# SPDX-License-Identifier: Apache-2.0
"""The interface of a detector that finds people in single images."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from flowing_puppet_ros.arrays import Image
from flowing_puppet_ros.image.detector.detection import PersonCandidate, PersonDetection
from flowing_puppet_ros.image.settings import DetectorSettings


class DetectorLike(Protocol):
    """A detector of people in one image, such as `part_detector.PartDetector`."""

    def detect(self, image: Image, settings: DetectorSettings) -> list[PersonDetection]:
        """Return the people in an image, most confident first."""
        ...

    def propose(self, image: Image) -> list[PersonCandidate]:
        """Return all places in an image where people may be."""
        ...

    def detect_at(self, image: Image, candidates: Sequence[PersonCandidate]) -> list[PersonDetection]:
        """Return the best pose at each candidate that scores high enough there, in their order."""
        ...
