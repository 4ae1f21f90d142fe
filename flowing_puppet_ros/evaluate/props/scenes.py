# SPDX-License-Identifier: Apache-2.0
"""Frames of people on, behind or with things that touch them.

frame = draw_props(RgbdStudio(source), np.random.default_rng(0), "armchair")
"""

from __future__ import annotations

import numpy as np

from flowing_puppet_ros.evaluate.props.people import draw_people
from flowing_puppet_ros.evaluate.rgbd.clothing import paint_surroundings
from flowing_puppet_ros.evaluate.rgbd.views import RgbdFrame, RgbdStudio
from flowing_puppet_ros.evaluate.scene.scene_meshes import Mesh

BEARING_RAD = {"backpack": (0.8, 2.6)}
"""By which the camera is away from where people face, to either side."""
MAX_BEARING_RAD = 1.3
BEHIND_M = (0.35, 0.6)  # between the middles of a person and of the chair that they stand behind


def draw_props(studio: RgbdStudio, rng: np.random.Generator, prop: str, noise: float = 5.0) -> RgbdFrame:
    """Draw whole people with one of `people.PROPS`; keypoints have `noise` px."""
    bodies, meshes = draw_people(studio.source, rng, prop)
    low, high = BEARING_RAD.get(prop, (0.0, MAX_BEARING_RAD))
    bearing = rng.uniform(low, high) * rng.choice([-1, 1])
    ahead = np.array([np.cos(bearing), np.sin(bearing), 0.0])
    if prop == "behind":
        meshes = _place_before(meshes, rng, ahead)
    cameras = studio.place_cameras(rng, bodies, "whole", ahead)
    room = [*studio.furnish(rng, bodies, cameras), *paint_surroundings(meshes, rng)]
    return studio.look(rng, bodies, room, cameras, noise)


def _place_before(meshes: list[Mesh], rng: np.random.Generator, ahead: np.ndarray) -> list[Mesh]:
    """Return a chair turned anyhow and placed in the direction `ahead` of who stands at x = y = 0."""
    yaw = rng.uniform(-np.pi, np.pi)
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    middle = np.mean([vertices.mean(axis=0) for vertices, _ in meshes], axis=0) * [1, 1, 0]
    place = rng.uniform(*BEHIND_M) * ahead + rng.uniform(-0.2, 0.2) * np.array([-ahead[1], ahead[0], 0.0])
    return [((vertices - middle) @ turn.T + place, triangles) for vertices, triangles in meshes]
