# SPDX-License-Identifier: Apache-2.0
"""Deformable Structures: the part-based 2D model of body shape and pose (thesis, chapter of that name).

Model space is in metres, x to the right and y down in the image of a camera that sees the person's front; an image
point is `scale * model + offset` (Eqs. 8 and 9), scale in pixels per metre. From behind, x is mirrored.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
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

_SOMEWHERE = 100.0  # metres: standard deviation of where a person stands in model space
_HUBER = 1.0  # standard deviations by which a bone may be shorter than usual before it counts less


@dataclass(frozen=True, slots=True, eq=False)
class DeformableStructures:
    """A learned 2D puppet: linear part shapes, and pairwise Gaussians that tie shape to relative pose (Eqs. 5-10).

    part_joints: joint indices of every part (proximal, distal, then any others). joint_prior: Gaussian of all joints
    (2J,) around their mid-torso. length_pairs (P,2): joints whose distance tells the scale, log_length (P,2): mean and
    standard deviation of its logarithm in metres. shoulder_width: distance of the mean puppet's shoulders, in metres.
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
        """Joint indices (N,2) of every part's bone: proximal, distal."""
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
        """The learned numbers as float32 arrays by name."""
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

    def likely(self) -> PuppetShape:
        """The puppet that grows from the mean torso by conditional means, in model space."""
        return self._descend(np.zeros(self.shapes[0].basis.shape[2]), lambda given: given.mean)

    def _descend(self, torso: Array, choose: Callable[[Gaussian], Array]) -> PuppetShape:
        """From the torso's coefficients to the leaves: `choose` picks from a child's conditional Gaussian (Eq. 12)."""
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
        """Joints (J,2) in model space of the puppet whose every part has its mean shape and relative pose."""
        layout = PairLayout(self.shapes[0].basis.shape[2])
        poses = [pair.mean[layout.angle + layout.gap] for pair in self.pairwise]
        return self._assemble([np.zeros(layout.size)] * len(self.tree), poses).joints

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
                turned_gap = rotate(np.array(gap), np.sin(angle[parent]), np.cos(angle[parent]))
                arm = rotate(local[-shape.joint_count], np.sin(angle[part]), np.cos(angle[part]))
                center[part] = joints[own[0]] + turned_gap - arm
            points = rotate(local, np.sin(angle[part]), np.cos(angle[part])) + center[part]
            contours.append(points[: -shape.joint_count])
            new = slice(0 if parent < 0 else 1, None)
            joints[list(own[new])] = points[-shape.joint_count :][new]
        return PuppetShape(joints, tuple(contours), tuple(coefficients), 1.0, "front")

    def puppet_from_joints(self, joints: Array, scale: float, view: View = "front") -> PuppetShape:
        """The most probable puppet on given joints (J,2) in pixels (thesis, annotation tool, Eqs. 23-30).

        `scale` in pixels per metre. All joints must be known: complete them first. InputError otherwise.
        """
        joints = self._checked(joints)
        if not np.isfinite(joints).all():
            unknown = self.joint_names[int(np.flatnonzero(~np.isfinite(joints).all(axis=1))[0])]
            raise InputError(f"joint {unknown} is unknown; complete the joints first")
        to_pixels = self._to_pixels(scale, view)
        origin = joints[0]
        contours, coefficients = self._shape_from_joints((joints - origin) / to_pixels)
        placed = tuple(contour * to_pixels + origin for contour in contours)
        return PuppetShape(joints.copy(), placed, coefficients, scale, view)

    def puppets_from_joints(
        self, joints: Array, scale: Array, view: View = "front", edges: Sequence[int] | None = None
    ) -> tuple[tuple[Array, ...], Array]:
        """The most probable puppets on P sets of joints (P,J,2) px at scales (P,) px/m, all known and positive.

        Returns contours (P,K_i,2) px of every part, and the energies (P,) of `energy` up to a constant, of the whole
        puppet or of some of the tree's `edges` (indices).
        """
        to_pixels = np.asarray(scale, np.float64)[:, None, None] * self._to_pixels(1.0, view)
        origin = joints[:, :1]
        local = (joints - origin) / to_pixels
        contours, coefficients = self._shape_from_joints.many(local)
        chosen = range(len(self.tree.edges)) if edges is None else edges
        energy = self._energy.many(local, coefficients, chosen)
        return tuple(contour * to_pixels + origin for contour in contours), energy

    def shape_coefficients(self, joints: Array, scale: Array, view: View = "front") -> Array:
        """Shape coefficients (P,N,Z) of the puppets that `puppets_from_joints` gives."""
        to_pixels = np.asarray(scale, np.float64)[:, None, None] * self._to_pixels(1.0, view)
        return self._shape_from_joints.many((joints - joints[:, :1]) / to_pixels)[1]

    def energy(self, shape: PuppetShape) -> float:
        """-log p(l) of Eq. 5 in nats, with Z = 1, of a puppet that stands on its joints; lower is more likely."""
        to_pixels = self._to_pixels(shape.scale, shape.view)
        return self._energy((shape.joints - shape.joints[0]) / to_pixels, np.stack(shape.coefficients))

    def estimate_scale(self, joints: Array, confidence: Array) -> float:
        """Pixels per metre of a person with joints (J,2) in pixels (NaN where unknown) and their confidence (J,).

        Robust mean over joint distances in proportion to what training saw; since foreshortening only shortens,
        distances that are too short count less. InputError when no distance is known.
        """
        joints, known = self._checked(joints), self._known(joints, confidence)
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
            weight = certainty * np.where(short > _HUBER, _HUBER / np.maximum(short, _HUBER), 1.0)
            log_scale = (weight * ratio).sum() / weight.sum()
        return float(np.exp(log_scale))

    def estimate_view(self, joints: Array, confidence: Array) -> View:
        """Which side the camera sees: "front" when the person's left shoulder and hip are on the right of the image."""
        joints, known = self._checked(joints), self._known(joints, confidence)
        sided = 0.0
        for name in ("shoulder", "hip"):
            left, right = self.joint_names.index(f"left_{name}"), self.joint_names.index(f"right_{name}")
            if known[left] and known[right]:
                sided += min(confidence[left], confidence[right]) * (joints[left, 0] - joints[right, 0])
        return "back" if sided < 0 else "front"

    def complete_joints(self, joints: Array, confidence: Array, scale: float, view: View = "front") -> Array:
        """Joints (J,2) in pixels with the unknown ones (NaN or confidence 0) at their most likely place.

        The known joints stay as they are. The others are the mean of the joint Gaussian given the known ones, whose
        noise grows as the confidence falls; hands and feet follow the limb they end (Eq. 10's mean angle); bones that
        this mean leaves shorter than usual, because it averages over directions, get their usual length. InputError
        when no joint is known.
        """
        joints, known = self._checked(joints), self._known(joints, confidence)
        if not known.any():
            raise InputError("no joint of the person is known, so the others cannot be completed")
        to_pixels = self._to_pixels(scale, view)
        deviation = KNOWN_JOINT_NOISE / np.where(known, confidence, 1.0)
        somewhere = _SOMEWHERE**2 * np.kron(np.ones((len(joints), len(joints))), np.eye(2))
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
        self._lay_extremities(filled, known, to_pixels)
        return self._with_usual_lengths(filled, known, scale)

    def _lay_extremities(self, joints: Array, known: Array, to_pixels: Array) -> None:
        """Put unknown hands and feet at their angle to a known limb; the joint Gaussian would average over angles."""
        for part in self._extremities:
            near, far = self.part_joints[part][:2]
            limb = list(self.part_joints[self.tree.parents[part]][:2])
            if known[far] or not known[limb].all():
                continue
            start, end = joints[limb] / to_pixels
            along = (end - start) / max(np.hypot(*(end - start)), np.finfo(float).tiny)
            sine, cosine = self.pairwise[part - 1].mean[PairLayout(self.shapes[part].basis.shape[2]).angle]
            turned = np.array([cosine * along[0] - sine * along[1], sine * along[0] + cosine * along[1]])
            joints[far] = joints[near] + turned / np.hypot(sine, cosine) * self._bone_length(part) * to_pixels

    @property
    def _extremities(self) -> tuple[int, ...]:
        return tuple(k for k, name in enumerate(self.tree.names) if name.endswith(("_hand", "_foot")))

    def _bone_length(self, part: int) -> float:
        """Length of a part's bone in its mean shape, metres."""
        return float(np.ptp(self.shapes[part].mean[-2:, 0]))

    def _with_usual_lengths(self, joints: Array, known: Array, scale: float) -> Array:
        for part in range(1, len(self.tree)):
            near, far = self.part_joints[part][:2]
            usual = scale * self._bone_length(part)
            bone = joints[far] - joints[near]
            length = np.hypot(*bone)
            if not known[far] and 0 < length < usual:
                joints[far] = joints[near] + bone * (usual / length)
        return joints

    def _checked(self, joints: Array) -> Array:
        joints = np.asarray(joints, np.float64)
        if joints.shape != (len(self.joint_names), 2):
            raise InputError(f"joints have the shape {joints.shape}; {self.name} needs ({len(self.joint_names)}, 2)")
        return joints

    @staticmethod
    def _known(joints: Array, confidence: Array) -> Array:
        return np.asarray(np.isfinite(joints).all(axis=1) & (np.nan_to_num(np.asarray(confidence)) > 0))

    @staticmethod
    def _to_pixels(scale: float, view: View) -> Array:
        if not (np.isfinite(scale) and scale > 0):
            raise InputError(f"the scale of a puppet is {scale} px/m; it must be positive")
        return np.array([scale if view == "front" else -scale, scale])
