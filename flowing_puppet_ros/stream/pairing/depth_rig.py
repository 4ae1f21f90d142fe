# SPDX-License-Identifier: Apache-2.0
"""Several depth cameras or LiDARs around the same people: their messages paired, and brought into one frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.body.scene.rig_agreement import measure_disagreement
from flowing_puppet_ros.body.scene.rig_scene import RigScene
from flowing_puppet_ros.body.scene.scene_cloud import SceneCloud
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.reporting import Report
from flowing_puppet_ros.settings import Settings, setting
from flowing_puppet_ros.stream.component import COMPRESSED_DEPTH, Port
from flowing_puppet_ros.stream.messages.depth import make_depth_cloud
from flowing_puppet_ros.stream.messages.geometry import make_header, stamp_ns
from flowing_puppet_ros.stream.messages.message_types import (
    CAMERA_INFO,
    IMAGE,
    POINT_CLOUD,
    SILHOUETTES,
    TRANSFORMS,
    MessageFactory,
)
from flowing_puppet_ros.stream.pairing.depth_pairs import DepthPairs
from flowing_puppet_ros.stream.pairing.time_synchronizer import TimeSynchronizer
from flowing_puppet_ros.stream.sensor_places import SensorPlace, SensorPlaces

MAX_SILENCE_NS = 500_000_000
"""From the last cloud of a sensor, within which what it misses is left out: without it bodies would jump."""
MAX_MISSED = 10
"""Moments in a row that a sensor which is alive may miss; then its clouds are never near the others' in time."""
COMPARED_MOMENTS, MAX_FREE_SHARE = 10, 0.3
"""Moments by which it is told whether sensors are where they are said to be, and the median share of what one saw that
another saw through from which on they are not: it is 0.02 to 0.1 where they are, and half where one is 2 degrees or
10 cm off."""

_SHARED = (
    Port("/tf_static", TRANSFORMS, "latched", optional=True),
    Port("/tf", TRANSFORMS, optional=True),
    Port("silhouettes", SILHOUETTES, optional=True),
)

type SensedCloud = tuple[SceneCloud, SensorPlace, bool]
"""A cloud with z up, the place of its sensor, and whether that is known."""


@dataclass(frozen=True)
class DepthRigSettings(Settings):
    """Which sensors see the same people, and when what they see belongs together."""

    cameras: str = setting(
        "",
        "depth cameras or LiDARs around the same people, separated by commas: each has <camera>/depth and"
        " <camera>/camera_info, or <camera>/points; empty: one sensor",
        advanced=True,
    )
    slop: float = setting(
        0.035, "maximum difference of stamps within one moment of several sensors", unit="s", low=0.0, high=1.0,
        advanced=True,
    )  # fmt: skip
    max_waiting: int = setting(
        3, "clouds of one sensor that wait for another that is late or dead", low=1, high=50, advanced=True
    )


@dataclass(frozen=True, slots=True, eq=False)
class RigMoment:
    """What the sensors saw at one time: by sensor `points`, a cloud and None, or `depth`, an image and its camera_info.

    The header's frame is that in which people are tracked: the fixed one, or the sensors' root.
    """

    header: Any
    seen: Mapping[str, tuple[str, Any, Any]]

    @property
    def frames(self) -> list[str]:
        """The sensors' frames."""
        return [message.header.frame_id.lstrip("/") for _, message, _ in self.seen.values()]


class DepthRig:
    """Pairs the messages of the sensors, and joins what they saw at one time in one frame."""

    def __init__(
        self, settings: DepthRigSettings, places: SensorPlaces, report: Report, factory: MessageFactory
    ) -> None:
        """Take the sensors of the settings; InputError if one is named twice."""
        self.names = tuple(filter(None, (name.strip() for name in settings.cameras.split(","))))
        if len(set(self.names)) < len(self.names):
            raise InputError(f"rig.cameras is {settings.cameras!r}: every sensor has a name of its own")
        self._settings, self._places, self._report, self._factory = settings, places, report, factory
        self.ports = (*(port for name in self.names for port in _list_ports(name)), *_SHARED)
        self.reset()

    def reset(self) -> None:
        """Drop what waits."""
        self._pairs = {name: DepthPairs(self._report) for name in self.names}
        slop = round(1e9 * self._settings.slop)
        self._sync = TimeSynchronizer(self.names, slop, patience=self._settings.max_waiting, min_items=1)
        self._last: dict[str, int] = {}
        self._missed = 0
        self._compared, self._shares = 0, dict[tuple[str, str], list[float]]()

    def add(self, port: str, message: Any) -> list[RigMoment]:
        """Add a message of one of the `ports`; return the moments that are now complete."""
        name, _, kind = port.rpartition("/")
        if kind == "points":
            return self._join(name, "points", message, None)
        return [moment for pair in self._pairs[name].add(kind, message) for moment in self._join(name, "depth", *pair)]

    def flush(self) -> list[RigMoment]:
        """Return the moments of what still waits."""
        moments = []
        for name, pairs in self._pairs.items():
            for pair in pairs.flush():
                moments += self._join(name, "depth", *pair)
        return moments + self._choose(self._sync.flush())

    def _join(self, name: str, kind: str, message: Any, info: Any) -> list[RigMoment]:
        stamp = stamp_ns(message)
        self._last[name] = stamp
        return self._choose(self._sync.add(name, stamp, (kind, message, info)))

    def _choose(self, sets: list[dict[str, tuple[int, Any]]]) -> list[RigMoment]:
        """Return the moments that no sensor misses, but those that are silent."""
        found = []
        for items in sets:
            stamp = next(iter(items.values()))[0]
            absent = [name for name in self.names if name not in items]
            alive = [name for name in absent if abs(stamp - self._last.get(name, 0)) < MAX_SILENCE_NS]
            self._missed = self._missed + 1 if alive else 0
            if 0 < self._missed <= MAX_MISSED:
                self._report.counters["moments that a sensor missed"] += 1
                continue
            if alive:
                self._report.warn(
                    f"no cloud of {' and '.join(alive)} is within rig.slop, {self._settings.slop:g} s, of those of "
                    f"{' and '.join(items)}: each is used by itself; raise it, or synchronise the sensors"
                )
            elif absent:
                self._report.counters["moments without a silent sensor"] += 1
                self._report.warn(f"nothing comes from {' and '.join(absent)}: bodies are fitted without it")
            seen = {name: item for name, (_, item) in items.items()}
            frame = self._places.fix(next(iter(seen.values()))[1].header.frame_id.lstrip("/"))
            found.append(RigMoment(make_header(self._factory, stamp, frame), seen))
        return found

    def merge(
        self, moment: RigMoment, decode: Callable[[Any, bool], SensedCloud]
    ) -> tuple[RigScene, SensorPlace, bool]:
        """Return what the sensors saw as one scene; those that cannot be used are left out, with a sentence.

        `decode` makes a scene of a cloud message, and is told whether it is a depth image's. InputError when no sensor
        can be used.
        """
        parts, used, left_out = [], [], []
        for name, (kind, message, info) in moment.seen.items():
            problem = self._places.describe_missing(message.header.frame_id, stamp_ns(message))
            if problem:
                left_out.append(f"{name} is left out: {problem}")
                continue
            try:
                cloud = message if kind == "points" else make_depth_cloud(self._factory, message, info)
                scene, _, _ = decode(cloud, kind == "depth")
            except InputError as error:
                left_out.append(f"{name} is left out: {error}")
                continue
            if len(scene.points):
                parts.append(scene)
                used.append(name)
        for sentence in left_out:
            self._report.count_unusable(InputError(sentence))
        if not parts:
            raise InputError("no sensor has a point in the region of interest")
        if len(parts) == len(self.names) and self._compared < COMPARED_MOMENTS:
            self._compared += 1
            self._compare(used, measure_disagreement(parts))
        return RigScene.merge(parts, stamp_ns(moment)), self._places.find_fixed(), True

    def _compare(self, names: Sequence[str], share: F64) -> None:
        """Warn of sensors that go on seeing things in space that another one sees through."""
        for (i, first), (j, second) in combinations(enumerate(names), 2):
            both = [each for each in (share[i, j], share[j, i]) if np.isfinite(each)]
            shares = self._shares.setdefault((first, second), [])
            shares += [float(np.mean(both))] if both else []
            if self._compared == COMPARED_MOMENTS and shares and np.median(shares) > MAX_FREE_SHARE:
                self._report.warn(
                    f"{first} and {second} do not fit together: {100 * np.median(shares):.0f} % of what one of them "
                    "saw stands where the other saw through; check their transforms on /tf, and their stamps"
                )


def _list_ports(name: str) -> tuple[Port, ...]:
    return (
        Port(f"{name}/points", POINT_CLOUD, "sensor", optional=True),
        Port(f"{name}/depth", IMAGE, "sensor", transport=COMPRESSED_DEPTH, optional=True),
        Port(f"{name}/camera_info", CAMERA_INFO, "sensor", optional=True),
    )
