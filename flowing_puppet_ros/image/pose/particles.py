# SPDX-License-Identifier: Apache-2.0
"""Particles of the 2D puppet, and the Gaussians between connected parts for many particles at once.

A particle of a part is its place, angle and shape in the image (thesis, "Definition" of the DS model) and a scale of
its own. Positions are pixels of the image, whose x is negated where the camera sees the person's back.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.model.ds.shape import PairLayout, PartShape, PuppetShape
from flowing_puppet_ros.model.gaussian import Gaussian

SHAPE_LIMIT = 2.5
"""Shape coefficients of particles are kept within this many standard deviations."""

RIDGE = 1e-4  # added to variances of conditional Gaussians, whose lengths and shapes are nearly dependent


@dataclass(frozen=True, slots=True, eq=False)
class Particles:
    """P particles of one part: center (P,2) px, angle (P,) of the bone, scale (P,) px/m, shape (P,Z)."""

    center: Array
    angle: Array
    scale: Array
    shape: Array

    def __len__(self) -> int:
        return len(self.angle)

    def take(self, indices: Array) -> Particles:
        """The particles `indices`, in that order."""
        return Particles(self.center[indices], self.angle[indices], self.scale[indices], self.shape[indices])

    @classmethod
    def join(cls, groups: list[Particles]) -> Particles:
        """All particles of several groups."""
        fields = ("center", "angle", "scale", "shape")
        return cls(*(np.concatenate([getattr(group, name) for group in groups]) for name in fields))


def world_points(shape: PartShape, particles: Particles, rows: Array | slice = slice(None)) -> Array:
    """Points (P,R,2) px of particles: the `rows` of `shape`, placed by Eqs. 6 and 7 and the particle's scale."""
    local = shape.mean[rows] + np.tensordot(particles.shape, shape.basis[rows], axes=(1, 2))
    sine, cosine = np.sin(particles.angle)[:, None], np.cos(particles.angle)[:, None]
    x, y = local[..., 0], local[..., 1]
    turned = np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)
    return np.asarray(turned * particles.scale[:, None, None] + particles.center[:, None])


def joint_rows(shape: PartShape) -> Array:
    """Rows of the joint points in a part's points: proximal, distal, then any others."""
    return np.arange(len(shape.mean) - shape.joint_count, len(shape.mean))


def particles_of(puppets: list[PuppetShape], bone: Array, mirror: Array) -> list[Particles]:
    """One particle a puppet for every part; `bone` (N,2) joints of each part, `mirror` (2,) signs of the axes."""
    groups = []
    for part, (near, far) in enumerate(bone):
        ends = np.array([(puppet.joints[near], puppet.joints[far]) for puppet in puppets]) * mirror
        along = ends[:, 1] - ends[:, 0]
        groups.append(
            Particles(
                ends.mean(axis=1),
                np.arctan2(along[:, 1], along[:, 0]),
                np.array([puppet.scale for puppet in puppets]),
                np.array([puppet.coefficients[part] for puppet in puppets]),
            )
        )
    return groups


def clip_shape(shape: Array) -> Array:
    """Shape coefficients clipped to `SHAPE_LIMIT`."""
    return np.clip(shape, -SHAPE_LIMIT, SHAPE_LIMIT)


class Regression:
    """The Gaussian of some variables of an edge given others (Eqs. 13 and 14), for many given values at once."""

    def __init__(self, pair: Gaussian, kept: list[int], given: list[int], noise: Array | None = None) -> None:
        """`noise` (kept,) are deviations added to the kept variables."""
        own, cross = pair.covariance[np.ix_(given, given)], pair.covariance[np.ix_(given, kept)]
        self.slope = np.linalg.solve(own + RIDGE * np.diag(np.diag(own)), cross).T
        covariance = pair.covariance[np.ix_(kept, kept)] - self.slope @ cross
        extra = RIDGE * np.diag(pair.covariance)[kept] + (0.0 if noise is None else noise**2)
        self.factor = np.linalg.cholesky((covariance + covariance.T) / 2 + np.diag(extra))
        self.offset = pair.mean[kept] - self.slope @ pair.mean[given]

    def sample(self, given: Array, rng: np.random.Generator) -> Array:
        """One draw (P,kept) for each of the given values (P,given)."""
        drawn = rng.standard_normal((len(given), len(self.offset)))
        return np.asarray(self.offset + given @ self.slope.T + drawn @ self.factor.T)


class PairwiseGaussian:
    """Potential and proposals between a parent and a child part; the springs q are loosened by `spring` metres.

    Parts that connect exactly would have no probability anywhere else ("loosely-connected" model of the thesis).
    """

    def __init__(self, pair: Gaussian, parent: PartShape, child: PartShape, row: int, spring: float) -> None:
        """`row` is the parent's point at which the child hangs."""
        layout = PairLayout(parent.basis.shape[2])
        self._parent, self._child, self._row = parent, child, row
        self._size = layout.size
        below, place, above = layout.child, layout.angle + layout.gap, layout.parent
        noise = np.concatenate([np.zeros(layout.size + 2), np.full(2, spring)])
        self._law = Regression(pair, below + place, above, noise)
        self._down = Regression(pair, below + place, above)
        self._up = Regression(pair, above + place, below)
        self._between = Regression(pair, below, above + layout.angle + layout.child_length)
        self._whiten = np.linalg.inv(self._law.factor)
        self._constant = float(np.log(np.diag(self._law.factor)).sum())

    def costs(self, parents: Particles, children: Particles, scale_deviation: float) -> Array:
        """-log p(child | parent) (Eq. 12 with loose springs) for all pairs (P,C), with the ratio of their scales."""
        size = self._size
        expected = self._whiten @ (self._law.offset[:, None] + self._law.slope @ parents.shape.T)
        own = self._whiten[:, :size] @ children.shape.T
        hang = world_points(self._parent, parents, np.array([self._row]))[:, 0]
        top = world_points(self._child, children, joint_rows(self._child)[:1])[:, 0]
        place = np.ascontiguousarray(self._whiten[:, size:])
        costs = _pair_costs(
            np.ascontiguousarray(expected.T), np.ascontiguousarray(own.T), place, hang, top,
            parents.angle, children.angle, parents.scale,
        )  # fmt: skip
        ratio = (np.log(children.scale)[None] - np.log(parents.scale)[:, None]) / scale_deviation
        return np.asarray(costs + 0.5 * ratio**2 + self._constant)

    def propose_child(self, parents: Particles, rng: np.random.Generator) -> Particles:
        """A child drawn for each of some parents."""
        drawn = self._down.sample(parents.shape, rng)
        shape, place = clip_shape(drawn[:, : self._size]), drawn[:, self._size :]
        angle = parents.angle + np.arctan2(place[:, 0], place[:, 1])
        hang = world_points(self._parent, parents, np.array([self._row]))[:, 0]
        top = hang + _turned(place[:, 2:], parents.angle) * parents.scale[:, None]
        return _hung(self._child, int(joint_rows(self._child)[0]), top, angle, parents.scale, shape)

    def propose_parent(self, children: Particles, rng: np.random.Generator) -> Particles:
        """A parent drawn for each of some children."""
        drawn = self._up.sample(children.shape, rng)
        shape, place = clip_shape(drawn[:, : self._size]), drawn[:, self._size :]
        angle = children.angle - np.arctan2(place[:, 0], place[:, 1])
        top = world_points(self._child, children, joint_rows(self._child)[:1])[:, 0]
        hang = top - _turned(place[:, 2:], angle) * children.scale[:, None]
        return _hung(self._parent, self._row, hang, angle, children.scale, shape)

    def propose_between(self, parents: Particles, far: Array, rng: np.random.Generator) -> Particles:
        """A child for each of some parents that reaches from its joint there to the places `far` (P,2) px."""
        near = world_points(self._parent, parents, np.array([self._row]))[:, 0]
        bone = far - near
        angle = np.arctan2(bone[:, 1], bone[:, 0])
        length = np.hypot(bone[:, 0], bone[:, 1]) / parents.scale
        given = np.column_stack([parents.shape, np.sin(angle - parents.angle), np.cos(angle - parents.angle), length])
        shape = clip_shape(self._between.sample(given, rng))
        return Particles((near + far) / 2, angle, parents.scale, shape)


def _turned(vectors: Array, angle: Array) -> Array:
    sine, cosine = np.sin(angle), np.cos(angle)
    x, y = vectors[:, 0], vectors[:, 1]
    return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=1)


def _hung(shape: PartShape, row: int, place: Array, angle: Array, scale: Array, coefficients: Array) -> Particles:
    """Particles whose point `row` lies at `place` (P,2)."""
    at_origin = Particles(np.zeros_like(place), angle, scale, coefficients)
    return Particles(place - world_points(shape, at_origin, np.array([row]))[:, 0], angle, scale, coefficients)


@njit(cache=True, nogil=True)
def _pair_costs(
    expected: Array, own: Array, place: Array, hang: Array, top: Array, above: Array, below: Array, scale: Array
) -> Array:
    """Half squared whitened deviations (P,C) of the child's shape, relative angle and gap from what is expected."""
    size = own.shape[1]
    costs = np.empty((len(expected), len(own)))
    for i in range(len(expected)):
        sine, cosine = np.sin(above[i]), np.cos(above[i])
        for j in range(len(own)):
            turn = below[j] - above[i]
            s, c = np.sin(turn), np.cos(turn)
            dx, dy = (top[j, 0] - hang[i, 0]) / scale[i], (top[j, 1] - hang[i, 1]) / scale[i]
            x, y = cosine * dx + sine * dy, cosine * dy - sine * dx
            total = 0.0
            for k in range(size):
                value = own[j, k] - expected[i, k] + place[k, 0] * s + place[k, 1] * c
                value += place[k, 2] * x + place[k, 3] * y
                total += value * value
            costs[i, j] = 0.5 * total
    return costs
