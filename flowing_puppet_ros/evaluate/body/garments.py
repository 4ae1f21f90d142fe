# SPDX-License-Identifier: Apache-2.0
"""Garments, shoes and hair on synthetic people: surfaces outside of a body that is known.

Cloth and hair are the skin, moved outwards by a distance that varies smoothly; a skirt is a surface of its own about
both legs.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.spatial import ConvexHull

from flowing_puppet_ros.body.cloud.mesh_geometry import vertex_normals
from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource, TrueBody

TRUNK = ("Hips", "LHipJoint", "RHipJoint", "LowerBack", "Spine", "Spine1", "LeftShoulder", "RightShoulder")
UPPER_ARMS, LOWER_ARMS = ("LeftArm", "RightArm"), ("LeftForeArm", "RightForeArm")
LEGS = ("Hips", "LHipJoint", "RHipJoint", "LeftUpLeg", "RightUpLeg", "LeftLeg", "RightLeg")
FEET = ("LeftFoot", "RightFoot", "LeftToeBase", "RightToeBase")
GARMENTS = {
    "shirt": ((*TRUNK, *UPPER_ARMS), 0.012, 0.008),
    "jacket": ((*TRUNK, *UPPER_ARMS, *LOWER_ARMS), 0.028, 0.013),
    "puffer jacket": ((*TRUNK, *UPPER_ARMS, *LOWER_ARMS), 0.045, 0.012),
    "jeans": (LEGS, 0.008, 0.005),
    "wide trousers": (LEGS, 0.03, 0.015),
    "shoes": (FEET, 0.012, 0.003),
}
"""The bones that a garment covers, the mean of its distance from the skin, and how much that varies, metres."""
OUTFITS = (
    ("shirt", "jeans", "shoes", "hair"),
    ("jacket", "wide trousers", "shoes"),
    ("shirt", "skirt", "hair"),
    ("puffer jacket", "jeans", "shoes", "hair"),
    ("shirt", "wide trousers"),
)
SOLE_M = 0.02
HAIR_M, HAIR_VARIATION_M = 0.03, 0.01
FOLDS = 25  # rounds of smoothing of a garment's distance: folds of some centimetres
SKIRT_RINGS, SKIRT_CORNERS = 24, 64
SKIRT_WIDTHS_M = (0.01, 0.06)  # outside of the legs, at the waist and at the hem
SLICE_M = 0.03  # half the height of the slice of the legs that a skirt's ring lies about


class Tailor:
    """Dresses the people of a source."""

    def __init__(self, source: BodySource) -> None:
        self._triangles = np.asarray(source.triangles)
        self._bone = np.array(source.bone_names)[source.bone_of_vertex]
        self._rest = source.rest_vertices
        edges = np.concatenate([self._triangles[:, [k, (k + 1) % 3]] for k in range(3)])
        edges = np.unique(np.concatenate([edges, edges[:, ::-1]]), axis=0)
        count = np.maximum(np.bincount(edges[:, 0], minlength=len(self._bone)), 1)
        self._mean = coo_matrix((1 / count[edges[:, 0]], edges.T), shape=(len(self._bone),) * 2).tocsr()

    def dress(self, body: TrueBody, outfit: tuple[str, ...], rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Return the outermost surface of a body in an outfit: vertices (N, 3) m and triangles (F, 3)."""
        offset = np.zeros(len(self._bone))
        for name in outfit:
            if name in GARMENTS:
                bones, mean, variation = GARMENTS[name]
                worn = np.isin(self._bone, bones) * np.maximum(mean + variation * self._draw_folds(rng), 0.001)
                offset = np.maximum(offset, worn)
        if "hair" in outfit:
            hair = np.maximum(HAIR_M + HAIR_VARIATION_M * self._draw_folds(rng), 0.0)
            offset = np.maximum(offset, self._find_hair() * hair)
        offset = self._smooth(offset, 6)
        outward = self._smooth(vertex_normals(body.vertices, self._triangles), 4)
        vertices = np.where(offset[:, None] > 0, body.vertices + offset[:, None] * outward, body.vertices)
        if "shoes" in outfit:
            vertices[np.isin(self._bone, FEET), 2] -= SOLE_M
        if "skirt" not in outfit:
            return vertices, self._triangles
        skirt, faces = self._sew_skirt(body)
        return np.concatenate([vertices, skirt]), np.concatenate([self._triangles, faces + len(vertices)])

    def _draw_folds(self, rng: np.random.Generator) -> np.ndarray:
        """Return smooth noise (V,) of variance 1."""
        folds = self._smooth(rng.standard_normal(len(self._bone)), FOLDS)
        return np.asarray(folds / folds.std())

    def _smooth(self, values: np.ndarray, rounds: int) -> np.ndarray:
        for _ in range(rounds):
            values = (values + self._mean @ values) / 2
        return values

    def _find_hair(self) -> np.ndarray:
        """Return which vertices (V,) are the top and the back of the head."""
        head, front, height = self._bone == "Head", self._rest[:, 0], self._rest[:, 2]
        up = (height - height[head].min()) / np.ptp(height[head])
        ahead = (front - front[head].min()) / np.ptp(front[head])
        return np.asarray(head & ((up > 0.75) | ((up > 0.3) & (ahead < 0.45))))

    def _sew_skirt(self, body: TrueBody) -> tuple[np.ndarray, np.ndarray]:
        """Return a skirt from the waist to the knees of somebody upright, open at both ends."""
        legs = body.vertices[np.isin(self._bone, LEGS)]
        top = body.vertices[np.isin(self._bone, ("LeftUpLeg", "RightUpLeg"))][:, 2].max()
        hem = body.vertices[np.isin(self._bone, ("LeftLeg", "RightLeg"))][:, 2].max() - 0.05
        angle = 2 * np.pi * np.arange(SKIRT_CORNERS) / SKIRT_CORNERS
        around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        rings = []
        for share in np.linspace(0, 1, SKIRT_RINGS):
            height = top + share * (hem - top)
            inside = legs[np.abs(legs[:, 2] - height) < SLICE_M][:, :2]
            hull = inside[ConvexHull(inside).vertices]
            middle = hull.mean(axis=0)
            radius = ((hull - middle) @ around.T).max(axis=0) + np.interp(share, (0, 1), SKIRT_WIDTHS_M)
            radius *= 1 + 0.03 * share * np.sin(9 * angle)  # its folds
            rings.append(np.column_stack([middle + around * radius[:, None], np.full(SKIRT_CORNERS, height)]))
        first = np.arange((SKIRT_RINGS - 1) * SKIRT_CORNERS)
        after = first - first % SKIRT_CORNERS + (first + 1) % SKIRT_CORNERS
        below, after_below = first + SKIRT_CORNERS, after + SKIRT_CORNERS
        faces = np.concatenate([np.stack([first, below, after], 1), np.stack([after, below, after_below], 1)])
        return np.concatenate(rings), faces
