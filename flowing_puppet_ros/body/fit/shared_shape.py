# SPDX-License-Identifier: Apache-2.0
"""Bodies of one person in several clouds, with one shape for all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flowing_puppet_ros.body.cloud.correspondence import Cloud
from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter
from flowing_puppet_ros.body.refine.gauss_newton import RefineWeights
from flowing_puppet_ros.body.search.energy import JointTargets

FIXED_SHAPE = RefineWeights(shape=1.0, sigma_start=0.06)
"""So strong a pull to the shared shape that the surface does not change it."""


def mean_shape(fits: Sequence[BodyFit]) -> np.ndarray:
    """Return the shape coefficients (S,) of one person from fits: their mean by confidence, of reliable ones if any."""
    reliable = [fit for fit in fits if fit.reliable] or list(fits)
    weight = np.array([max(fit.confidence, 0.01) for fit in reliable])
    return np.asarray(np.average([fit.state.shape.mean(axis=0) for fit in reliable], axis=0, weights=weight))


def fit_with_shape(fitter: BodyFitter, fit: BodyFit, cloud: Cloud, shape: np.ndarray) -> BodyFit:
    """Return a fit to the same cloud with a given shape (S,): all parts are adjusted to it anew."""
    shapes = np.tile(shape, (len(fit.state.shape), 1))
    weights = replace(FIXED_SHAPE, shape_center=shape)
    start = replace(fit.state, shape=shapes)
    state = fitter.gauss_newton.run(start, cloud, JointTargets.none(fitter.model), weights)
    return fitter.assess_surface(replace(state, shape=shapes), cloud)
