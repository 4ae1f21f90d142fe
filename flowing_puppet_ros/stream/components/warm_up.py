# SPDX-License-Identifier: Apache-2.0
"""A synthetic recording of a person, which a component processes once so that the first real message need not wait.

Models are loaded and kernels compiled at their first use, which takes seconds.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import F64, Array
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.tracking.tracker import FlowingPuppetTracker, TrackedPuppet
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.stream.component import Component
from flowing_puppet_ros.stream.messages.clouds import make_cloud
from flowing_puppet_ros.stream.messages.depth import back_project
from flowing_puppet_ros.stream.messages.geometry import make_header, make_transform
from flowing_puppet_ros.stream.messages.images import make_image
from flowing_puppet_ros.stream.messages.message_types import CAMERA_INFO, PUPPETS, TRANSFORMS, MessageFactory
from flowing_puppet_ros.stream.messages.puppets import make_puppets

type Messages = list[tuple[str, Any]]

IMAGE_SIZE = (192, 160)  # px, height and width
SCALE_PX_PER_M, FOCAL_PX, DISTANCE_M = 80.0, 200.0, 2.5  # scale = focal length / distance
PERIOD_NS = 100_000_000  # between two images
FRAMES = 3  # images per camera
SIDE_BY_SIDE_M = np.array([0.4, 0.0, 0.0])  # between people who are found as one piece and taken apart
WORLD_FRAME = "warm_up"


def run(component: Component[Any], messages: Messages) -> None:
    """Let a component, which is used for nothing else, process messages; optional inputs among them are expected."""
    optional = {port.name for port in component.inputs if port.optional}
    for name in optional & {name for name, _ in messages}:
        component.set_expected(name, True)
    for name, message in messages:
        component.handle(name, message)


def make_images(factory: MessageFactory, camera: str = WORLD_FRAME) -> list[Any]:
    """Return images of a random texture that moves by one pixel per image."""
    grain = np.random.default_rng(0).integers(60, 200, (IMAGE_SIZE[0] // 4, IMAGE_SIZE[1] // 4, 3), dtype=np.uint8)
    still = np.repeat(np.repeat(grain, 4, axis=0), 4, axis=1)
    return [
        make_image(factory, make_header(factory, (k + 1) * PERIOD_NS, camera), np.roll(still, k, axis=1), "rgb8")
        for k in range(FRAMES)
    ]


def make_tracker_input(factory: MessageFactory, model: DeformableStructures) -> Messages:
    """Return the input of a puppet tracker: images, and the detection of one person in each."""
    found: Messages = []
    for image in make_images(factory):
        puppets = make_puppets(factory, image.header, model, [make_puppet(model)])
        found += [("detections", puppets), ("image", image)]
    return found


def make_hull_input(factory: MessageFactory, names: tuple[str, ...]) -> Messages:
    """Return the input of a visual hull: calibrated cameras in a circle around a person, several images each."""
    model = DeformableStructures.load()
    person = make_puppet(model)
    labels = np.zeros(IMAGE_SIZE, np.uint8)
    rows, columns = np.mgrid[: IMAGE_SIZE[0], : IMAGE_SIZE[1]]
    labels[(((columns - IMAGE_SIZE[1] / 2) / 20) ** 2 + ((rows - IMAGE_SIZE[0] / 2) / 70) ** 2) < 1] = 1
    frames = [_make_camera_transform(factory, name, 2 * np.pi * k / (len(names) + 1)) for k, name in enumerate(names)]
    found: Messages = [("/tf_static", factory.make(TRANSFORMS, transforms=frames))]
    found += [(f"{name}/camera_info", _make_camera_info(factory, name)) for name in names]
    for name in names:
        for image in make_images(factory, name):
            header = image.header
            found += [
                (f"{name}/image", image),
                (f"{name}/part_labels", make_image(factory, header, labels, "mono8")),
                (f"{name}/puppets", make_puppets(factory, header, model, [person])),
            ]
    return found


def make_fitter_input(factory: MessageFactory, model: StitchedPuppet) -> Messages:
    """Return the input of a body fitter: depth images of somebody on a floor before a wall, and the puppets."""
    vertices, joints = _place_before_camera(model)
    depth = _draw_depth(vertices)
    puppets = [
        factory.make("flowing_puppet_msgs/msg/PuppetJoint", name=name, x=x, y=y, confidence=0.9)
        for name, (x, y) in zip(model.joint_names, _project(joints), strict=True)
    ]
    found: Messages = []
    for number in range(1, FRAMES + 1):
        header = make_header(factory, number * PERIOD_NS, WORLD_FRAME)
        puppet = factory.make("flowing_puppet_msgs/msg/Puppet", id="w1", confidence=0.9, joints=puppets)
        info = _make_camera_info(factory, WORLD_FRAME, number * PERIOD_NS)
        found += [("puppets/camera_info", info), ("camera_info", info)]
        found += [("puppets", factory.make(PUPPETS, header=header, puppets=[puppet]))]
        found += [("depth", make_image(factory, header, depth, "16UC1"))]
    return found


def make_scan_input(factory: MessageFactory, model: StitchedPuppet) -> Messages:
    """Return scans of two people who touch, before a wall, as a LiDAR publishes them: points in no order, z up."""
    vertices = _place_before_camera(model)[0]
    depth = 1e-3 * _draw_depth(np.concatenate([vertices - SIDE_BY_SIDE_M / 2, vertices + SIDE_BY_SIDE_M / 2]))
    right, down, forward = back_project(depth.astype(np.float32), _make_camera_info(factory, WORLD_FRAME)).T
    points = np.stack([forward, -right, -down], axis=1)
    headers = [make_header(factory, number * PERIOD_NS, WORLD_FRAME) for number in range(1, FRAMES + 1)]
    return [("points", make_cloud(factory, header, points)) for header in headers]


def _place_before_camera(model: StitchedPuppet) -> tuple[F64, F64]:
    """Return the vertices and joints of the mean person who stands before a camera, metres in its optical frame."""
    vertices = model.vertices(model.rest_state())
    to_camera = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    placed, joints = (
        (points - middle) @ to_camera.T + [0.0, 0.0, DISTANCE_M] for points in (vertices, model.joints(vertices))
    )
    return placed, joints


def _draw_depth(vertices: F64) -> Array:
    """Return the depth image (H, W) in millimetres of places (V, 3) m in the camera's frame, on a floor, before a wall.

    Each place covers the pixels around its own.
    """
    rows = np.arange(IMAGE_SIZE[0]) - (IMAGE_SIZE[0] - 1) / 2
    floor = FOCAL_PX * vertices[:, 1].max() / np.maximum(rows, 1e-3)
    depth = np.tile(np.minimum(floor, 2 * DISTANCE_M)[:, None], (1, IMAGE_SIZE[1]))
    columns, lines = np.floor(_project(vertices) + 0.5).astype(np.int64).T
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            np.minimum.at(depth, (lines + down, columns + right), vertices[:, 2])
    return (1000 * depth).astype(np.uint16)


def _project(points: F64) -> F64:
    middle = np.array([(IMAGE_SIZE[1] - 1) / 2, (IMAGE_SIZE[0] - 1) / 2])
    return FOCAL_PX * points[:, :2] / points[:, 2:] + middle


def make_puppet(model: DeformableStructures) -> TrackedPuppet:
    """Return the mean person in the middle of the image."""
    joints = model.mean_joints() * SCALE_PX_PER_M
    joints += np.array([IMAGE_SIZE[1] / 2, IMAGE_SIZE[0] / 2]) - (joints.min(axis=0) + joints.max(axis=0)) / 2
    person = Keypoints(tuple(model.joint_names), joints, np.ones(len(joints)))
    return FlowingPuppetTracker(model).step(np.zeros((*IMAGE_SIZE, 3), np.uint8), 0, [person]).puppets[0]


def _make_camera_info(factory: MessageFactory, name: str, stamp: int = PERIOD_NS) -> Any:
    k = np.array([FOCAL_PX, 0, (IMAGE_SIZE[1] - 1) / 2, 0, FOCAL_PX, (IMAGE_SIZE[0] - 1) / 2, 0, 0, 1.0])
    header = make_header(factory, stamp, name)
    return factory.make(CAMERA_INFO, header=header, width=IMAGE_SIZE[1], height=IMAGE_SIZE[0], k=k, p=np.zeros(12))


def _make_camera_transform(factory: MessageFactory, name: str, angle: float) -> Any:
    """Return the pose of a camera on a circle that looks at its centre."""
    forward = np.array([-np.cos(angle), -np.sin(angle), 0.0])
    down = np.array([0.0, 0.0, -1.0])
    rotation: F64 = np.stack([np.cross(down, forward), down, forward], axis=1)
    return make_transform(factory, make_header(factory, 0, WORLD_FRAME), name, -DISTANCE_M * forward, rotation)
