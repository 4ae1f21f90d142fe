# SPDX-License-Identifier: Apache-2.0
"""Settings of verbs, which their parsers need too; it loads nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass

from flowing_puppet_ros.body.settings import FitterSettings, SegmentationSettings
from flowing_puppet_ros.image.pose.settings import PoseSettings
from flowing_puppet_ros.image.settings import DetectorSettings
from flowing_puppet_ros.settings import Settings, nested

GENDERS = ("neutral", "female", "male")


@dataclass(frozen=True)
class FitVerbSettings(Settings):
    """Settings of the fit, and of the segmentation of scenes before it."""

    fitter: FitterSettings = nested(FitterSettings)
    segmentation: SegmentationSettings = nested(SegmentationSettings)


@dataclass(frozen=True)
class PoseVerbSettings(Settings):
    """Settings of the search for a pose, and of the detector before it."""

    pose: PoseSettings = nested(PoseSettings)
    detector: DetectorSettings = nested(DetectorSettings)
