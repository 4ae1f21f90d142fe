# SPDX-License-Identifier: Apache-2.0
"""Settings of fits, tracking and segmentation, apart from what they set: a parser needs no more."""

from __future__ import annotations

from dataclasses import dataclass

from flowing_puppet_ros.settings import Settings, setting


@dataclass(frozen=True, slots=True)
class FitterSettings(Settings):
    """Settings of `BodyFitter`; the defaults are fast, the thesis has 80 particles and 120 iterations."""

    particles: int = setting(20, "particles per part", low=4, high=1000)
    iterations: int = setting(25, "iterations of the search when the pose is unknown", low=1, high=10000)
    local_particles: int = setting(
        20, "particles per part when the pose is roughly known", low=4, high=1000, advanced=True
    )
    local_iterations: int = setting(
        16, "iterations of the search when the pose is roughly known", low=0, high=10000, advanced=True
    )
    levenberg_steps: int = setting(4, "Levenberg-Marquardt steps per new particle", low=0, high=50, advanced=True)
    gauss_newton_steps: int = setting(15, "Gauss-Newton steps of the final refinement", low=0, high=200, advanced=True)
    max_points: int = setting(10000, "points that a cloud is downsampled to", low=200, high=200000, advanced=True)
    joint_weight: float = setting(
        0.02, "weight of an initial joint relative to the whole cloud", low=0.0, high=100.0, advanced=True
    )
    clip_factor: float = setting(
        2.0,
        "limb radii around the initial joints' bones to which a cloud is cropped; 0: not cropped",
        low=0.0,
        high=20.0,
        advanced=True,
    )
    restarts: int = setting(
        1,
        "larger searches from new starts while no body is close to the cloud and reliable",
        low=0,
        high=20,
        advanced=True,
    )
    restart_distance: float = setting(
        0.02, "two-way distance below which a body is close to the cloud", unit="m", low=0.0, high=1.0, advanced=True
    )
    max_limb_repairs: int = setting(
        3, "maximum rounds in which limbs that seem misplaced are searched again", low=0, high=20, advanced=True
    )
    nonrigid: bool = setting(True, "refine the surface beyond the model where a whole cloud is dense", advanced=True)
    threads: int = setting(2, "threads, at most one per core; the result does not depend on it", low=1, high=64)
    seed: int = setting(0, "seed of all random draws", low=0)


@dataclass(frozen=True)
class SegmentationSettings(Settings):
    """Settings of `segment_people`."""

    max_people: int = setting(30, "maximum number of people taken from a cloud, by score", low=1, high=100)
    max_range: float = setting(
        30.0, "distance from the sensor beyond which points are dropped", unit="m", low=0.5, high=1000.0
    )
    sensor_height: float = setting(
        0.0,
        "height of the sensor over the floor, for clouds that show no floor; 0: not known",
        unit="m",
        low=0.0,
        high=20.0,
        advanced=True,
    )
    plane_clearance: float = setting(
        0.05,
        "distance from the floor or a wall up to which points belong to it",
        unit="m",
        low=0.005,
        high=0.5,
        advanced=True,
    )
    max_gap: float = setting(
        0.12,
        "maximum gap between points of one person up to 4 m from the sensor; grows with distance beyond",
        unit="m",
        low=0.02,
        high=1.0,
        advanced=True,
    )
    min_points: int = setting(60, "minimum number of points of a person", low=50, high=100000, advanced=True)
    min_score: float = setting(0.5, "minimum score of a cluster to count as a person", low=0.0, high=1.0, advanced=True)


@dataclass(frozen=True)
class BodyTrackerSettings(Settings):
    """Settings of `BodyTracker`."""

    max_points: int = setting(
        5000,
        "points that a tracked cloud from all sides is downsampled to",
        low=200,
        high=200000,
        advanced=True,
    )
    gauss_newton_steps: int = setting(
        5,
        "Gauss-Newton steps per cloud; at most 3 where a camera's puppets show the joints, and in live scans",
        low=1, high=100, advanced=True,
    )  # fmt: skip
    lost_ratio: float = setting(
        1.3,
        "two-way distance, relative to the best since the last search, beyond which the track is lost",
        low=1.0,
        high=10.0,
        advanced=True,
    )
    lost_distance: float = setting(0.001, "distance added to that bound", unit="m", low=0.0, high=1.0, advanced=True)
    max_time_gap: float = setting(
        0.5,
        "time between clouds beyond which the motion is not extrapolated",
        unit="s",
        low=0.01,
        high=60.0,
        advanced=True,
    )
