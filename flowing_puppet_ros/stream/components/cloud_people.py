# SPDX-License-Identifier: Apache-2.0
"""Everybody in the clouds of a stream, found in the cloud alone or by the puppets that a camera shows in it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.body.fit.fitter import Progress
from flowing_puppet_ros.body.scene.scene_cloud import SceneCloud
from flowing_puppet_ros.body.track.scene_tracker import SceneSettings, SceneTracker
from flowing_puppet_ros.body.track.tracked_body import TrackedBody
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.fusion.coarse_place import CoarsePerson, place_others
from flowing_puppet_ros.fusion.people_fitter import FusionSettings, PeopleFitter
from flowing_puppet_ros.fusion.seen_cloud import SeenCloud
from flowing_puppet_ros.fusion.tracker import FusedTracker
from flowing_puppet_ros.reporting import Report
from flowing_puppet_ros.stream.pairing.puppet_pairs import PairedPuppets
from flowing_puppet_ros.stream.sensor_places import SensorPlace

OFFSET_BODIES, MIN_OFFSET_JOINTS = 20, 6
"""Bodies of which the mean offset of their puppets tells whether colour and depth fit, and sure joints of each."""
MAX_OFFSET_RAD = 0.015
"""Of the mean; a network's joints are 0.005 beside a body's at most, in the median of a body."""
MIN_OUTSIDE_SHARE = 0.1
"""Of a cloud's points, outside of the camera's view, from which on people are found there without puppets."""


@dataclass(frozen=True, slots=True, eq=False)
class FoundPeople:
    """The `bodies` in a cloud, the ids of those out of sight, and who is seen in colour only; in the cloud's frame."""

    bodies: list[TrackedBody] = field(default_factory=list)
    occluded: list[str] = field(default_factory=list)
    coarse: list[CoarsePerson] = field(default_factory=list)

    def move_back(self, place: SensorPlace) -> FoundPeople:
        """Return them in the frame of the message."""
        bodies = [body.move(*place.back) for body in self.bodies]
        return FoundPeople(bodies, self.occluded, [person.move(*place.back) for person in self.coarse])


class OffsetCheck:
    """Notices puppets that lie beside the bodies which the cloud shows: then camera and cloud do not fit.

    The joints only start a body and draw it aside a little; points decide. So a wrong calibration, transform or clock
    moves puppets and bodies apart, always in the same direction.
    """

    def __init__(self) -> None:
        """Start without bodies."""
        self._offsets: deque[F64] = deque(maxlen=OFFSET_BODIES)

    def clear(self) -> None:
        """Forget the bodies."""
        self._offsets.clear()

    def add(self, paired: PairedPuppets, bodies: Sequence[TrackedBody]) -> str:
        """Take the bodies of a cloud with their puppets; return what is to be said, or ""."""
        fits = {body.id: body.fit for body in bodies}
        for puppet in paired.puppets:
            sure = puppet.sure
            if puppet.id in fits and np.count_nonzero(sure) >= MIN_OFFSET_JOINTS:
                pixels, _ = paired.camera.project(fits[puppet.id].joints[sure])
                self._offsets.append(np.median(puppet.pixels[sure] - pixels, axis=0))
        if len(self._offsets) < OFFSET_BODIES:
            return ""
        right, down = np.mean(self._offsets, axis=0)
        if np.hypot(right, down) <= MAX_OFFSET_RAD * paired.camera.focal:
            return ""
        return (
            f"puppets lie {right:+.0f} px to the right of and {down:+.0f} px below the bodies that the cloud shows, in"
            f" the mean of {OFFSET_BODIES}: colour and depth do not fit; check puppets/camera_info, the transform"
            " between both sensors, and their stamps"
        )


class CloudPeople:
    """Finds and tracks people in clouds.

    A cloud whose place is not known is fitted by itself: nobody is tracked through it.

    Attributes:
        scene: finds people in clouds alone.
    """

    def __init__(
        self,
        people: PeopleFitter,
        settings: SceneSettings,
        fusion: FusionSettings,
        report: Report,
        publish_id: Callable[[str], str],
    ) -> None:
        """Fit with `people`; `publish_id` makes the id to publish of one of the trackers' own."""
        self.scene = SceneTracker(people.fitter, settings, report)
        self._fused = FusedTracker(people, settings.tracker, settings.tracker.hold, report, publish_id)
        self._model = people.fitter.model
        self._colour_only = fusion.colour_only
        self._offset = OffsetCheck()
        self._report = report
        self._publish_id = publish_id

    def reset(self) -> None:
        """Forget everybody."""
        self.scene.reset()
        self._fused.reset()
        self._offset.clear()

    def fit_once(self, scene: SceneCloud, seed: int, progress: Progress | None) -> list[TrackedBody]:
        """Return the bodies in a cloud of which nobody is tracked."""
        return self._publish_ids(self.scene.fit_once(scene, seed, progress))

    def find_alone(self, scene: SceneCloud, seed: int, is_known: bool, background: Executor | None) -> FoundPeople:
        """Return everybody in a cloud alone; `is_known`: whether the place of the cloud is."""
        if not is_known:
            return FoundPeople(self._publish_ids(self.scene.step_alone(scene, seed)))
        bodies, occluded = self.scene.step(scene, seed, background)
        return FoundPeople(self._publish_ids(bodies), [self._publish_id(own) for own in occluded])

    def find_with_puppets(
        self, scene: SceneCloud, paired: PairedPuppets, seed: int, is_known: bool, background: Executor | None
    ) -> FoundPeople:
        """Return everybody in a cloud that a camera sees.

        Where the camera looks, only who has a puppet has a body. Elsewhere people are found in the cloud alone.
        """
        seen = SeenCloud.of(scene.points, paired.camera, scene.viewpoint)
        puppets = paired.puppets if self._colour_only else []
        try:
            self.scene.check(scene)
        except InputError as error:
            self._report.count_unusable(error)
            return FoundPeople(coarse=place_others(self._model, puppets, seen))
        if is_known:
            bodies, own = self._fused.step(seen, scene.draw_image(), paired.puppets, scene.stamp)
        else:
            bodies, own = self._fused.step_alone(seen, scene.draw_image(), paired.puppets)
        if told := self._offset.add(paired, bodies):
            self._report.warn(told)
        occluded = self._fused.occluded_ids
        with_body = {body.id for body in bodies}
        coarse = place_others(self._model, [each for each in puppets if each.id not in with_body], seen)
        if paired.puppets and not own.any():
            self._report.warn(
                f"none of the {len(paired.puppets)} puppets lies on the cloud: nobody is near enough to the sensor, or "
                "camera and cloud do not belong together"
            )
        outside = ~seen.in_view & ~own
        if outside.mean() > MIN_OUTSIDE_SHARE:
            others = self.find_alone(scene.take(outside), seed, is_known, background)
            bodies, occluded = [*bodies, *others.bodies], [*occluded, *others.occluded]
        return FoundPeople(bodies, occluded, coarse)

    def _publish_ids(self, bodies: list[TrackedBody]) -> list[TrackedBody]:
        return [replace(body, id=self._publish_id(body.id)) for body in bodies]
