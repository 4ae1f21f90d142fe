# SPDX-License-Identifier: Apache-2.0
"""Colours of synthetic people and rooms: skin, hair, eyes and clothes; textured walls, floor and boxes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource, TrueBody
from flowing_puppet_ros.evaluate.rgbd.rendering import PaintedMesh
from flowing_puppet_ros.evaluate.scene.scene_meshes import Mesh

SKINS = ((224, 178, 150), (198, 150, 118), (141, 98, 72), (94, 64, 48))
SHIRTS = ((46, 74, 140), (150, 46, 52), (56, 120, 78), (196, 160, 60), (90, 90, 98), (170, 96, 140))
TROUSERS = ((48, 52, 66), (92, 84, 70), (40, 60, 96), (30, 30, 32))
HAIR, SHOES, EYES, LIPS = (48, 34, 26), (36, 32, 30), (30, 24, 22), (150, 84, 80)  # RGB
SURFACES = ((176, 168, 156), (150, 160, 166), (186, 178, 160))
LEGS = ("Hips", "LHipJoint", "RHipJoint", "LeftUpLeg", "RightUpLeg", "LeftLeg", "RightLeg")
FEET = ("LeftFoot", "RightFoot", "LeftToeBase", "RightToeBase")
BARE = ("Neck", "Neck1", "Head", "LeftForeArm", "RightForeArm", "LeftHand", "RightHand", "LThumb", "RThumb",
        "LeftFingerBase", "RightFingerBase", "LeftHandFinger1", "RightHandFinger1")  # fmt: skip
PATCH_M = 0.12  # edge of the triangles of rooms, whose corners have colours of their own
GRAIN = 0.09  # standard deviation of the lightness of neighbouring corners


class Wardrobe:
    """Clothes people, each of them by their number, the same in every image."""

    def __init__(self, source: BodySource) -> None:
        self._triangles = source.triangles
        names = np.array(source.bone_names)[source.bone_of_vertex]
        rest = source.rest_vertices
        head = names == "Head"
        front, height = rest[:, 0], rest[:, 2]
        low, high = height[head].min(), height[head].max()
        back, tip = front[head].min(), front[head].max()
        up, ahead = (height - low) / (high - low), (front - back) / (tip - back)
        self._hair = head & ((up > 0.84) | ((up > 0.42) & (ahead < 0.45)))
        width = np.abs(rest[:, 1]) / max(float(np.ptp(rest[head, 1])), 1e-6)
        self._lips = head & (np.abs(up - 0.2) < 0.035) & (width < 0.16) & (ahead > 0.7)
        eye = [list(source.joint_names).index(f"{side}_eye") for side in ("left", "right")]
        self._eye_joints = eye
        self._kinds = {
            "bare": np.isin(names, BARE),
            "legs": np.isin(names, LEGS),
            "feet": np.isin(names, FEET),
        }

    def dress(self, body: TrueBody, person: int) -> PaintedMesh:
        """Return the painted mesh of the `person`-th body of an image."""
        rng = np.random.default_rng([person, 7])
        colours = np.empty((len(body.vertices), 3))
        colours[:] = SHIRTS[(person + int(rng.integers(2))) % len(SHIRTS)]
        colours[self._kinds["legs"]] = TROUSERS[int(rng.integers(len(TROUSERS)))]
        colours[self._kinds["feet"]] = SHOES
        cloth = ~self._kinds["bare"]
        colours[cloth] *= 1 + GRAIN * rng.standard_normal((int(cloth.sum()), 1))
        colours[self._kinds["bare"]] = SKINS[int(rng.integers(len(SKINS)))]
        colours[self._hair] = HAIR
        colours[self._hair] *= 1 + 2 * GRAIN * rng.standard_normal((int(self._hair.sum()), 1))
        colours[self._lips] = LIPS
        for joint in self._eye_joints:
            colours[np.linalg.norm(body.vertices - body.joints[joint], axis=1) < 0.017] = EYES
        return PaintedMesh(body.vertices, self._triangles, np.clip(colours, 0, 255), person)


def paint_surroundings(meshes: Sequence[Mesh], rng: np.random.Generator) -> list[PaintedMesh]:
    """Return boxes and prisms with a texture that optical flow can follow."""
    painted = []
    for vertices, triangles in meshes:
        fine, faces = _subdivide(np.asarray(vertices, float), np.asarray(triangles))
        colour = np.array(SURFACES[int(rng.integers(len(SURFACES)))], dtype=float)
        shade = 1 + GRAIN * rng.standard_normal((len(fine), 1))
        painted.append(PaintedMesh(fine, faces, np.clip(colour * shade, 0, 255)))
    return painted


def _subdivide(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Halve the edges of a mesh until none that matters is longer than a patch, at most five times."""
    for _ in range(5):
        corners = vertices[triangles]
        if np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max() < PATCH_M:
            break
        edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
        unique, which = np.unique(edges, axis=0, return_inverse=True)
        middle = len(vertices) + which.reshape(3, -1).T  # of the edges ab, bc, ca
        vertices = np.concatenate([vertices, vertices[unique].mean(axis=1)])
        a, b, c = triangles.T
        ab, bc, ca = middle.T
        triangles = np.concatenate(
            [np.stack(each, axis=1) for each in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
    return vertices, triangles
