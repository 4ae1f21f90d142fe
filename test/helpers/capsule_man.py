# SPDX-License-Identifier: Apache-2.0
"""A man and a dog made of capsules, whose surfaces and joints owe nothing to the learned body model."""

import numpy as np

Joints = dict[str, np.ndarray]

HEIGHTS = {"pelvis": 0.0, "belly": 0.12, "neck": 0.5, "face": 0.66, "head_top": 0.8}
LIMBS = (
    ("left_shoulder", "left_elbow", 0.055, 0.045),
    ("left_elbow", "left_wrist", 0.045, 0.032),
    ("left_wrist", "left_hand", 0.035, 0.035),
    ("left_hip", "left_knee", 0.085, 0.058),
    ("left_knee", "left_ankle", 0.055, 0.042),
    ("left_ankle", "left_toe", 0.045, 0.04),
)
TRUNK = (
    ("left_shoulder", "right_shoulder", 0.07, 0.07),
    ("neck", "face", 0.06, 0.09),
    ("face", "head_top", 0.09, 0.06),
    ("left_hip", "right_hip", 0.1, 0.1),
)


def joints_of(bend: float = 0.3, raise_left: float = 0.6, raise_right: float = 0.3) -> dict[str, np.ndarray]:
    """Return joints in metres: facing +x, left at +y; arms raised sideways by angles (rad), elbows bent forward."""
    joints = {name: np.array([0.0, 0.0, height]) for name, height in HEIGHTS.items()}
    joints["face"] = np.array([0.04, 0.0, HEIGHTS["face"]])
    for side, sign, lift in (("left", 1.0, raise_left), ("right", -1.0, raise_right)):
        shoulder = np.array([0.0, 0.17 * sign, 0.43])
        upper = np.array([0.0, sign * np.sin(lift), -np.cos(lift)])
        lower = np.cos(bend) * upper + np.sin(bend) * np.array([1.0, 0.0, 0.0])
        joints[f"{side}_shoulder"] = shoulder
        joints[f"{side}_elbow"] = shoulder + 0.28 * upper
        joints[f"{side}_wrist"] = joints[f"{side}_elbow"] + 0.25 * lower
        joints[f"{side}_hand"] = joints[f"{side}_wrist"] + 0.13 * lower
        joints[f"{side}_hip"] = np.array([0.0, 0.09 * sign, -0.04])
        joints[f"{side}_knee"] = np.array([0.03, 0.11 * sign, -0.44])
        joints[f"{side}_ankle"] = np.array([0.0, 0.13 * sign, -0.83])
        joints[f"{side}_toe"] = np.array([0.16, 0.15 * sign, -0.87])
    return joints


def cloud_of(joints: dict[str, np.ndarray], count: int = 6000, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Sample outer surface points (count, 3) and normals (count, 3) of the capsules along the joints."""
    mirrored = [(a.replace("left", "right"), b.replace("left", "right"), ra, rb) for a, b, ra, rb in LIMBS]
    capsules = [(joints[a], joints[b], ra, rb) for a, b, ra, rb in (*LIMBS, *mirrored, *TRUNK)]
    for sign in (1.0, -1.0):
        low, high = np.array([0.0, 0.06 * sign, 0.0]), np.array([0.0, 0.08 * sign, 0.4])
        capsules.append((low, high, 0.1, 0.11))
    return _surface(capsules, count, np.random.default_rng(seed))


def dog() -> tuple[np.ndarray, np.ndarray]:
    """Sample outer surface points (4000, 3) and normals of a dog 1.2 m long."""
    capsules = [
        (np.array([-0.35, 0, 0]), np.array([0.35, 0, 0.02]), 0.14, 0.16),
        (np.array([0.4, 0, 0.1]), np.array([0.55, 0, 0.3]), 0.08, 0.08),
        (np.array([0.55, 0, 0.3]), np.array([0.75, 0, 0.26]), 0.09, 0.05),
        (np.array([-0.45, 0, 0.05]), np.array([-0.7, 0, 0.25]), 0.03, 0.02),
    ]
    legs = [np.array([x, y, -0.1]) for x in (-0.3, 0.3) for y in (-0.1, 0.1)]
    capsules += [(leg, leg - [0, 0, 0.4], 0.05, 0.04) for leg in legs]
    return _surface(capsules, 4000, np.random.default_rng(0))


def _surface(
    capsules: list[tuple[np.ndarray, np.ndarray, float, float]], count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    points, normals = [], []
    sizes = np.array([(np.linalg.norm(b - a) + ra + rb) * (ra + rb) for a, b, ra, rb in capsules])
    for size, (a, b, ra, rb) in zip(sizes, capsules, strict=True):
        new, outward = _capsule(a, b, ra, rb, int(3 * count * size / sizes.sum()) + 1, rng)
        points.append(new)
        normals.append(outward)
    every, directions = np.concatenate(points), np.concatenate(normals)
    outside = np.ones(len(every), dtype=bool)
    for capsule in capsules:
        outside &= _depth(every, *capsule) < 1e-6
    chosen = rng.permutation(np.flatnonzero(outside))[:count]
    return every[chosen], directions[chosen]


def _capsule(
    a: np.ndarray, b: np.ndarray, radius_a: float, radius_b: float, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    axis = (b - a) / np.linalg.norm(b - a)
    along = rng.uniform(-radius_a, np.linalg.norm(b - a) + radius_b, count)
    inside = np.clip(along, 0, np.linalg.norm(b - a))
    radius = radius_a + (radius_b - radius_a) * inside / np.linalg.norm(b - a)
    across = rng.normal(size=(count, 3))
    across -= np.outer(across @ axis, axis)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    beyond = (along - inside) / radius
    normal = beyond[:, None] * axis + np.sqrt(np.maximum(1 - beyond**2, 0))[:, None] * across
    return a + inside[:, None] * axis + radius[:, None] * normal, normal


def _depth(points: np.ndarray, a: np.ndarray, b: np.ndarray, radius_a: float, radius_b: float) -> np.ndarray:
    axis = b - a
    along = np.clip((points - a) @ axis / (axis @ axis), 0, 1)
    gap = np.linalg.norm(points - a - along[:, None] * axis, axis=1)
    return radius_a + along * (radius_b - radius_a) - gap
