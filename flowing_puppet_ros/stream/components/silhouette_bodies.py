# SPDX-License-Identifier: Apache-2.0
"""Fits bodies to the silhouettes of people."""

from __future__ import annotations

from typing import Any

from flowing_puppet_ros.body.track.scene_tracker import ONLY_ID
from flowing_puppet_ros.body.track.tracked_body import TorsoMotion, TrackedBody
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet
from flowing_puppet_ros.multiview.silhouette_fit import SilhouetteFitter, SilhouetteFitterSettings
from flowing_puppet_ros.stream.components.body_outputs import id_sort_key
from flowing_puppet_ros.stream.messages.bodies.silhouettes import decode_silhouettes
from flowing_puppet_ros.stream.messages.geometry import header_ns, stamp_ns
from flowing_puppet_ros.stream.messages.puppets import decode_body_joints

_MAX_AGE_NS = 1_000_000_000
"""Maximum age of a person's last body as the start of the next fit, nanoseconds."""


class SilhouetteBodies:
    """Fits the person of each SilhouetteSet; remembers every person's last reliable body for a second.

    The fits of one instant are collected until everybody's set has come, or a set of another instant.
    """

    def __init__(self, model: StitchedPuppet, settings: SilhouetteFitterSettings) -> None:
        """Prepare to fit `model`."""
        self._fitter = SilhouetteFitter(model, settings)
        self._last: dict[str, tuple[int, BodyState]] = {}
        self._motions: dict[str, TorsoMotion] = {}
        self._header: Any = None
        self._missing: set[str] = set()
        self._bodies: list[TrackedBody] = []

    def reset(self) -> None:
        """Forget all people and what is collected."""
        self._last.clear()
        self._motions.clear()
        self._header = None
        self._missing.clear()
        self._bodies.clear()

    @property
    def is_complete(self) -> bool:
        """Whether sets have come and none of the same instant is to come."""
        return self._header is not None and not self._missing

    def is_other_instant(self, message: Any) -> bool:
        """Return whether a set is of another instant than those collected, or of somebody who is among them."""
        if self._header is None:
            return False
        return header_ns(self._header) != stamp_ns(message) or _find_id(message) not in self._missing

    def add(self, message: Any) -> None:
        """Fit the person in a SilhouetteSet and collect the body. InputError when it cannot be fitted."""
        if self._header is None:
            self._header, self._missing = message.header, {*message.people, _find_id(message)}
        self._missing.discard(_find_id(message))
        self._bodies.append(self.fit(message))

    def collect(self) -> tuple[Any, list[TrackedBody]]:
        """Return the header (None if there is nothing) and the bodies of the sets collected, and begin anew."""
        header, bodies = self._header, sorted(self._bodies, key=lambda body: id_sort_key(body.id))
        self._header, self._missing, self._bodies = None, set(), []
        return header, bodies

    def fit(self, message: Any) -> TrackedBody:
        """Fit the person in a SilhouetteSet. InputError when it cannot be fitted."""
        identity, stamp = _find_id(message), stamp_ns(message)
        last_stamp, last_state = self._last.get(identity, (stamp, None))
        if not 0 <= stamp - last_stamp <= _MAX_AGE_NS:
            last_state = None
        fit = self._fitter.fit(decode_silhouettes(message), decode_body_joints(message.person), last_state)
        if fit.reliable:
            self._last[identity] = stamp, fit.state
        return self._motions.setdefault(identity, TorsoMotion()).add(identity, stamp, fit)


def _find_id(message: Any) -> str:
    return message.person.id or ONLY_ID
