# SPDX-License-Identifier: Apache-2.0
"""Fits bodies to the silhouettes of people."""

from __future__ import annotations

from typing import Any

from flowing_puppet_ros.body.track.tracked_body import BodyMotion, TrackedBody
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet
from flowing_puppet_ros.multiview.silhouette_fit import SilhouetteFitter, SilhouetteFitterSettings
from flowing_puppet_ros.stream.messages.bodies.silhouettes import decode_silhouettes
from flowing_puppet_ros.stream.messages.geometry import stamp_ns
from flowing_puppet_ros.stream.messages.puppets import decode_body_joints

_MAX_AGE_NS = 1_000_000_000
"""Maximum age of a person's last body as the start of the next fit, nanoseconds."""


class SilhouetteBodies:
    """Fits the person of each SilhouetteSet; remembers every person's last reliable body for a second."""

    def __init__(self, model: StitchedPuppet, settings: SilhouetteFitterSettings) -> None:
        """Prepare to fit `model`."""
        self._fitter = SilhouetteFitter(model, settings)
        self._last: dict[str, tuple[int, BodyState]] = {}
        self._motions: dict[str, BodyMotion] = {}

    def reset(self) -> None:
        """Forget all people."""
        self._last.clear()
        self._motions.clear()

    def fit(self, message: Any) -> TrackedBody:
        """Fit the person in a SilhouetteSet. InputError when it cannot be fitted."""
        identity, stamp = message.person.id or "b1", stamp_ns(message)
        last_stamp, last_state = self._last.get(identity, (stamp, None))
        if not 0 <= stamp - last_stamp <= _MAX_AGE_NS:
            last_state = None
        fit = self._fitter.fit(decode_silhouettes(message), decode_body_joints(message.person), last_state)
        if fit.reliable:
            self._last[identity] = stamp, fit.state
        return self._motions.setdefault(identity, BodyMotion()).add(identity, stamp, fit)
