# SPDX-License-Identifier: Apache-2.0
"""Images, part labels and puppets of several calibrated cameras in; silhouettes, joints and visual hull out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.hull_builder import HullBuilder, HullBuilderSettings, MultiViewPerson
from flowing_puppet_ros.multiview.visual_hull import MIN_VIEWS
from flowing_puppet_ros.settings import setting
from flowing_puppet_ros.stream.component import COMPRESSED, Component, Output, Port
from flowing_puppet_ros.stream.components import warm_up
from flowing_puppet_ros.stream.components.person_views import PersonView, same_person, view_of
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
from flowing_puppet_ros.stream.messages.silhouettes import make_silhouettes
from flowing_puppet_ros.stream.time_synchronizer import TimeSynchronizer

_OF_CAMERA = ("image", "part_labels", "puppets")


@dataclass(frozen=True)
class VisualHullSettings(HullBuilderSettings):
    """Settings of silhouettes, triangulation and hull, and of what the component pairs."""

    cameras: str = setting("", "names of the cameras, separated by commas")
    frame: str = setting("", "frame of the hull; empty for the topmost frame of the cameras on /tf_static")
    slop: float = setting(0.008, "largest difference of stamps within one set of images", unit="s", low=0.0, high=1.0)
    patience: int = setting(10, "newer images of a camera that may wait for another that is late or dead, 0: for ever",
                            low=0, high=50)  # fmt: skip
    every: int = setting(6, "sets with a person from one hull to the next; all give silhouettes", low=1, high=9999)


class VisualHullComponent(Component):
    """Cuts one person out of the images and carves its hull; its joints are triangulated from the puppets."""

    settings_type = VisualHullSettings
    fixed = frozenset({"cameras"})
    outputs = (
        Port("silhouettes", SILHOUETTES, lazy=True),
        Port("hull", POINT_CLOUD),
        Port("hull/joints", BODIES),
    )

    def __init__(self, settings: VisualHullSettings, factory: MessageFactory) -> None:
        """Make the ports of the cameras named in the settings; InputError when there are fewer than two."""
        super().__init__(settings, factory)
        self._settings = settings
        self._names = tuple(name for name in (part.strip() for part in settings.cameras.split(",")) if name)
        if len(self._names) < 2 or len(set(self._names)) < len(self._names):
            raise InputError(f"cameras is {settings.cameras!r}: a visual hull needs two or more different names")
        self.inputs = (
            *(port for name in self._names for port in _ports_of(name)),
            Port("/tf_static", TRANSFORMS, "latched"),
        )
        self._builder = HullBuilder(settings)
        self._frames = FrameTree()
        self._infos: dict[str, Any] = {}
        self._of_camera = {name: TimeSynchronizer(_OF_CAMERA) for name in self._names}
        self._sets = TimeSynchronizer(self._names, round(settings.slop * 1e9), patience=settings.patience)
        self._last_stamp: int | None = None
        self._seen = 0
        self._frame = ""

    def warm_up(self) -> None:
        """Cut out and carve somebody made up with a component of its own."""
        other = type(self)(replace(self._settings, every=1, frame=""), self.factory)
        other.set_subscribed("silhouettes", True)
        for port, message in warm_up.cameras(self.factory, self._names):
            other.handle(port, message)

    def reset(self) -> None:
        """Forget backgrounds and what waits; calibrations and frames stay."""
        self._builder.reset()
        for pairing in (*self._of_camera.values(), self._sets):
            pairing.reset()
        self._last_stamp = None
        self._seen = 0

    def flush(self) -> Output:
        """Use the sets that still wait."""
        outputs: Output = []
        for complete in self._sets.flush():
            outputs += self._use(complete)
        self._count_unpaired()
        return outputs

    def _process(self, port: str, message: Any) -> Output:
        if port == "/tf_static":
            self._frames.add(message)
            return []
        name, kind = port.rsplit("/", 1)
        if kind == "camera_info":
            self._infos[name] = message
            return []
        outputs: Output = []
        for seen in self._of_camera[name].add(kind, stamp_ns(message), message):
            stamp = seen["image"][0]
            for complete in self._sets.add(name, stamp, {key: item for key, (_, item) in seen.items()}):
                outputs += self._use(complete)
        self._count_unpaired()
        return outputs

    def _count_unpaired(self) -> None:
        for pairing, level in ((self._sets, "sets"), *((each, name) for name, each in self._of_camera.items())):
            for reason, count in pairing.counters.items():
                self.counters[f"{reason} {level}"] = count

    def _use(self, complete: dict[str, tuple[int, Any]]) -> Output:
        stamp = next(iter(complete.values()))[0]
        if self._last_stamp is not None and stamp < self._last_stamp:
            self._builder.reset()
            self.counters["restarts"] += 1
            self._seen = 0
        self._last_stamp = stamp
        self.counters["sets"] += 1
        views = self._views(complete, self._cameras(complete))
        if len(views) < MIN_VIEWS:
            return []
        self._seen += 1
        carve = self._seen % self._settings.every == 0
        if not carve and "silhouettes" not in self._wanted:
            return []
        person = self._builder.segment({name: view.hull_view for name, view in views.items()})
        header = make_header(self.factory, stamp, self._frame)
        names = next(iter(views.values())).joint_names
        joints = make_joints(self.factory, names, person.joints, person.confidence)
        confidence = float(person.confidence.mean())
        body = self.factory.make("flowing_puppet_msgs/msg/Body", id="b1", confidence=confidence, joints=joints)
        headers = {name: complete[name][1]["image"].header for name in views}
        outputs = self._silhouettes(header, body, person, headers)
        return outputs + self._hull(header, body, person) if carve else outputs

    def _cameras(self, complete: dict[str, tuple[int, Any]]) -> dict[str, Camera]:
        """The calibrated cameras of a set; those that lack something are said and left out."""
        cameras: dict[str, Camera] = {}
        for name in complete:
            try:
                cameras[name] = self._camera(name, first=not cameras)
            except InputError as error:
                self._unusable(error)
                continue
            self._builder.set_camera(name, cameras[name])
        return cameras

    def _camera(self, name: str, first: bool) -> Camera:
        """A calibrated camera in the common frame, which the first one gives; InputError says what is missing."""
        info = self._infos.get(name)
        if info is None:
            raise InputError(f"no camera_info came yet on {name}/camera_info")
        frame = info.header.frame_id
        if first:
            # Looked up for every set: /tf_static may come after the first images.
            self._frame = self._settings.frame or self._frames.root(frame.lstrip("/"))
        world = self._frames.pose(self._frame, frame)
        if world is None:
            raise InputError(f"/tf_static does not connect the frame {frame!r} of {name} with {self._frame!r}")
        translation, rotation = world
        size = info.width, info.height
        try:
            return Camera.from_info(info.k, info.d, *size, rotation, translation, info.distortion_model)
        except InputError as error:
            raise InputError(f"{name}: {error}") from error

    def _views(self, complete: dict[str, tuple[int, Any]], cameras: dict[str, Camera]) -> dict[str, PersonView]:
        """Observe the same person in every camera that sees one; images that cannot be used are said and left out."""
        people = {name: list(complete[name][1]["puppets"].puppets) for name in cameras}
        chosen = same_person(cameras, people, self._settings)
        views = {}
        for name, puppet in chosen.items():
            item = complete[name][1]
            try:
                image, labels = decode_image(item["image"]), decode_labels(item["part_labels"])
                views[name] = view_of(self._builder, name, image, labels, puppet)
            except InputError as error:
                self._unusable(error)
        return views

    def _silhouettes(self, header: Any, body: Any, person: MultiViewPerson, headers: dict[str, Any]) -> Output:
        if "silhouettes" not in self._wanted:
            return []
        if person.problem:
            self._warn(person.problem)
            self.counters["sets without silhouettes"] += 1
            return []
        self.counters["silhouettes"] += 1
        cameras = self._builder.cameras
        return [("silhouettes", make_silhouettes(self.factory, header, body, cameras, person.masks, headers))]

    def _hull(self, header: Any, body: Any, person: MultiViewPerson) -> Output:
        outputs: Output = [("hull/joints", make_bodies(self.factory, header, [body] if body.joints else []))]
        hull = self._builder.carve(person)
        if hull.problem:
            self._warn(hull.problem)
            self.counters["sets without hull"] += 1
        else:
            self.counters["hulls"] += 1
            outputs.append(("hull", make_cloud(self.factory, header, hull.points, hull.normals)))
        return outputs


def _ports_of(camera: str) -> tuple[Port, ...]:
    return (
        Port(f"{camera}/image", IMAGE, "sensor", transport=COMPRESSED),
        Port(f"{camera}/part_labels", IMAGE),
        Port(f"{camera}/puppets", PUPPETS),
        Port(f"{camera}/camera_info", CAMERA_INFO, "sensor"),
    )
