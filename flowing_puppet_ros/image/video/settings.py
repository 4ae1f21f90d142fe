# SPDX-License-Identifier: Apache-2.0
"""When the detector runs: on a stream, in time with it, and on a clip that is known as a whole."""

from __future__ import annotations

from dataclasses import dataclass

from flowing_puppet_ros.flow.settings import FlowSettings
from flowing_puppet_ros.image.arms.viterbi import ArmPathSettings
from flowing_puppet_ros.image.thesis_loop.settings import EnergySettings, LoopSettings
from flowing_puppet_ros.image.tracking.settings import SmoothingSettings, TrackerSettings
from flowing_puppet_ros.settings import Settings, nested, setting


@dataclass(frozen=True)
class NetworkTimingSettings(Settings):
    """When keypoint networks run on the images of a stream."""

    looks: float = setting(
        30.0,
        "close looks at the tracked person that the machine has time for; half as many where several are tracked, which"
        " takes longer too, one of them at a time",
        unit="1/s",
        low=0.1,
        high=1e6,
    )
    min_wait: float = setting(
        0.07,
        "time between images from which on each waits for the look at itself; in faster streams the next one uses it",
        unit="s",
        low=0.0,
        high=10.0,
        advanced=True,
    )
    everybody_interval: float = setting(
        1.0, "time between searches for everybody while people are tracked", unit="s", low=0.0, high=3600.0
    )
    search_interval: float = setting(
        0.1, "time between searches while nobody is tracked", unit="s", low=0.0, high=3600.0, advanced=True
    )


@dataclass(frozen=True)
class LiveDetectionSettings(Settings):
    """When people are looked for in the images of a stream, and by whom."""

    source: str = setting(
        "auto",
        "who finds people: auto: the detections topic where somebody publishes on it, else the keypoint networks where"
        " they are installed, else the package's own detector; neural: the networks; own: that detector; none: the"
        " detections topic alone",
        choices=("auto", "neural", "own", "none"),
    )
    network: str = setting(
        "",
        "description file (YAML) of a keypoint network of your own, ONNX or TFLite, in place of the package's",
        advanced=True,
    )
    networks: NetworkTimingSettings = nested(NetworkTimingSettings)
    min_probability: float = setting(0.3, "minimum probability of a detected person to be tracked", low=0.0, high=1.0)
    full_frame_interval: float = setting(
        2.0, "time between full-frame detections while all tracked people are confirmed", unit="s", low=0.0, high=3600.0
    )
    search_interval: float = setting(
        0.7,
        "time between full-frame detections while nobody is tracked, or somebody not yet confirmed",
        unit="s",
        low=0.0,
        high=3600.0,
        advanced=True,
    )
    confirming_full_frames: int = setting(
        1, "full-frame detections that confirm a person", low=1, high=1000, advanced=True
    )
    full_frame_delay: float = setting(
        0.4,
        "age at which the result of a full-frame detection is used; three times that while people are tracked",
        unit="s",
        low=0.0,
        high=10.0,
        advanced=True,
    )
    roi_interval: float = setting(
        0.2, "time between re-detections in the region (ROI) of each known person", unit="s", low=0.0, high=3600.0
    )
    roi_delay: float = setting(
        0.13,
        "age at which the result of an ROI re-detection is used, for each person in it; 0: in its own image",
        unit="s",
        low=0.0,
        high=10.0,
        advanced=True,
    )


EVERY_IMAGE = LiveDetectionSettings(
    full_frame_interval=0.33,
    search_interval=0.0,
    confirming_full_frames=5,
    full_frame_delay=0.0,
    roi_interval=0.0,
    roi_delay=0.0,
    networks=NetworkTimingSettings(looks=1e6, min_wait=0.0, everybody_interval=0.33, search_interval=0.0),
)
"""For recordings, where the detector takes the time it needs: people are re-detected in every image."""


@dataclass(frozen=True)
class ClipDetectionSettings(Settings):
    """When the detector runs on the images of a clip."""

    min_probability: float = setting(
        0.3,
        "minimum probability of a detected person to be tracked; the most probable one needs a third of it",
        low=0.0,
        high=1.0,
    )
    stride: int = setting(2, "images from one full-frame detection to the next", low=1, high=10000)


@dataclass(frozen=True)
class ThesisSettings(Settings):
    """Settings of the loop of the thesis."""

    loop: LoopSettings = nested(LoopSettings)
    energy: EnergySettings = nested(EnergySettings)


@dataclass(frozen=True)
class ClipSettings(Settings):
    """Settings of all that a clip goes through."""

    tracker: TrackerSettings = nested(TrackerSettings)
    flow: FlowSettings = nested(FlowSettings)
    detection: ClipDetectionSettings = nested(ClipDetectionSettings)
    arms: ArmPathSettings = nested(ArmPathSettings)
    smoothing: SmoothingSettings = nested(SmoothingSettings)
    thesis: ThesisSettings = nested(ThesisSettings)
