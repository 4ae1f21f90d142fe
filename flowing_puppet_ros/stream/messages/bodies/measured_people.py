# SPDX-License-Identifier: Apache-2.0
"""People's measurements as a message."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from flowing_puppet_ros.stream.messages.message_types import MEASUREMENTS, MessageFactory

if TYPE_CHECKING:
    from flowing_puppet_ros.body.track.tracked_body import TrackedBody


def make_measurements(
    factory: MessageFactory, header: Any, people: Sequence[tuple[TrackedBody, Mapping[str, float]]]
) -> Any:
    """Return the BodyMeasurementsArray of bodies, each with its measurements as of `measure_fit`."""
    measured = [
        factory.make(
            "flowing_puppet_msgs/msg/BodyMeasurements",
            id=body.id,
            reliable=body.fit.reliable,
            confidence=body.fit.confidence,
            **sizes,
        )
        for body, sizes in people
    ]
    return factory.make(MEASUREMENTS, header=header, people=measured)
