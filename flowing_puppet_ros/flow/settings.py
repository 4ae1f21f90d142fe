# SPDX-License-Identifier: Apache-2.0
"""Settings of the optical flow."""

from __future__ import annotations

from dataclasses import dataclass

from flowing_puppet_ros.settings import Settings, setting

PRESETS = ("ultrafast", "fast", "medium")
"""Presets of DIS, the fastest first."""


@dataclass(frozen=True)
class FlowSettings(Settings):
    """How the dense flow is computed."""

    preset: str = setting("medium", "DIS preset: medium is more accurate, fast is for live use", choices=PRESETS)
    max_side: int = setting(640, "longest image side the flow is computed at", unit="px", low=32, high=8192)
