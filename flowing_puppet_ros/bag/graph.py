# SPDX-License-Identifier: Apache-2.0
"""The components that a recording can feed, found from its topics, and how their topics connect."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from flowing_puppet_ros.bag.colour_topics import ColourTopics, choose_colour, find_colour_topics
from flowing_puppet_ros.bag.depth_topics import (
    DepthTopic,
    ImageSample,
    find_rig,
    find_rig_of_cameras,
    holds_depth,
    select_depth_topics,
)
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.settings import Settings
from flowing_puppet_ros.stream.component import COMPRESSED_DEPTH, Component, Port, base_topic
from flowing_puppet_ros.stream.components.body_fitter import BodyFitterComponent, BodyFitterSettings
from flowing_puppet_ros.stream.components.puppet_tracker import PuppetTrackerComponent, PuppetTrackerSettings
from flowing_puppet_ros.stream.components.visual_hull import VisualHullComponent, VisualHullSettings
from flowing_puppet_ros.stream.messages.detections import UNDERSTOOD, find_body_id
from flowing_puppet_ros.stream.messages.geometry import FrameTree
from flowing_puppet_ros.stream.messages.message_types import (
    BODIES,
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IDS_LIST,
    IMAGE,
    POINT_CLOUD,
    PUPPETS,
    SKELETON_2D,
    MessageFactory,
)

IMAGE_NAMES = ("image", "image_raw", "image_color", "image_rect", "image_rect_color")
"""Last names of the image topics of cameras, in order of preference."""
_DETECTIONS = next(port for port in PuppetTrackerComponent.inputs if port.name == "detections")
MIN_CAMERAS = 2
"""Minimum calibrated cameras for a visual hull and the fit to its silhouettes."""


@dataclass(slots=True, eq=False)
class Instance:
    """A component in the graph: the namespace of its relative topics, and port -> topic for remapped ports.

    An input that is remapped to "" gets nothing.
    """

    name: str
    component: Component[Any]
    namespace: str
    remapped: dict[str, str] = field(default_factory=dict)
    seconds: float = 0.0

    def resolve(self, port: str) -> str:
        """Return the absolute topic of a port."""
        if port in self.remapped:
            return self.remapped[port]
        return port if port.startswith("/") else f"{self.namespace}/{port}"


@dataclass(slots=True, eq=False)
class Graph:
    """The components for a recording, in the order in which messages reach them; `notes` say what is missing."""

    instances: list[Instance]
    notes: list[str] = field(default_factory=list)

    def find_routes(self, recorded: Mapping[str, str]) -> dict[str, list[tuple[Instance, str]]]:
        """Return topic -> (instance, input port) it feeds; `recorded` is topic -> type of the recording.

        An image's compressed topic feeds the same input, unless the raw image was recorded too, and so do the skeletons
        of the bodies in a list. A recorded topic of another type than the input's feeds nothing.
        """
        found: dict[str, list[tuple[Instance, str]]] = {}
        for instance in self.instances:
            for port in instance.component.inputs:
                topic = instance.resolve(port.name)
                if not topic:
                    continue
                kind = recorded.get(topic, port.type)
                if port.accepts(kind) or (port.transport and kind == COMPRESSED_IMAGE):
                    found.setdefault(topic, []).append((instance, port.name))
                if port.accepts(kind) and kind == IDS_LIST:
                    for skeleton in _find_skeletons(topic, recorded):
                        found.setdefault(skeleton, []).append((instance, port.name))
                if port.transport and topic not in recorded:
                    found.setdefault(f"{topic}/{port.transport}", []).append((instance, port.name))
        return found

    def find_outputs(self) -> dict[str, Port]:
        """Return topic -> the output port that publishes it."""
        return {instance.resolve(port.name): port for instance in self.instances for port in instance.component.outputs}


@dataclass(frozen=True, slots=True)
class CameraTopics:
    """The topics of one camera in a recording."""

    namespace: str
    image: str

    @property
    def name(self) -> str:
        """The camera's name: its namespace without the leading slash."""
        return self.namespace.lstrip("/")


def build_graph(
    topics: Mapping[str, str],
    samples: Mapping[str, ImageSample],
    frames: FrameTree,
    infos: Mapping[str, Any],
    settings: Mapping[str, Mapping[str, Any]],
    factory: MessageFactory,
    cloud_frames: Mapping[str, str] | None = None,
    moving: FrameTree | None = None,
) -> Graph:
    """Make the components that the topics (name -> type) of a recording can feed.

    - One tracker per camera.
    - One visual hull of two or more cameras that `frames` connects (`infos`: topic -> its first CameraInfo), and one
      body fitter for its silhouettes.
    - One body fitter for all depth cameras that `frames` connects and that look at the same people; it is the one for
      the silhouettes too, if these are of the same people.
    - One body fitter for every other topic of clouds or depth images (`samples`: image topic -> its first image;
      `cloud_frames`: cloud topic -> its frame), joined with the puppets of a colour camera that looks there too.

    `moving` connects frames that move against each other too, as a camera on a head and a LiDAR do.
    `settings` is component name -> setting -> value. Outputs of these components in the recording are not used but
    made again. InputError lists the topics if nothing can be used.
    """
    of_depth = {name for name, sample in samples.items() if holds_depth(name, sample.encoding)}
    cameras = find_cameras({name: kind for name, kind in topics.items() if name not in of_depth})
    clouds = [topic for topic, kind in topics.items() if kind == POINT_CLOUD and not topic.endswith("/body_vertices")]
    depths, depth_notes = select_depth_topics(samples, infos, clouds)
    if not cameras and not clouds and not depths:
        raise InputError("; ".join([_describe_unusable(topics), *depth_notes]))
    graph = Graph([_make_tracker(camera, topics, settings, factory) for camera in cameras])
    graph.notes += [*_note_missing_detections(graph.instances, topics), *depth_notes]
    calibrated: list[CameraTopics] = []
    if len(cameras) >= MIN_CAMERAS:
        calibrated, note = _select_calibrated(cameras, moving or frames, infos)
        graph.notes += [note] if note else []
        if len(calibrated) >= MIN_CAMERAS:
            graph.instances += _make_hull_and_fitter(calibrated, settings, factory)
    made = graph.find_outputs()
    rig = find_rig(depths, infos, frames)
    around = [infos[f"{camera.namespace}/camera_info"] for camera in calibrated] if len(calibrated) > 1 else []
    joined = find_rig_of_cameras(depths, around, infos, frames)
    if joined:  # what the silhouettes show and what depth shows is one body
        rig = [depth for depth in depths if depth in (*rig, *joined)]
        graph.instances = [each for each in graph.instances if each.name != "body_fitter"]
    if rig:
        graph.instances.append(_make_rig_fitter(rig, bool(joined), "/bodies" in made, settings, factory))
        depths = [depth for depth in depths if depth not in rig]
    sources: list[str | DepthTopic] = [*(cloud for cloud in clouds if cloud not in made), *depths]
    trackers = {tracker.resolve("image"): tracker for tracker in graph.instances if "image" in tracker.remapped}
    colours = find_colour_topics(list(trackers), samples, infos)
    for source in sources:
        topic = source.image if isinstance(source, DepthTopic) else source
        colour, note = choose_colour(topic, _find_frame(topic, samples, cloud_frames or {}), colours, moving or frames)
        graph.notes += [note] if note else []
        fitter = _make_scene_fitter(source, topics, settings, factory)
        if colour is not None:
            _join_colour(fitter, trackers[colour.image], colour, settings, factory)
        if fitter.resolve("bodies") in graph.find_outputs():  # by another cloud in the same namespace
            fitter.namespace = f"/{fitter.name.removesuffix('/body_fitter')}"
        graph.instances.append(fitter)
    for instance in graph.instances:  # people have the ids that a node of this name and namespace would give them
        instance.component.node = f"{instance.namespace}/{instance.name.rpartition('/')[2]}"
    return graph


def _describe_unusable(topics: Mapping[str, str]) -> str:
    listed = ", ".join(f"{name} ({kind})" for name, kind in sorted(topics.items())) or "none"
    images = sorted(name for name, kind in topics.items() if kind in (IMAGE, COMPRESSED_IMAGE))
    old = images[0] if images else "OLD"
    new = f"{base_topic(old).rpartition('/')[0]}/image" if images else "NEW"
    return (
        f"no topic can be used: wanted are images named {', '.join(IMAGE_NAMES)}, depth images with their "
        f"camera_info, or point clouds; the topics are {listed}; --topic-map {old}:={new} renames one"
    )


def _note_missing_detections(trackers: list[Instance], topics: Mapping[str, str]) -> list[str]:
    """Return notes on cameras for which the own detector runs although the recording seems to have detections."""
    wanted = [tracker.resolve("detections") for tracker in trackers]
    others = sorted(_find_detections(topics, trackers) - set(wanted))
    return [
        f"the detector of this package finds the people in {tracker.resolve('image')}: there are no keypoints "
        f"on {topic}"
        + (f", not {topics[topic]} ({UNDERSTOOD})" if topic in topics else "")
        + (f"; --topic-map {others[0]}:={topic} takes those that are there" if others else "")
        for tracker, topic in zip(trackers, wanted, strict=True)
        if not _DETECTIONS.accepts(topics.get(topic, "")) and (others or topic in topics)
    ]


def _find_detections(topics: Mapping[str, str], trackers: list[Instance]) -> set[str]:
    """Return the topics that may hold somebody's detections, not the trackers' own puppets and bodies."""
    made = {tracker.resolve(port.name) for tracker in trackers for port in tracker.component.outputs}
    found = {name for name, kind in topics.items() if _DETECTIONS.accepts(kind)}
    lists = {name for name in found if topics[name] == IDS_LIST}
    ours = any(topics[name] == PUPPETS for name in found & made)
    empty = {name for name in lists if ours or not _find_skeletons(name, topics)}
    return found - made - empty


def _find_skeletons(listing: str, topics: Mapping[str, str]) -> list[str]:
    """Return the topics of the skeletons of the bodies that are listed on the topic `listing`."""
    return sorted(name for name, kind in topics.items() if kind == SKELETON_2D and find_body_id(listing, name))


def find_cameras(topics: Mapping[str, str]) -> list[CameraTopics]:
    """Return the cameras whose images are among the topics (name -> type), by namespace."""
    found: dict[str, str] = {}
    for base in IMAGE_NAMES:
        for topic, kind in topics.items():
            image = topic.removesuffix("/compressed") if kind == COMPRESSED_IMAGE else topic
            namespace, _, name = image.rpartition("/")
            if kind in (IMAGE, COMPRESSED_IMAGE) and name == base:
                found.setdefault(namespace, image)
    return [CameraTopics(namespace, found[namespace]) for namespace in sorted(found)]


def _make_settings[S: Settings](kind: type[S], name: str, settings: Mapping[str, Mapping[str, Any]], **fixed: Any) -> S:
    return kind.from_mapping({**settings.get(name, {}), **fixed})


def _make_tracker(
    camera: CameraTopics, topics: Mapping[str, str], settings: Mapping[str, Mapping[str, Any]], factory: MessageFactory
) -> Instance:
    chosen = _make_settings(PuppetTrackerSettings, "puppet_tracker", settings)
    component = PuppetTrackerComponent(chosen, factory)
    instance = Instance(f"{camera.name}/puppet_tracker", component, camera.namespace, {"image": camera.image})
    for port in component.inputs:
        if port.optional:
            component.set_expected(port.name, port.accepts(topics.get(instance.resolve(port.name), "")))
    return instance


def _select_calibrated(
    cameras: list[CameraTopics], frames: FrameTree, infos: Mapping[str, Any]
) -> tuple[list[CameraTopics], str]:
    """Return the largest group of calibrated cameras with a common root frame, and why others are not in it."""
    groups: dict[str, list[CameraTopics]] = {}
    reasons = []
    for camera in cameras:
        try:
            groups.setdefault(_find_root(camera, frames, infos), []).append(camera)
        except InputError as error:
            reasons.append(f"{camera.name}: {error}")
    chosen = max(groups.values(), key=len, default=[])
    for root, group in groups.items():
        if group is not chosen:
            reasons += [f"{camera.name}: its frames end in {root!r}" for camera in group]
    if not reasons:
        return chosen, ""
    what = "without these cameras" if len(chosen) >= MIN_CAMERAS else f"not built, it needs {MIN_CAMERAS} cameras"
    return chosen, f"the visual hull is {what} ({'; '.join(reasons)})"


def _find_root(camera: CameraTopics, frames: FrameTree, infos: Mapping[str, Any]) -> str:
    """Return the root of a camera's frame; InputError if the camera is not calibrated or its frame has no parent."""
    info = infos.get(f"{camera.namespace}/camera_info")
    if info is None:
        raise InputError(f"there is no {camera.namespace}/camera_info")
    frame = info.header.frame_id.lstrip("/")
    root = frames.find_root(frame)
    if root == frame:
        raise InputError(f"/tf_static has no transform to its frame {frame!r}")
    pose = frames.lookup_pose(root, frame)
    assert pose is not None
    translation, rotation = pose
    Camera.from_info(info.k, info.d, info.width, info.height, rotation, translation, info.distortion_model)
    return root


def _make_hull_and_fitter(
    cameras: list[CameraTopics], settings: Mapping[str, Mapping[str, Any]], factory: MessageFactory
) -> list[Instance]:
    names = ",".join(camera.name for camera in cameras)
    chosen = _make_settings(VisualHullSettings, "visual_hull", settings, cameras=names)
    hull = VisualHullComponent(chosen, factory)
    remapped = {f"{camera.name}/image": camera.image for camera in cameras}
    fitter = BodyFitterComponent(_make_settings(BodyFitterSettings, "body_fitter", settings), factory)
    published = {port.name for port in fitter.outputs}
    remapped_inputs = {port.name: "" for port in fitter.inputs if port.name not in published}
    remapped_inputs["silhouettes"] = "/silhouettes"
    return [Instance("visual_hull", hull, "", remapped), Instance("body_fitter", fitter, "", remapped_inputs)]


def _make_scene_fitter(
    source: str | DepthTopic,
    topics: Mapping[str, str],
    settings: Mapping[str, Mapping[str, Any]],
    factory: MessageFactory,
) -> Instance:
    """Return a body fitter for a topic of clouds, or for depth images with their camera_info."""
    remapped = dict.fromkeys(("points", "depth", "camera_info", "silhouettes", "puppets", "puppets/camera_info"), "")
    if isinstance(source, DepthTopic):
        topic = base_topic(source.image)
        remapped |= {"depth": source.image, "camera_info": source.info}
    else:
        topic = source
        remapped["points"] = source
    fitter = BodyFitterComponent(_make_settings(BodyFitterSettings, "body_fitter", settings), factory)
    instance = Instance(f"{topic.lstrip('/')}/body_fitter", fitter, topic.rpartition("/")[0], remapped)
    fitter.set_expected("initial", topics.get(instance.resolve("initial")) == BODIES)
    return instance


def _make_rig_fitter(
    rig: list[DepthTopic],
    has_silhouettes: bool,
    has_bodies: bool,
    settings: Mapping[str, Mapping[str, Any]],
    factory: MessageFactory,
) -> Instance:
    """Return the body fitter for depth cameras together, with the silhouettes of the same people if there are any.

    Without, it is below `depth_cameras` where others make /bodies.
    """
    fixed = {"rig.cameras": ",".join(depth.name for depth in rig)}
    chosen = {"": {**fixed, **settings.get("body_fitter", {})}}
    remapped = {"silhouettes": "/silhouettes" if has_silhouettes else ""}
    for depth in rig:
        remapped |= {f"{depth.name}/depth": depth.image, f"{depth.name}/camera_info": depth.info}
        remapped[f"{depth.name}/points"] = ""
    fitter = BodyFitterComponent(_make_settings(BodyFitterSettings, "", chosen), factory)
    fitter.set_expected("silhouettes", has_silhouettes)
    namespace = "/depth_cameras" if has_bodies and not has_silhouettes else ""
    return Instance(f"{namespace}/body_fitter".lstrip("/"), fitter, namespace, remapped)


def _find_frame(topic: str, samples: Mapping[str, ImageSample], cloud_frames: Mapping[str, str]) -> str:
    """Return the frame of the depth images or clouds on a topic, "" where it is not known."""
    sample = next((samples[name] for name in (topic, f"{topic}/{COMPRESSED_DEPTH}") if name in samples), None)
    return sample.frame if sample else cloud_frames.get(topic, "").lstrip("/")


def _join_colour(
    fitter: Instance,
    tracker: Instance,
    colour: ColourTopics,
    settings: Mapping[str, Mapping[str, Any]],
    factory: MessageFactory,
) -> None:
    """Let a body fitter take the puppets of a tracker, with the calibration of its camera."""
    if colour.rectified:
        chosen = {"fusion.rectified": True, **settings.get("body_fitter", {})}
        fitter.component = BodyFitterComponent(_make_settings(BodyFitterSettings, "", {"": chosen}), factory)
    fitter.remapped |= {"puppets": tracker.resolve("puppets"), "puppets/camera_info": colour.info}
    for port in ("puppets", "puppets/camera_info"):
        fitter.component.set_expected(port, True)


def find_info_topics(topics: Mapping[str, str]) -> list[str]:
    """Return the topics of type CameraInfo."""
    return [topic for topic, kind in topics.items() if kind == CAMERA_INFO]
