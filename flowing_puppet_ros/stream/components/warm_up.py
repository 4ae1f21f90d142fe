# SPDX-License-Identifier: Apache-2.0
"""A made-up recording of a person: what a component is fed with once, so that the first real message need not wait.

Models are loaded and kernels compiled at their first use, which takes seconds. Nothing here is real but the types.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.tracking.tracker import FlowingPuppetTracker, TrackedPuppet
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.stream.messages.geometry import make_header, make_transform
from flowing_puppet_ros.stream.messages.images import make_image
from flowing_puppet_ros.stream.messages.message_types import CAMERA_INFO, TRANSFORMS, MessageFactory
from flowing_puppet_ros.stream.messages.puppets import make_puppets

type Messages = list[tuple[str, Any]]

SIZE = (192, 160)  # px, height and width
SCALE, FOCAL, AWAY = 80.0, 200.0, 2.5  # px/m, px and m; SCALE = FOCAL / AWAY
STEP = 100_000_000
FRAMES = 3
WORLD = "warm_up"


def images(factory: MessageFactory, camera: str = WORLD) -> list[Any]:
    """Pictures of nothing in particular that moves."""
    grain = np.random.default_rng(0).integers(60, 200, (SIZE[0] // 4, SIZE[1] // 4, 3), dtype=np.uint8)
    still = np.repeat(np.repeat(grain, 4, axis=0), 4, axis=1)
    return [
        make_image(factory, make_header(factory, (k + 1) * STEP, camera), np.roll(still, k, axis=1), "rgb8")
        for k in range(FRAMES)
    ]


def tracking(factory: MessageFactory, model: DeformableStructures) -> Messages:
    """What a puppet tracker gets: images, and the detection of somebody in each."""
    found: Messages = []
    for image in images(factory):
        puppets = make_puppets(factory, image.header, model, [puppet(model)])
        found += [("detections", puppets), ("image", image)]
    return found


def cameras(factory: MessageFactory, names: tuple[str, ...]) -> Messages:
    """What a visual hull gets of calibrated cameras in a circle around a person: all its inputs, several times."""
    model = DeformableStructures.load()
    person = puppet(model)
    labels = np.zeros(SIZE, np.uint8)
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    labels[(((columns - SIZE[1] / 2) / 20) ** 2 + ((rows - SIZE[0] / 2) / 70) ** 2) < 1] = 1
    frames = [_transform(factory, name, 2 * np.pi * k / (len(names) + 1)) for k, name in enumerate(names)]
    found: Messages = [("/tf_static", factory.make(TRANSFORMS, transforms=frames))]
    found += [(f"{name}/camera_info", _info(factory, name)) for name in names]
    for name in names:
        for image in images(factory, name):
            header = image.header
            found += [
                (f"{name}/image", image),
                (f"{name}/part_labels", make_image(factory, header, labels, "mono8")),
                (f"{name}/puppets", make_puppets(factory, header, model, [person])),
            ]
    return found


def puppet(model: DeformableStructures) -> TrackedPuppet:
    """The mean person in the middle of the image."""
    joints = model.mean_joints() * SCALE
    joints += np.array([SIZE[1] / 2, SIZE[0] / 2]) - (joints.min(axis=0) + joints.max(axis=0)) / 2
    person = Keypoints(tuple(model.joint_names), joints, np.ones(len(joints)))
    return FlowingPuppetTracker(model).step(np.zeros((*SIZE, 3), np.uint8), 0, [person]).puppets[0]


def _info(factory: MessageFactory, name: str) -> Any:
    k = np.array([FOCAL, 0, (SIZE[1] - 1) / 2, 0, FOCAL, (SIZE[0] - 1) / 2, 0, 0, 1.0])
    header = make_header(factory, STEP, name)
    return factory.make(CAMERA_INFO, header=header, width=SIZE[1], height=SIZE[0], k=k, p=np.zeros(12))


def _transform(factory: MessageFactory, name: str, angle: float) -> Any:
    """A camera in a circle that looks at its middle."""
    forward = np.array([-np.cos(angle), -np.sin(angle), 0.0])
    down = np.array([0.0, 0.0, -1.0])
    rotation: F64 = np.stack([np.cross(down, forward), down, forward], axis=1)
    return make_transform(factory, make_header(factory, 0, WORLD), name, -AWAY * forward, rotation)
