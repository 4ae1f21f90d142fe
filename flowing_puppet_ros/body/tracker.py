# SPDX-License-Identifier: Apache-2.0
"""One person through a stream of clouds: from the last bodies a few Gauss-Newton steps, a search only when lost.

Motion goes on at the last velocity, shape is learned over the frames, and the two-way distance between body and cloud
tells when the track is lost.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from flowing_puppet_ros.body.correspondence import Cloud, two_way_distance
from flowing_puppet_ros.body.energy import JointTargets
from flowing_puppet_ros.body.fitter import BodyFit, BodyFitter, checked_cloud
from flowing_puppet_ros.body.normals import thinned
from flowing_puppet_ros.body.refine import Refiner, RefineWeights
from flowing_puppet_ros.model import rotation
from flowing_puppet_ros.model.sp import BodyState
from flowing_puppet_ros.settings import Settings, setting

NARROW, WIDE = (0.10, 0.03), (0.25, 0.03)  # first and last kernel width of a usual step and of a lost body's, metres
WIDE_STEPS = 20
BELIEF = 1e-6  # weight in `RefineWeights.shape` that each frame adds to the shape of the frames before
MOST_FRAMES = 30  # that are remembered of a shape, or a first mistake would stay
MOST_STRETCH = 2.0  # frames' steps that a motion may go on unseen


@dataclass(frozen=True, slots=True)
class BodyTrackerSettings(Settings):
    """Settings of `BodyTracker`."""

    points: int = setting(5000, "points that a tracked cloud is thinned to", low=200, high=200000)
    steps: int = setting(5, "Gauss-Newton steps a frame", low=1, high=100)
    lost_ratio: float = setting(1.4, "two-way distance, against the best since the last search, of a lost track",
                                low=1.0, high=10.0)  # fmt: skip
    lost_distance: float = setting(0.003, "distance that must be added to that", unit="m", low=0.0, high=1.0)
    longest_gap: float = setting(0.5, "gap between clouds after which a body is searched for again", unit="s",
                                 low=0.01, high=60.0)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """A body, the time of its cloud (nanoseconds), and its two-way distance (metres)."""

    state: BodyState
    stamp: int
    distance: float


class BodyTracker:
    """Follows one person; `counters` counts frames by how they were fitted: tracked, widened, searched."""

    def __init__(self, fitter: BodyFitter, settings: BodyTrackerSettings) -> None:
        """Track with the model of `fitter`, which also makes the full fits."""
        self._fitter = fitter
        self._settings = settings
        self._refiner = Refiner(fitter.model)
        self._none = JointTargets.none(fitter.model)
        self.counters: Counter[str] = Counter()
        self.reset()

    def reset(self) -> None:
        """Forget the person."""
        self._before: _Seen | None = None
        self._last: _Seen | None = None
        self._best = np.inf
        self._frames = 0

    def step(
        self,
        points: np.ndarray,
        normals: np.ndarray | None,
        stamp: int,
        viewpoint: np.ndarray | None = None,
        seed: int | None = None,
    ) -> BodyFit:
        """Fit the next cloud of the person.

        Args:
            points: (N, 3) metres, z up, in one frame through the stream.
            normals: (N, 3) outward unit normals, or None to estimate them.
            stamp: nanoseconds; one that is not later than the last starts a new track.
            viewpoint: (3,) where the sensor stood when the cloud shows one side only.
            seed: of a full fit; overrides the fitter's.

        Raises:
            InputError: when the cloud cannot be the surface of a person; the track goes on with the next one.
        """
        points, normals = thinned(*checked_cloud(points, normals), self._settings.points)
        if self._last is not None and not 0 < stamp - self._last.stamp <= 1e9 * self._settings.longest_gap:
            self.reset()
        with threadpool_limits(limits=1):
            cloud = self._fitter.cloud(points, normals, viewpoint)
            found = None if self._last is None else self._tracked(self._last, cloud, stamp)
            if found is None or self._is_lost(found):
                found = self._searched(found, cloud, stamp, seed)
            self._before, self._last = self._last, found
            self._best = min(self._best, found.distance)
            self._frames += 1
            return self._fitter.result(found.state, cloud)

    def _tracked(self, last: _Seen, cloud: Cloud, stamp: int) -> _Seen:
        """A few steps from where the person should be; when they do not get there, more steps that look farther."""
        start = self._predicted(last, stamp)
        found = self._refined(start, cloud, stamp, NARROW, self._settings.steps)
        if self._is_lost(found):
            wide = self._refined(start, cloud, stamp, WIDE, WIDE_STEPS)
            found = min(found, wide, key=lambda seen: seen.distance)
            self.counters["widened"] += 1
        else:
            self.counters["tracked"] += 1
        return found

    def _searched(self, tracked: _Seen | None, cloud: Cloud, stamp: int, seed: int | None) -> _Seen:
        """The full fit, unless the tracked body is closer to the cloud; its distance is the new measure of lost."""
        self.counters["searched"] += 1
        fit = self._fitter.fit(cloud.points, cloud.normals, viewpoint=cloud.viewpoint, seed=seed)
        found = _Seen(fit.state, stamp, fit.two_way_distance)
        if tracked is not None and tracked.distance <= found.distance:
            found = tracked
        else:
            self.reset()
        self._best = found.distance
        return found

    def _predicted(self, last: _Seen, stamp: int) -> BodyState:
        """The last body, moved on by its last motion in proportion to the time."""
        if self._before is None:
            return last.state
        share = min((stamp - last.stamp) / (last.stamp - self._before.stamp), MOST_STRETCH)
        before, state = self._before.state, last.state
        turn = rotation.log(np.swapaxes(before.rotation, -1, -2) @ state.rotation)
        return replace(
            state,
            center=state.center + share * (state.center - before.center),
            rotation=state.rotation @ rotation.exp(share * turn),
        )

    def _refined(self, start: BodyState, cloud: Cloud, stamp: int, widths: tuple[float, float], steps: int) -> _Seen:
        weights = RefineWeights(sigma_start=widths[0], sigma_end=widths[1], iterations=steps)
        weights = replace(
            weights,
            shape=weights.shape + BELIEF * min(self._frames, MOST_FRAMES),
            shape_center=start.shape.mean(axis=0),
        )
        state = self._refiner.run(start, cloud, self._none, weights)
        vertices = self._fitter.model.vertices(state)
        return _Seen(state, stamp, two_way_distance(vertices, self._fitter.model.faces, cloud))

    def _is_lost(self, found: _Seen) -> bool:
        return found.distance > self._settings.lost_ratio * self._best + self._settings.lost_distance
