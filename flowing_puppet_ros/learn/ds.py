# SPDX-License-Identifier: Apache-2.0
"""Learn the 2D Deformable Structures puppet from projected Anny bodies."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.learn.anny import GENDERS
from flowing_puppet_ros.learn.ds_samples import PartSamples, TrainingSet, make_training_set
from flowing_puppet_ros.model.ds import DeformableStructures
from flowing_puppet_ros.model.ds_joints import JOINT_NAMES, PART_JOINTS
from flowing_puppet_ros.model.ds_shape import PairLayout, PartShape, rotate
from flowing_puppet_ros.model.gaussian import Gaussian
from flowing_puppet_ros.settings import make_out_folder

Array = np.ndarray[Any, Any]

COMPONENTS = 10
POSES = 1500
NEGLIGIBLE = 1e-6  # metres: components with less deviation are rounding noise and get coefficients of about 0
# Standard deviations added to the pairwise variables: lengths depend exactly on shapes, which cannot be inverted.
SHAPE_FLOOR, ANGLE_FLOOR, METRE_FLOOR = 0.03, 0.03, 0.003

LENGTH_PAIRS = (
    *(("neck", "belly"), ("neck", "face"), ("face", "belly"), ("right_shoulder", "left_shoulder")),
    ("right_hip", "left_hip"),
    *((f"{side}_{a}", f"{side}_{b}") for side in ("right", "left") for a, b in (("shoulder", "hip"), ("hip", "knee"))),
    *((f"{side}_{a}", f"{side}_{b}") for side in ("right", "left") for a, b in (("knee", "ankle"), ("elbow", "wrist"))),
    *((f"{side}_shoulder", f"{side}_elbow") for side in ("right", "left")),
    *(("neck", f"{side}_{joint}") for side in ("right", "left") for joint in ("shoulder", "hip")),
)
"""Joints whose distance tells the scale of a person."""


def fit(gender: str, training: TrainingSet, components: int = COMPONENTS) -> DeformableStructures:
    """Fit the part shapes (Eq. 6), the pairwise Gaussians (Eq. 10) and the statistics of the joints."""
    fitted = [_fit_part(part, name, components) for part, name in zip(training.parts, training.tree.names, strict=True)]
    shapes = tuple(shape for shape, _ in fitted)
    coefficients = [z for _, z in fitted]
    pairwise = tuple(_fit_pair(training, shapes, coefficients, *edge) for edge in training.tree.edges)
    middle = training.joints[:, :2].mean(axis=1, keepdims=True)
    prior = Gaussian.from_samples((training.joints - middle).reshape(len(training.joints), -1), ridge=1e-6)
    pairs = np.array([[training.joint_names.index(name) for name in pair] for pair in LENGTH_PAIRS])
    log_length = np.log(np.linalg.norm(training.joints[:, pairs[:, 0]] - training.joints[:, pairs[:, 1]], axis=2))
    spread = np.maximum(log_length.std(axis=0), 0.02)
    statistics = np.stack([log_length.mean(axis=0), spread], axis=1)
    return DeformableStructures(gender, training.tree, shapes, pairwise, prior, pairs, statistics)


def _fit_part(part: PartSamples, name: str, components: int) -> tuple[PartShape, Array]:
    """Principal components of one part's points; returns the shape and the samples' coefficients (n,Z)."""
    flat = part.points.reshape(len(part.points), -1)
    mean = flat.mean(axis=0)
    _, values, axes = np.linalg.svd(flat - mean, full_matrices=False)
    deviation = np.maximum(values[:components] / np.sqrt(len(flat) - 1), NEGLIGIBLE)
    coefficients = (flat - mean) @ axes[:components].T / deviation
    basis = (axes[:components].T * deviation).reshape(*part.points.shape[1:], components)
    return PartShape(mean.reshape(-1, 2), basis, len(PART_JOINTS[name])), coefficients


def _fit_pair(
    training: TrainingSet, shapes: tuple[PartShape, ...], coefficients: list[Array], parent: int, child: int
) -> Gaussian:
    """Gaussian over [z_j, sin, cos, q_ji, t_j, z_i, t_i]; q_ji is what the truncated shapes leave open at the joint."""
    above, below = training.parts[parent], training.parts[child]
    angle = below.angle - above.angle
    sine, cosine = np.sin(angle), np.cos(angle)
    shared = PART_JOINTS[training.tree.names[parent]].index(PART_JOINTS[training.tree.names[child]][0])
    center = rotate(below.center - above.center, -np.sin(above.angle), np.cos(above.angle))
    joint = _joint(shapes[child], coefficients[child], 0)
    gap = center + rotate(joint, sine, cosine) - _joint(shapes[parent], coefficients[parent], shared)
    columns = [coefficients[child], sine, cosine, gap, below.length, coefficients[parent], above.length]
    layout = PairLayout(coefficients[child].shape[1])
    floor = np.full(2 * layout.size + 6, SHAPE_FLOOR)
    floor[layout.angle] = ANGLE_FLOOR
    floor[layout.gap + layout.child_length + layout.parent_length] = METRE_FLOOR
    pair = Gaussian.from_samples(np.column_stack(columns))
    return Gaussian(pair.mean, pair.covariance + np.diag(floor**2))


def _joint(shape: PartShape, coefficients: Array, index: int) -> Array:
    """Joint point `index` (n,2) of a part for coefficients (n,Z)."""
    row = len(shape.mean) - shape.joint_count + index
    return np.asarray(shape.mean[row] + coefficients @ shape.basis[row].T)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Flags of `learn ds`."""
    parser.add_argument("--gender", choices=GENDERS, default="neutral", help="whose body [%(default)s]")
    parser.add_argument("--parts", type=int, choices=tuple(JOINT_NAMES), default=10, help="parts [%(default)s]")
    parser.add_argument("--out", type=Path, required=True, help="folder for ds_GENDER-PARTS.npz and its model card")
    parser.add_argument("--mocap", type=Path, help="motion capture, expmap_20hz.npz; without it joint limits alone")
    parser.add_argument("--poses", type=int, default=POSES, help="random poses, each also mirrored [%(default)s]")
    parser.add_argument("--seed", type=int, default=0, help="seed of poses and cameras [%(default)s]")


def run(arguments: argparse.Namespace) -> int:
    """Learn one model and write it with its card."""
    if arguments.poses < 2 * COMPONENTS:
        raise InputError(f"--poses is {arguments.poses}; a model needs at least {2 * COMPONENTS}")
    if arguments.seed < 0:
        raise InputError(f"--seed is {arguments.seed}; it must be 0 or more")
    make_out_folder(arguments.out)
    rng = np.random.default_rng(arguments.seed)
    training = make_training_set(arguments.gender, arguments.parts, arguments.poses, rng, arguments.mocap)
    model = fit(arguments.gender, training)
    path = arguments.out / f"ds_{model.name}.npz"
    np.savez_compressed(path, **model.to_arrays())  # type: ignore[arg-type]
    path.with_suffix(".md").write_text(_card(model, arguments), encoding="utf-8")
    print(path)
    return 0


def _card(model: DeformableStructures, arguments: argparse.Namespace) -> str:
    poses = "frames of the CMU motion capture with noise, and joint limits" if arguments.mocap else "joint limits"
    mocap = " --mocap expmap_20hz.npz" if arguments.mocap else ""
    command = (
        f"flowing-puppet learn ds --gender {model.gender} --parts {len(model.tree)} --poses {arguments.poses}"
        f" --seed {arguments.seed}{mocap} --out flowing_puppet_ros/weights"
    )
    return _CARD.format(
        name=model.name, gender=model.gender, parts=len(model.tree), samples=2 * arguments.poses, poses=poses,
        command=command, components=COMPONENTS,
    )  # fmt: skip


_CARD = """# Deformable Structures puppet {name}

A 2D model of the shape and pose of a {gender} adult of average build in {parts} parts, seen roughly from the front
(S. Zuffi, thesis, chapter "Deformable Structure Model"). It holds, for every part, the mean contour and {components}
principal components, and for every joint of two parts a Gaussian over both shapes, their relative angle and lengths;
also the Gaussian of all joints, and the lengths that tell a person's scale.

- Learned from {samples} samples (half of them mirror images) with the command
  `{command}`
- Body: Anny 0.6.2 (code Apache-2.0, assets CC0, made from MakeHuman), fixed average build, minimal clothing.
- Poses: {poses}. The motion capture is from mocap.cs.cmu.edu, created with
  funding from NSF EIA-0196217; only statistics of it are in this file.
- Camera: perspective, 3 to 6 m away, yaw 15, pitch 5 and roll 3 degrees (standard deviations) off the front view.
- Limits: no clothing, no hair; one build; profile views and strongly foreshortened limbs are extrapolated.
- Licence: Apache-2.0, as the package.
"""
