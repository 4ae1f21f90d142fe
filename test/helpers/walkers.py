# SPDX-License-Identifier: Apache-2.0
"""Stick people who walk among calibrated cameras: joints in space that are known, and their noisy pixels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.multiview.association.view import PersonInView
from flowing_puppet_ros.multiview.camera import Camera

NAMES = tuple(
    ["neck", "face"]
    + [
        f"{side}_{name}"
        for name in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
        for side in ("left", "right")
    ]
)
SIZE = (1920, 1080)


def ring(count: int = 4, radius: float = 5.0, height: float = 2.0) -> dict[str, Camera]:
    """Return cameras on a circle (not evenly spaced) that look at a point 1 m above its middle; z is up."""
    cameras = {}
    for k in range(count):
        angle = 2 * np.pi * k / count + 0.3 * (k % 2)
        centre = np.array([radius * np.cos(angle), radius * np.sin(angle), height + 0.2 * k])
        forward = np.array([0.0, 0.0, 1.0]) - centre
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        k_matrix = np.array([[1200.0, 0, 959.5], [0, 1200.0, 539.5], [0, 0, 1]])
        lens = np.array([-0.05, 0.02, 0.0, 0.0, 0.0])
        cameras[f"cam{k + 1}"] = Camera(k_matrix, lens, SIZE, rotation, -rotation @ centre)
    return cameras


def walker(place: Sequence[float], heading: float, phase: float, height: float = 1.75) -> F64:
    """Return the joints (14, 3) m of a person at `place` (x, y) who walks along `heading` (radians)."""
    swing, share = np.sin(phase), height / 1.75
    front, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])

    def at(ahead: float, aside: float, up: float) -> F64:
        return np.array([*(np.asarray(place) + share * (ahead * front + aside * left)), share * up])

    joints = {"neck": at(0, 0, 1.48), "face": at(0.05, 0, 1.62)}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        s = sign * swing
        joints[f"{side}_shoulder"] = at(0, sign * 0.19, 1.43)
        joints[f"{side}_elbow"] = at(-0.15 * s, sign * 0.23, 1.16)
        joints[f"{side}_wrist"] = at(0.12 - 0.30 * s, sign * 0.24, 0.98 + 0.1 * abs(s))
        joints[f"{side}_hip"] = at(0, sign * 0.10, 0.93)
        joints[f"{side}_knee"] = at(0.05 + 0.22 * s, sign * 0.11, 0.52)
        joints[f"{side}_ankle"] = at(0.35 * s, sign * 0.11, 0.10)
    return np.array([joints[name] for name in NAMES])


def photograph(
    cameras: Mapping[str, Camera],
    people: Mapping[str, F64],
    noise: float,
    random: np.random.Generator,
    hide: bool = True,
) -> dict[str, list[PersonInView]]:
    """Return what each camera's tracker says of `people` (name -> joints): their noisy pixels.

    A joint with somebody else's trunk before it is guessed badly, with little confidence; who is mostly hidden is not
    found at all. With `hide` off everybody is transparent.
    """
    found: dict[str, list[PersonInView]] = {}
    for camera, calibration in cameras.items():
        group = []
        for name, joints in people.items():
            pixels, depth = calibration.project(joints)
            pixels = pixels + random.normal(0, noise, pixels.shape)
            hidden = np.zeros(len(joints), bool)
            for other, theirs in people.items():
                trunk, near = calibration.project(theirs)
                low, high = np.nanmin(trunk[[0, 2, 3, 8, 9]], axis=0), np.nanmax(trunk[[0, 2, 3, 8, 9]], axis=0)
                if hide and other != name and np.nanmean(near) < np.nanmean(depth):
                    hidden |= ((pixels > low - 15) & (pixels < high + 15)).all(axis=1)
            if hidden.mean() > 0.6:
                continue
            pixels[hidden] += random.normal(0, 25, (int(hidden.sum()), 2))
            group.append(PersonInView(name, pixels, np.where(hidden, 0.2, 0.8)))
        found[camera] = group
    return found
