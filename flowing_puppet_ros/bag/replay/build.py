# SPDX-License-Identifier: Apache-2.0
"""Which components a recording can feed, by its topics: trackers, a visual hull, body fitters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from flowing_puppet_ros.bag.depth_topics import (
    DepthTopic,
    ImageSample,
    find_rig,
    find_rig_of_cameras,
    holds_depth,
    select_depth_topics,
)
from flowing_puppet_ros.bag.replay.cameras import (
    IMAGE_NAMES,
    MIN_CAMERAS,
    CameraTopics,
    find_cameras,
    select_calibrated,
)
from flowing_puppet_ros.bag.replay.colour_topics import ColourTopics, choose_colour, find_colour_topics
from flowing_puppet_ros.bag.replay.graph import Graph, Instance, find_skeletons
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.settings import Settings
from flowing_puppet_ros.stream.component import COMPRESSED_DEPTH, base_topic
from flowing_puppet_ros.stream.components.body_fitter import BodyFitterComponent, BodyFitterSettings
from flowing_puppet_ros.stream.components.puppet_tracker import PuppetTrackerComponent, PuppetTrackerSettings
from flowing_puppet_ros.stream.components.visual_hull import VisualHullComponent, VisualHullSettings
from flowing_puppet_ros.stream.messages.detections import UNDERSTOOD
from flowing_puppet_ros.stream.messages.geometry import FrameTree
from flowing_puppet_ros.stream.messages.message_types import (
    BODIES,
    COMPRESSED_IMAGE,
    IDS_LIST,
    IMAGE,
    POINT_CLOUD,
    PUPPETS,
    MessageFactory,
)

COLOUR_INPUTS = ("puppets", "person_masks", "puppets/camera_info")
"""What a body fitter takes of a colour camera."""
_DETECTIONS = next(port for port in PuppetTrackerComponent.inputs if port.name == "detections")


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
        calibrated, note = select_calibrated(cameras, moving or frames, infos)
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
    empty = {name for name in lists if ours or not find_skeletons(name, topics)}
    return found - made - empty


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
    remapped = dict.fromkeys(("points", "depth", "camera_info", "silhouettes", *COLOUR_INPUTS), "")
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
    fitter.remapped |= {port: tracker.resolve(port) for port in COLOUR_INPUTS} | {"puppets/camera_info": colour.info}
    for port in COLOUR_INPUTS:
        fitter.component.set_expected(port, True)
