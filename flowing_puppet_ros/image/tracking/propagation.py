# SPDX-License-Identifier: Apache-2.0
"""Carry people from one image to the next by the puppet flow (thesis, flowing puppets, section 2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import F64, U16, Flow
from flowing_puppet_ros.flow.affine import RegionMotions, transform
from flowing_puppet_ros.flow.estimate import FlowPair
from flowing_puppet_ros.flow.puppet_flow import PuppetFlow, explained_fraction, motion_field, part_motions
from flowing_puppet_ros.image.tracking.track import Track, TrackerSettings
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.render import depth_order, render_labels
from flowing_puppet_ros.model.ds.shape import PuppetShape

MOTION_SHARE = 0.3  # error of a flow vector as a share of its length
DOUBT = 0.03  # m; drift a step of a joint whose part has no supported motion
ENOUGH_PIXELS = 200.0  # a part's motion gains no weight from more


@dataclass(frozen=True, slots=True)
class ImageScale:
    """The working grid of an image: sizes (width, height) of both; pixel (0, 0) is the centre of the first pixel."""

    image: tuple[int, int]
    work: tuple[int, int]

    @property
    def factor(self) -> F64:
        """(2,) working pixels per image pixel."""
        return np.asarray(np.array(self.work) / np.array(self.image), dtype=np.float64)

    def to_work(self, points: F64) -> F64:
        """Image points (..., 2) in working pixels."""
        return np.asarray((points + 0.5) * self.factor - 0.5)

    def to_image(self, points: F64) -> F64:
        """Working points (..., 2) in image pixels."""
        return np.asarray((points + 0.5) / self.factor - 0.5)


def render_label_map(model: DeformableStructures, shapes: Sequence[PuppetShape], grid: ImageScale) -> U16:
    """Labels (h, w) on the working grid, P parts a person: part i of person k is k * P + i + 1, 0 background.

    Larger people are painted last: they are nearer.
    """
    width, height = grid.work
    labels = np.zeros((height, width), dtype=np.uint16)
    for k in sorted(range(len(shapes)), key=lambda k: shapes[k].scale):
        contours = tuple(grid.to_work(contour) for contour in shapes[k].contours)
        own = render_labels(contours, depth_order(model, shapes[k].view), (height, width))
        np.copyto(labels, own + np.uint16(k * len(model.tree)), where=own > 0)
    return labels


@dataclass(frozen=True, slots=True, eq=False)
class Propagation:
    """Layered motion from the previous image to this one: `labels` (h, w) of the previous, motions on its grid."""

    labels: U16
    motions: RegionMotions
    background: F64
    forward: Flow

    def puppet_flow(self) -> PuppetFlow:
        """The puppet flow of all people together, on the working grid."""
        field = motion_field(self.labels, self.motions.affine, self.background)
        explained = explained_fraction(self.labels, field, self.forward)
        return PuppetFlow(self.motions.affine, self.background, field, explained)


def propagate_tracks(
    model: DeformableStructures, people: Sequence[Track], flow: FlowPair, grid: ImageScale, settings: TrackerSettings
) -> Propagation:
    """Move every person's joints with the affine motion of their parts; their variances grow with what speaks against.

    `flow` is the (forward, backward) pair on the working grid. Also sets each person's `flow_energy`, the mean over
    the visible parts of half the squared misfit in pixels, less by the parts' support.
    """
    count = len(model.tree)
    labels = render_label_map(model, [person.shape for person in people if person.shape is not None], grid)
    forest = tuple(
        parent + k * count if parent >= 0 else -1 for k in range(len(people)) for parent in model.tree.parents
    )
    motions, background = part_motions(labels, forest, *flow)
    for k, person in enumerate(people):
        own = slice(k * count, (k + 1) * count)
        mine = RegionMotions(motions.affine[own], motions.residual[own], motions.support[own], motions.pixels[own])
        _propagate_one(model, person, mine, grid, settings)
    return Propagation(labels, motions, background, flow[0])


def _propagate_one(
    model: DeformableStructures, person: Track, motions: RegionMotions, grid: ImageScale, settings: TrackerSettings
) -> None:
    joints = grid.to_work(person.mean)
    moved = transform(motions.affine, joints[None])  # (P, J, 2)
    trust = np.minimum(motions.pixels, ENOUGH_PIXELS) / ENOUGH_PIXELS * motions.support + 1e-3
    weight = trust[:, None] * membership(model)
    share = weight / weight.sum(axis=0)
    mean = np.einsum("pj,pjc->jc", share, moved)
    spread = np.einsum("pj,pjc->j", share, (moved - mean) ** 2)
    residual = np.where(np.isfinite(motions.residual), motions.residual, 0.0)
    misfit = share.T @ residual**2
    support = np.einsum("pj,p->j", share, np.where(motions.known, motions.support, 0.0))
    length = ((mean - joints) ** 2).sum(axis=1)
    pixels = (spread + misfit / ENOUGH_PIXELS + MOTION_SHARE**2 * length) / np.mean(grid.factor) ** 2
    drift = (settings.flow_deviation * person.scale) ** 2 + (DOUBT * person.scale * (1 - support)) ** 2
    person.mean = grid.to_image(mean)
    person.variance = person.variance + drift + pixels
    person.age += 1
    # A refused detection is only comparable with the next one where it would be by now.
    person.outlier_position = person.outlier_position + grid.to_image(mean) - grid.to_image(joints)
    disagreement = (0.5 * residual**2 + 1 - motions.support)[motions.known]
    person.flow_energy = float(disagreement.mean()) if len(disagreement) else 0.0


def membership(model: DeformableStructures) -> F64:
    """(P, J) 1 where a joint belongs to a part, else 0."""
    member = np.zeros((len(model.tree), len(model.joint_names)))
    for part, joints in enumerate(model.part_joints):
        member[part, list(joints)] = 1.0
    return member
