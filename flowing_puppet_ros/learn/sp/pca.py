# SPDX-License-Identifier: Apache-2.0
"""Principal components of part meshes, weighted by surface area and exact in the left-right mirror."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import Array

MIRROR = np.array([1.0, -1.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class MeshSpace:
    """A linear space of meshes: mean + basis d, where the coefficients d have unit variance over the training set.

    Attributes:
        mean: (N, 3) m.
        basis: (N, 3, P) m.
        weight: (N,) of each vertex, its area.
        share: share of the weighted variance that the basis keeps.
        residual: root mean square distance of training vertices from the space, metres.
    """

    mean: Array
    basis: Array
    weight: Array
    share: float
    residual: float

    def project(self, meshes: Array) -> Array:
        """Return the coefficients (n, P) of meshes (n, N, 3)."""
        scaled = self.weight[:, None, None] * self.basis
        flat = scaled.reshape((-1, self.basis.shape[2]))
        return np.asarray((meshes - self.mean).reshape((len(meshes), -1)) @ flat / (scaled * self.basis).sum((0, 1)))


def fit_space(meshes: Array, weight: Array, count: int) -> MeshSpace:
    """Fit the `count` strongest principal components of meshes (n, N, 3), with vertex weights `weight` (N,)."""
    mean = meshes.mean(axis=0)
    basis, _ = _find_components(meshes - mean, weight, count)
    return _make_space(meshes, mean, basis, weight)


def fit_mirrored_space(meshes: Array, across: Array, weight: Array, count: int) -> tuple[MeshSpace, Array]:
    """Fit principal components of a part on the midline, each of which a mirror either keeps or negates.

    The training set is the meshes and their mirror images.

    Args:
        meshes: (n, N, 3) m.
        across: (N,) vertex on the other side.
        weight: (N,) of each vertex.
        count: number of components P.

    Returns:
        The space, and the sign (P,) that each coefficient gets in a mirror.
    """
    images = meshes[:, across] * MIRROR
    mean = (meshes.mean(axis=0) + images.mean(axis=0)) / 2
    even, even_variance = _find_components((meshes + images) / 2 - mean, weight, count)
    odd, odd_variance = _find_components((meshes - images) / 2, weight, count)
    variance = np.concatenate([even_variance, odd_variance])
    strongest = np.argsort(-variance, kind="stable")[:count]
    basis = np.concatenate([even, odd], axis=2)[..., strongest]
    signs = np.where(strongest < count, 1.0, -1.0)
    basis = (basis + signs * basis[across] * MIRROR[:, None]) / 2
    return _make_space(np.concatenate([meshes, images]), mean, basis, weight), signs


def _find_components(centred: Array, weight: Array, count: int) -> tuple[Array, Array]:
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
    # The sign of an eigenvector is arbitrary; fix it so that the weights are the same on every machine.
    vectors *= np.sign(vectors[np.abs(vectors).argmax(axis=0), np.arange(count)])
    return (vectors * np.sqrt(kept)).reshape((len(weight), 3, count)) / root[:, None, None], kept


def _make_space(meshes: Array, mean: Array, basis: Array, weight: Array) -> MeshSpace:
    centred = meshes - mean
    coefficients = MeshSpace(mean, basis, weight, 0.0, 0.0).project(meshes)
    left_over = centred - (coefficients @ basis.reshape((-1, basis.shape[2])).T).reshape(meshes.shape)
    missed, total = (float(((x**2).sum(axis=2) @ weight).sum()) for x in (left_over, centred))
    return MeshSpace(mean, basis, weight, 1 - missed / total, float(np.sqrt(missed / (len(meshes) * weight.sum()))))
