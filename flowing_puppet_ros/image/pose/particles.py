# SPDX-License-Identifier: Apache-2.0
"""Particles of the 2D puppet, and the Gaussians between connected parts for many particles at once.

A particle of a part is its place, angle and shape in the image (thesis, "Definition" of the DS model), and a scale of
its own. Positions are pixels of the image, with x negated where the camera sees the person's back.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.model.ds.shape import PairLayout, PartShape, PuppetShape
from flowing_puppet_ros.model.gaussian import Gaussian

MAX_SHAPE_SD = 2.5
"""Bound of the particles' shape coefficients, in standard deviations."""

RIDGE = 1e-4  # added to variances of conditional Gaussians, whose lengths and shapes are nearly dependent


@dataclass(frozen=True, slots=True, eq=False)
class PartParticles:
    """P particles of one part: `center` (P, 2) px, `angle` (P,) rad of the bone, `scale` (P,) px/m, `shape` (P, Z)."""

    center: Array
    angle: Array
    scale: Array
    shape: Array

    def __len__(self) -> int:
        return len(self.angle)

    def take(self, indices: Array) -> PartParticles:
        """Return the particles `indices`, in that order."""
        return PartParticles(self.center[indices], self.angle[indices], self.scale[indices], self.shape[indices])

    @classmethod
    def join(cls, groups: list[PartParticles]) -> PartParticles:
        """Join the particles of several groups."""
        fields = ("center", "angle", "scale", "shape")
        return cls(*(np.concatenate([getattr(group, name) for group in groups]) for name in fields))


def world_points(shape: PartShape, particles: PartParticles, rows: Array | slice = slice(None)) -> Array:
    """Return points (P, R, 2) px of particles: the `rows` of `shape`, placed by Eqs. 6-7 and the particle's scale."""
    local = shape.mean[rows] + np.tensordot(particles.shape, shape.basis[rows], axes=(1, 2))
    sine, cosine = np.sin(particles.angle)[:, None], np.cos(particles.angle)[:, None]
    x, y = local[..., 0], local[..., 1]
    rotated = np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)
    return np.asarray(rotated * particles.scale[:, None, None] + particles.center[:, None])


def joint_rows(shape: PartShape) -> Array:
    """Return the rows of the joint points in a part's points: proximal, distal, then any others."""
    return np.arange(len(shape.mean) - shape.joint_count, len(shape.mean))


def particles_from_puppets(puppets: list[PuppetShape], bone: Array, mirror: Array) -> list[PartParticles]:
    """Return one particle per puppet for every part.

    `bone` (N, 2) holds the joints of each part, `mirror` (2,) the signs of the axes.
    """
    groups = []
    for part, (near, far) in enumerate(bone):
        ends = np.array([(puppet.joints[near], puppet.joints[far]) for puppet in puppets]) * mirror
        along = ends[:, 1] - ends[:, 0]
        groups.append(
            PartParticles(
                ends.mean(axis=1),
                np.arctan2(along[:, 1], along[:, 0]),
                np.array([puppet.scale for puppet in puppets]),
                np.array([puppet.coefficients[part] for puppet in puppets]),
            )
        )
    return groups


def clip_shape(shape: Array) -> Array:
    """Clip shape coefficients to +-MAX_SHAPE_SD."""
    return np.clip(shape, -MAX_SHAPE_SD, MAX_SHAPE_SD)


class ConditionalGaussian:
    """The Gaussian of some variables of an edge given others (Eqs. 13-14), for many values at once."""

    def __init__(self, pair: Gaussian, kept: list[int], given: list[int], noise: Array | None = None) -> None:
        """Condition the variables `kept` on those `given`; `noise` (kept,) is added to the deviations of the former."""
        own, cross = pair.covariance[np.ix_(given, given)], pair.covariance[np.ix_(given, kept)]
        self.slope = np.linalg.solve(own + RIDGE * np.diag(np.diag(own)), cross).T
        covariance = pair.covariance[np.ix_(kept, kept)] - self.slope @ cross
        extra = RIDGE * np.diag(pair.covariance)[kept] + (0.0 if noise is None else noise**2)
        self.factor = np.linalg.cholesky((covariance + covariance.T) / 2 + np.diag(extra))
        self.offset = pair.mean[kept] - self.slope @ pair.mean[given]

    def sample(self, given: Array, rng: np.random.Generator) -> Array:
        """Draw once (P, kept) for each of the values `given` (P, given)."""
        drawn = rng.standard_normal((len(given), len(self.offset)))
        return np.asarray(self.offset + given @ self.slope.T + drawn @ self.factor.T)


class PairwiseGaussian:
    """Potential and proposals between a parent and a child part; the springs q are loosened by `spring` metres.

    Parts that must connect exactly would have no probability elsewhere ("loosely-connected" model of the thesis).
    """

    def __init__(self, pair: Gaussian, parent: PartShape, child: PartShape, row: int, spring: float) -> None:
        """Prepare the conditional Gaussians; `row` is the parent's point to which the child is attached."""
        layout = PairLayout(parent.basis.shape[2])
        self._parent, self._child, self._row = parent, child, row
        self._size = layout.size
        below, place, above = layout.child, layout.angle + layout.gap, layout.parent
        noise = np.concatenate([np.zeros(layout.size + 2), np.full(2, spring)])
        self._child_given_parent = ConditionalGaussian(pair, below + place, above, noise)
        self._child_sampler = ConditionalGaussian(pair, below + place, above)
        self._parent_sampler = ConditionalGaussian(pair, above + place, below)
        self._joined_sampler = ConditionalGaussian(pair, below, above + layout.angle + layout.child_length)
        self._whiten = np.linalg.inv(self._child_given_parent.factor)
        self._constant = float(np.log(np.diag(self._child_given_parent.factor)).sum())

    def costs(self, parents: PartParticles, children: PartParticles, scale_deviation: float) -> Array:
        """Return -log p(child | parent) (P, C) of all pairs (Eq. 12, loose springs), with the ratio of their scales."""
        size = self._size
        expected = self._whiten @ (
            self._child_given_parent.offset[:, None] + self._child_given_parent.slope @ parents.shape.T
        )
        own = self._whiten[:, :size] @ children.shape.T
        anchor = world_points(self._parent, parents, np.array([self._row]))[:, 0]
        top = world_points(self._child, children, joint_rows(self._child)[:1])[:, 0]
        place = np.ascontiguousarray(self._whiten[:, size:])
        costs = _pair_costs(
            np.ascontiguousarray(expected.T), np.ascontiguousarray(own.T), place, anchor, top,
            parents.angle, children.angle, parents.scale,
        )  # fmt: skip
        ratio = (np.log(children.scale)[None] - np.log(parents.scale)[:, None]) / scale_deviation
        return np.asarray(costs + 0.5 * ratio**2 + self._constant)

    def propose_child(self, parents: PartParticles, rng: np.random.Generator) -> PartParticles:
        """Draw a child for each of some parents."""
        drawn = self._child_sampler.sample(parents.shape, rng)
        shape, place = clip_shape(drawn[:, : self._size]), drawn[:, self._size :]
        angle = parents.angle + np.arctan2(place[:, 0], place[:, 1])
        anchor = world_points(self._parent, parents, np.array([self._row]))[:, 0]
        top = anchor + _rotate(place[:, 2:], parents.angle) * parents.scale[:, None]
        return _attach(self._child, int(joint_rows(self._child)[0]), top, angle, parents.scale, shape)

    def propose_parent(self, children: PartParticles, rng: np.random.Generator) -> PartParticles:
        """Draw a parent for each of some children."""
        drawn = self._parent_sampler.sample(children.shape, rng)
        shape, place = clip_shape(drawn[:, : self._size]), drawn[:, self._size :]
        angle = children.angle - np.arctan2(place[:, 0], place[:, 1])
        top = world_points(self._child, children, joint_rows(self._child)[:1])[:, 0]
        anchor = top - _rotate(place[:, 2:], angle) * children.scale[:, None]
        return _attach(self._parent, self._row, anchor, angle, children.scale, shape)

    def propose_between(self, parents: PartParticles, far: Array, rng: np.random.Generator) -> PartParticles:
        """Draw a child for each of some parents that reaches from the common joint to `far` (P, 2) px."""
        near = world_points(self._parent, parents, np.array([self._row]))[:, 0]
        bone = far - near
        angle = np.arctan2(bone[:, 1], bone[:, 0])
        length = np.hypot(bone[:, 0], bone[:, 1]) / parents.scale
        given = np.column_stack([parents.shape, np.sin(angle - parents.angle), np.cos(angle - parents.angle), length])
        shape = clip_shape(self._joined_sampler.sample(given, rng))
        return PartParticles((near + far) / 2, angle, parents.scale, shape)


def _rotate(vectors: Array, angle: Array) -> Array:
    sine, cosine = np.sin(angle), np.cos(angle)
    x, y = vectors[:, 0], vectors[:, 1]
    return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=1)


def _attach(shape: PartShape, row: int, place: Array, angle: Array, scale: Array, coefficients: Array) -> PartParticles:
    """Return particles whose point `row` lies at `place` (P, 2) px."""
    at_origin = PartParticles(np.zeros_like(place), angle, scale, coefficients)
    return PartParticles(place - world_points(shape, at_origin, np.array([row]))[:, 0], angle, scale, coefficients)


@njit(cache=True, nogil=True)
def _pair_costs(
    expected: Array, own: Array, place: Array, anchor: Array, top: Array, above: Array, below: Array, scale: Array
) -> Array:
    """Return half the squared whitened deviations (P, C) of the child's shape, angle and gap from the expected ones."""
    size = own.shape[1]
    costs = np.empty((len(expected), len(own)))
    for i in range(len(expected)):
        sine, cosine = np.sin(above[i]), np.cos(above[i])
        for j in range(len(own)):
            angle = below[j] - above[i]
            s, c = np.sin(angle), np.cos(angle)
            dx, dy = (top[j, 0] - anchor[i, 0]) / scale[i], (top[j, 1] - anchor[i, 1]) / scale[i]
            x, y = cosine * dx + sine * dy, cosine * dy - sine * dx
            total = 0.0
            for k in range(size):
                value = own[j, k] - expected[i, k] + place[k, 0] * s + place[k, 1] * c
                value += place[k, 2] * x + place[k, 3] * y
                total += value * value
            costs[i, j] = 0.5 * total
    return costs
