# SPDX-License-Identifier: Apache-2.0
"""Propagation of tracks from one image to the next by the puppet flow (thesis, flowing puppets, section 2)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from flowing_puppet_ros.arrays import F64, U8, U16, Flow
from flowing_puppet_ros.flow.affine import RegionMotions, apply_affine
from flowing_puppet_ros.flow.estimate import FlowPair
from flowing_puppet_ros.flow.puppet_flow import PuppetFlow, explained_fraction, fit_part_motions, motion_field
from flowing_puppet_ros.image.tracking.settings import TrackerSettings
from flowing_puppet_ros.image.tracking.track import Track
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.render import depth_order, render_labels
from flowing_puppet_ros.model.ds.shape import PuppetShape

MOTION_ERROR_SHARE = 0.3  # error of a flow vector relative to its length
UNSUPPORTED_DRIFT_M = 0.03  # drift per image of a joint whose part has no supported motion
SATURATION_PIXELS = 200.0  # a part's motion gains no weight from more pixels


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
        """Convert image `points` (..., 2) to working pixels."""
        return np.asarray((points + 0.5) * self.factor - 0.5)

    def to_image(self, points: F64) -> F64:
        """Convert working `points` (..., 2) to image pixels."""
        return np.asarray((points + 0.5) / self.factor - 0.5)


def render_label_map(
    model: DeformableStructures, shapes: Sequence[PuppetShape], headings: Sequence[float], grid: ImageScale
) -> U16:
    """Draw labels (h, w) on the working grid: with P parts, part i of person k is k * P + i + 1; 0 is background.

    `headings` (rad) tell which limbs of a person seen from the side are behind the torso. Larger people are drawn
    last, as the nearer ones.
    """
    labels = np.zeros(grid.work[::-1], dtype=np.uint16)
    for k, own in _render_people(model, shapes, headings, grid):
        np.copyto(labels, own + np.uint16(k * len(model.tree)), where=own > 0)
    return labels


def render_part_map(
    model: DeformableStructures, shapes: Sequence[PuppetShape], headings: Sequence[float], grid: ImageScale
) -> U8:
    """Draw labels (h, w) as `render_label_map` does, but with part i of everybody as i + 1."""
    parts = np.zeros(grid.work[::-1], dtype=np.uint8)
    for _, own in _render_people(model, shapes, headings, grid):
        cv2.copyTo(own, own, parts)
    return parts


def _render_people(
    model: DeformableStructures, shapes: Sequence[PuppetShape], headings: Sequence[float], grid: ImageScale
) -> Iterator[tuple[int, U8]]:
    """Yield the number of each person with the own part labels (h, w), in the order in which they cover each other."""
    width, height = grid.work
    for k in sorted(range(len(shapes)), key=lambda k: shapes[k].scale):
        contours = tuple(grid.to_work(contour) for contour in shapes[k].contours)
        yield k, render_labels(contours, depth_order(model, shapes[k].view, headings[k]), (height, width))


def render_tracks(model: DeformableStructures, tracks: Sequence[Track], grid: ImageScale) -> U16:
    """Draw the label map of the people who are tracked."""
    drawn = [(track.shape, track.side_heading) for track in tracks if track.shape is not None]
    return render_label_map(model, [shape for shape, _ in drawn], [heading for _, heading in drawn], grid)


@dataclass(frozen=True, slots=True, eq=False)
class Propagation:
    """Layered motion from the previous image to this one: `labels` (h, w) of the previous, motions on its grid."""

    labels: U16
    motions: RegionMotions
    background: F64
    forward: Flow

    def puppet_flow(self) -> PuppetFlow:
        """Return the puppet flow of all people together, on the working grid."""
        field = motion_field(self.labels, self.motions.affine, self.background)
        explained = explained_fraction(self.labels, field, self.forward)
        return PuppetFlow(self.motions.affine, self.background, field, explained)


def propagate_tracks(
    model: DeformableStructures, tracks: Sequence[Track], flow: FlowPair, grid: ImageScale, settings: TrackerSettings
) -> Propagation:
    """Move the joints of every track with the affine motions of their parts; variances grow with the flow's misfit.

    `flow` is the (forward, backward) pair on the working grid. Also sets each track's `flow_energy`, the mean over the
    visible parts of half the squared misfit in pixels plus the share of pixels that do not support the motion.
    """
    count = len(model.tree)
    labels = render_tracks(model, tracks, grid)
    forest = tuple(
        parent + k * count if parent >= 0 else -1 for k in range(len(tracks)) for parent in model.tree.parents
    )
    motions, background = fit_part_motions(labels, forest, *flow)
    for k, track in enumerate(tracks):
        own = slice(k * count, (k + 1) * count)
        parts = RegionMotions(motions.affine[own], motions.residual[own], motions.support[own], motions.pixels[own])
        _propagate_one(model, track, parts, grid, settings)
    return Propagation(labels, motions, background, flow[0])


def _propagate_one(
    model: DeformableStructures, track: Track, motions: RegionMotions, grid: ImageScale, settings: TrackerSettings
) -> None:
    joints = grid.to_work(track.mean)
    moved = apply_affine(motions.affine, joints[None])  # (P, J, 2)
    trust = np.minimum(motions.pixels, SATURATION_PIXELS) / SATURATION_PIXELS * motions.support + 1e-3
    weight = trust[:, None] * part_membership(model)
    share = weight / weight.sum(axis=0)
    mean = np.einsum("pj,pjc->jc", share, moved)
    spread = np.einsum("pj,pjc->j", share, (moved - mean) ** 2)
    residual = np.where(np.isfinite(motions.residual), motions.residual, 0.0)
    misfit = share.T @ residual**2
    support = np.einsum("pj,p->j", share, np.where(motions.known, motions.support, 0.0))
    length = ((mean - joints) ** 2).sum(axis=1)
    pixels = (spread + misfit / SATURATION_PIXELS + MOTION_ERROR_SHARE**2 * length) / np.mean(grid.factor) ** 2
    drift = (settings.flow_deviation * track.scale) ** 2 + (UNSUPPORTED_DRIFT_M * track.scale * (1 - support)) ** 2
    track.mean = grid.to_image(mean)
    track.variance = track.variance + drift + pixels
    track.age += 1
    # An outlier is comparable with the next detection only after it has moved with the flow.
    track.outlier_position = track.outlier_position + grid.to_image(mean) - grid.to_image(joints)
    disagreement = (0.5 * residual**2 + 1 - motions.support)[motions.known]
    track.flow_energy = float(disagreement.mean()) if len(disagreement) else 0.0


def part_membership(model: DeformableStructures) -> F64:
    """Return the matrix (P, J) that is 1 where a joint belongs to a part, else 0."""
    member = np.zeros((len(model.tree), len(model.joint_names)))
    for part, joints in enumerate(model.part_joints):
        member[part, list(joints)] = 1.0
    return member
