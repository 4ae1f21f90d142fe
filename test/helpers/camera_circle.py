# SPDX-License-Identifier: Apache-2.0
"""Depth cameras on a circle around the man of capsules: what they see of him, and their messages."""

from collections.abc import Iterable, Mapping
from typing import Any

import cv2
import numpy as np
from capsule_man import cloud_of, joints_of  # type: ignore[import-not-found]

from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.body.fit.visibility import Visibility
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.stream.messages.bodies.silhouettes import make_silhouettes
from flowing_puppet_ros.stream.messages.geometry import make_camera_info, make_header, make_transform
from flowing_puppet_ros.stream.messages.images import make_image
from flowing_puppet_ros.stream.messages.message_types import TRANSFORMS
from flowing_puppet_ros.stream.messages.puppets import make_joints

FACTORY = BagMessageFactory()
FOCAL, WIDTH, HEIGHT, AWAY_M = 220.0, 320, 240, 2.3
MATRIX = [FOCAL, 0, (WIDTH - 1) / 2, 0, FOCAL, (HEIGHT - 1) / 2, 0, 0, 1]
TENTH = 100_000_000
LIMBS = [f"{side}_{name}" for side in ("left", "right") for name in ("elbow", "wrist", "knee", "ankle")]
MAN = joints_of()
ANGLES = (0.3, 2.2, -1.8)
POINTS = cloud_of(MAN, 60_000)[0]
HALL_M = np.array([1.0, -2.0, 0.5])  # where the frame of the colour cameras begins in the world
SHOWN = [name for name in MAN if name.partition("_")[2] in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")]


def axes_of(angle: float) -> np.ndarray:
    """Return the axes (3, 3), as columns right, down and forward, of a camera at an angle from x that looks at him."""
    forward = -np.array([np.cos(angle), np.sin(angle), 0.0])
    right = np.array([forward[1], -forward[0], 0.0])
    return np.stack([right, [0.0, 0.0, -1.0], forward], axis=1)


def depth_from(angle: float, points: np.ndarray) -> np.ndarray:
    """Return what a camera at an angle sees of places (N, 3) m: metres (H, W), 0 where nothing is."""
    local = (points - AWAY_M * np.array([np.cos(angle), np.sin(angle), 0.0])) @ axes_of(angle)
    columns, rows = np.rint(local[:, :2] / local[:, 2:] * FOCAL + np.array([WIDTH - 1, HEIGHT - 1]) / 2).T.astype(int)
    inside = (columns >= 0) & (columns < WIDTH) & (rows >= 0) & (rows < HEIGHT)
    nearest = np.full((HEIGHT, WIDTH), np.inf)
    np.minimum.at(nearest, (rows[inside], columns[inside]), local[inside, 2])
    return np.where(np.isfinite(nearest), nearest, 0.0)


def frames_of(angles: Iterable[float], shift: float = 0.0) -> Any:
    """Return where the cameras are in the world; the last one `shift` m beside its true place."""
    angles = list(angles)
    transforms = []
    for number, angle in enumerate(angles):
        place = AWAY_M * np.array([np.cos(angle), np.sin(angle), 0.0])
        place = place + (shift * axes_of(angle)[:, 0] if number == len(angles) - 1 else 0.0)
        header = make_header(FACTORY, 0, "world")
        transforms.append(make_transform(FACTORY, header, f"cam{number}_optical_frame", place, axes_of(angle)))
    return FACTORY.make(TRANSFORMS, transforms=transforms)


def messages_of(number: int, stamp: int, depth: np.ndarray) -> list[tuple[str, Any]]:
    """Return (port, message) of a depth image and its camera_info."""
    header = make_header(FACTORY, stamp, f"cam{number}_optical_frame")
    info = make_camera_info(FACTORY, header, (WIDTH, HEIGHT), np.reshape(MATRIX, (3, 3)), np.zeros(5))
    image = make_image(FACTORY, header, depth.astype(np.float32), "32FC1")
    return [(f"cam{number}/camera_info", info), (f"cam{number}/depth", image)]


def camera_at(angle: float) -> Camera:
    place, axes = AWAY_M * np.array([np.cos(angle), np.sin(angle), 0.0]), axes_of(angle)
    return Camera.from_info(MATRIX, [], WIDTH, HEIGHT, axes.T, -axes.T @ place)


def mask_of(depth: np.ndarray) -> np.ndarray:
    return 255 * cv2.morphologyEx((depth > 0).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))


DEPTHS = [depth_from(angle, POINTS) for angle in ANGLES]
"""What the cameras at ANGLES see of him."""


def silhouettes_at(stamp: int, masks: Mapping[int, np.ndarray] | None = None, frame: str = "world") -> Any:
    """Return the SilhouetteSet of the man, whose joints are 1 cm off; `masks` are others than his own."""
    shift = HALL_M if frame == "hall" else np.zeros(3)
    rng = np.random.default_rng(3)
    places = np.array([MAN[name] for name in SHOWN]) + 0.01 * rng.standard_normal((len(SHOWN), 3)) - shift
    seen = [Visibility.SEEN] * len(SHOWN)
    joints = make_joints(FACTORY, SHOWN, places, np.full(len(SHOWN), 0.8), seen)
    person = FACTORY.make("flowing_puppet_msgs/msg/Body", id="a7", confidence=0.8, joints=joints)
    cameras, shown, headers = {}, {}, {}
    for number, angle in enumerate(ANGLES):
        name, camera = f"colour{number}", camera_at(angle)
        cameras[name] = Camera(
            camera.matrix, camera.distortion, camera.size, camera.rotation, camera.translation + camera.rotation @ shift
        )
        shown[name] = (masks or {}).get(number, mask_of(DEPTHS[number]))
        headers[name] = make_header(FACTORY, stamp, name)
    header = make_header(FACTORY, stamp, frame)
    return make_silhouettes(FACTORY, header, person, cameras, shown, headers, ["a7"])
