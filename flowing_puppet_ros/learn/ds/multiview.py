# SPDX-License-Identifier: Apache-2.0
"""Learn the Deformable Structures puppet of nine views (thesis, "Multi-view DS Model", Eqs. 38-43)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.learn.ds.fit import fit_pair, fit_part, joint_statistics
from flowing_puppet_ros.learn.ds.samples import PartSamples, TrainingSet
from flowing_puppet_ros.model.ds.multiview import packed, turned_torso
from flowing_puppet_ros.model.ds.shape import PartShape
from flowing_puppet_ros.model.gaussian import Gaussian

LEAST_VARIANCE = 1e-4
"""Added to the variances of a view's torso coefficients, which have unit variance over all views."""


def fit_views(sets: Sequence[TrainingSet], components: int) -> dict[str, Array]:
    """Fit the arrays of `MultiViewStructures.from_arrays` to the samples of every view, in the order of the views.

    The part shapes are those of all views together. Per view there are the torso's Gaussian (Eq. 39), the potentials
    between the torso and its neighbours (Eq. 42, over standardised torso coefficients) and the statistics of the
    joints; the potentials of the limbs are fitted to all views at once.
    """
    everyone = _joined(sets)
    tree = everyone.tree
    fitted = [fit_part(part, name, components) for part, name in zip(everyone.parts, tree.names, strict=True)]
    shapes = tuple(shape for shape, _ in fitted)
    coefficients = [z for _, z in fitted]
    limbs = {edge: fit_pair(everyone, shapes, coefficients, *edge) for edge in tree.edges if edge[0] != 0}
    pairs: list[Gaussian] = list(limbs.values())
    place = {edge: index for index, edge in enumerate(limbs)}
    ends = np.cumsum([len(one.joints) for one in sets])[:-1]
    own = [np.split(z, ends) for z in coefficients]
    rows: list[list[int]] = []
    torsos: list[tuple[Array, Array]] = []
    for view, training in enumerate(sets):
        mean, factor, standard = _standardised(own[0][view])
        torsos.append((mean, factor))
        turned = (turned_torso(shapes[0], mean, factor), *shapes[1:])
        z = [standard, *(part[view] for part in own[1:])]
        rows.append([])
        for edge in tree.edges:
            if edge in place:
                rows[-1].append(place[edge])
            else:
                rows[-1].append(len(pairs))
                pairs.append(fit_pair(training, turned, z, *edge))
    arrays = _shape_arrays(tree.names, shapes) | {
        "torso_mean": np.stack([mean for mean, _ in torsos]),
        "torso_factor": np.stack([factor for _, factor in torsos]),
        "pair_of_view": np.array(rows),
        "pair_mean": np.stack([pair.mean for pair in pairs]),
        "pair_covariance": packed(np.stack([pair.covariance for pair in pairs])),
        "prior": np.array([len(one.joints) for one in sets]) / len(everyone.joints),
    }
    arrays |= _joint_arrays(sets)
    return {key: np.asarray(value, np.float32) for key, value in arrays.items()}


def _joint_arrays(sets: Sequence[TrainingSet]) -> dict[str, Array]:
    """The statistics of the joints in every view."""
    priors, pairs, lengths = zip(*(joint_statistics(training) for training in sets), strict=True)
    return {
        "joint_mean": np.stack([prior.mean for prior in priors]),
        "joint_covariance": packed(np.stack([prior.covariance for prior in priors])),
        "length_pairs": pairs[0],
        "log_length": np.stack(lengths),
    }


def _shape_arrays(names: Sequence[str], shapes: Sequence[PartShape]) -> dict[str, Array]:
    means = {f"mean_{name}": shape.mean for name, shape in zip(names, shapes, strict=True)}
    return means | {f"basis_{name}": shape.basis for name, shape in zip(names, shapes, strict=True)}


def _joined(sets: Sequence[TrainingSet]) -> TrainingSet:
    def together(part: int) -> PartSamples:
        fields = [[getattr(one.parts[part], name) for one in sets] for name in ("points", "angle", "center", "length")]
        return PartSamples(*(np.concatenate(values) for values in fields))

    parts = tuple(together(part) for part in range(len(sets[0].parts)))
    joints = np.concatenate([one.joints for one in sets])
    return TrainingSet(sets[0].tree, sets[0].joint_names, parts, joints)


def _standardised(coefficients: Array) -> tuple[Array, Array, Array]:
    """Mean (Z,) and Cholesky factor (Z,Z) of coefficients (n,Z), and the coefficients in those terms."""
    law = Gaussian.from_samples(coefficients, ridge=LEAST_VARIANCE)
    factor = np.linalg.cholesky(law.covariance)
    return law.mean, factor, np.linalg.solve(factor, (coefficients - law.mean).T).T
