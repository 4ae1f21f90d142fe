# SPDX-License-Identifier: Apache-2.0
"""Where the time of a tracked cloud and of a whole fit goes: processor time of each stage without the stages in it."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from flowing_puppet_ros.body.cloud import single_view
from flowing_puppet_ros.body.cloud.correspondence import TwoWayCorrespondence
from flowing_puppet_ros.body.cloud.single_view import SingleViewCloud
from flowing_puppet_ros.body.fit import fitter as fitting
from flowing_puppet_ros.body.fit import hypotheses
from flowing_puppet_ros.body.fit.fitter import BodyFitter
from flowing_puppet_ros.body.fit.pose_bank import PoseBank
from flowing_puppet_ros.body.fit.single_view_search import SingleViewSearch
from flowing_puppet_ros.body.refine.normal_equations import NormalEquations
from flowing_puppet_ros.body.refine.tree_solution import TreeSolution
from flowing_puppet_ros.body.search import dpmp
from flowing_puppet_ros.body.search.body_energy import BodyEnergy
from flowing_puppet_ros.body.search.dpmp import BodyParticleSearch
from flowing_puppet_ros.body.search.limb_search import LimbSearch
from flowing_puppet_ros.body.track import body_tracker
from flowing_puppet_ros.evaluate.tables import Row
from flowing_puppet_ros.evidence.cloud import data_term, one_sided
from flowing_puppet_ros.evidence.cloud.nearest import NearestPoints
from flowing_puppet_ros.evidence.cloud.one_sided import OneSidedView
from flowing_puppet_ros.model.posing import BodyPoints
from flowing_puppet_ros.process.threads import one_blas_thread

REST = "everything else"
REFINEMENT: dict[str, list[tuple[Any, str]]] = {
    "downsampling": [(body_tracker, "downsample"), (fitting, "downsample")],
    "normals": [
        (body_tracker, "estimate_normals"),
        (fitting, "estimate_normals"),
        (single_view, "estimate_view_normals"),
    ],
    "nearest points: indices": [(NearestPoints, "__init__")],
    "nearest points: queries": [(NearestPoints, "query")],
    "single view": [
        (one_sided, "fill_nearest"),
        (one_sided, "find_neighbours"),
        (single_view, "find_neighbours"),
        (OneSidedView, "compare"),
        (OneSidedView, "find_hidden"),
        (SingleViewCloud, "free_space_term"),
        (SingleViewCloud, "sees"),
    ],
    "correspondences": [(TwoWayCorrespondence, "attract")],
    "points of the body": [(BodyPoints, "pose")],
    "normal equations": [(NormalEquations, name) for name in ("add_surface", "add_stitching", "add_joint_prior")],
    "solution": [(TreeSolution, "solve")],
    "confidence": [(fitting, "assess_fit"), (hypotheses, "assess_fit")],
    "energy": [(BodyEnergy, "measure")],
}
"""Functions of each stage of a tracked cloud."""
SEARCH: dict[str, list[tuple[Any, str]]] = {
    "grid of the search": [(data_term, "fill_nearest")],
    "Levenberg-Marquardt moves": [(dpmp, "levenberg_marquardt")],
    "proposals": [(BodyParticleSearch, "_propose")],
    "data costs": [(BodyParticleSearch, "_improve")],
    "stitching and messages": [(BodyParticleSearch, "_solve")],
    "selection": [(BodyParticleSearch, "_select")],
    "limbs searched again": [(LimbSearch, "run")],
    "hands": [(fitting, "refine_hand_pose")],
    "surface beyond the model": [(BodyFitter, "_refine_nonrigid")],
    "hypotheses": [(hypotheses.BodyHypotheses, "evaluate")],
}
"""Functions of each stage of a whole fit, besides the search for nearest points and Gauss-Newton."""
ONE_SIDED_SEARCH: dict[str, list[tuple[Any, str]]] = REFINEMENT | {
    "bank of poses": [(PoseBank, "find_best")],
    "limbs sampled again": [(SingleViewSearch, "_resample_limbs")],
}
"""Functions of each stage of a fit to one side."""


@contextmanager
def measure_stages(stages: dict[str, list[tuple[Any, str]]]) -> Iterator[dict[str, float]]:
    """Measure processor seconds by stage, in one thread, until the end of the block."""
    spent: dict[str, float] = defaultdict(float)
    inner: list[float] = [0.0]
    originals = [(owner, name, getattr(owner, name)) for functions in stages.values() for owner, name in functions]

    def wrap(stage: str, work: Callable[..., Any]) -> Callable[..., Any]:
        def measured(*arguments: Any, **named: Any) -> Any:
            inner.append(0.0)
            started = time.process_time()
            try:
                return work(*arguments, **named)
            finally:
                passed = time.process_time() - started
                spent[stage] += passed - inner.pop()
                inner[-1] += passed

        return measured

    for stage, functions in stages.items():
        for owner, name in functions:
            setattr(owner, name, wrap(stage, getattr(owner, name)))
    started = time.process_time()
    try:
        with one_blas_thread():
            yield spent
        spent[REST] = time.process_time() - started - inner[0]
    finally:
        for owner, name, original in originals:
            setattr(owner, name, original)


def make_rows(path: str, runs: list[dict[str, float]]) -> list[Row]:
    """Return the median milliseconds of each stage over some runs, the longest first, and their share of the sum."""
    stages = {stage: 1000 * float(np.median([run.get(stage, 0.0) for run in runs])) for run in runs for stage in run}
    total = sum(stages.values())
    order = sorted(stages.items(), key=lambda pair: -pair[1])
    return [
        {"path": path, "stage": stage, "milliseconds": spent, "percent": 100 * spent / total} for stage, spent in order
    ]
