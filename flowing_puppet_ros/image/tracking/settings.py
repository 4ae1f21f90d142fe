# SPDX-License-Identifier: Apache-2.0
"""Settings of tracking and of smoothing after it."""

from __future__ import annotations

from dataclasses import dataclass

from flowing_puppet_ros.settings import Settings, setting


@dataclass(frozen=True)
class TrackerSettings(Settings):
    """How people are propagated, corrected by detections, started and dropped."""

    detection_deviation: float = setting(
        0.015,
        "standard deviation of a detected joint of confidence 1",
        unit="m",
        low=0.001,
        high=0.5,
        advanced=True,
    )
    flow_deviation: float = setting(
        0.007,
        "standard deviation that the flow adds to a joint in each image",
        unit="m",
        low=0.0005,
        high=0.5,
        advanced=True,
    )
    gate: float = setting(3.5, "standard deviations beyond which a detected joint is an outlier", low=1.0, high=100.0)
    outliers_to_accept: int = setting(
        3, "outliers in a row at one place after which the joint moves there", low=1, high=100, advanced=True
    )
    match_distance: float = setting(
        0.5, "maximum median distance of joints between a detection and its track", unit="m", low=0.01, high=10.0
    )
    min_joints: int = setting(
        5, "minimum number of known joints of a detection that starts a track", low=3, high=15, advanced=True
    )
    max_people: int = setting(8, "maximum number of people tracked at once", low=1, high=100)
    max_unmatched_images: int = setting(
        300, "images without a matched detection after which a track is dropped", low=1, high=100000
    )
    max_missed_detections: int = setting(
        15, "detector runs without a match after which a track is dropped", low=1, high=100000
    )
    seed: int = setting(0, "picks the letters that ids begin with", low=0, high=1_000_000)


@dataclass(frozen=True)
class SmoothingSettings(Settings):
    """How joints are smoothed over time."""

    flow_weight: float = setting(10.0, "weight of the flow relative to the detections", low=0.0, high=1000.0)
    detection_width: float = setting(0.016, "distance beyond which a detection counts less", unit="m",
                                     low=0.001, high=1.0)  # fmt: skip
    flow_width: float = setting(0.005, "distance beyond which the flow counts less", unit="m",
                                low=0.0005, high=1.0)  # fmt: skip
