# SPDX-License-Identifier: Apache-2.0
"""Training samples of the Deformable Structures model: part contours of random bodies seen by random cameras.

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
from flowing_puppet_ros.learn.ds.contour import resample_sides, to_bone_frame, trace_contour
from flowing_puppet_ros.model import rotation
from flowing_puppet_ros.model.ds.joints import JOINT_NAMES, PART_JOINTS, part_tree
from flowing_puppet_ros.model.ds.multiview import VIEW_HEADINGS, VIEW_NAMES
from flowing_puppet_ros.model.tree import PartTree, mirrored_name

BATCH_SIZE = 20  # poses sampled at a time
POINTS_PER_SIDE = {"torso": 40, "head": 24}  # of a contour
OTHER_POINTS_PER_SIDE = 28  # of the contours of all other parts
MIN_SKIN_SHARE = 0.25
"""A face belongs to every part with at least this share of its skin weight, so that parts overlap at joints."""

MIN_SKIN_SHARE_OF_PART = {"torso": 0.4, "head": 0.4, "right_upper_arm": 0.4, "left_upper_arm": 0.4}
"""Larger shares for the parts whose skin follows several bones over a wide area."""

MIN_BONE_SHARE = 0.3
"""Poses that foreshorten a limb to less than this share of its length are rejected: its angle would be noise."""

MIN_UPRIGHT_SHARE = 0.8
"""Poses whose torso keeps less than this share of its length vertical in the image are rejected."""

ROOT_BONES = {
    "head": "Neck",
    "upper_arm": "Arm",
    "lower_arm": "ForeArm",
    "hand": "Hand",
    "upper_leg": "UpLeg",
    "lower_leg": "Leg",
    "foot": "Foot",
}
YAW_DEVIATION, PITCH_DEVIATION, ROLL_DEVIATION = np.radians(15.0), np.radians(5.0), np.radians(3.0)  # off the view
CAMERA_DISTANCE_M = (3.0, 6.0)  # minimum and maximum
VIEW_YAW_DEVIATION = np.radians(8.0)
"""Standard deviation of the yaw within one of the nine views, which are 22.5 degrees apart."""


@dataclass(frozen=True, slots=True, eq=False)
class PartSamples:
    """Samples of a part: `points` (n, K+M, 2) m in its bone frame, `angle` (n,), `center` (n, 2) m, `length` (n,) m."""

    points: Array
    angle: Array
    center: Array
    length: Array


@dataclass(frozen=True, slots=True, eq=False)
class TrainingSet:
    """Samples of all parts of one model, and the `joints` (n, J, 2) m between them in the image plane."""

    tree: PartTree
    joint_names: tuple[str, ...]
    parts: tuple[PartSamples, ...]
    joints: Array


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """One body in one image: closed contours {part: (K, 2)} and joints {name: (2,)} in metres, x right, y down."""

    contours: dict[str, Array]
    joints: dict[str, Array]

    def mirror(self) -> Projection:
        """Mirror the projection and exchange left and right."""
        flip = np.array([-1.0, 1.0])
        return Projection(
            {mirrored_name(name): contour * flip for name, contour in self.contours.items()},
            {mirrored_name(name): joint * flip for name, joint in self.joints.items()},
        )


class BodySampler:
    """Random projections of an average body of one gender: Anny in random poses seen by random cameras."""

    def __init__(self, gender: str, parts: int, mocap: Path | None = None) -> None:
        """Make a sampler for 10 or 14 `parts`; without motion capture `mocap`, poses come from joint limits alone."""
        self.tree = part_tree(parts)
        self._name = f"{gender} {parts}"
        self._body = AnnyBody(gender)
        self._sampler = PoseSampler(self._body, mocap)
        self._rest = self._body.make_rest_body(self._body.mean_phenotype())
        self._faces = assign_faces(self._body, self.tree)

    def sample_projections(self, poses: int, rng: np.random.Generator, view: CameraView) -> list[Projection]:
        """Project `poses` random poses, each by a random camera of `view`."""
        projections: list[Projection] = []
        with tqdm(total=poses, desc=f"{self._name} {np.degrees(view.heading):+.0f}", unit="pose") as progress:
            while len(projections) < poses:
                vertices, bones = self._body.pose(self._rest, self._sampler.sample(rng, BATCH_SIZE))
                joints = self._body.locate_landmarks(vertices, bones)
                for index in range(BATCH_SIZE):
                    posed = {name: xyz[index] for name, xyz in joints.items()}
                    image = project(vertices[index], posed, self._faces, RandomCamera.draw(rng, view))
                    if image is not None and len(projections) < poses:
                        projections.append(image)
                        progress.update()
        return projections


def make_training_set(sampler: BodySampler, poses: int, rng: np.random.Generator) -> TrainingSet:
    """Project `poses` random poses seen from the front, each with its mirror image (2 * poses samples)."""
    seen = sampler.sample_projections(poses, rng, CameraView())
    return collect(sampler.tree, [image for one in seen for image in (one, one.mirror())])


def make_view_sets(sampler: BodySampler, poses: int, rng: np.random.Generator) -> tuple[TrainingSet, ...]:
    """Make the training sets of the nine views of `VIEW_NAMES`, `poses` samples per view.

    If `poses` is odd, the middle view has one less. A person who faces south-west faces south-east in a mirror, so half
    of the views are mirror images of the others.
    """
    count = len(VIEW_NAMES)
    images: list[list[Projection]] = [[] for _ in range(count)]
    for view in range(count // 2 + 1):
        wanted = poses if view < count // 2 else poses // 2
        seen = sampler.sample_projections(wanted, rng, CameraView(VIEW_HEADINGS[view], VIEW_YAW_DEVIATION))
        images[view] += seen
        images[count - 1 - view] += [image.mirror() for image in seen]
    return tuple(collect(sampler.tree, seen) for seen in images)


@dataclass(frozen=True, slots=True)
class CameraView:
    """Distribution of headings in radians: mean `heading` and standard deviation `yaw`.

    Heading 0 faces the camera, a positive heading the right of the image.
    """

    heading: float = 0.0
    yaw: float = YAW_DEVIATION


@dataclass(frozen=True, slots=True, eq=False)
class RandomCamera:
    """A perspective camera that sees the body rotated by `rotation` (3, 3) from `distance` metres."""

    rotation: Array
    distance: float

    @classmethod
    def draw(cls, rng: np.random.Generator, view: CameraView) -> RandomCamera:
        """Draw a camera with slight yaw, pitch and roll off the view, a few metres away."""
        roll, pitch, yaw = rng.normal(0.0, [ROLL_DEVIATION, PITCH_DEVIATION, view.yaw])
        yaw += view.heading
        turn = rotation.exp(np.array([roll, 0.0, 0.0])) @ rotation.exp(np.array([0.0, pitch, 0.0]))
        return cls(turn @ rotation.exp(np.array([0.0, 0.0, yaw])), float(rng.uniform(*CAMERA_DISTANCE_M)))

    def project(self, points: Array) -> Array:
        """Project body points (..., 3) m; return (..., 2) m in the plane of the body's origin, x right, y down."""
        rotated = points @ self.rotation.T
        magnification = self.distance / (self.distance - rotated[..., 0])
        return np.stack([rotated[..., 1] * magnification, -rotated[..., 2] * magnification], axis=-1)


def assign_faces(body: AnnyBody, tree: PartTree) -> dict[str, Array]:
    """Return the triangles (F_i, 3) of each part; neighbours overlap where the skin follows both."""
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
    min_share = [MIN_SKIN_SHARE_OF_PART.get(name, MIN_SKIN_SHARE) for name in tree.names]
    return {name: body.triangles[weight[:, part] >= min_share[part]] for part, name in enumerate(tree.names)}


def project(
    vertices: Array, joints: dict[str, Array], faces: dict[str, Array], camera: RandomCamera
) -> Projection | None:
    """Project a posed body (V, 3) m; None if a bone is too foreshortened or the torso too far from upright.

    The distal points of hands and feet are not centres of rotation; they are the means of the parts' contours.
    """
    image = {name: camera.project(joints[name]) for name in JOINT_NAMES[10]}
    if (image["belly"] - image["neck"])[1] < MIN_UPRIGHT_SHARE * np.linalg.norm(joints["belly"] - joints["neck"]):
        return None
    for part in part_tree(10).names:
        near, far = PART_JOINTS[part][:2]
        if np.linalg.norm(image[far] - image[near]) < MIN_BONE_SHARE * np.linalg.norm(joints[far] - joints[near]):
            return None
    points = camera.project(vertices)
    contours = {name: trace_contour(points, triangles) for name, triangles in faces.items()}
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
