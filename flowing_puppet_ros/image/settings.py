# SPDX-License-Identifier: Apache-2.0
"""Settings of the detector of people in images."""

from __future__ import annotations

from dataclasses import dataclass

from flowing_puppet_ros.settings import Settings, setting


@dataclass(frozen=True, slots=True)
class DetectorSettings(Settings):
    """Which people to detect, and with how much effort."""

    min_shoulder_width: float = setting(
        0.0, "minimum shoulder width; 0: a twentieth of the longer image side", unit="px", low=0.0, high=1e5
    )
    max_side: int = setting(720, "longest image side at which people are detected", unit="px", low=64, high=4096)
    max_candidates: int = setting(12, "maximum number of candidates for which a pose is searched", low=1, high=80)
    max_people: int = setting(8, "maximum number of people", low=1, high=80)
    mirrored: bool = setting(True, "also detect in the mirror image: more accurate, twice as slow")
    min_confidence: float = setting(0.03, "minimum probability of a person", low=0.0, high=1.0)
