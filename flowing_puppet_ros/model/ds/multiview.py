# SPDX-License-Identifier: Apache-2.0
"""Deformable Structures in nine views (thesis, "Multi-view DS Model", Eqs. 38-43).

Views are named by where the torso faces on a map whose south is the camera: S faces it, W the left of the image, E its
right. The torso's shape is a mixture of one Gaussian per view, and so are the potentials between the torso and its
neighbours; shapes and potentials of the limbs are the same in every view. Given its view, the model is an ordinary
`DeformableStructures`: the coefficients of its torso are those of Eq. 39, standardised.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.model import weights
from flowing_puppet_ros.model.ds.joints import PART_JOINTS, part_tree
from flowing_puppet_ros.model.ds.puppet import KNOWN_JOINT_NOISE, DeformableStructures
from flowing_puppet_ros.model.ds.shape import PartShape, PuppetShape
from flowing_puppet_ros.model.gaussian import Gaussian

VIEW_NAMES = ("W", "WSW", "SW", "SSW", "S", "SSE", "SE", "ESE", "E")
VIEW_HEADINGS = tuple(float(angle) for angle in np.radians(np.linspace(-90.0, 90.0, len(VIEW_NAMES))))
"""Angle in radians by which the torso of each view is rotated from the camera towards the right of the image."""

MIN_SIDE_PROBABILITY = 0.97
"""Probability of a side view from which the model of that view is used instead of the frontal one."""

LOG_SCALES = np.linspace(-0.3, 0.3, 13)
"""Logarithms of the scales, relative to the frontal estimate, over which `MultiViewStructures.posterior` averages."""


@dataclass(frozen=True, slots=True, eq=False)
class MultiViewStructures:
    """One puppet per view, `views` in the order of `VIEW_NAMES`, with probabilities `prior` (9,) (Eq. 38)."""

    views: tuple[DeformableStructures, ...]
    prior: Array

    @classmethod
    def load(cls, gender: str = "neutral", parts: int = 10) -> Self:
        """Load the shipped model; InputError when there is none of that gender ("neutral", ...) and parts (10, 14)."""
        return cls.from_arrays(gender, parts, weights.load("ds", f"{gender}-{parts}-views"))

    @property
    def name(self) -> str:
        """Gender, number of parts and "views", for example "neutral-10-views"."""
        return f"{self.views[0].name}-views"

    def at(self, view: str) -> DeformableStructures:
        """Return the puppet whose torso faces `view` (Eqs. 41 and 42); InputError when there is no such view."""
        if view not in VIEW_NAMES:
            raise InputError(f"there is no view {view!r}; choose one of {', '.join(VIEW_NAMES)}")
        return self.views[VIEW_NAMES.index(view)]

    def sample(self, rng: np.random.Generator, view: str | None = None) -> PuppetShape:
        """Draw a puppet in model space (Eq. 40), in a random view unless one is named."""
        drawn = VIEW_NAMES[rng.choice(len(VIEW_NAMES), p=self.prior)] if view is None else view
        return self.at(drawn).sample(rng)

    def posterior(self, joints: Array, confidence: Array) -> Array:
        """Return the probability (9,) of each view given `joints` (J, 2) px, NaN unknown, and `confidence` (J,).

        It is the Gaussian of the known joints in every view, averaged over the unknown scale. InputError as in
        `DeformableStructures.estimate_scale`.
        """
        joints, confidence = np.asarray(joints, np.float64), np.asarray(confidence, np.float64)
        frontal = self.views[len(self.views) // 2]
        known = np.isfinite(joints).all(axis=1) & (np.nan_to_num(confidence) > 0)
        scale = frontal.estimate_scale(joints, np.where(known, confidence, 0.0))
        noise = np.repeat((KNOWN_JOINT_NOISE / confidence[known]) ** 2, 2)
        index = np.arange(2 * len(joints)).reshape(-1, 2)[known].ravel()
        evidence = np.empty((len(self.views), len(LOG_SCALES)))
        for row, view in enumerate(self.views):
            prior = view.joint_prior.marginal(index)
            metres = (joints[known] / scale).reshape(-1, 1) / np.exp(LOG_SCALES)
            # A density over pixels: metres shrink as the scale grows.
            evidence[row] = (
                _translation_free_log_density(metres - prior.mean[:, None], prior.covariance + np.diag(noise))
                - (len(index) - 2) * LOG_SCALES
            )
        total = np.logaddexp.reduce(evidence, axis=1) + np.log(self.prior)
        return np.asarray(np.exp(total - np.logaddexp.reduce(total)))

    def frontal_probability(self, probability: Array) -> float:
        """Return the sum of the probabilities (9,) of the views in which the frontal puppet is right."""
        middle = len(probability) // 2
        return float(probability[middle - 1 : middle + 2].sum())

    def find_side(self, probability: Array) -> int | None:
        """Return the likeliest view, by its index, if a side is nearly certain by `probability` (9,), else None."""
        if self.frontal_probability(probability) > 1.0 - MIN_SIDE_PROBABILITY:
            return None
        return int(probability.argmax())

    @classmethod
    def from_arrays(cls, gender: str, parts: int, arrays: Mapping[str, Array]) -> Self:
        """Build from the arrays of a weights file (float32 is enough)."""
        tree = part_tree(parts)
        data = {key: np.asarray(value, np.float64) for key, value in arrays.items()}
        shapes = tuple(PartShape(data[f"mean_{n}"], data[f"basis_{n}"], len(PART_JOINTS[n])) for n in tree.names)
        pairs = data["pair_of_view"].astype(np.intp)
        gaussians = [
            Gaussian(*g) for g in zip(data["pair_mean"], _unpack_symmetric(data["pair_covariance"]), strict=True)
        ]
        priors = [
            Gaussian(*g) for g in zip(data["joint_mean"], _unpack_symmetric(data["joint_covariance"]), strict=True)
        ]
        views = tuple(
            DeformableStructures(
                gender,
                tree,
                (make_view_torso(shapes[0], data["torso_mean"][view], data["torso_factor"][view]), *shapes[1:]),
                tuple(gaussians[index] for index in pairs[view]),
                priors[view],
                data["length_pairs"].astype(np.intp),
                data["log_length"][view],
            )
            for view in range(len(VIEW_NAMES))
        )
        return cls(views, data["prior"] / data["prior"].sum())


def make_view_torso(shape: PartShape, mean: Array, factor: Array) -> PartShape:
    """Return the torso of one view: its coefficients are `mean` (Z,) + `factor` (Z, Z) times `shape`'s (Eq. 39)."""
    return PartShape(shape.mean + shape.basis @ mean, shape.basis @ factor, shape.joint_count)


def pack_symmetric(covariances: Array) -> Array:
    """Return the lower triangles (n, D (D + 1) / 2) of symmetric matrices (n, D, D)."""
    rows, columns = np.tril_indices(covariances.shape[-1])
    return np.asarray(covariances[:, rows, columns])


def _unpack_symmetric(triangles: Array) -> Array:
    size = round((np.sqrt(8 * triangles.shape[1] + 1) - 1) / 2)
    rows, columns = np.tril_indices(size)
    full = np.empty((len(triangles), size, size))
    full[:, rows, columns] = full[:, columns, rows] = triangles
    return full


def _translation_free_log_density(deviation: Array, covariance: Array) -> Array:
    """Return the log density of deviations (2K, S), up to a constant, under a flat prior over a common translation."""
    shift = np.tile(np.eye(2), (len(deviation) // 2, 1))
    factor = np.linalg.cholesky(covariance)
    white, place = np.linalg.solve(factor, deviation), np.linalg.solve(factor, shift)
    precision = place.T @ place
    fitted = np.linalg.solve(precision, place.T @ white)
    volume = np.log(np.diagonal(factor)).sum() + 0.5 * np.linalg.slogdet(precision)[1]
    return np.asarray(-0.5 * ((white - place @ fitted) ** 2).sum(axis=0) - volume)
