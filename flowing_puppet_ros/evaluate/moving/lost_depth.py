# SPDX-License-Identifier: Apache-2.0
"""Depth images in which much of the people is missing, as black clothes, sunlight or a broken sensor leave them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flowing_puppet_ros.evaluate.body.synthetic_bodies import TrueBody
from flowing_puppet_ros.evaluate.rgbd.views import RgbdFrame
from flowing_puppet_ros.evidence.cloud.nearest import NearestPoints
from flowing_puppet_ros.model.sp import StitchedPuppet

LOSSES = ("full", "patches", "clothes", "one")
"""full: nothing is missing; patches: of each person, in each camera for itself, discs of sunlight until 60 % is gone;
clothes: everybody's shirt or trousers, in all cameras alike; one: all depth of all cameras but the first."""
LOST_SHARE = 0.6
PATCH_RADIUS_M = (0.15, 0.3)
SHIRT, TROUSERS = ("torso", "shoulder", "upper_arm", "lower_arm"), ("upper_leg", "lower_leg", "foot")
"""Parts of the body, without their sides, that clothes cover."""


def lose_depth(
    frames: Sequence[RgbdFrame], loss: str, rng: np.random.Generator, model: StitchedPuppet
) -> list[RgbdFrame]:
    """Return the frames of cameras at one moment without the depth that a loss, one of LOSSES, takes away."""
    if loss == "full":
        return list(frames)
    if loss == "one":
        return [frames[0], *(replace(frame, depth=np.full_like(frame.depth, np.nan)) for frame in frames[1:])]
    if loss == "patches":
        return [_lose_patches(frame, rng) for frame in frames]
    black = [SHIRT if rng.random() < 0.5 else TROUSERS for _ in frames[0].bodies]
    return [_lose_clothes(frame, black, model) for frame in frames]


def _lose_patches(frame: RgbdFrame, rng: np.random.Generator) -> RgbdFrame:
    depth = frame.depth.copy()
    rows, columns = np.indices(depth.shape)
    for person in range(len(frame.bodies)):
        own = (frame.person == person) & np.isfinite(frame.depth)
        count = np.count_nonzero(own)
        while np.count_nonzero(own & np.isfinite(depth)) > (1 - LOST_SHARE) * count:
            left = np.flatnonzero(own & np.isfinite(depth))
            row, column = np.unravel_index(left[rng.integers(len(left))], depth.shape)
            radius = rng.uniform(*PATCH_RADIUS_M) * frame.cameras.depth.focal / frame.true_depth[row, column]
            depth[(rows - row) ** 2 + (columns - column) ** 2 < radius**2] = np.nan
    return replace(frame, depth=depth)


def _lose_clothes(frame: RgbdFrame, black: Sequence[Sequence[str]], model: StitchedPuppet) -> RgbdFrame:
    depth = frame.depth.copy()
    camera = frame.cameras.depth
    for person, (body, kinds) in enumerate(zip(frame.bodies, black, strict=True)):
        own = np.flatnonzero(frame.person == person)
        if not len(own):
            continue
        row, column = np.unravel_index(own, depth.shape)
        rays = camera.cast_rays(np.stack([column, row], axis=1))
        along = frame.true_depth[row, column] / (rays @ camera.rotation[2])
        part = _find_parts(body, camera.centre + along[:, None] * rays, model)
        lost = np.array([(name.partition("_")[2] or name) in kinds for name in model.tree.names])
        depth.reshape(-1)[own[lost[part]]] = np.nan
    return replace(frame, depth=depth)


def _find_parts(body: TrueBody, places: np.ndarray, model: StitchedPuppet) -> np.ndarray:
    """Return the parts (K,) of the model that are nearest to places (K, 3) m on a body."""
    nearest = NearestPoints(body.template_vertices(model.name)).query(np.ascontiguousarray(places))[1]
    return np.asarray(model.part_of_vertex[nearest])
