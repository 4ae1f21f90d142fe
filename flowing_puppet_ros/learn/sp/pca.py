# SPDX-License-Identifier: Apache-2.0
"""Principal components of part meshes, weighted by surface area and exact in the left-right mirror."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import Array

MIRROR = np.array([1.0, -1.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class Space:
    """A linear space of meshes: mean (N,3) + basis (N,3,P) d, where d has unit variance over the training set.

    weight (N,) is the area of each vertex; share is the share of the (weighted) variance that the basis keeps;
    residual the root mean square distance of training vertices to the space, metres.
    """

    mean: Array
    basis: Array
    weight: Array
    share: float
    residual: float

    def project(self, meshes: Array) -> Array:
        """Coefficients (n,P) of meshes (n,N,3)."""
        scaled = self.weight[:, None, None] * self.basis
        flat = scaled.reshape((-1, self.basis.shape[2]))
        return np.asarray((meshes - self.mean).reshape((len(meshes), -1)) @ flat / (scaled * self.basis).sum((0, 1)))


def principal_space(meshes: Array, weight: Array, count: int) -> Space:
    """The `count` strongest principal components of meshes (n,N,3) whose vertices weigh `weight` (N,)."""
    mean = meshes.mean(axis=0)
    basis, _ = _components(meshes - mean, weight, count)
    return _measured(meshes, mean, basis, weight)


def mirrored_space(meshes: Array, across: Array, weight: Array, count: int) -> tuple[Space, Array]:
    """Principal components of a part on the midline, each either kept or negated by a mirror; signs (P,) say which.

    meshes: (n,N,3); across: (N,) the vertex on the other side. The training set is the meshes and their mirror images.
    """
    images = meshes[:, across] * MIRROR
    mean = (meshes.mean(axis=0) + images.mean(axis=0)) / 2
    even, even_variance = _components((meshes + images) / 2 - mean, weight, count)
    odd, odd_variance = _components((meshes - images) / 2, weight, count)
    variance = np.concatenate([even_variance, odd_variance])
    strongest = np.argsort(-variance, kind="stable")[:count]
    basis = np.concatenate([even, odd], axis=2)[..., strongest]
    signs = np.where(strongest < count, 1.0, -1.0)
    basis = (basis + signs * basis[across] * MIRROR[:, None]) / 2
    return _measured(np.concatenate([meshes, images]), mean, basis, weight), signs


def _components(centred: Array, weight: Array, count: int) -> tuple[Array, Array]:
    n, root = len(centred), np.sqrt(weight)
    data = (centred * root[:, None]).reshape((n, -1))
    if n < data.shape[1]:
        variance, scores = np.linalg.eigh(data @ data.T / (n - 1))
        strongest = np.argsort(-variance)[:count]
        vectors = data.T @ scores[:, strongest]
        vectors /= np.linalg.norm(vectors, axis=0)
    else:
        variance, axes = np.linalg.eigh(data.T @ data / (n - 1))
        strongest = np.argsort(-variance)[:count]
        vectors = axes[:, strongest]
    kept = np.maximum(variance[strongest], 0.0)
    # The sign of an eigenvector is arbitrary; fixing it makes the weights the same on every machine.
    vectors *= np.sign(vectors[np.abs(vectors).argmax(axis=0), np.arange(count)])
    return (vectors * np.sqrt(kept)).reshape((len(weight), 3, count)) / root[:, None, None], kept


def _measured(meshes: Array, mean: Array, basis: Array, weight: Array) -> Space:
    centred = meshes - mean
    coefficients = Space(mean, basis, weight, 0.0, 0.0).project(meshes)
    left_over = centred - (coefficients @ basis.reshape((-1, basis.shape[2])).T).reshape(meshes.shape)
    missed, total = (float(((x**2).sum(axis=2) @ weight).sum()) for x in (left_over, centred))
    return Space(mean, basis, weight, 1 - missed / total, float(np.sqrt(missed / (len(meshes) * weight.sum()))))
