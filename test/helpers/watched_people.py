# SPDX-License-Identifier: Apache-2.0
"""Capsule men in a room before a camera that sees depth, and their joints in its colour image."""

from dataclasses import dataclass

import numpy as np
from capsule_man import Joints, cloud_of

from flowing_puppet_ros.evidence.cloud.range_image import RangeImage
from flowing_puppet_ros.evidence.cloud.sensor_field import SensorProjection
from flowing_puppet_ros.fusion.puppet_joints import PuppetJoints
from flowing_puppet_ros.fusion.seen_cloud import SeenCloud
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.multiview.camera import Camera

FOCAL, WIDTH, HEIGHT = 262.5, 320, 240
TO_Z_UP = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""From an optical frame (x right, y down, z forward) to one with x ahead, y left and z up."""
FLOOR_M, WALL_M = -1.0, 4.0
"""Height of the floor below the camera, and distance of the wall behind the people."""
PUPPET_JOINTS = (
    *("neck", "belly", "face", "right_shoulder", "left_shoulder", "right_hip", "left_hip", "right_elbow"),
    *("left_elbow", "right_knee", "left_knee", "right_wrist", "left_wrist", "right_ankle", "left_ankle"),
)


@dataclass(frozen=True)
class Standing:
    """A capsule man in the room: `joints` by name (3,) m and `surface` (N, 3) m."""

    joints: Joints
    surface: np.ndarray


def stand_at(joints: Joints, ahead: float, left: float = 0.0, turn: float = np.pi) -> Standing:
    """Place a capsule man on the floor, facing the camera (`turn` pi) or away from it (0)."""
    around = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1.0]])
    shift = np.array([ahead, left, FLOOR_M + 0.92])
    placed = {name: around @ place + shift for name, place in joints.items()}
    return Standing(placed, cloud_of(joints, 30_000)[0] @ around.T + shift)


@dataclass(frozen=True)
class Watched:
    """What the depth camera sees: `depth` (H, W) m, NaN unknown, and who is there."""

    depth: np.ndarray
    people: list[Standing]
    owner: np.ndarray

    @property
    def points(self) -> np.ndarray:
        """The cloud (N, 3) m, z up."""
        rows, columns = np.nonzero(np.isfinite(self.depth))
        z = self.depth[rows, columns]
        optical = np.stack([(columns - (WIDTH - 1) / 2) / FOCAL * z, (rows - (HEIGHT - 1) / 2) / FOCAL * z, z], axis=1)
        return np.asarray(optical @ TO_Z_UP.T)

    @property
    def image(self) -> RangeImage:
        """The range image of the points."""
        projection = SensorProjection.pinhole(FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2).turn(TO_Z_UP)
        known = np.flatnonzero(np.isfinite(self.depth))
        return RangeImage.of_camera(projection, self.points, known, self.depth.shape)

    def seen_by(self, camera: Camera) -> SeenCloud:
        """Return the cloud with the pixels of a camera."""
        return SeenCloud.of(self.points, camera)


def watch(people: list[Standing], noise: float = 0.004, seed: int = 0) -> Watched:
    """Return what the camera at the origin sees of people, a floor and a wall."""
    rng = np.random.default_rng(seed)
    clouds = [person.surface for person in people]
    across = np.linspace(-3, 3, 700)
    floor = np.stack(np.meshgrid(np.linspace(0.8, WALL_M, 500), across, indexing="ij"), axis=-1).reshape(-1, 2)
    wall = np.stack(np.meshgrid(across, np.linspace(FLOOR_M, 2.2, 500), indexing="ij"), axis=-1).reshape(-1, 2)
    room = np.concatenate(
        [
            np.column_stack([floor, np.full(len(floor), FLOOR_M)]),
            np.column_stack([np.full(len(wall), WALL_M), wall]),
        ]
    )
    points = np.concatenate([*clouds, room])
    who = np.concatenate([*(np.full(len(cloud), k) for k, cloud in enumerate(clouds)), np.full(len(room), -1)])
    optical = points @ TO_Z_UP
    columns = np.rint(optical[:, 0] / optical[:, 2] * FOCAL + (WIDTH - 1) / 2).astype(int)
    rows = np.rint(optical[:, 1] / optical[:, 2] * FOCAL + (HEIGHT - 1) / 2).astype(int)
    seen = np.flatnonzero((columns >= 0) & (columns < WIDTH) & (rows >= 0) & (rows < HEIGHT))
    order = seen[np.argsort(-optical[seen, 2], kind="stable")]  # the nearest is written last
    depth, owner = np.full((HEIGHT, WIDTH), np.nan), np.full((HEIGHT, WIDTH), -1)
    depth[rows[order], columns[order]] = optical[order, 2]
    owner[rows[order], columns[order]] = who[order]
    depth += noise * rng.standard_normal(depth.shape)
    return Watched(depth, people, owner[np.isfinite(depth)])


def make_colour_camera(beside: float = 0.0, factor: float = 2.0) -> Camera:
    """Return the colour camera, `beside` metres to the right of the depth camera, of `factor` times its size."""
    matrix = [FOCAL * factor, 0, (WIDTH * factor - 1) / 2, 0, FOCAL * factor, (HEIGHT * factor - 1) / 2, 0, 0, 1]
    rotation = TO_Z_UP.T
    size = round(WIDTH * factor), round(HEIGHT * factor)
    return Camera.from_info(matrix, [], *size, rotation, rotation @ np.array([0.0, beside, 0.0]))


def find_puppet(
    model: StitchedPuppet, person: Standing, camera: Camera, identity: str, noise: float = 0.0, seed: int = 0
) -> PuppetJoints:
    """Return a person's joints as a tracker would see them in the colour image, certain of all that are in it."""
    rng = np.random.default_rng(seed)
    pixels, confidence = np.full((len(model.joint_names), 2), np.nan), np.zeros(len(model.joint_names))
    for name in PUPPET_JOINTS:
        row = model.joint_names.index(name)
        pixels[row] = camera.project(person.joints[name])[0] + noise * rng.standard_normal(2)
        inside = (pixels[row] >= 0).all() and (pixels[row] < camera.size).all()
        confidence[row] = 0.9 if inside else 0.05
    return PuppetJoints(identity, pixels, confidence, np.zeros(len(confidence), dtype=bool))
