# SPDX-License-Identifier: Apache-2.0
"""Frames of recordings: those that never move, which ROS 1 and Foxglove repeat on /tf, and those of people."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

MAX_CHANGE = 1e-9
"""Of metres and of the parts of a quaternion; what is measured changes by more."""


def find_static_transforms(messages: Iterable[Any]) -> list[Any]:
    """Return one TransformStamped of every child frame in the TFMessages whose parent and pose are always the same."""
    first: dict[str, Any] = {}
    moving: set[str] = set()
    for message in messages:
        for item in message.transforms:
            child = item.child_frame_id.lstrip("/")
            known = first.setdefault(child, item)
            if child not in moving and known is not item and _differ(known, item):
                moving.add(child)
    return [item for child, item in first.items() if child not in moving]


def _differ(one: Any, other: Any) -> bool:
    if one.header.frame_id.lstrip("/") != other.header.frame_id.lstrip("/"):
        return True
    return bool(np.abs(_values(one) - _values(other)).max() > MAX_CHANGE)


def _values(item: Any) -> Any:
    t, q = item.transform.translation, item.transform.rotation
    return np.array([t.x, t.y, t.z, q.x, q.y, q.z, q.w])


def is_of_people(message: Any) -> bool:
    """Return whether a TFMessage tells where bodies are (REP-155), as a body fitter publishes them.

    Its frames are `body_<id>`, after the fitter's `output.frame_prefix`, or hang on such a frame of the same message.
    """
    bodies = {item.child_frame_id for item in message.transforms if "body_" in item.child_frame_id}
    own = [item.child_frame_id in bodies or item.header.frame_id in bodies for item in message.transforms]
    return bool(own) and all(own)
