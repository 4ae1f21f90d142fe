# SPDX-License-Identifier: Apache-2.0
"""Settings of the association of people across cameras."""

from __future__ import annotations

from dataclasses import dataclass

from flowing_puppet_ros.settings import Settings, setting


@dataclass(frozen=True)
class AssociationSettings(Settings):
    """When people in several cameras are one person, and how long somebody who is not seen is remembered."""

    max_people: int = setting(6, "people in space at the same time", low=1, high=20)
    max_epipolar_distance: float = setting(
        0.15,
        "distance of two rays at which a joint no longer speaks for one person",
        unit="m",
        low=0.01,
        high=1.0,
        advanced=True,
    )
    max_joint_distance: float = setting(
        0.30,
        "distance of a ray from a tracked person's joint at which it no longer speaks for that person",
        unit="m",
        low=0.02,
        high=2.0,
        advanced=True,
    )
    max_mismatch: float = setting(
        0.55,
        "mean of these distances over all joints, in shares of the maximum, beyond which people are not the same",
        low=0.05,
        high=1.0,
        advanced=True,
    )
    max_view_error: float = setting(
        0.12,
        "median distance of a view's joints from the joints in space beyond which the view shows another person",
        unit="m",
        low=0.01,
        high=1.0,
        advanced=True,
    )
    confirm_sets: int = setting(
        3,
        "consecutive sets of images in which the same views must agree before they are a new person, where others are"
        " in view too",
        low=1,
        high=100,
        advanced=True,
    )
    memory: float = setting(60.0, "how long somebody who is not seen keeps the id", unit="s", low=0.1, high=86400.0)
