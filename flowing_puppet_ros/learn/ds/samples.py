# SPDX-License-Identifier: Apache-2.0
"""Training samples of the Deformable Structures model: random bodies seen by random cameras as one contour a part.

Thesis, chapter "Deformable Structure Model", section "Learning"; the Anny body stands in for SCAPE.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.learn.anny.body import AnnyBody
from flowing_puppet_ros.learn.anny.poses import PoseSampler
from flowing_puppet_ros.learn.ds.contour import closed_contour, resample_sides, to_bone_frame
from flowing_puppet_ros.model import rotation
from flowing_puppet_ros.model.ds.joints import JOINT_NAMES, PART_JOINTS, part_tree
from flowing_puppet_ros.model.ds.multiview import VIEW_HEADINGS, VIEW_NAMES
from flowing_puppet_ros.model.tree import PartTree, mirrored_name

BATCH = 20
POINTS_PER_SIDE = {"torso": 40, "head": 24}
OTHER_POINTS_PER_SIDE = 28
OVERLAP = 0.25
"""A face belongs to every part that carries at least this share of its skin weight, so that parts overlap at joints."""

WIDE_OVERLAP = {"torso": 0.4, "head": 0.4, "right_upper_arm": 0.4, "left_upper_arm": 0.4}
"""Larger shares, for the parts whose skin follows several bones over a wide area."""

SHORTEST_BONE = 0.3
"""Poses in which a limb keeps less than this share of its length in the image are drawn again: their angle is noise."""

UPRIGHT = 0.8
"""Least share of the torso's length that must remain vertical in the image."""

ROOT_BONES = {
    "head": "Neck",
    "upper_arm": "Arm",
    "lower_arm": "ForeArm",
    "hand": "Hand",
    "upper_leg": "UpLeg",
    "lower_leg": "Leg",
    "foot": "Foot",
}
YAW, PITCH, ROLL = np.radians(15.0), np.radians(5.0), np.radians(3.0)
DISTANCE = (3.0, 6.0)
VIEW_YAW = np.radians(8.0)
"""Standard deviation of the yaw within one of the nine views, which are 22.5 degrees apart."""


@dataclass(frozen=True, slots=True, eq=False)
class PartSamples:
    """Samples of one part: points (n,K+M,2) in its bone frame, angle (n,), center (n,2), length (n,); metres."""

    points: Array
    angle: Array
    center: Array
    length: Array


@dataclass(frozen=True, slots=True, eq=False)
class TrainingSet:
    """Samples of all parts of one model and the joints (n,J,2) they were cut at, metres in the image plane."""

    tree: PartTree
    joint_names: tuple[str, ...]
    parts: tuple[PartSamples, ...]
    joints: Array


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """One body in one image: closed contour of each part (K,2) and joints {name: (2,)}; metres, x right, y down."""

    contours: dict[str, Array]
    joints: dict[str, Array]

    def mirrored(self) -> Projection:
        """The mirror image, with left and right exchanged."""
        flip = np.array([-1.0, 1.0])
        return Projection(
            {mirrored_name(name): contour * flip for name, contour in self.contours.items()},
            {mirrored_name(name): joint * flip for name, joint in self.joints.items()},
        )


class People:
    """Random people of one gender in the average build: Anny bodies in random poses, ready to be projected."""

    def __init__(self, gender: str, parts: int, mocap: Path | None = None) -> None:
        """`parts` is 10 or 14. `mocap` names the motion capture; without it poses come from joint limits alone."""
        self.tree = part_tree(parts)
        self._name = f"{gender} {parts}"
        self._body = AnnyBody(gender)
        self._sampler = PoseSampler(self._body, mocap)
        self._rest = self._body.rest(self._body.mean_phenotype())
        self._faces = part_faces(self._body, self.tree)

    def images(self, poses: int, rng: np.random.Generator, view: CameraView) -> list[Projection]:
        """Project `poses` random poses, each by a random camera of `view`."""
        found: list[Projection] = []
        with tqdm(total=poses, desc=f"{self._name} {np.degrees(view.heading):+.0f}", unit="pose") as progress:
            while len(found) < poses:
                vertices, bones = self._body.pose(self._rest, self._sampler.sample(rng, BATCH))
                joints = self._body.landmarks(vertices, bones)
                for index in range(BATCH):
                    posed = {name: xyz[index] for name, xyz in joints.items()}
                    image = project(vertices[index], posed, self._faces, RandomCamera.draw(rng, view))
                    if image is not None and len(found) < poses:
                        found.append(image)
                        progress.update()
        return found


def make_training_set(people: People, poses: int, rng: np.random.Generator) -> TrainingSet:
    """Project `poses` random poses seen from the front, each with its mirror image (2 * poses samples)."""
    seen = people.images(poses, rng, CameraView())
    return collect(people.tree, [image for one in seen for image in (one, one.mirrored())])


def make_view_sets(people: People, poses: int, rng: np.random.Generator) -> tuple[TrainingSet, ...]:
    """Training samples of the nine views of `VIEW_NAMES`, `poses` a view (an even number, or one less in the south).

    A person who faces south-west is one who faces south-east in the mirror, so half of the views come from mirrors.
    """
    count = len(VIEW_NAMES)
    images: list[list[Projection]] = [[] for _ in range(count)]
    for view in range(count // 2 + 1):
        wanted = poses if view < count // 2 else poses // 2
        seen = people.images(wanted, rng, CameraView(VIEW_HEADINGS[view], VIEW_YAW))
        images[view] += seen
        images[count - 1 - view] += [image.mirrored() for image in seen]
    return tuple(collect(people.tree, seen) for seen in images)


@dataclass(frozen=True, slots=True)
class CameraView:
    """How people stand before the camera: turned by `heading` on average, with deviation `yaw`; radians.

    Heading 0 faces the camera, a positive one the right of the image.
    """

    heading: float = 0.0
    yaw: float = YAW


@dataclass(frozen=True, slots=True, eq=False)
class RandomCamera:
    """A perspective camera: the body is turned by `turn` (3,3) and seen from `distance` metres."""

    turn: Array
    distance: float

    @classmethod
    def draw(cls, rng: np.random.Generator, view: CameraView) -> RandomCamera:
        """Draw slight yaw, pitch and roll off the view and a distance of a few metres."""
        roll, pitch, yaw = rng.normal(0.0, [ROLL, PITCH, view.yaw])
        yaw += view.heading
        turn = rotation.exp(np.array([roll, 0.0, 0.0])) @ rotation.exp(np.array([0.0, pitch, 0.0]))
        return cls(turn @ rotation.exp(np.array([0.0, 0.0, yaw])), float(rng.uniform(*DISTANCE)))

    def project(self, points: Array) -> Array:
        """Image (...,2) of body points (...,3); metres in the plane of the body's origin, x right, y down."""
        turned = points @ self.turn.T
        nearness = self.distance / (self.distance - turned[..., 0])
        return np.stack([turned[..., 1] * nearness, -turned[..., 2] * nearness], axis=-1)


def part_faces(body: AnnyBody, tree: PartTree) -> dict[str, Array]:
    """Triangles (F_i,3) of each part; neighbouring parts overlap where the skin follows both."""
    owner = np.zeros(len(body.bone_names), np.intp)
    for bone, name in enumerate(body.bone_names):
        parent = body.bone_parents[bone]
        owner[bone] = owner[parent] if parent >= 0 else 0
        for part, part_name in enumerate(tree.names[1:], start=1):
            side, _, limb = part_name.partition("_") if part_name != "head" else ("", "", "head")
            if name == side.capitalize() + ROOT_BONES[limb]:
                owner[bone] = part
    share = np.stack([body.skin_weights[:, owner == part].sum(axis=1) for part in range(len(tree))], axis=1)
    weight = share[body.triangles].mean(axis=1)
    least = [WIDE_OVERLAP.get(name, OVERLAP) for name in tree.names]
    return {name: body.triangles[weight[:, part] >= least[part]] for part, name in enumerate(tree.names)}


def project(
    vertices: Array, joints: dict[str, Array], faces: dict[str, Array], camera: RandomCamera
) -> Projection | None:
    """Project a posed body (V,3); None when a bone is too foreshortened or the torso too far from upright.

    The distal points of hands and feet, which are no centres of rotation, are the average of the part's contour.
    """
    image = {name: camera.project(joints[name]) for name in JOINT_NAMES[10]}
    if (image["belly"] - image["neck"])[1] < UPRIGHT * np.linalg.norm(joints["belly"] - joints["neck"]):
        return None
    for part in part_tree(10).names:
        near, far = PART_JOINTS[part][:2]
        if np.linalg.norm(image[far] - image[near]) < SHORTEST_BONE * np.linalg.norm(joints[far] - joints[near]):
            return None
    points = camera.project(vertices)
    contours = {name: closed_contour(points, triangles) for name, triangles in faces.items()}
    for name in JOINT_NAMES[14][len(JOINT_NAMES[10]) :]:
        if name in contours:
            image[name] = contours[name].mean(axis=0)
    return Projection(contours, image)


def collect(tree: PartTree, images: list[Projection]) -> TrainingSet:
    """Align every part's samples to its bone frame and stack them."""
    joint_names = JOINT_NAMES[len(tree)]
    parts = []
    for name in tree.names:
        count = POINTS_PER_SIDE.get(name, OTHER_POINTS_PER_SIDE)
        ends = np.array([[image.joints[joint] for joint in PART_JOINTS[name]] for image in images])
        points = [
            np.concatenate([resample_sides(image.contours[name], y[0], y[1], count), to_bone_frame(y, y[0], y[1])])
            for image, y in zip(images, ends, strict=True)
        ]
        bone = ends[:, 1] - ends[:, 0]
        angle, length = np.arctan2(bone[:, 1], bone[:, 0]), np.hypot(bone[:, 0], bone[:, 1])
        parts.append(PartSamples(np.stack(points), angle, ends[:, :2].mean(axis=1), length))
    joints = np.array([[image.joints[joint] for joint in joint_names] for image in images])
    return TrainingSet(tree, joint_names, tuple(parts), joints)
