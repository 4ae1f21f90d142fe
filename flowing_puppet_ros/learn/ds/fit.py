# SPDX-License-Identifier: Apache-2.0
"""Fit the 2D Deformable Structures puppet to projected bodies: part shapes, pairwise Gaussians, joint statistics."""

from __future__ import annotations

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.learn.ds.samples import PartSamples, TrainingSet
from flowing_puppet_ros.model.ds.joints import PART_JOINTS
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.shape import PairLayout, PartShape, rotate
from flowing_puppet_ros.model.gaussian import Gaussian

COMPONENTS = 10  # of each part's shape
MIN_DEVIATION_M = 1e-6  # of a component: below it is rounding noise, which gets coefficients near 0
# Standard deviations added to the pairwise variables, whose covariance is singular: shapes determine lengths.
SHAPE_FLOOR, ANGLE_FLOOR, METRE_FLOOR = 0.03, 0.03, 0.003
MIN_LOG_DEVIATION = 0.02  # of the logarithm of a distance between joints

LENGTH_PAIRS = (
    *(("neck", "belly"), ("neck", "face"), ("face", "belly"), ("right_shoulder", "left_shoulder")),
    ("right_hip", "left_hip"),
    *((f"{side}_{a}", f"{side}_{b}") for side in ("right", "left") for a, b in (("shoulder", "hip"), ("hip", "knee"))),
    *((f"{side}_{a}", f"{side}_{b}") for side in ("right", "left") for a, b in (("knee", "ankle"), ("elbow", "wrist"))),
    *((f"{side}_shoulder", f"{side}_elbow") for side in ("right", "left")),
    *(("neck", f"{side}_{joint}") for side in ("right", "left") for joint in ("shoulder", "hip")),
)
"""Pairs of joints whose distance determines the scale of a person."""


def fit_puppet(gender: str, training: TrainingSet, components: int = COMPONENTS) -> DeformableStructures:
    """Fit the part shapes (Eq. 6), the pairwise Gaussians (Eq. 10) and the statistics of the joints."""
    fitted = [fit_part(part, name, components) for part, name in zip(training.parts, training.tree.names, strict=True)]
    shapes = tuple(shape for shape, _ in fitted)
    coefficients = [z for _, z in fitted]
    pairwise = tuple(fit_pair(training, shapes, coefficients, *edge) for edge in training.tree.edges)
    return DeformableStructures(gender, training.tree, shapes, pairwise, *fit_joint_statistics(training))


def fit_joint_statistics(training: TrainingSet) -> tuple[Gaussian, Array, Array]:
    """Fit the statistics that complete hidden joints and estimate a person's scale.

    Returns:
        The Gaussian of all joints around their mid-torso; pairs of joints (P, 2) whose distance determines the scale;
        mean and deviation (P, 2) of the logarithm of those distances in metres.
    """
    middle = training.joints[:, :2].mean(axis=1, keepdims=True)
    prior = Gaussian.from_samples((training.joints - middle).reshape(len(training.joints), -1), ridge=1e-6)
    pairs = np.array([[training.joint_names.index(name) for name in pair] for pair in LENGTH_PAIRS])
    log_length = np.log(np.linalg.norm(training.joints[:, pairs[:, 0]] - training.joints[:, pairs[:, 1]], axis=2))
    spread = np.maximum(log_length.std(axis=0), MIN_LOG_DEVIATION)
    return prior, pairs, np.stack([log_length.mean(axis=0), spread], axis=1)


def fit_part(part: PartSamples, name: str, components: int) -> tuple[PartShape, Array]:
    """Fit the principal components (Eq. 6) of a part; return the shape and the samples' coefficients (n, Z)."""
    flat = part.points.reshape(len(part.points), -1)
    mean = flat.mean(axis=0)
    _, values, axes = np.linalg.svd(flat - mean, full_matrices=False)
    deviation = np.maximum(values[:components] / np.sqrt(len(flat) - 1), MIN_DEVIATION_M)
    coefficients = (flat - mean) @ axes[:components].T / deviation
    basis = (axes[:components].T * deviation).reshape(*part.points.shape[1:], components)
    return PartShape(mean.reshape(-1, 2), basis, len(PART_JOINTS[name])), coefficients


def fit_pair(
    training: TrainingSet, shapes: tuple[PartShape, ...], coefficients: list[Array], parent: int, child: int
) -> Gaussian:
    """Fit the Gaussian of Eq. 10 over [z_j, sin, cos, q_ji, t_j, z_i, t_i] (Eq. 43).

    The gap q_ji is what the truncated shapes leave open at the joint.
    """
    above, below = training.parts[parent], training.parts[child]
    angle = below.angle - above.angle
    sine, cosine = np.sin(angle), np.cos(angle)
    shared = PART_JOINTS[training.tree.names[parent]].index(PART_JOINTS[training.tree.names[child]][0])
    center = rotate(below.center - above.center, -np.sin(above.angle), np.cos(above.angle))
    joint = _locate_joint(shapes[child], coefficients[child], 0)
    gap = center + rotate(joint, sine, cosine) - _locate_joint(shapes[parent], coefficients[parent], shared)
    columns = [coefficients[child], sine, cosine, gap, below.length, coefficients[parent], above.length]
    layout = PairLayout(coefficients[child].shape[1])
    floor = np.full(2 * layout.size + 6, SHAPE_FLOOR)
    floor[layout.angle] = ANGLE_FLOOR
    floor[layout.gap + layout.child_length + layout.parent_length] = METRE_FLOOR
    pair = Gaussian.from_samples(np.column_stack(columns))
    return Gaussian(pair.mean, pair.covariance + np.diag(floor**2))


def _locate_joint(shape: PartShape, coefficients: Array, index: int) -> Array:
    """Return the joint point `index` (n, 2) m of a part for coefficients (n, Z)."""
    row = len(shape.mean) - shape.joint_count + index
    return np.asarray(shape.mean[row] + coefficients @ shape.basis[row].T)
