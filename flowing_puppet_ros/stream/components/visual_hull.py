# SPDX-License-Identifier: Apache-2.0
"""Images, part labels and puppets of several calibrated cameras in; silhouettes, joints and visual hull out."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flowing_puppet_ros.body.fit.visibility import Visibility
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.multiview.association.people_tracker import PersonInSpace
from flowing_puppet_ros.multiview.association.settings import AssociationSettings
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.hull_builder import HullBuilder, HullBuilderSettings, MultiViewPerson
from flowing_puppet_ros.settings import nested, setting
from flowing_puppet_ros.stream.component import COMPRESSED, Component, Output, Port
from flowing_puppet_ros.stream.components import warm_up
from flowing_puppet_ros.stream.components.person_views import (
    CameraFrame,
    PersonMatcher,
    learn_background,
    observe_person,
)
from flowing_puppet_ros.stream.messages.bodies.silhouettes import make_silhouettes
from flowing_puppet_ros.stream.messages.camera_info import describe_images
from flowing_puppet_ros.stream.messages.clouds import make_cloud
from flowing_puppet_ros.stream.messages.geometry import FrameTree, make_header, stamp_ns
from flowing_puppet_ros.stream.messages.images import decode_image, decode_labels
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
from flowing_puppet_ros.stream.messages.puppets import make_bodies, make_joints
from flowing_puppet_ros.stream.pairing.time_synchronizer import TimeSynchronizer

_CAMERA_TOPICS = ("image", "part_labels", "puppets")  # synchronised for each camera, the first leads


@dataclass(frozen=True)
class VisualHullSettings(HullBuilderSettings):
    """Settings of silhouettes, triangulation and hull, and of what the component pairs."""

    cameras: str = setting("", "names of the cameras, separated by commas")
    frame: str = setting("", "frame of the hull; empty: the root frame of the cameras on /tf_static")
    slop: float = setting(0.008, "maximum difference of stamps within one set of images", unit="s", low=0.0, high=1.0)
    max_waiting_images: int = setting(
        10, "images of a camera that wait for a camera that is late or dead; 0: wait for ever", low=0, high=50
    )
    hull_every: int = setting(
        6, "sets of images with a person from one hull to the next; every set gives silhouettes", low=1, high=9999
    )
    association: AssociationSettings = nested(AssociationSettings)


class VisualHullComponent(Component[VisualHullSettings]):
    """Finds people across the cameras, segments each, triangulates its joints from the puppets, and carves its hull."""

    settings_type = VisualHullSettings
    fixed = frozenset({"cameras"})
    outputs = (
        Port("silhouettes", SILHOUETTES, lazy=True),
        Port("hull", POINT_CLOUD),
        Port("hull/joints", BODIES),
    )

    def __init__(self, settings: VisualHullSettings, factory: MessageFactory) -> None:
        """Make the ports of the cameras in the settings; InputError if there are fewer than two."""
        super().__init__(settings, factory)
        self._camera_names = tuple(name for name in (part.strip() for part in settings.cameras.split(",")) if name)
        if len(self._camera_names) < 2 or len(set(self._camera_names)) < len(self._camera_names):
            raise InputError(f"cameras is {settings.cameras!r}: a visual hull needs two or more different names")
        self.inputs = (
            *(port for name in self._camera_names for port in _camera_ports(name)),
            Port("/tf_static", TRANSFORMS, "latched"),
            Port("/tf", TRANSFORMS, optional=True),
        )
        self._builder = HullBuilder(settings)
        self._matcher = PersonMatcher(settings.association, settings.triangulation)
        self._frame_tree = FrameTree()
        self._infos: dict[str, Any] = {}
        self._camera_sync = {name: TimeSynchronizer(_CAMERA_TOPICS) for name in self._camera_names}
        self._set_sync = TimeSynchronizer(
            self._camera_names, round(settings.slop * 1e9), patience=settings.max_waiting_images
        )
        self._waiting: deque[dict[str, tuple[int, Any]]] = deque()  # sets, for transforms that are yet to come
        self._last_stamp: int | None = None
        self._person_sets = 0
        self._frame = ""

    def warm_up(self) -> None:
        """Segment and carve a synthetic person with another component."""
        other = type(self)(replace(self.settings, hull_every=1, frame=""), self.factory)
        other.set_subscribed("silhouettes", True)
        for port, message in warm_up.make_hull_input(self.factory, self._camera_names):
            other.handle(port, message)

    def reset(self) -> None:
        """Drop the backgrounds, the people and what waits; keep calibrations and frames. Ids go on."""
        self._builder.reset()
        self._matcher.reset()
        for synchronizer in (*self._camera_sync.values(), self._set_sync):
            synchronizer.reset()
        self._waiting.clear()
        self._last_stamp = None
        self._person_sets = 0

    def flush(self) -> Output:
        """Process the sets that still wait."""
        self._waiting += self._set_sync.flush()
        outputs = self._process_waiting(final=True)
        self._update_counters()
        return outputs

    def _process(self, port: str, message: Any) -> Output:
        if port in ("/tf_static", "/tf"):
            self._frame_tree.add(message, moving=port == "/tf")
            return self._process_waiting()
        name, kind = port.rsplit("/", 1)
        if kind == "camera_info":
            self._infos[name] = message
            return []
        for view in self._camera_sync[name].add(kind, stamp_ns(message), message):
            stamp = view["image"][0]
            self._waiting += self._set_sync.add(name, stamp, {key: item for key, (_, item) in view.items()})
        outputs = self._process_waiting()
        self._update_counters()
        return outputs

    def _process_waiting(self, final: bool = False) -> Output:
        """Process the complete sets in line, up to the first one whose cameras' place at its stamp is yet to come."""
        outputs: Output = []
        most = self.settings.max_waiting_images or len(self._waiting)
        while self._waiting and (final or len(self._waiting) > most or not self._is_awaited(self._waiting[0])):
            outputs += self._process_set(self._waiting.popleft())
        return outputs

    def _is_awaited(self, complete: Mapping[str, tuple[int, Any]]) -> bool:
        """Return whether transforms that are yet to come tell where a moving camera is in a set."""
        known = {name: self._infos[name].header.frame_id.lstrip("/") for name in complete if name in self._infos}
        pairs = [
            (name, frame, self.settings.frame or self._frame_tree.find_root(frame)) for name, frame in known.items()
        ]
        return any(
            self._frame_tree.is_connected(frame, root) and self._frame_tree.is_awaited(frame, root, complete[name][0])
            for name, frame, root in pairs
        )

    def _update_counters(self) -> None:
        for level, synchronizer in [("sets", self._set_sync), *self._camera_sync.items()]:
            for reason, count in synchronizer.counters.items():
                self.counters[f"{reason} {level}"] = count

    def _process_set(self, complete: dict[str, tuple[int, Any]]) -> Output:
        stamp = next(iter(complete.values()))[0]
        if self._last_stamp is not None and stamp < self._last_stamp:
            self._builder.reset()
            self._matcher.reset()
            self.counters["restarts"] += 1
            self._person_sets = 0
        self._last_stamp = stamp
        self.counters["sets"] += 1
        cameras = self._calibrate_cameras(complete)
        frames = self._decode_frames(complete, cameras)
        people = self._matcher.match(stamp, cameras, frames)
        if self._matcher.problem:
            self.report.warn(self._matcher.problem)
        if not people:
            return []
        self._person_sets += 1
        carve = self._person_sets % self.settings.hull_every == 0
        if not carve and "silhouettes" not in self._subscribed:
            return []
        segmented = [(person.id, self._segment(frames, person, puppets)) for person, puppets in people]
        header = make_header(self.factory, stamp, self._frame)
        bodies = [self._make_body(self.publish_id(identity), person) for identity, person in segmented]
        headers = {name: complete[name][1]["image"].header for name in frames}
        outputs = self._make_silhouettes(header, bodies, [person for _, person in segmented], headers)
        return outputs + self._make_hull(header, bodies, [person for _, person in segmented]) if carve else outputs

    def _segment(
        self, frames: Mapping[str, CameraFrame], person: PersonInSpace, puppets: Mapping[str, Any]
    ) -> MultiViewPerson:
        views = {
            name: observe_person(self._builder, name, frames[name], puppet, person) for name, puppet in puppets.items()
        }
        return self._builder.segment(views, person.id, (person.joints, person.confidence))

    def _make_body(self, identity: str, person: MultiViewPerson) -> Any:
        names = self._matcher.joint_names
        seen = [Visibility.SEEN] * len(names)
        joints = make_joints(self.factory, names, person.joints, person.confidence, seen)
        confidence = float(person.confidence.mean())
        return self.factory.make("flowing_puppet_msgs/msg/Body", id=identity, confidence=confidence, joints=joints)

    def _calibrate_cameras(self, complete: dict[str, tuple[int, Any]]) -> dict[str, Camera]:
        """Return the calibrated cameras of a set; the others are warned of and left out."""
        cameras: dict[str, Camera] = {}
        for name in complete:
            try:
                cameras[name] = self._make_camera(name, complete[name][0], first=not cameras)
            except InputError as error:
                self.report.count_unusable(error)
                continue
            self._builder.set_camera(name, cameras[name])
        return cameras

    def _make_camera(self, name: str, stamp: int, first: bool) -> Camera:
        """Return a camera at a stamp, ns, in the common frame, which the `first` one sets; InputError if unknown."""
        info = self._infos.get(name)
        if info is None:
            raise InputError(f"no camera_info came yet on {name}/camera_info")
        info = describe_images(info)
        frame = info.header.frame_id
        if first:
            # Looked up for every set: /tf_static may come after the first images.
            self._frame = self.settings.frame or self._frame_tree.find_root(frame.lstrip("/"))
        world = self._frame_tree.lookup_pose(self._frame, frame, stamp)
        if world is None:
            raise InputError(f"{name}: {self._frame_tree.describe_missing(frame, self._frame, stamp)}")
        translation, rotation = world
        size = info.width, info.height
        try:
            return Camera.from_info(info.k, info.d, *size, rotation, translation, info.distortion_model)
        except InputError as error:
            raise InputError(f"{name}: {error}") from error

    def _decode_frames(
        self, complete: dict[str, tuple[int, Any]], cameras: Mapping[str, Camera]
    ) -> dict[str, CameraFrame]:
        """Decode the images in which there are puppets and learn their backgrounds; unusable ones are left out."""
        frames = {}
        for name in cameras:
            item = complete[name][1]
            if not item["puppets"].puppets:
                continue
            try:
                image, labels = decode_image(item["image"]), decode_labels(item["part_labels"])
                frames[name] = CameraFrame(image, labels, list(item["puppets"].puppets))
                learn_background(self._builder, name, frames[name])
            except InputError as error:
                frames.pop(name, None)
                self.report.count_unusable(error)
        return frames

    def _make_silhouettes(
        self, header: Any, bodies: Sequence[Any], people: Sequence[MultiViewPerson], headers: dict[str, Any]
    ) -> Output:
        if "silhouettes" not in self._subscribed:
            return []
        usable = []
        for body, person in zip(bodies, people, strict=True):
            if person.problem:
                self.report.warn(person.problem)
                self.counters["sets without silhouettes"] += 1
            else:
                usable.append((body, person))
        self.counters["silhouettes"] += len(usable)
        cameras, ids = self._builder.cameras, [body.id for body, _ in usable]
        return [
            ("silhouettes", make_silhouettes(self.factory, header, body, cameras, person.masks, headers, ids))
            for body, person in usable
        ]

    def _make_hull(self, header: Any, bodies: Sequence[Any], people: Sequence[MultiViewPerson]) -> Output:
        outputs: Output = [("hull/joints", make_bodies(self.factory, header, [body for body in bodies if body.joints]))]
        hulls = [self._builder.carve(person) for person in people]
        for hull in hulls:
            if hull.problem:
                self.report.warn(hull.problem)
                self.counters["sets without hull"] += 1
        carved = [hull for hull in hulls if not hull.problem]
        self.counters["hulls"] += len(carved)
        if carved:
            points = np.concatenate([hull.points for hull in carved])
            normals = np.concatenate([hull.normals for hull in carved])
            outputs.append(("hull", make_cloud(self.factory, header, points, normals)))
        return outputs


def _camera_ports(camera: str) -> tuple[Port, ...]:
    return (
        Port(f"{camera}/image", IMAGE, "sensor", transport=COMPRESSED),
        Port(f"{camera}/part_labels", IMAGE),
        Port(f"{camera}/puppets", PUPPETS),
        Port(f"{camera}/camera_info", CAMERA_INFO, "sensor"),
    )
