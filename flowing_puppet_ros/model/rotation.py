# SPDX-License-Identifier: Apache-2.0
"""Rotations of space: Rodrigues vectors, matrices and the orthogonal Procrustes problem, all batched."""

from __future__ import annotations

import numpy as np
from numba import njit

from flowing_puppet_ros.arrays import Array

MAX_JACOBI_SWEEPS = 12  # over a 4 x 4 matrix; five are usual


def exp(r: Array) -> Array:
    """Return the rotation matrices (..., 3, 3) of Rodrigues vectors `r` (..., 3) rad; they act on column vectors."""
    r = np.asarray(r, dtype=np.float64)
    return np.asarray(_exp_all(np.ascontiguousarray(r).reshape((-1, 3))).reshape((*r.shape, 3)))


def quaternion(matrix: Array) -> Array:
    """Return the unit quaternions (..., 4) as (w, x, y, z), w >= 0, of rotation matrices `matrix` (..., 3, 3)."""
    matrix = np.asarray(matrix, dtype=np.float64)
    m = matrix.reshape((-1, 3, 3))
    # Rows of 4 q q^T: the row with the largest diagonal entry is the numerically safe multiple of q (Shepperd 1978).
    outer = np.empty((len(m), 4, 4))
    trace = m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2]
    outer[:, 0, 0] = 1 + trace
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        outer[:, i + 1, i + 1] = 1 + 2 * m[:, i, i] - trace
        outer[:, 0, i + 1] = outer[:, i + 1, 0] = m[:, k, j] - m[:, j, k]
        outer[:, j + 1, k + 1] = outer[:, k + 1, j + 1] = m[:, k, j] + m[:, j, k]
    best = np.argmax(np.diagonal(outer, axis1=1, axis2=2), axis=1)
    rows = outer[np.arange(len(m)), best]
    rows = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    rows = np.where(rows[:, :1] < 0, -rows, rows)
    return np.asarray(rows.reshape((*matrix.shape[:-2], 4)))


def log(matrix: Array) -> Array:
    """Return the Rodrigues vectors (..., 3) rad of rotation matrices `matrix` (..., 3, 3).

    Angles are in [0, pi] and accurate near both ends.
    """
    matrix = np.asarray(matrix, dtype=np.float64)
    return np.asarray(_log_all(np.ascontiguousarray(matrix).reshape((-1, 3, 3))).reshape(matrix.shape[:-1]))


def nearest_rotation(matrix: Array) -> Array:
    """Return the rotation R (..., 3, 3) with the largest trace(R^T M) for M = `matrix` (..., 3, 3)."""
    matrix = np.asarray(matrix, dtype=np.float64)
    return np.asarray(_nearest_all(np.ascontiguousarray(matrix).reshape((-1, 3, 3))).reshape(matrix.shape))


def procrustes(a: Array, b: Array, w: Array | None = None) -> tuple[Array, Array]:
    """Return the rotation R (..., 3, 3) and translation t (..., 3) that minimise sum_k w_k |R a_k + t - b_k|^2.

    `a` and `b` (..., K, 3) are points, `w` (K,) or (..., K) weights >= 0 (uniform when left out).
    """
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    weight = np.ones(a.shape[-2]) if w is None else np.asarray(w, dtype=np.float64)
    weight = (weight / weight.sum(axis=-1, keepdims=True))[..., None]
    centre_a, centre_b = (weight * a).sum(axis=-2), (weight * b).sum(axis=-2)
    moment = np.swapaxes(weight * (b - centre_b[..., None, :]), -1, -2) @ (a - centre_a[..., None, :])
    rotation = nearest_rotation(moment)
    translation = centre_b - np.squeeze(rotation @ centre_a[..., None], axis=-1)
    return rotation, np.asarray(translation)


@njit(cache=True, nogil=True)
def exp_one(vector: Array) -> Array:
    """Return the rotation (3, 3) of one rotation vector (3,) by Rodrigues' formula; `exp` for compiled loops."""
    angle = np.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)
    cross = np.zeros((3, 3))
    cross[0, 1], cross[0, 2] = -vector[2], vector[1]
    cross[1, 0], cross[1, 2] = vector[2], -vector[0]
    cross[2, 0], cross[2, 1] = -vector[1], vector[0]
    first = np.sin(angle) / angle if angle > 1e-8 else 1.0
    second = (1 - np.cos(angle)) / angle**2 if angle > 1e-8 else 0.5
    return np.eye(3) + first * cross + second * (cross @ cross)


@njit(cache=True, nogil=True)
def log_one(m: Array) -> Array:
    """Return the rotation vector (3,) of one rotation (3, 3), by the quaternion; `log` for compiled loops."""
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    q = np.empty(4)
    best = 0
    for i in range(1, 4):
        if m[i - 1, i - 1] > (trace if best == 0 else m[best - 1, best - 1]):
            best = i
    if best == 0:
        q[0] = 1 + trace
        q[1], q[2], q[3] = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    else:
        i = best - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        q[0], q[1 + i] = m[k, j] - m[j, k], 1 + 2 * m[i, i] - trace
        q[1 + j], q[1 + k] = m[j, i] + m[i, j], m[k, i] + m[i, k]
    q /= np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    if q[0] < 0:
        q = -q
    sine = np.sqrt(q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    return q[1:] * (2 * np.arctan2(sine, q[0]) / sine if sine > 1e-12 else 2.0)


@njit(cache=True, nogil=True)
def _exp_all(vectors: Array) -> Array:
    result = np.empty((len(vectors), 3, 3))
    for row in range(len(vectors)):
        result[row] = exp_one(vectors[row])
    return result


@njit(cache=True, nogil=True)
def _log_all(matrices: Array) -> Array:
    result = np.empty((len(matrices), 3))
    for row in range(len(matrices)):
        result[row] = log_one(matrices[row])
    return result


@njit(cache=True, nogil=True)
def _nearest_all(matrices: Array) -> Array:
    """Return `nearest_rotation` of matrices (N, 3, 3) by the quaternion that maximises the trace (Horn 1987)."""
    result = np.empty_like(matrices)
    for row in range(len(matrices)):
        m = matrices[row]
        form = np.empty((4, 4))
        trace = m[0, 0] + m[1, 1] + m[2, 2]
        form[0, 0] = trace
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            form[i + 1, i + 1] = 2 * m[i, i] - trace
            form[0, i + 1] = form[i + 1, 0] = m[k, j] - m[j, k]
            form[j + 1, k + 1] = form[k + 1, j + 1] = m[k, j] + m[j, k]
        w, x, y, z = _largest_axis(form)
        result[row, 0, 0], result[row, 0, 1], result[row, 0, 2] = (
            w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y),
        )  # fmt: skip
        result[row, 1, 0], result[row, 1, 1], result[row, 1, 2] = (
            2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x),
        )  # fmt: skip
        result[row, 2, 0], result[row, 2, 1], result[row, 2, 2] = (
            2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z,
        )  # fmt: skip
    return result


@njit(cache=True, nogil=True)
def _largest_axis(form: Array) -> tuple[float, float, float, float]:
    """Return the unit eigenvector of the largest eigenvalue of a symmetric matrix (4, 4), by Jacobi's rotations."""
    axes = np.eye(4)
    for _ in range(MAX_JACOBI_SWEEPS):
        off, total = 0.0, 0.0
        for i in range(4):
            total += form[i, i] ** 2
            for j in range(i + 1, 4):
                off += form[i, j] ** 2
        if off <= 1e-32 * total:
            break
        for i in range(3):
            for j in range(i + 1, 4):
                if form[i, j] == 0.0:
                    continue
                ratio = (form[j, j] - form[i, i]) / (2 * form[i, j])
                tangent = (1.0 if ratio >= 0 else -1.0) / (abs(ratio) + np.sqrt(ratio * ratio + 1))
                cosine = 1 / np.sqrt(tangent * tangent + 1)
                sine = tangent * cosine
                for k in range(4):
                    p, q = form[k, i], form[k, j]
                    form[k, i], form[k, j] = cosine * p - sine * q, sine * p + cosine * q
                for k in range(4):
                    p, q = form[i, k], form[j, k]
                    form[i, k], form[j, k] = cosine * p - sine * q, sine * p + cosine * q
                for k in range(4):
                    p, q = axes[k, i], axes[k, j]
                    axes[k, i], axes[k, j] = cosine * p - sine * q, sine * p + cosine * q
    best = 0
    for i in range(1, 4):
        if form[i, i] > form[best, best]:
            best = i
    length = np.sqrt(axes[0, best] ** 2 + axes[1, best] ** 2 + axes[2, best] ** 2 + axes[3, best] ** 2)
    return axes[0, best] / length, axes[1, best] / length, axes[2, best] / length, axes[3, best] / length
