# SPDX-License-Identifier: Apache-2.0
"""Point clouds, depth images or silhouettes in, fitted bodies out."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.body.fit.fitter import BodyFitter, Progress
from flowing_puppet_ros.body.scans.scan_frame import UP_AXES
from flowing_puppet_ros.body.scene.scene_cloud import RegionSettings, SceneCloud, crop_to_region
from flowing_puppet_ros.body.settings import FitterSettings
from flowing_puppet_ros.body.track.scene_tracker import SceneSettings
from flowing_puppet_ros.body.track.tracked_body import TrackedBody
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.cloud.range_image import RangeImage
from flowing_puppet_ros.fusion.people_fitter import FusionSettings, PeopleFitter
from flowing_puppet_ros.ids import id_sort_key
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.multiview.silhouette_fit import SilhouetteFitterSettings
from flowing_puppet_ros.settings import nested, setting
from flowing_puppet_ros.stream.component import COMPRESSED_DEPTH, Component, Output, Port
from flowing_puppet_ros.stream.components import warm_up
from flowing_puppet_ros.stream.components.body_outputs import BodyOutputs, BodyOutputSettings
from flowing_puppet_ros.stream.components.cloud_people import CloudPeople, FoundPeople
from flowing_puppet_ros.stream.components.ros4hri import Ros4HriSettings
from flowing_puppet_ros.stream.messages.clouds import decode_pixels
from flowing_puppet_ros.stream.messages.depth import make_depth_cloud
from flowing_puppet_ros.stream.messages.geometry import FrameTree, stamp_ns
from flowing_puppet_ros.stream.messages.message_types import (
    BODIES,
    CAMERA_INFO,
    IMAGE,
    POINT_CLOUD,
    PUPPETS,
    SILHOUETTES,
    TRANSFORMS,
    MessageFactory,
)
from flowing_puppet_ros.stream.messages.puppets import decode_body_joints, make_bodies, make_body
from flowing_puppet_ros.stream.pairing.depth_pairs import DepthPairs
from flowing_puppet_ros.stream.pairing.depth_rig import DepthRig, DepthRigSettings
from flowing_puppet_ros.stream.pairing.puppet_pairs import PuppetPairs
from flowing_puppet_ros.stream.pairing.rig_silhouettes import RigSilhouettes
from flowing_puppet_ros.stream.pairing.silhouette_bodies import SilhouetteBodies
from flowing_puppet_ros.stream.pairing.stamp_buffer import CloudLine, StampBuffer
from flowing_puppet_ros.stream.pairing.stuck_stamps import CloudClock
from flowing_puppet_ros.stream.sensor_places import SensorPlace, SensorPlaces

COLOUR_PORTS = ("puppets", "person_masks", "puppets/camera_info", "/tf_static", "/tf")
MAX_WAITING = 12
"""Clouds that wait at most in a live node."""


@dataclass(frozen=True)
class BodyFitterSettings(SceneSettings):
    """Settings of the fits, and of what the component reads, waits for and publishes."""

    model: str = setting("neutral", "body model", choices=("neutral", "female", "male"))
    up: str = setting(
        "auto",
        "axis of the cloud's frame that points up; auto: z of what the sensor is mounted on by /tf_static, else -y in"
        " frames named *optical or *optical_frame and for clouds without a frame_id that lie ahead along z as those of"
        " cameras do, else z",
        choices=("auto", *UP_AXES),
    )
    fixed_frame: str = setting(
        "",
        "frame with z up that stands still (map, odom), in which people are tracked where the sensor moves or is"
        " tilted; empty: the cloud's, as `up` says",
    )
    sensor_frame: str = setting(
        "",
        "frame of the sensor of clouds that come in another frame (base_link, odom, map); empty: the cloud's",
        advanced=True,
    )
    floor_frame: str = setting(
        "base_footprint",
        "frame whose origin is on the floor (REP-120): it tells how high the sensor is where clouds show no floor",
        advanced=True,
    )
    transform_wait: int = setting(
        3, "clouds to wait for late transforms before one is fitted without them", low=0, high=50, advanced=True
    )
    wait: int = setting(
        1, "clouds to wait for late initial joints before fitting a cloud without them", low=0, high=50, advanced=True
    )
    rig: DepthRigSettings = nested(DepthRigSettings)
    region: RegionSettings = nested(RegionSettings)
    fusion: FusionSettings = nested(FusionSettings)
    fitter: FitterSettings = nested(FitterSettings)
    silhouettes: SilhouetteFitterSettings = nested(SilhouetteFitterSettings)
    output: BodyOutputSettings = nested(BodyOutputSettings)
    ros4hri: Ros4HriSettings = nested(Ros4HriSettings)


class BodyFitterComponent(Component[BodyFitterSettings]):
    """Fits a body to each cloud; starts from the joints on `initial` when somebody publishes them.

    Each fit to a cloud draws its random numbers from the seed and the cloud's stamp, so it does not depend on which
    clouds came before it or were dropped, unless a person is tracked. What comes on `silhouettes` has its joints with
    it and is fitted at once, or with what the sensors of `rig.cameras` saw; nothing in that is random.
    """

    settings_type = BodyFitterSettings
    fixed = frozenset({"rig.cameras"})
    min_queue = MAX_WAITING
    inputs: tuple[Port, ...] = (
        Port("points", POINT_CLOUD, "sensor"),
        Port("depth", IMAGE, "sensor", transport=COMPRESSED_DEPTH),
        Port("camera_info", CAMERA_INFO, "sensor"),
        Port("puppets", PUPPETS, optional=True),
        Port("person_masks", IMAGE, optional=True),
        Port("puppets/camera_info", CAMERA_INFO, "sensor", optional=True),
        Port("/tf_static", TRANSFORMS, "latched", optional=True),
        Port("/tf", TRANSFORMS, optional=True),
        Port("initial", BODIES, optional=True),
        Port("silhouettes", SILHOUETTES),
    )
    outputs: tuple[Port, ...] = BodyOutputs.always

    def __init__(self, settings: BodyFitterSettings, factory: MessageFactory) -> None:
        """Load the body model."""
        super().__init__(settings, factory)
        self._model = StitchedPuppet.load(settings.model)
        self._fitter = BodyFitter(self._model, settings.fitter)
        self._looked_at: tuple[int, SensorPlace] | None = None
        people = PeopleFitter(self._fitter, settings.fusion)
        self._people = CloudPeople(people, settings, settings.fusion, self.report, self.publish_id)
        self._frames = FrameTree()
        self._puppets = PuppetPairs(self._model, settings.fusion, self._frames, self.report)
        self._places = SensorPlaces(
            self._frames,
            settings.up,
            settings.fixed_frame,
            settings.sensor_frame,
            self.report,
            settings.view,
            settings.floor_frame,
        )
        self._is_fixed = False
        self._turns: dict[str, F64] = {}
        self._rig = DepthRig(settings.rig, self._places, self.report, factory) if settings.rig.cameras else None
        if self._rig is not None:  # people are found by depth and silhouettes
            self.inputs = self._rig.ports
        self._silhouettes = SilhouetteBodies(self._model, settings.silhouettes, self.report)
        self._joined = RigSilhouettes(people, settings, self._frames, self.report)
        self._depth = DepthPairs(self.report)
        self._clock = CloudClock(self.report)
        self._line = CloudLine(lambda item: self.dropped.update([item[0]]))
        self._initial = StampBuffer()
        self._outputs = BodyOutputs(settings.output, settings.ros4hri, factory, self._model)
        self.outputs = self._outputs.ports

    def warm_up(self) -> None:
        """Do beforehand what the first clouds of a live stream would wait for: fit somebody made up, too."""
        self._people.scene.warm_up()
        self._outputs.warm_up()
        alone = replace(
            self.settings, up="auto", fixed_frame="", sensor_frame="", rig=DepthRigSettings(), region=RegionSettings()
        )
        warm_up.run(type(self)(alone, self.factory), warm_up.make_fitter_input(self.factory, self._model))
        one_sided = replace(alone, view="single")
        warm_up.run(type(self)(one_sided, self.factory), warm_up.make_scan_input(self.factory, self._model))

    def reset(self) -> None:
        """Forget what waits, whom the silhouettes showed and who was tracked; ids of tracked people go on."""
        self._silhouettes.reset()
        self._joined.reset()
        self._people.reset()
        self._puppets.reset()
        self._depth.reset()
        if self._rig is not None:
            self._rig.reset()
        self._line.clear()
        self._initial.clear()
        self._places.reset()
        self._frames.forget_moving()
        self._clock.reset()

    def flush(self) -> Output:
        """Fit the clouds that still wait."""
        for pair in self._depth.flush():
            self._append("depth", *pair)
        for moment in self._rig.flush() if self._rig is not None else ():
            self._append("points", moment)
        return self._release(final=True) + self._publish_silhouettes(self._silhouettes.collect())

    def fit(
        self, cloud: Any, initial: Any | None, seed: int, progress: Progress | None = None
    ) -> tuple[Any, list[TrackedBody]]:
        """Fit the bodies in a PointCloud2 message: those in `initial` (a BodyArray), else those of the scene, else one.

        Nothing of other clouds is used or changed. Returns the BodyArray message and its bodies, in the cloud's frame.
        InputError in one sentence when the cloud cannot be used.
        """
        scene, place, _ = self._decode(cloud, of_depth=False)
        if initial is not None and initial.bodies:
            bodies = self._fit_initial(scene, place, initial, seed, progress)
        else:
            bodies = self._people.fit_once(scene, seed, progress)
        bodies = [body.move(*place.back) for body in bodies]
        messages = [make_body(self.factory, self._model, body) for body in bodies]
        return make_bodies(self.factory, cloud.header, messages), bodies

    def _decode(self, cloud: Any, of_depth: bool) -> tuple[SceneCloud, SensorPlace, bool]:
        """Return the points of a cloud message in the region of interest, z up, their place, and whether it is known.

        That of a depth image is seen from one side, in an optical frame, whatever its name, whose y axis points down.
        """
        points, normals, pixel = decode_pixels(cloud)
        image = RangeImage.of_organised(points, pixel, (int(cloud.height), int(cloud.width)))
        inside = crop_to_region(points, self.settings.region)
        if not inside.all():
            points, normals = points[inside], None if normals is None else normals[inside]
            image = image and image.take(inside)
        where, stamp = (cloud.header, stamp_ns(cloud), points, of_depth), stamp_ns(cloud)
        found = self._places.find(*where)
        place = found or self._places.find_alone(*where)
        normals = None if normals is None else normals @ place.rotation.T
        image = image and image.turn(place.rotation).move(place.translation)
        scene = SceneCloud(
            place.put(points), normals, stamp, of_depth, image, place.viewpoint, place.to_sensor, place.height
        )
        return scene, place, found is not None

    def _fit_initial(
        self, scene: SceneCloud, place: SensorPlace, initial: Any, seed: int, progress: Progress | None = None
    ) -> list[TrackedBody]:
        """Fit each of the bodies in `initial` to the whole cloud, from its joints."""
        viewpoint = scene.viewpoint if self.settings.view == "single" or scene.single_view else None
        field = scene.image.make_field(slice(None)) if scene.image is not None and viewpoint is not None else None
        bodies = []
        for number, body in enumerate(initial.bodies, start=1):
            joints, seen = place.put_joints(decode_body_joints(body)), (scene.points, scene.normals)
            fit = self._fitter.fit(
                *seen, initial=joints, viewpoint=viewpoint, field=field, seed=seed, progress=progress
            )
            bodies.append(TrackedBody(body.id or self.publish_id(f"b{number}"), fit))
        return sorted(bodies, key=lambda body: id_sort_key(body.id))

    def seed_of(self, stamp: int) -> int:
        """Return the seed of the fit to the cloud of a stamp (nanoseconds)."""
        return int(np.random.SeedSequence([self.settings.fitter.seed, max(stamp, 0)]).generate_state(1)[0])

    def _process(self, port: str, message: Any) -> Output:
        if port == "silhouettes" and self._rig is None:
            self.counters["silhouettes"] += 1
            return self._publish_silhouettes(self._silhouettes.add(message))
        if port in ("depth", "camera_info"):
            for pair in self._depth.add(port, message):
                self._append("depth", *pair)
        elif port in COLOUR_PORTS:
            self._puppets.add(port, message)
        elif port == "silhouettes":
            self._joined.add(message)
        elif port == "points":
            self._append(port, message)
        elif self._rig is not None:
            for moment in self._rig.add(port, message):
                self._append("points", moment)
        elif self._line.is_late(stamp_ns(message)):
            self.counters["late initial"] += 1
        else:
            self._initial.put(stamp_ns(message), message)
        return self._release(final=False)

    def _append(self, port: str, message: Any, info: Any = None) -> None:
        """Let a cloud wait, or a depth image with its camera_info."""
        is_live = self.background is not None
        self._line.append(stamp_ns(message), (port, message, info), MAX_WAITING if is_live else None)

    def _release(self, final: bool) -> Output:
        """Fit the clouds that have what they wait for.

        While messages wait, none: a node that is behind first takes in what came, then goes on with the newest cloud.
        """
        outputs: Output = []
        while True:
            if not final and self.is_behind():
                self._line.is_behind = True
                return outputs
            taken = self._line.take(lambda index: final or self._is_ready(index))
            if taken is None:
                return outputs
            stamp, (port, message, info) = taken
            initial = self._initial.get(stamp)
            self._initial.drop_until(stamp)
            try:
                cloud = message if port == "points" else make_depth_cloud(self.factory, message, info)
            except InputError as error:
                self.report.count_unusable(error)
            else:
                outputs += self._fit_one(stamp, cloud, port == "depth", initial)

    def _is_ready(self, index: int) -> bool:
        """Return whether all that is expected for a cloud in line is there, or it has waited long enough."""
        stamp, (_, message, _) = self._line.waiting[index]
        frame, waiting = message.header.frame_id, len(self._line.waiting) - 1 - index
        if "initial" in self._expected and self._initial.get(stamp) is None and waiting < self.settings.wait:
            return False
        first, last = self._line.first or stamp, self._line.waiting[-1][0]
        if "silhouettes" in self._expected and self._joined.is_awaited(stamp, first, last):
            return False
        frames = [frame] if self._rig is None else message.frames
        if waiting < self.settings.transform_wait and any(self._places.is_awaited(each, stamp) for each in frames):
            return False
        # Without a calibration no puppet can be used, however long a cloud waits for it.
        calibrated = self._puppets.is_calibrated or "puppets/camera_info" in self._expected
        puppets = calibrated and "puppets" in self._expected and self._puppets.is_awaited(first, last)
        return not puppets or self._puppets.is_ready(frame, stamp, "person_masks" in self._expected)

    def describe_rejected(self) -> dict[str, Any] | None:
        """Return what was looked at in the last cloud and is no person."""
        if self._looked_at is None:
            return None
        stamp, place = self._looked_at
        return {"stamp_ns": stamp, "candidates": [one.describe(*place.back) for one in self._people.scene.rejected]}

    def _fit_one(self, stamp: int, cloud: Any, of_depth: bool, initial: Any | None) -> Output:
        self.counters["clouds"] += 1
        found = FoundPeople()
        try:
            rig, decode = self._rig, self._decode
            scene, place, is_known = decode(cloud, of_depth) if rig is None else rig.merge(cloud, decode)
            scene = replace(scene, stamp=self._clock.advance(stamp))
            if is_known and (place.is_fixed != self._is_fixed or self._is_turned(cloud.header.frame_id, place)):
                self._is_fixed = place.is_fixed
                self._people.reset()
                self._joined.reset_people()
            if initial is not None and initial.bodies:
                found = FoundPeople(self._fit_initial(scene, place, initial, self.seed_of(stamp)))
            else:
                found = self._find_people(scene, cloud.header, stamp, place, is_known)
            found = found.move_back(place)
            self._looked_at = stamp, place
        except InputError as error:
            self.report.count_unusable(error)
        self.counters["bodies"] += len(found.bodies)
        self.counters["people in colour only"] += len(found.coarse)
        return self._outputs.make(cloud.header, found.bodies, found.occluded, self._subscribed, found.coarse)

    def _is_turned(self, frame: str, place: SensorPlace) -> bool:
        """Return whether what is up in a frame of clouds is known better since its last cloud."""
        if place.is_fixed:
            return False
        before, self._turns[frame] = self._turns.get(frame), place.rotation
        return before is not None and not np.array_equal(before, place.rotation)

    def _find_people(
        self, scene: SceneCloud, header: Any, stamp: int, place: SensorPlace, is_known: bool
    ) -> FoundPeople:
        """Return everybody in a cloud, by the silhouettes or puppets that belong to it, else by itself."""
        alone = self.seed_of(stamp), is_known, self.background
        if "silhouettes" in self._expected:
            bodies, own = self._joined.fit(scene, stamp, header.frame_id, place)
            left = FoundPeople() if own.all() else self._people.find_alone(scene.take(~own), *alone)
            others, occluded = self._joined.add_others(left.bodies, left.occluded)
            return FoundPeople([*bodies, *others], occluded)
        if "puppets" not in self._expected or not self.settings.scene:
            return self._people.find_alone(scene, *alone)
        try:
            paired = self._puppets.find(header, stamp, *place.back)
        except InputError as error:
            self.report.warn(str(error))
            self.counters["clouds without puppets"] += 1
            return self._people.find_alone(scene, *alone)
        self._puppets.drop_until(stamp)
        return self._people.find_with_puppets(scene, paired, *alone)

    def _publish_silhouettes(self, instants: Iterable[tuple[Any, list[TrackedBody]]]) -> Output:
        outputs: Output = []
        for header, bodies in instants:
            self.counters["bodies"] += len(bodies)
            self.counters["doubtful bodies"] += sum(not body.fit.reliable for body in bodies)
            outputs += self._outputs.make(header, bodies, subscribed=self._subscribed)
        return outputs
