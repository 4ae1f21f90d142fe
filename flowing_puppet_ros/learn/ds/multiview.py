# SPDX-License-Identifier: Apache-2.0
"""Learn the Deformable Structures puppet of nine views (thesis, "Multi-view DS Model", Eqs. 38-43)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.learn.ds.fit import fit_joint_statistics, fit_pair, fit_part
from flowing_puppet_ros.learn.ds.samples import PartSamples, TrainingSet
from flowing_puppet_ros.model.ds.multiview import make_view_torso, pack_symmetric
from flowing_puppet_ros.model.ds.shape import PartShape
from flowing_puppet_ros.model.gaussian import Gaussian

VARIANCE_RIDGE = 1e-4
"""Added to the variances of a view's torso coefficients, which have unit variance over all views."""


def fit_views(sets: Sequence[TrainingSet], components: int) -> dict[str, Array]:
    """Fit the arrays of `MultiViewStructures.from_arrays` to the samples of every view, in the order of the views.

    All views share the part shapes and the potentials between limbs. Each view has its own Gaussian of the torso
    (Eq. 39), potentials between the torso and its neighbours (Eq. 42, over standardised torso coefficients) and joint
    statistics.
    """
    all_views = _join_sets(sets)
    tree = all_views.tree
    fitted = [fit_part(part, name, components) for part, name in zip(all_views.parts, tree.names, strict=True)]
    shapes = tuple(shape for shape, _ in fitted)
    coefficients = [z for _, z in fitted]
    limbs = {edge: fit_pair(all_views, shapes, coefficients, *edge) for edge in tree.edges if edge[0] != 0}
    pairs: list[Gaussian] = list(limbs.values())
    place = {edge: index for index, edge in enumerate(limbs)}
    ends = np.cumsum([len(one.joints) for one in sets])[:-1]
    own = [np.split(z, ends) for z in coefficients]
    rows: list[list[int]] = []
    torsos: list[tuple[Array, Array]] = []
    for view, training in enumerate(sets):
        mean, factor, standard = _standardise(own[0][view])
        torsos.append((mean, factor))
        view_shapes = (make_view_torso(shapes[0], mean, factor), *shapes[1:])
        z = [standard, *(part[view] for part in own[1:])]
        rows.append([])
        for edge in tree.edges:
            if edge in place:
                rows[-1].append(place[edge])
            else:
                rows[-1].append(len(pairs))
                pairs.append(fit_pair(training, view_shapes, z, *edge))
    arrays = _pack_shapes(tree.names, shapes) | {
        "torso_mean": np.stack([mean for mean, _ in torsos]),
        "torso_factor": np.stack([factor for _, factor in torsos]),
        "pair_of_view": np.array(rows),
        "pair_mean": np.stack([pair.mean for pair in pairs]),
        "pair_covariance": pack_symmetric(np.stack([pair.covariance for pair in pairs])),
        "prior": np.array([len(one.joints) for one in sets]) / len(all_views.joints),
    }
    arrays |= _pack_joints(sets)
    return {key: np.asarray(value, np.float32) for key, value in arrays.items()}


def _pack_joints(sets: Sequence[TrainingSet]) -> dict[str, Array]:
    """Return the joint statistics of every view as arrays."""
    priors, pairs, lengths = zip(*(fit_joint_statistics(training) for training in sets), strict=True)
    return {
        "joint_mean": np.stack([prior.mean for prior in priors]),
        "joint_covariance": pack_symmetric(np.stack([prior.covariance for prior in priors])),
        "length_pairs": pairs[0],
        "log_length": np.stack(lengths),
    }


def _pack_shapes(names: Sequence[str], shapes: Sequence[PartShape]) -> dict[str, Array]:
    means = {f"mean_{name}": shape.mean for name, shape in zip(names, shapes, strict=True)}
    return means | {f"basis_{name}": shape.basis for name, shape in zip(names, shapes, strict=True)}


def _join_sets(sets: Sequence[TrainingSet]) -> TrainingSet:
    def together(part: int) -> PartSamples:
        fields = [[getattr(one.parts[part], name) for one in sets] for name in ("points", "angle", "center", "length")]
        return PartSamples(*(np.concatenate(values) for values in fields))

    parts = tuple(together(part) for part in range(len(sets[0].parts)))
    joints = np.concatenate([one.joints for one in sets])
    return TrainingSet(sets[0].tree, sets[0].joint_names, parts, joints)


def _standardise(coefficients: Array) -> tuple[Array, Array, Array]:
    """Return mean (Z,) and Cholesky factor (Z, Z) of coefficients (n, Z), and the coefficients standardised by them."""
    law = Gaussian.from_samples(coefficients, ridge=VARIANCE_RIDGE)
    factor = np.linalg.cholesky(law.covariance)
    return law.mean, factor, np.linalg.solve(factor, (coefficients - law.mean).T).T
