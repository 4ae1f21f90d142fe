# SPDX-License-Identifier: Apache-2.0
"""Which components a recording can feed, found from its topics, and how their topics join."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.settings import Settings
from flowing_puppet_ros.stream.body_fitter import BodyFitterComponent
from flowing_puppet_ros.stream.component import (
    BODIES,
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    POINT_CLOUD,
    PUPPETS,
    Component,
    Port,
)
from flowing_puppet_ros.stream.messages import FrameTree, MessageFactory
from flowing_puppet_ros.stream.puppet_tracker import PuppetTrackerComponent
from flowing_puppet_ros.stream.visual_hull import VisualHullComponent

IMAGE_NAMES = ("image", "image_raw", "image_color", "image_rect", "image_rect_color")
LEAST_CAMERAS = 3
"""Calibrated cameras from which a hull is worth building."""


@dataclass(slots=True, eq=False)
class Instance:
    """A component in the graph: the namespace of its relative topics, and topics that stand for its ports."""

    name: str
    component: Component
    namespace: str
    renamed: dict[str, str] = field(default_factory=dict)
    seconds: float = 0.0

    def topic(self, port: str) -> str:
        """Return the absolute topic of a port."""
        if port in self.renamed:
            return self.renamed[port]
        return port if port.startswith("/") else f"{self.namespace}/{port}"


@dataclass(slots=True, eq=False)
class Graph:
    """The components over a recording, in the order in which messages reach them."""

    instances: list[Instance]

    def routes(self) -> dict[str, list[tuple[Instance, str]]]:
        """Return topic -> the inputs that it feeds; an image's compressed form feeds the same input."""
        found: dict[str, list[tuple[Instance, str]]] = {}
        for instance in self.instances:
            for port in instance.component.inputs:
                topic = instance.topic(port.name)
                topics = (topic, f"{topic}/compressed") if port.compressed else (topic,)
                for each in topics:
                    found.setdefault(each, []).append((instance, port.name))
        return found

    def outputs(self) -> dict[str, Port]:
        """Return topic -> the output port that publishes it."""
        return {instance.topic(port.name): port for instance in self.instances for port in instance.component.outputs}


@dataclass(frozen=True, slots=True)
class Camera:
    """The topics of one camera in a recording."""

    namespace: str
    image: str

    @property
    def name(self) -> str:
        """The camera's name: its namespace without the leading slash."""
        return self.namespace.lstrip("/")


def build_graph(
    topics: Mapping[str, str],
    frames: FrameTree,
    info_frames: Mapping[str, str],
    settings: Mapping[str, Mapping[str, Any]],
    factory: MessageFactory,
) -> Graph:
    """Make the components that the topics (name -> type) of a recording can feed.

    One tracker a camera; a visual hull of three or more cameras that `frames` connects (`info_frames`: topic of
    camera_info -> frame_id); a body fitter for the hull and one for every cloud topic. `settings` are those of each
    kind of component by its name. InputError lists what there is when nothing can be used.
    """
    cameras = _cameras(topics)
    clouds = [topic for topic, kind in topics.items() if kind == POINT_CLOUD and not topic.endswith("/body_vertices")]
    if not cameras and not clouds:
        listed = ", ".join(f"{name} ({kind})" for name, kind in sorted(topics.items())) or "none"
        raise InputError(
            f"no topic can be used: wanted are images named {', '.join(IMAGE_NAMES)}, or point clouds; the topics are "
            f"{listed}; --topic-map OLD:=NEW renames them"
        )
    instances = [_tracker(camera, topics, settings, factory) for camera in cameras]
    calibrated = _calibrated(cameras, frames, info_frames)
    if len(calibrated) >= LEAST_CAMERAS:
        instances += _hull_and_fitter(calibrated, settings, factory)
    for cloud in clouds:
        instances.append(_cloud_fitter(cloud, topics, settings, factory))
    return Graph(instances)


def _cameras(topics: Mapping[str, str]) -> list[Camera]:
    found: dict[str, str] = {}
    for base in IMAGE_NAMES:
        for topic, kind in topics.items():
            image = topic.removesuffix("/compressed") if kind == COMPRESSED_IMAGE else topic
            namespace, _, name = image.rpartition("/")
            if kind in (IMAGE, COMPRESSED_IMAGE) and name == base:
                found.setdefault(namespace, image)
    return [Camera(namespace, found[namespace]) for namespace in sorted(found)]


def _settings(kind: type[Component], name: str, settings: Mapping[str, Mapping[str, Any]], **fixed: Any) -> Settings:
    return kind.settings_type.from_mapping({**settings.get(name, {}), **fixed})


def _tracker(
    camera: Camera, topics: Mapping[str, str], settings: Mapping[str, Mapping[str, Any]], factory: MessageFactory
) -> Instance:
    chosen = _settings(PuppetTrackerComponent, "puppet_tracker", settings)
    component = PuppetTrackerComponent(chosen, factory)  # type: ignore[arg-type]
    instance = Instance(f"{camera.name}/puppet_tracker", component, camera.namespace, {"image": camera.image})
    kinds = {"detections": PUPPETS, "flow/forward": IMAGE, "flow/backward": IMAGE}
    for port, kind in kinds.items():
        component.expects(port, topics.get(instance.topic(port)) == kind)
    return instance


def _calibrated(cameras: list[Camera], frames: FrameTree, info_frames: Mapping[str, str]) -> list[Camera]:
    """Return the largest group of cameras with a camera_info whose frames hang on one root."""
    groups: dict[str, list[Camera]] = {}
    for camera in cameras:
        frame = info_frames.get(f"{camera.namespace}/camera_info", "").lstrip("/")
        root = frames.root(frame) if frame else ""
        if root not in ("", frame):
            groups.setdefault(root, []).append(camera)
    return max(groups.values(), key=len, default=[])


def _hull_and_fitter(
    cameras: list[Camera], settings: Mapping[str, Mapping[str, Any]], factory: MessageFactory
) -> list[Instance]:
    names = ",".join(camera.name for camera in cameras)
    chosen = _settings(VisualHullComponent, "visual_hull", settings, cameras=names)
    hull = VisualHullComponent(chosen, factory)  # type: ignore[arg-type]
    renamed = {f"{camera.name}/image": camera.image for camera in cameras}
    fitter = BodyFitterComponent(_settings(BodyFitterComponent, "body_fitter", settings), factory)  # type: ignore[arg-type]
    fitter.expects("initial", True)
    joined = {"points": "/hull", "initial": "/hull/joints"}
    return [Instance("visual_hull", hull, "", renamed), Instance("body_fitter", fitter, "", joined)]


def _cloud_fitter(
    cloud: str, topics: Mapping[str, str], settings: Mapping[str, Mapping[str, Any]], factory: MessageFactory
) -> Instance:
    namespace = cloud.rpartition("/")[0]
    fitter = BodyFitterComponent(_settings(BodyFitterComponent, "body_fitter", settings), factory)  # type: ignore[arg-type]
    instance = Instance(f"{cloud.lstrip('/')}/body_fitter", fitter, namespace, {"points": cloud})
    fitter.expects("initial", topics.get(instance.topic("initial")) == BODIES)
    return instance


def info_topics(topics: Mapping[str, str]) -> list[str]:
    """Return the topics of type CameraInfo."""
    return [topic for topic, kind in topics.items() if kind == CAMERA_INFO]
