# SPDX-License-Identifier: Apache-2.0
"""The bodies that are fitted to the silhouettes of people."""

from __future__ import annotations

from typing import Any

from flowing_puppet_ros.body.fit.fitter import BodyFit
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet
from flowing_puppet_ros.multiview.silhouette_fit import SilhouetteFitter, SilhouetteFitterSettings
from flowing_puppet_ros.stream.messages.geometry import stamp_ns
from flowing_puppet_ros.stream.messages.puppets import joints_of
from flowing_puppet_ros.stream.messages.silhouettes import views_of

_FORGET_NS = 1_000_000_000
"""A person seen longer ago than this, or later, tells nothing of a body's pose."""


class SilhouetteBodies:
    """Fits the person of each SilhouetteSet; remembers the last good body of every person for about a second."""

    def __init__(self, model: StitchedPuppet, settings: SilhouetteFitterSettings) -> None:
        """Prepare the fit of `model`."""
        self._fitter = SilhouetteFitter(model, settings)
        self._last: dict[str, tuple[int, BodyState]] = {}

    def reset(self) -> None:
        """Forget everybody."""
        self._last.clear()

    def fit(self, message: Any) -> tuple[str, BodyFit]:
        """Return the id and the body of the person in a SilhouetteSet; InputError when it cannot be fitted."""
        identity, stamp = message.person.id or "b1", stamp_ns(message)
        seen, before = self._last.get(identity, (stamp, None))
        if not 0 <= stamp - seen <= _FORGET_NS:
            before = None
        fit = self._fitter.fit(views_of(message), joints_of(message.person), before)
        if fit.reliable:
            self._last[identity] = stamp, fit.state
        return identity, fit
