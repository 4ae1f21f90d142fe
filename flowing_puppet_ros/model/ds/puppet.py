# SPDX-License-Identifier: Apache-2.0
"""Deformable Structures: the part-based 2D model of body shape and pose (thesis, chapter of that name).

Model space is in metres, x to the right and y down in the image of a camera that sees the person's front; an image
point is `scale * model + offset` (Eqs. 8 and 9), scale in pixels per metre. From behind, x is mirrored.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Self

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.model import weights
from flowing_puppet_ros.model.ds.energy import PairwiseEnergy
from flowing_puppet_ros.model.ds.joints import JOINT_NAMES, PART_JOINTS, part_tree
from flowing_puppet_ros.model.ds.shape import COEFFICIENT_LIMIT, PairLayout, PartShape, PuppetShape, View, rotate
from flowing_puppet_ros.model.ds.shape_from_joints import ShapeFromJoints
from flowing_puppet_ros.model.gaussian import Gaussian
from flowing_puppet_ros.model.tree import PartTree

KNOWN_JOINT_NOISE = 0.02
"""Standard deviation in metres of a joint with confidence 1; it grows with the inverse of the confidence."""

_POSITION_DEVIATION_M = 100.0  # standard deviation of a person's position in model space
_HUBER_WIDTH = 1.0  # standard deviations by which a bone may be shorter than the mean before it counts less


@dataclass(frozen=True, slots=True, eq=False)
class DeformableStructures:
    """A learned 2D puppet: linear part shapes, and pairwise Gaussians that tie shape to relative pose (Eqs. 5-10).

    `part_joints` are the joint indices of every part (proximal, distal, then any others). `joint_prior` is the Gaussian
    of all joints (2J,) around their mid-torso. `length_pairs` (P, 2) are joints whose distance determines the scale,
    `log_length` (P, 2) mean and standard deviation of its logarithm in metres. `shoulder_width` is the distance of the
    mean puppet's shoulders in metres.
    """

    gender: str
    tree: PartTree
    shapes: tuple[PartShape, ...]
    pairwise: tuple[Gaussian, ...]
    joint_prior: Gaussian
    length_pairs: Array
    log_length: Array
    joint_names: tuple[str, ...] = field(init=False)
    part_joints: tuple[tuple[int, ...], ...] = field(init=False)
    shoulder_width: float = field(init=False)
    _shape_from_joints: ShapeFromJoints = field(init=False, repr=False)
    _energy: PairwiseEnergy = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Derive names and the precomputed shape inference."""
        names = JOINT_NAMES[len(self.tree)]
        part_joints = tuple(tuple(names.index(joint) for joint in PART_JOINTS[part]) for part in self.tree.names)
        object.__setattr__(self, "joint_names", names)
        object.__setattr__(self, "part_joints", part_joints)
        right, left = (self.mean_joints()[names.index(f"{side}_shoulder")] for side in ("right", "left"))
        object.__setattr__(self, "shoulder_width", float(np.linalg.norm(right - left)))
        inference = ShapeFromJoints(self.tree, self.shapes, self.pairwise, part_joints)
        object.__setattr__(self, "_shape_from_joints", inference)
        object.__setattr__(self, "_energy", PairwiseEnergy(self.tree, self.shapes, self.pairwise, part_joints))

    @property
    def name(self) -> str:
        """Gender and number of parts, for example "neutral-10"."""
        return f"{self.gender}-{len(self.tree)}"

    @property
    def bone(self) -> Array:
        """Joint indices (N, 2) of every part's bone: proximal, distal."""
        return np.array([joints[:2] for joints in self.part_joints])

    @classmethod
    def load(cls, gender: str = "neutral", parts: int = 10) -> Self:
        """Load the shipped model; InputError when there is none of that gender ("neutral", ...) and parts (10, 14)."""
        return cls.from_arrays(gender, parts, weights.load("ds", f"{gender}-{parts}"))

    @classmethod
    def from_arrays(cls, gender: str, parts: int, arrays: Mapping[str, Array]) -> Self:
        """Build from the arrays that `to_arrays` gave (float32 is enough)."""
        tree = part_tree(parts)
        data = {key: np.asarray(value, np.float64) for key, value in arrays.items()}
        shapes = tuple(
            PartShape(data[f"mean_{name}"], data[f"basis_{name}"], len(PART_JOINTS[name])) for name in tree.names
        )
        pairwise = tuple(Gaussian(*pair) for pair in zip(data["pair_mean"], data["pair_covariance"], strict=True))
        prior = Gaussian(data["joint_mean"], data["joint_covariance"])
        return cls(gender, tree, shapes, pairwise, prior, data["length_pairs"].astype(np.intp), data["log_length"])

    def to_arrays(self) -> dict[str, Array]:
        """Return what was learned as float32 arrays by name."""
        arrays = {f"mean_{name}": shape.mean for name, shape in zip(self.tree.names, self.shapes, strict=True)}
        arrays |= {f"basis_{name}": shape.basis for name, shape in zip(self.tree.names, self.shapes, strict=True)}
        arrays["pair_mean"] = np.stack([pair.mean for pair in self.pairwise])
        arrays["pair_covariance"] = np.stack([pair.covariance for pair in self.pairwise])
        arrays |= {"joint_mean": self.joint_prior.mean, "joint_covariance": self.joint_prior.covariance}
        arrays |= {"length_pairs": self.length_pairs, "log_length": self.log_length}
        return {key: np.asarray(value, np.float32) for key, value in arrays.items()}

    def sample(self, rng: np.random.Generator) -> PuppetShape:
        """Draw a puppet in model space, from torso to leaves (Eqs. 11-14); the torso is upright at the origin."""
        size = self.shapes[0].basis.shape[2]
        return self._descend(rng.standard_normal(size), lambda given: given.sample(rng, 1)[0])

    def likely_puppet(self) -> PuppetShape:
        """Return the puppet that grows from the mean torso by conditional means, in model space."""
        return self._descend(np.zeros(self.shapes[0].basis.shape[2]), lambda given: given.mean)

    def _descend(self, torso: Array, choose: Callable[[Gaussian], Array]) -> PuppetShape:
        """Grow a puppet from torso to leaves: `choose` picks from each child's conditional Gaussian (Eq. 12)."""
        size = len(torso)
        layout = PairLayout(size)
        kept = layout.child + layout.angle + layout.gap
        coefficients = [np.clip(torso, -COEFFICIENT_LIMIT, COEFFICIENT_LIMIT)]
        poses: list[Array] = []
        for parent, child in self.tree.edges:
            chosen = choose(self.pairwise[child - 1].condition(kept, layout.parent, coefficients[parent]))
            coefficients.append(np.clip(chosen[:size], -COEFFICIENT_LIMIT, COEFFICIENT_LIMIT))
            poses.append(chosen[size:])
        return self._assemble(coefficients, poses)

    def mean_joints(self) -> Array:
        """Return the joints (J, 2) m in model space of the puppet of mean part shapes and mean relative poses."""
        return _mean_joints(self).copy()

    def _assemble(self, coefficients: list[Array], poses: list[Array]) -> PuppetShape:
        """Place the parts (Eq. 7): `poses` holds (sin, cos, q_x, q_y) of every edge; angles are those of the bones."""
        joints = np.zeros((len(self.joint_names), 2))
        contours: list[Array] = []
        angle, center = np.full(len(self.tree), np.pi / 2), np.zeros((len(self.tree), 2))
        for part, shape in enumerate(self.shapes):
            local = shape.points(coefficients[part])
            own, parent = self.part_joints[part], self.tree.parents[part]
            if parent >= 0:
                sine, cosine, *gap = poses[part - 1]
                angle[part] = angle[parent] + np.arctan2(sine, cosine)
                rotated_gap = rotate(np.array(gap), np.sin(angle[parent]), np.cos(angle[parent]))
                arm = rotate(local[-shape.joint_count], np.sin(angle[part]), np.cos(angle[part]))
                center[part] = joints[own[0]] + rotated_gap - arm
            points = rotate(local, np.sin(angle[part]), np.cos(angle[part])) + center[part]
            contours.append(points[: -shape.joint_count])
            new = slice(0 if parent < 0 else 1, None)
            joints[list(own[new])] = points[-shape.joint_count :][new]
        return PuppetShape(joints, tuple(contours), tuple(coefficients), 1.0, "front")

    def puppet_from_joints(self, joints: Array, scale: float, view: View = "front") -> PuppetShape:
        """Return the most probable puppet on given `joints` (J, 2) px at `scale` px/m (Eqs. 23-30, annotation tool).

        InputError unless all joints are known: complete them first.
        """
        joints = self._check_joints(joints)
        if not np.isfinite(joints).all():
            unknown = self.joint_names[int(np.flatnonzero(~np.isfinite(joints).all(axis=1))[0])]
            raise InputError(f"joint {unknown} is unknown; complete the joints first")
        to_pixels = self._pixels_per_metre(scale, view)
        origin = joints[0]
        contours, coefficients = self._shape_from_joints((joints - origin) / to_pixels)
        placed = tuple(contour * to_pixels + origin for contour in contours)
        return PuppetShape(joints.copy(), placed, coefficients, scale, view)

    def puppets_from_joints(
        self, joints: Array, scale: Array, view: View = "front", edges: Sequence[int] | None = None
    ) -> tuple[tuple[Array, ...], Array]:
        """Return the most probable puppets on P sets of known `joints` (P, J, 2) px at `scale` (P,) px/m > 0.

        They come as contours (P, K_i, 2) px of every part, and energies (P,) as of `energy`, up to a constant, of the
        whole puppet or of some of the tree's `edges` (indices).
        """
        to_pixels = np.asarray(scale, np.float64)[:, None, None] * self._pixels_per_metre(1.0, view)
        origin = joints[:, :1]
        local = (joints - origin) / to_pixels
        contours, coefficients = self._shape_from_joints.infer_batch(local)
        chosen = range(len(self.tree.edges)) if edges is None else edges
        energy = self._energy.evaluate_batch(local, coefficients, chosen)
        return tuple(contour * to_pixels + origin for contour in contours), energy

    def shape_coefficients(self, joints: Array, scale: Array, view: View = "front") -> Array:
        """Return the shape coefficients (P, N, Z) of the puppets of `puppets_from_joints`."""
        to_pixels = np.asarray(scale, np.float64)[:, None, None] * self._pixels_per_metre(1.0, view)
        return self._shape_from_joints.infer_batch((joints - joints[:, :1]) / to_pixels)[1]

    def energy(self, shape: PuppetShape) -> float:
        """Return -log p(l) of Eq. 5 in nats, with Z = 1, of a puppet from `puppet_from_joints`; lower is likelier."""
        to_pixels = self._pixels_per_metre(shape.scale, shape.view)
        return self._energy((shape.joints - shape.joints[0]) / to_pixels, np.stack(shape.coefficients))

    def estimate_scale(self, joints: Array, confidence: Array) -> float:
        """Estimate the scale in px/m of a person with `joints` (J, 2) px, NaN unknown, and their `confidence` (J,).

        It is a robust mean of joint distances relative to those of the training data. Foreshortening only shortens, so
        distances that are too short count less. InputError if no distance is known.
        """
        joints, known = self._check_joints(joints), self._find_known(joints, confidence)
        pairs = known[self.length_pairs].all(axis=1)
        distance = np.linalg.norm(joints[self.length_pairs[:, 0]] - joints[self.length_pairs[:, 1]], axis=1)
        pairs &= np.where(pairs, distance, 0.0) > 0.0
        if not pairs.any():
            raise InputError("the scale of a person needs at least two connected joints with a confidence above 0")
        ratio = np.log(distance[pairs]) - self.log_length[pairs, 0]
        deviation = self.log_length[pairs, 1]
        certainty = np.asarray(confidence)[self.length_pairs[pairs]].min(axis=1) / deviation**2
        order = np.argsort(ratio)
        share = np.cumsum(certainty[order]) / certainty.sum()
        log_scale = ratio[order][np.searchsorted(share, 0.5)]
        for _ in range(10):
            short = (log_scale - ratio) / deviation
            weight = certainty * np.where(short > _HUBER_WIDTH, _HUBER_WIDTH / np.maximum(short, _HUBER_WIDTH), 1.0)
            log_scale = (weight * ratio).sum() / weight.sum()
        return float(np.exp(log_scale))

    def estimate_view(self, joints: Array, confidence: Array) -> View:
        """Return the side that the camera sees: "front" if left shoulder and hip are on the right of the image."""
        joints, known = self._check_joints(joints), self._find_known(joints, confidence)
        sided = 0.0
        for name in ("shoulder", "hip"):
            left, right = self.joint_names.index(f"left_{name}"), self.joint_names.index(f"right_{name}")
            if known[left] and known[right]:
                sided += min(confidence[left], confidence[right]) * (joints[left, 0] - joints[right, 0])
        return "back" if sided < 0 else "front"

    def complete_joints(self, joints: Array, confidence: Array, scale: float, view: View = "front") -> Array:
        """Fill in the unknown `joints` (J, 2) px (NaN or confidence 0) at their most likely position.

        Known joints stay as they are. The others are the mean of the joint Gaussian given the known ones, whose noise
        grows as the `confidence` (J,) falls. Hands and feet follow the limb they end (mean angle of Eq. 10). Bones that
        come out short, because the mean averages over directions, get their mean length. InputError if no joint is
        known.
        """
        joints, known = self._check_joints(joints), self._find_known(joints, confidence)
        if not known.any():
            raise InputError("no joint of the person is known, so the others cannot be completed")
        to_pixels = self._pixels_per_metre(scale, view)
        deviation = KNOWN_JOINT_NOISE / np.where(known, confidence, 1.0)
        somewhere = _POSITION_DEVIATION_M**2 * np.kron(np.ones((len(joints), len(joints))), np.eye(2))
        noisy = Gaussian(
            self.joint_prior.mean, self.joint_prior.covariance + somewhere + np.diag(np.repeat(deviation**2, 2))
        )
        origin = joints[known][0]
        index = np.arange(2 * len(joints)).reshape(-1, 2)
        given = ((joints[known] - origin) / to_pixels).ravel()
        filled = joints.copy()
        if not known.all():
            rest = noisy.condition(index[~known].ravel(), index[known].ravel(), given).mean.reshape(-1, 2)
            filled[~known] = rest * to_pixels + origin
        self._place_extremities(filled, known, to_pixels)
        return self._stretch_to_mean_lengths(filled, known, scale)

    def _place_extremities(self, joints: Array, known: Array, to_pixels: Array) -> None:
        """Put unknown hands and feet at their angle to a known limb; the joint Gaussian would average over angles."""
        for part in self._extremities:
            near, far = self.part_joints[part][:2]
            limb = list(self.part_joints[self.tree.parents[part]][:2])
            if known[far] or not known[limb].all():
                continue
            start, end = joints[limb] / to_pixels
            along = (end - start) / max(np.hypot(*(end - start)), np.finfo(float).tiny)
            sine, cosine = self.pairwise[part - 1].mean[PairLayout(self.shapes[part].basis.shape[2]).angle]
            rotated = np.array([cosine * along[0] - sine * along[1], sine * along[0] + cosine * along[1]])
            joints[far] = joints[near] + rotated / np.hypot(sine, cosine) * self._bone_length(part) * to_pixels

    @property
    def _extremities(self) -> tuple[int, ...]:
        return tuple(k for k, name in enumerate(self.tree.names) if name.endswith(("_hand", "_foot")))

    def _bone_length(self, part: int) -> float:
        """Length of a part's bone in its mean shape, metres."""
        return float(np.ptp(self.shapes[part].mean[-2:, 0]))

    def _stretch_to_mean_lengths(self, joints: Array, known: Array, scale: float) -> Array:
        for part in range(1, len(self.tree)):
            near, far = self.part_joints[part][:2]
            mean_length = scale * self._bone_length(part)
            bone = joints[far] - joints[near]
            length = np.hypot(*bone)
            if not known[far] and 0 < length < mean_length:
                joints[far] = joints[near] + bone * (mean_length / length)
        return joints

    def _check_joints(self, joints: Array) -> Array:
        joints = np.asarray(joints, np.float64)
        if joints.shape != (len(self.joint_names), 2):
            raise InputError(f"joints have the shape {joints.shape}; {self.name} needs ({len(self.joint_names)}, 2)")
        return joints

    @staticmethod
    def _find_known(joints: Array, confidence: Array) -> Array:
        return np.asarray(np.isfinite(joints).all(axis=1) & (np.nan_to_num(np.asarray(confidence)) > 0))

    @staticmethod
    def _pixels_per_metre(scale: float, view: View) -> Array:
        """Return the factors (2,) from metres to pixels (Eqs. 8 and 9); InputError unless the scale is positive."""
        if not (np.isfinite(scale) and scale > 0):
            raise InputError(f"the scale of a puppet is {scale} px/m; it must be positive")
        return np.array([scale if view == "front" else -scale, scale])


@cache
def _mean_joints(model: DeformableStructures) -> Array:
    layout = PairLayout(model.shapes[0].basis.shape[2])
    poses = [pair.mean[layout.angle + layout.gap] for pair in model.pairwise]
    return model._assemble([np.zeros(layout.size)] * len(model.tree), poses).joints
