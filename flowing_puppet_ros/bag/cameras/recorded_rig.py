# SPDX-License-Identifier: Apache-2.0
"""The rig and the tracked people of the cameras in a bag."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flowing_puppet_ros.bag.frames import open_bag_frames
from flowing_puppet_ros.bag.reader import Bag, open_bag
from flowing_puppet_ros.bag.replay.cameras import MIN_CAMERAS, find_cameras, find_info_topics
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.networks.keypoint_networks import KeypointSource
from flowing_puppet_ros.image.video.clip import Clip, Progress, track_clip
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.multiview.association.view import PersonInView
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.rig.rig import CameraRig, RigCamera
from flowing_puppet_ros.stream.messages.geometry import FrameTree, stamp_ns
from flowing_puppet_ros.stream.messages.message_types import COMPRESSED_IMAGE, PUPPETS, TRANSFORMS
from flowing_puppet_ros.stream.messages.puppets import decode_puppet_joints
from flowing_puppet_ros.units import NANOSECONDS

type Frames = dict[str, list[tuple[float, list[PersonInView]]]]
"""Camera -> (stamp in seconds since the first image of any camera, people) of its images, in order."""


@dataclass(frozen=True, slots=True, eq=False)
class RecordedRig:
    """The calibrated cameras of a bag, metres, and the image topic of each, "" where it has puppets only."""

    rig: CameraRig
    topics: dict[str, str]


def read_recorded_rig(path: Path, warn: Callable[[str], None]) -> RecordedRig:
    """Read camera_info and /tf_static of all cameras; InputError when fewer than two are calibrated in one frame."""
    with open_bag(path) as bag:
        frames = FrameTree()
        for record in bag.messages([name for name, kind in bag.topics.items() if kind == TRANSFORMS]):
            with suppress(InputError):
                frames.add(record.message)
        infos = _read_infos(bag)
        groups: dict[str, dict[str, RigCamera]] = {}
        topics: dict[str, str] = {}
        images = {camera.namespace: camera.image for camera in find_cameras(bag.topics)}
        # What `replay` writes has puppets without images.
        tracked = {name.removesuffix("/puppets") for name, kind in bag.topics.items() if kind == PUPPETS}
        for namespace in sorted({*images, *(name for name in tracked if f"{name}/camera_info" in infos)}):
            info = infos.get(f"{namespace}/camera_info")
            if info is None:
                warn(f"there is no {namespace}/camera_info: {namespace.lstrip('/')} is left out")
                continue
            root, found = _place(info, frames)
            name, image = namespace.lstrip("/"), images.get(namespace, "")
            groups.setdefault(root, {})[name] = RigCamera(found)
            topics[name] = f"{image}/compressed" if bag.topics.get(f"{image}/compressed") == COMPRESSED_IMAGE else image
    cameras = max(groups.values(), key=len, default={})
    if len(cameras) < MIN_CAMERAS:
        raise InputError(
            f"{path} has {len(cameras)} cameras with camera_info whose poses /tf_static connects; give two"
        )
    return RecordedRig(CameraRig(cameras, "m"), {name: topics[name] for name in cameras})


def _read_infos(bag: Bag) -> dict[str, Any]:
    wanted = find_info_topics(bag.topics)
    infos: dict[str, Any] = {}
    for record in bag.messages(wanted) if wanted else ():
        with suppress(InputError):
            infos.setdefault(record.topic, record.message)
        if len(infos) == len(wanted):
            break
    return infos


def _place(info: Any, frames: FrameTree) -> tuple[str, Camera]:
    frame = info.header.frame_id.lstrip("/")
    root = frames.find_root(frame)
    pose = frames.lookup_pose(root, frame)
    assert pose is not None
    translation, rotation = pose  # of the root frame in the camera's: world to camera
    return root, Camera.from_info(info.k, info.d, info.width, info.height, rotation, translation, info.distortion_model)


def read_people(
    path: Path,
    recorded: RecordedRig,
    networks: KeypointSource | None,
    warn: Callable[[str], None],
    progress: Progress = lambda frames, title: frames,
) -> tuple[tuple[str, ...], Frames]:
    """Return the names of joints and everybody in the images: the bag's own puppets, or else tracked now.

    Tracking starts from the bag's detections, or from the `networks`.
    """
    names, frames = _read_puppets(path, list(recorded.topics))
    missing = [name for name in recorded.topics if name not in frames]
    if missing:
        model = DeformableStructures.load(parts=14)
        if frames and names != model.joint_names:
            warn("the puppets in the bag have other joints than those tracked now: everybody is tracked again")
            missing, frames = list(recorded.topics), {}
        names = tuple(model.joint_names)
        for name in missing:
            if not recorded.topics[name]:
                raise InputError(f"{path} has neither images nor puppets of {name}: give the bag with the images")
            frames[name] = _track(path, recorded.topics[name], name, model, networks, warn, progress)
    first = min(group[0][0] for group in frames.values() if group) if any(frames.values()) else 0.0
    return names, {name: [(time - first, people) for time, people in frames[name]] for name in recorded.topics}


def _read_puppets(path: Path, cameras: Sequence[str]) -> tuple[tuple[str, ...], Frames]:
    names: tuple[str, ...] = ()
    found: Frames = {}
    with open_bag(path) as bag:
        topics = [f"/{name}/puppets" for name in cameras if bag.topics.get(f"/{name}/puppets") == PUPPETS]
        for record in bag.messages(topics) if topics else ():
            people = []
            for number, puppet in enumerate(record.message.puppets):
                names = names or tuple(joint.name for joint in puppet.joints)
                if tuple(joint.name for joint in puppet.joints) == names:
                    people.append(PersonInView(puppet.id or f"p{number}", *decode_puppet_joints(puppet)))
            time = stamp_ns(record.message) / NANOSECONDS
            found.setdefault(record.topic.removesuffix("/puppets").lstrip("/"), []).append((time, people))
    return names, found


def _track(
    path: Path,
    topic: str,
    title: str,
    model: DeformableStructures,
    networks: KeypointSource | None,
    warn: Callable[[str], None],
    progress: Progress,
) -> list[tuple[float, list[PersonInView]]]:
    """Track one camera with its whole recording in view."""
    bag = open_bag_frames(path, topic, warn=warn)
    found = []
    clip = Clip(bag, bool(bag.detections))
    for frame in track_clip(
        clip, model, networks=networks, warn=warn, progress=lambda frames, _: progress(frames, title)
    ):
        people = [
            PersonInView(puppet.id, np.where(puppet.confidence[:, None] > 0, puppet.joints, np.nan), puppet.confidence)
            for puppet in frame.puppets
        ]
        found.append((frame.stamp_ns / NANOSECONDS, people))
    return found
