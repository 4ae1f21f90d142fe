# SPDX-License-Identifier: Apache-2.0
"""From joints to part contours: the posterior of thesis Eqs. 23-30, precomputed, then each part laid on its bone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.model.ds.shape import COEFFICIENT_LIMIT, PartShape, rotate, shape_posterior
from flowing_puppet_ros.model.gaussian import Gaussian
from flowing_puppet_ros.model.tree import PartTree

LENGTH_LIMIT = 3.0
"""The shape posterior sees bone lengths within this many standard deviations of the mean; the rest is stretching."""

LEAST_STRETCH = 0.4
"""A bone that points at the camera keeps at least this share of its model length, so that its part stays a blob."""

_SHORTEST = 1e-3  # metres: the direction of anything shorter is noise


class ShapeFromJoints:
    """Posterior mean shape of every part for given joints, with all matrices made once."""

    def __init__(
        self,
        tree: PartTree,
        shapes: Sequence[PartShape],
        pairwise: Sequence[Gaussian],
        part_joints: Sequence[Sequence[int]],
    ) -> None:
        """`part_joints` names, for every part, its joints: proximal, distal, then any others."""
        self._gain, self._offset = shape_posterior(tree, shapes, pairwise)
        self._size = shapes[0].basis.shape[2]
        self._mean = np.concatenate([shape.mean for shape in shapes])
        self._basis = np.concatenate([shape.basis for shape in shapes])
        counts = [len(shape.mean) for shape in shapes]
        self._part = np.repeat(np.arange(len(shapes)), counts)
        self._start = np.concatenate([[0], np.cumsum(counts)])
        self._contour_end = self._start[1:] - [shape.joint_count for shape in shapes]
        self._bone = np.array([joints[:2] for joints in part_joints])
        self._parent, self._child = np.array(tree.edges).T
        self._flat_joints = np.concatenate([np.asarray(joints) for joints in part_joints])
        self._flat_part = np.repeat(np.arange(len(shapes)), [len(joints) for joints in part_joints])
        self._is_joint = np.concatenate([np.arange(len(s.mean)) >= len(s.mean) - s.joint_count for s in shapes])
        self._spread = [_spread(shape) if shape.joint_count > 2 else None for shape in shapes]
        proximal = self._contour_end
        mean_length = self._mean[proximal + 1, 0] - self._mean[proximal, 0]
        deviation = np.linalg.norm(self._basis[proximal + 1, 0] - self._basis[proximal, 0], axis=1)
        self._shortest = np.maximum(mean_length - LENGTH_LIMIT * deviation, 0.2 * mean_length)
        self._longest = mean_length + LENGTH_LIMIT * deviation

    def observation(self, joints: Array) -> tuple[Array, Array, Array, Array]:
        """What the posterior is conditioned on, for joints (J,2) in model space, metres.

        Returns the observation (D,) of `shape_posterior`, bone directions (N,2), centres (N,2) and lengths (N,), and
        clips the lengths inside the observation to what training has seen.
        """
        ends = joints[self._bone]
        bone = ends[:, 1] - ends[:, 0]
        length = np.hypot(bone[:, 0], bone[:, 1])
        direction = np.where(length[:, None] > _SHORTEST, bone / np.maximum(length, _SHORTEST)[:, None], (0.0, 1.0))
        center = 0.5 * (ends[:, 0] + ends[:, 1])
        seen = np.clip(length, self._shortest, self._longest)
        part = self._flat_part
        local = rotate(joints[self._flat_joints] - center[part], -direction[part, 1], direction[part, 0])
        local[:, 0] *= (seen / np.maximum(length, _SHORTEST))[part]
        first, second = direction[self._parent], direction[self._child]
        sine = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
        cosine = (first * second).sum(axis=1)
        pair = np.stack([sine, cosine, seen[self._child]], axis=1)
        return np.concatenate([local.ravel(), pair.ravel()]), direction, center, length

    def __call__(self, joints: Array) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        """Contours (K_i,2) and coefficients (Z,) of every part for joints (J,2); model space, metres.

        After the inference every part is stretched along its bone so that the bone's ends lie on the given joints (what
        lies beyond the ends, such as a hand beyond the wrist, keeps its size), and the torso's contour follows what
        remains at its shoulders and hips.
        """
        observation, direction, center, length = self.observation(joints)
        posterior = (self._gain @ observation + self._offset).reshape(-1, self._size)
        coefficients = np.clip(posterior, -COEFFICIENT_LIMIT, COEFFICIENT_LIMIT)
        points = self._mean + np.squeeze(self._basis @ coefficients[self._part][:, :, None], axis=-1)
        proximal = points[self._contour_end]
        model_length = np.maximum(points[self._contour_end + 1, 0] - proximal[:, 0], self._shortest)
        stretch = np.maximum(length / model_length, LEAST_STRETCH)
        part = self._part
        along = points[:, 0] - proximal[part, 0]
        inside = np.clip(along, 0.0, model_length[part])
        points[:, 0] = along + inside * (stretch[part] - 1.0) - 0.5 * (model_length * stretch)[part]
        points = rotate(points, direction[part, 1], direction[part, 0]) + center[part]
        contours = [points[start:end] for start, end in zip(self._start, self._contour_end, strict=False)]
        residual = joints[self._flat_joints] - points[self._is_joint]
        for index, spread in enumerate(self._spread):
            if spread is not None:
                contours[index] = contours[index] + spread @ residual[self._flat_part == index]
        return tuple(contours), tuple(coefficients)

    def many(self, joints: Array) -> tuple[tuple[Array, ...], Array]:
        """What a call gives, for P sets of joints (P,J,2) at once: contours (P,K_i,2) a part, coefficients (P,N,Z)."""
        ends = joints[:, self._bone]
        bone = ends[:, :, 1] - ends[:, :, 0]
        length = np.hypot(bone[..., 0], bone[..., 1])
        direction = np.where(length[..., None] > _SHORTEST, bone / np.maximum(length, _SHORTEST)[..., None], (0.0, 1.0))
        center = 0.5 * (ends[:, :, 0] + ends[:, :, 1])
        seen = np.clip(length, self._shortest, self._longest)
        part = self._flat_part
        local = rotate(joints[:, self._flat_joints] - center[:, part], -direction[:, part, 1], direction[:, part, 0])
        local[..., 0] *= (seen / np.maximum(length, _SHORTEST))[:, part]
        first, second = direction[:, self._parent], direction[:, self._child]
        sine = first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]
        pair = np.stack([sine, (first * second).sum(axis=2), seen[:, self._child]], axis=2)
        observation = np.concatenate([local.reshape(len(joints), -1), pair.reshape(len(joints), -1)], axis=1)
        posterior = (observation @ self._gain.T + self._offset).reshape(len(joints), -1, self._size)
        coefficients = np.clip(posterior, -COEFFICIENT_LIMIT, COEFFICIENT_LIMIT)
        contours = []
        for index, (start, end) in enumerate(zip(self._start, self._start[1:], strict=False)):
            count = self._contour_end[index] - start
            points = self._mean[start:end] + np.tensordot(coefficients[:, index], self._basis[start:end], axes=(1, 2))
            proximal = points[:, count, 0]
            model_length = np.maximum(points[:, count + 1, 0] - proximal, self._shortest[index])
            stretch = np.maximum(length[:, index] / model_length, LEAST_STRETCH)
            along = points[..., 0] - proximal[:, None]
            inside = np.clip(along, 0.0, model_length[:, None])
            middle = 0.5 * (model_length * stretch)[:, None]
            points[..., 0] = along + inside * (stretch[:, None] - 1.0) - middle
            turned = rotate(points, direction[:, index, None, 1], direction[:, index, None, 0]) + center[:, None, index]
            contour, spread = turned[:, :count], self._spread[index]
            if spread is not None:
                own = self._flat_joints[self._flat_part == index]
                contour = contour + spread @ (joints[:, own] - turned[:, count:])
            contours.append(contour)
        return tuple(contours), coefficients


def _spread(shape: PartShape) -> Array:
    """Shares (K,M) in which each contour point follows each joint: inverse squared distance in the mean shape."""
    contour, joints = shape.mean[: -shape.joint_count], shape.mean[-shape.joint_count :]
    weight = 1.0 / (((contour[:, None] - joints[None]) ** 2).sum(axis=2) + 1e-6)
    return np.asarray(weight / weight.sum(axis=1, keepdims=True))
