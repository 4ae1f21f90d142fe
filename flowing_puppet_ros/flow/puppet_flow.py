# SPDX-License-Identifier: Apache-2.0
"""Puppet flow: the motion field of a layered puppet, one affine motion a visible part and one for the background.

Thesis, flowing puppets, section 2 and its Figures 2 to 4: the parts are painted in depth order, an affine motion is
fitted to the dense flow inside each visible part, and these motions take the joints to the neighbouring frame.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from flowing_puppet_ros.arrays import F64, U16, Flow
from flowing_puppet_ros.flow.affine import RegionMotions, fit_regions


class PuppetFlow(NamedTuple):
    """The motions of a layered puppet and the field that they make.

    Attributes:
        affine: (P, 2, 3) motions of the parts.
        background: (2, 3) motion of the background.
        field: (H, W, 2) float32 displacements in pixels.
        explained: share in [0, 1] of the parts' pixels where the field agrees with the dense flow, within 1 px or a
            tenth of the flow; 0 when no part is visible.
    """

    affine: F64
    background: F64
    field: Flow
    explained: float


def fit_part_motions(
    labels: NDArray[np.unsignedinteger], parents: tuple[int, ...], forward: Flow, backward: Flow | None = None
) -> tuple[RegionMotions, F64]:
    """Fit the motions of the parts, label = part + 1 in `labels` (H, W), and the background's motion (2, 3).

    `parents` (P,) is the part tree (a forest for several people), -1 at roots. A hidden part moves like the mean of
    its tree neighbours, a wholly hidden person like the background.
    """
    regions = fit_regions(labels, len(parents) + 1, forward, backward)
    background = regions.affine[0]
    parts = RegionMotions(regions.affine[1:], regions.residual[1:], regions.support[1:], regions.pixels[1:])
    affine, known = parts.affine.copy(), parts.known.copy()
    neighbours: list[list[int]] = [[] for _ in parents]
    for child, parent in enumerate(parents):
        if parent >= 0:
            neighbours[child].append(parent)
            neighbours[parent].append(child)
    while True:
        ready = [part for part in np.flatnonzero(~known) if known[neighbours[part]].any()]
        if not ready:
            break
        for part in ready:
            affine[part] = np.mean([affine[other] for other in neighbours[part] if known[other]], axis=0)
        known[ready] = True
    affine[~known] = background
    return replace(parts, affine=affine), background


def motion_field(labels: NDArray[np.unsignedinteger], affine: F64, background: F64) -> Flow:
    """Return the field (H, W, 2) px of layered motions: label k moves by affine[k - 1], label 0 by `background`."""
    return _paint(np.ascontiguousarray(labels, dtype=np.uint16), np.concatenate([background[None], affine]))


def fit_puppet_flow(
    labels: NDArray[np.unsignedinteger],
    flow: Flow,
    backward: Flow | None = None,
    parents: tuple[int, ...] | None = None,
) -> PuppetFlow:
    """Fit the puppet flow to dense `flow` (H, W, 2) under part `labels` (H, W), label = part + 1, 0 background.

    `parents` (P,) is the part tree through which hidden parts borrow motion. Without it the largest label is the number
    of parts, and hidden ones move with the background.
    """
    if parents is None:
        parents = (-1,) * int(labels.max(initial=0))
    motions, background = fit_part_motions(labels, parents, flow, backward)
    field = motion_field(labels, motions.affine, background)
    return PuppetFlow(motions.affine, background, field, explained_fraction(labels, field, flow))


def explained_fraction(labels: NDArray[np.unsignedinteger], field: Flow, flow: Flow) -> float:
    """Return the share of the parts' pixels where `field` is within 1 px, or a tenth of the flow, of dense `flow`."""
    inside = labels > 0
    difference, magnitude = (field[inside] - flow[inside]).astype(np.float64), flow[inside].astype(np.float64)
    known = np.isfinite(difference).all(axis=1)
    if not known.any():
        return 0.0
    misfit = np.hypot(difference[known, 0], difference[known, 1])
    return float(np.mean(misfit <= np.maximum(1.0, 0.1 * np.hypot(magnitude[known, 0], magnitude[known, 1]))))


@njit(cache=True, nogil=True)
def _paint(labels: U16, motions: F64) -> Flow:
    height, width = labels.shape
    field = np.empty((height, width, 2), np.float32)
    for y in range(height):
        for x in range(width):
            a = motions[labels[y, x]]
            field[y, x, 0] = a[0, 0] * x + a[0, 1] * y + a[0, 2] - x
            field[y, x, 1] = a[1, 0] * x + a[1, 1] * y + a[1, 2] - y
    return field
