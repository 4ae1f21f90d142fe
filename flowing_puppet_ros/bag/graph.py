# SPDX-License-Identifier: Apache-2.0
"""Which components a recording can feed, found from its topics, and how their topics join."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from flowing_puppet_ros.bag.depth_topics import depth_topics, holds_depth
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.multiview.camera import Camera as CameraModel
from flowing_puppet_ros.settings import Settings
from flowing_puppet_ros.stream.component import Component, Port, base_topic
from flowing_puppet_ros.stream.components.body_fitter import BodyFitterComponent
from flowing_puppet_ros.stream.components.puppet_tracker import PuppetTrackerComponent
from flowing_puppet_ros.stream.components.visual_hull import VisualHullComponent
from flowing_puppet_ros.stream.messages.geometry import FrameTree
from flowing_puppet_ros.stream.messages.message_types import (
    BODIES,
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    POINT_CLOUD,
    PUPPETS,
    MessageFactory,
)

IMAGE_NAMES = ("image", "image_raw", "image_color", "image_rect", "image_rect_color")
LEAST_CAMERAS = 2
"""Calibrated cameras from which a person is fitted and a hull is built."""


@dataclass(slots=True, eq=False)
class Instance:
    """A component in the graph: the namespace of its relative topics, and topics that stand for its ports.

    An input that stands for no topic ("") gets nothing.
    """

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
    """The components over a recording, in the order in which messages reach them; `notes` say what it lacks."""

    instances: list[Instance]
    notes: list[str] = field(default_factory=list)

    def routes(self, recorded: Mapping[str, str]) -> dict[str, list[tuple[Instance, str]]]:
        """Return topic -> the inputs that it feeds, `recorded` being the recording's topics and their types.

        An image's compressed form feeds the same input, unless the image itself was recorded too. A recorded topic of
        another type than the input's feeds nothing.
        """
        found: dict[str, list[tuple[Instance, str]]] = {}
        for instance in self.instances:
            for port in instance.component.inputs:
                topic = instance.topic(port.name)
                if not topic:
                    continue
                kinds = (port.type, COMPRESSED_IMAGE) if port.transport else (port.type,)
                if recorded.get(topic, port.type) in kinds:
                    found.setdefault(topic, []).append((instance, port.name))
                if port.transport and topic not in recorded:
                    found.setdefault(f"{topic}/{port.transport}", []).append((instance, port.name))
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
    encoded: Mapping[str, str],
    frames: FrameTree,
    infos: Mapping[str, Any],
    settings: Mapping[str, Mapping[str, Any]],
    factory: MessageFactory,
) -> Graph:
    """Make the components that the topics (name -> type) of a recording can feed.

    One tracker a camera; a visual hull of two or more cameras that `frames` connects (`infos`: topic -> its first
    CameraInfo); a body fitter for their silhouettes and one for every topic of clouds or depth images (`encoded`: image
    topic -> encoding). `settings` are those of each kind of component by its name. What the recording holds of their
    outputs is not used: it is made anew. InputError lists what there is when nothing can be used.
    """
    cameras = _cameras({name: kind for name, kind in topics.items() if not holds_depth(name, encoded.get(name, ""))})
    clouds = [topic for topic, kind in topics.items() if kind == POINT_CLOUD and not topic.endswith("/body_vertices")]
    depths, depth_notes = depth_topics(topics, encoded, clouds)
    if not cameras and not clouds and not depths:
        raise InputError("; ".join([_nothing_usable(topics), *depth_notes]))
    graph = Graph([_tracker(camera, topics, settings, factory) for camera in cameras])
    graph.notes += [*_detection_notes(graph.instances, topics), *depth_notes]
    if len(cameras) >= LEAST_CAMERAS:
        calibrated, note = _calibrated(cameras, frames, infos)
        graph.notes += [note] if note else []
        if len(calibrated) >= LEAST_CAMERAS:
            graph.instances += _hull_and_fitter(calibrated, settings, factory)
    made = graph.outputs()
    for topic in (*(cloud for cloud in clouds if cloud not in made), *depths):
        port = "depth" if topic in depths else "points"
        fitter = _scene_fitter(port, topic, topics, settings, factory)
        if fitter.topic("bodies") in graph.outputs():  # of another cloud in the same namespace
            fitter.namespace = topic
        graph.instances.append(fitter)
    return graph


def _nothing_usable(topics: Mapping[str, str]) -> str:
    listed = ", ".join(f"{name} ({kind})" for name, kind in sorted(topics.items())) or "none"
    images = sorted(name for name, kind in topics.items() if kind in (IMAGE, COMPRESSED_IMAGE))
    old = images[0] if images else "OLD"
    new = f"{base_topic(old).rpartition('/')[0]}/image" if images else "NEW"
    return (
        f"no topic can be used: wanted are images named {', '.join(IMAGE_NAMES)}, depth images with their "
        f"camera_info, or point clouds; the topics are {listed}; --topic-map {old}:={new} renames one"
    )


def _detection_notes(trackers: list[Instance], topics: Mapping[str, str]) -> list[str]:
    """Say in which cameras the package's own detector finds the people though the recording seems to have them."""
    wanted = [tracker.topic("detections") for tracker in trackers]
    others = sorted(name for name, kind in topics.items() if kind == PUPPETS and name not in wanted)
    return [
        f"the detector of this package finds the people in {tracker.topic('image')}: there are no keypoints "
        f"({PUPPETS}) on {topic}"
        + (f", not {topics[topic]}" if topic in topics else "")
        + (f"; --topic-map {others[0]}:={topic} takes those that are there" if others else "")
        for tracker, topic in zip(trackers, wanted, strict=True)
        if topics.get(topic) != PUPPETS and (others or topic in topics)
    ]


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
        component.set_expected(port, topics.get(instance.topic(port)) == kind)
    return instance


def _calibrated(cameras: list[Camera], frames: FrameTree, infos: Mapping[str, Any]) -> tuple[list[Camera], str]:
    """Return the largest group of calibrated cameras whose frames hang on one root, and why others are not in it."""
    groups: dict[str, list[Camera]] = {}
    reasons = []
    for camera in cameras:
        try:
            groups.setdefault(_root(camera, frames, infos), []).append(camera)
        except InputError as error:
            reasons.append(f"{camera.name}: {error}")
    chosen = max(groups.values(), key=len, default=[])
    for root, group in groups.items():
        if group is not chosen:
            reasons += [f"{camera.name}: its frames end in {root!r}" for camera in group]
    if not reasons:
        return chosen, ""
    what = "without these cameras" if len(chosen) >= LEAST_CAMERAS else f"not built, it needs {LEAST_CAMERAS} cameras"
    return chosen, f"the visual hull is {what} ({'; '.join(reasons)})"


def _root(camera: Camera, frames: FrameTree, infos: Mapping[str, Any]) -> str:
    """Return the frame above a camera's frame; InputError when the camera is not calibrated or hangs on nothing."""
    info = infos.get(f"{camera.namespace}/camera_info")
    if info is None:
        raise InputError(f"there is no {camera.namespace}/camera_info")
    frame = info.header.frame_id.lstrip("/")
    root = frames.root(frame)
    if root == frame:
        raise InputError(f"/tf_static has no transform to its frame {frame!r}")
    placed = frames.pose(root, frame)
    assert placed is not None
    translation, rotation = placed
    CameraModel.from_info(info.k, info.d, info.width, info.height, rotation, translation, info.distortion_model)
    return root


def _hull_and_fitter(
    cameras: list[Camera], settings: Mapping[str, Mapping[str, Any]], factory: MessageFactory
) -> list[Instance]:
    names = ",".join(camera.name for camera in cameras)
    chosen = _settings(VisualHullComponent, "visual_hull", settings, cameras=names)
    hull = VisualHullComponent(chosen, factory)  # type: ignore[arg-type]
    renamed = {f"{camera.name}/image": camera.image for camera in cameras}
    fitter = BodyFitterComponent(_settings(BodyFitterComponent, "body_fitter", settings), factory)  # type: ignore[arg-type]
    joined = {"silhouettes": "/silhouettes", "points": "", "depth": "", "camera_info": "", "initial": ""}
    return [Instance("visual_hull", hull, "", renamed), Instance("body_fitter", fitter, "", joined)]


def _scene_fitter(
    port: str,
    topic: str,
    topics: Mapping[str, str],
    settings: Mapping[str, Mapping[str, Any]],
    factory: MessageFactory,
) -> Instance:
    """A body fitter whose `port` (points, or depth with the camera_info beside it) is `topic`."""
    namespace = topic.rpartition("/")[0]
    fitter = BodyFitterComponent(_settings(BodyFitterComponent, "body_fitter", settings), factory)  # type: ignore[arg-type]
    renamed = {"points": "", "depth": "", "camera_info": "", "silhouettes": "", port: topic}
    if port == "depth":
        renamed["camera_info"] = f"{namespace}/camera_info"
    instance = Instance(f"{topic.lstrip('/')}/body_fitter", fitter, namespace, renamed)
    fitter.set_expected("initial", topics.get(instance.topic("initial")) == BODIES)
    return instance


def info_topics(topics: Mapping[str, str]) -> list[str]:
    """Return the topics of type CameraInfo."""
    return [topic for topic, kind in topics.items() if kind == CAMERA_INFO]
