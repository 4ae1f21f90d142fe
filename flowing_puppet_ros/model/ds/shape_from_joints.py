# SPDX-License-Identifier: Apache-2.0
"""From joints to part contours: the posterior of Eqs. 23-30, precomputed, then each part is placed on its bone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.model.ds.shape import COEFFICIENT_LIMIT, PartShape, rotate, shape_posterior
from flowing_puppet_ros.model.gaussian import Gaussian
from flowing_puppet_ros.model.tree import PartTree

LENGTH_LIMIT = 3.0
"""Standard deviations within which bone lengths enter the shape posterior; the rest is stretching."""

MIN_STRETCH = 0.4
"""Share of its model length that a bone pointing at the camera keeps, so that its part stays a blob."""

_MIN_LENGTH_M = 1e-3  # the direction of a shorter bone is noise


class ShapeFromJoints:
    """Posterior mean shape of every part for given joints, with all matrices computed once."""

    def __init__(
        self,
        tree: PartTree,
        shapes: Sequence[PartShape],
        pairwise: Sequence[Gaussian],
        part_joints: Sequence[Sequence[int]],
    ) -> None:
        """Precompute; `part_joints` are the joint indices of every part: proximal, distal, then any others."""
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
        self._influence = [_joint_influence(shape) if shape.joint_count > 2 else None for shape in shapes]
        proximal = self._contour_end
        mean_length = self._mean[proximal + 1, 0] - self._mean[proximal, 0]
        deviation = np.linalg.norm(self._basis[proximal + 1, 0] - self._basis[proximal, 0], axis=1)
        self._min_length = np.maximum(mean_length - LENGTH_LIMIT * deviation, 0.2 * mean_length)
        self._max_length = mean_length + LENGTH_LIMIT * deviation

    def make_observation(self, joints: Array) -> tuple[Array, Array, Array, Array]:
        """Return what the posterior is conditioned on, for `joints` (J, 2) m in model space.

        It is the observation (D,) of `shape_posterior`, in which bone lengths are clipped to the range of the training
        data, with bone directions (N, 2), centres (N, 2) and lengths (N,).
        """
        ends = joints[self._bone]
        bone = ends[:, 1] - ends[:, 0]
        length = np.hypot(bone[:, 0], bone[:, 1])
        direction = np.where(
            length[:, None] > _MIN_LENGTH_M, bone / np.maximum(length, _MIN_LENGTH_M)[:, None], (0.0, 1.0)
        )
        center = 0.5 * (ends[:, 0] + ends[:, 1])
        clipped = np.clip(length, self._min_length, self._max_length)
        part = self._flat_part
        local = rotate(joints[self._flat_joints] - center[part], -direction[part, 1], direction[part, 0])
        local[:, 0] *= (clipped / np.maximum(length, _MIN_LENGTH_M))[part]
        first, second = direction[self._parent], direction[self._child]
        sine = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
        cosine = (first * second).sum(axis=1)
        pair = np.stack([sine, cosine, clipped[self._child]], axis=1)
        return np.concatenate([local.ravel(), pair.ravel()]), direction, center, length

    def __call__(self, joints: Array) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        """Return contours (K_i, 2) m and coefficients (Z,) of every part for `joints` (J, 2) m in model space.

        After the inference, every part is stretched along its bone so that the bone's ends lie on the given joints.
        What lies beyond the ends, such as a hand beyond the wrist, keeps its size. The torso's contour follows the
        remaining offsets at its shoulders and hips.
        """
        observation, direction, center, length = self.make_observation(joints)
        posterior = (self._gain @ observation + self._offset).reshape(-1, self._size)
        coefficients = np.clip(posterior, -COEFFICIENT_LIMIT, COEFFICIENT_LIMIT)
        points = self._mean + np.squeeze(self._basis @ coefficients[self._part][:, :, None], axis=-1)
        proximal = points[self._contour_end]
        model_length = np.maximum(points[self._contour_end + 1, 0] - proximal[:, 0], self._min_length)
        stretch = np.maximum(length / model_length, MIN_STRETCH)
        part = self._part
        along = points[:, 0] - proximal[part, 0]
        inside = np.clip(along, 0.0, model_length[part])
        points[:, 0] = along + inside * (stretch[part] - 1.0) - 0.5 * (model_length * stretch)[part]
        points = rotate(points, direction[part, 1], direction[part, 0]) + center[part]
        contours = [points[start:end] for start, end in zip(self._start, self._contour_end, strict=False)]
        residual = joints[self._flat_joints] - points[self._is_joint]
        for index, influence in enumerate(self._influence):
            if influence is not None:
                contours[index] = contours[index] + influence @ residual[self._flat_part == index]
        return tuple(contours), tuple(coefficients)

    def infer_batch(self, joints: Array) -> tuple[tuple[Array, ...], Array]:
        """Return contours (P, K_i, 2) m per part and coefficients (P, N, Z) for P sets of `joints` (P, J, 2) m."""
        ends = joints[:, self._bone]
        bone = ends[:, :, 1] - ends[:, :, 0]
        length = np.hypot(bone[..., 0], bone[..., 1])
        direction = np.where(
            length[..., None] > _MIN_LENGTH_M, bone / np.maximum(length, _MIN_LENGTH_M)[..., None], (0.0, 1.0)
        )
        center = 0.5 * (ends[:, :, 0] + ends[:, :, 1])
        clipped = np.clip(length, self._min_length, self._max_length)
        part = self._flat_part
        local = rotate(joints[:, self._flat_joints] - center[:, part], -direction[:, part, 1], direction[:, part, 0])
        local[..., 0] *= (clipped / np.maximum(length, _MIN_LENGTH_M))[:, part]
        first, second = direction[:, self._parent], direction[:, self._child]
        sine = first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]
        pair = np.stack([sine, (first * second).sum(axis=2), clipped[:, self._child]], axis=2)
        observation = np.concatenate([local.reshape(len(joints), -1), pair.reshape(len(joints), -1)], axis=1)
        posterior = (observation @ self._gain.T + self._offset).reshape(len(joints), -1, self._size)
        coefficients = np.clip(posterior, -COEFFICIENT_LIMIT, COEFFICIENT_LIMIT)
        contours = []
        for index, (start, end) in enumerate(zip(self._start, self._start[1:], strict=False)):
            count = self._contour_end[index] - start
            points = self._mean[start:end] + np.tensordot(coefficients[:, index], self._basis[start:end], axes=(1, 2))
            proximal = points[:, count, 0]
            model_length = np.maximum(points[:, count + 1, 0] - proximal, self._min_length[index])
            stretch = np.maximum(length[:, index] / model_length, MIN_STRETCH)
            along = points[..., 0] - proximal[:, None]
            inside = np.clip(along, 0.0, model_length[:, None])
            middle = 0.5 * (model_length * stretch)[:, None]
            points[..., 0] = along + inside * (stretch[:, None] - 1.0) - middle
            placed = rotate(points, direction[:, index, None, 1], direction[:, index, None, 0]) + center[:, None, index]
            contour, influence = placed[:, :count], self._influence[index]
            if influence is not None:
                own = self._flat_joints[self._flat_part == index]
                contour = contour + influence @ (joints[:, own] - placed[:, count:])
            contours.append(contour)
        return tuple(contours), coefficients


def _joint_influence(shape: PartShape) -> Array:
    """Return the weights (K, M) of the joints at each contour point: inverse squared distance in the mean shape."""
    contour, joints = shape.mean[: -shape.joint_count], shape.mean[-shape.joint_count :]
    weight = 1.0 / (((contour[:, None] - joints[None]) ** 2).sum(axis=2) + 1e-6)
    return np.asarray(weight / weight.sum(axis=1, keepdims=True))
