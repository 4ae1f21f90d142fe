# SPDX-License-Identifier: Apache-2.0
"""Fits bodies to the silhouettes of people."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from flowing_puppet_ros.body.track.scene_tracker import ONLY_ID
from flowing_puppet_ros.body.track.tracked_body import TorsoMotion, TrackedBody
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.ids import id_sort_key
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet
from flowing_puppet_ros.multiview.silhouette_fit import SilhouetteFitter, SilhouetteFitterSettings
from flowing_puppet_ros.reporting import Report
from flowing_puppet_ros.stream.messages.bodies.silhouettes import decode_silhouettes
from flowing_puppet_ros.stream.messages.geometry import header_ns, stamp_ns
from flowing_puppet_ros.stream.messages.puppets import decode_body_joints

_MAX_AGE_NS = 1_000_000_000
"""Maximum age of a person's last body as the start of the next fit, nanoseconds."""


class SilhouetteBodies:
    """Fits the person of each SilhouetteSet; remembers every person's last reliable body for a second.

    The fits of one instant are collected until everybody's set has come, or a set of another instant.
    """

    def __init__(self, model: StitchedPuppet, settings: SilhouetteFitterSettings, report: Report) -> None:
        """Prepare to fit `model`; `report` is told of sets that cannot be fitted."""
        self._report = report
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

    def add(self, message: Any) -> Iterator[tuple[Any, list[TrackedBody]]]:
        """Fit the person in a SilhouetteSet; yield header and bodies of the instants that are over by that."""
        stamp, identity = stamp_ns(message), _find_id(message)
        if self._header is not None and (header_ns(self._header) != stamp or identity not in self._missing):
            yield from self.collect()
        if self._header is None:
            self._header, self._missing = message.header, {*message.people, identity}
        self._missing.discard(identity)
        try:
            self._bodies.append(self.fit(message))
        except InputError as error:
            self._report.count_unusable(error)
        if not self._missing:
            yield from self.collect()

    def collect(self) -> Iterator[tuple[Any, list[TrackedBody]]]:
        """Yield the header and the bodies of the sets collected, if any, and begin anew."""
        if self._header is not None:
            yield self._header, sorted(self._bodies, key=lambda body: id_sort_key(body.id))
        self._header, self._missing, self._bodies = None, set(), []

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
