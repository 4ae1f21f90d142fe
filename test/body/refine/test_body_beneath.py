# SPDX-License-Identifier: Apache-2.0
"""Bodies beneath garments, against people whom no puppet model made and whose bodies are known."""

from importlib.util import find_spec

import numpy as np
import pytest

from flowing_puppet_ros.body.cloud.correspondence import Cloud
from flowing_puppet_ros.body.fit.fitter import BodyFitter
from flowing_puppet_ros.body.refine.body_beneath import BodyBeneath, measure_gaps, measure_part_gaps
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.body.settings import FitterSettings
from flowing_puppet_ros.evaluate.body.garments import Tailor
from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource, TrueBody
from flowing_puppet_ros.evaluate.body.synthetic_scans import RaycastScene, scan_whole
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet

LEARN = pytest.mark.skipif(not (find_spec("anny") and find_spec("body_models")), reason="needs the extra learn")


@pytest.fixture(scope="module")
def source() -> BodySource:
    return BodySource()


def stand(source: BodySource) -> TrueBody:
    return source.pose_person(source.draw_person(np.random.default_rng(3)), {}, np.eye(3))


def scan(fitter: BodyFitter, source: BodySource, outfit: tuple[str, ...]) -> Cloud:
    rng = np.random.default_rng(5)
    seen = scan_whole(RaycastScene(*Tailor(source).dress(stand(source), outfit, rng)), rng, 8000, noise=0.001)
    return fitter.prepare_cloud(seen.points, seen.normals, None)


def fit_to(fitter: BodyFitter, source: BodySource, cloud: Cloud) -> BodyState:
    """Return the closest body without regard to garments, from the true joints to spare the search."""
    body, names = stand(source), fitter.model.joint_names
    given = dict(zip(source.joint_names, body.joints.tolist(), strict=True))
    initial = {name: (*given[name], 1.0) for name in names}
    state = fitter.fit(cloud.points, cloud.normals, initial=initial).state
    return fitter.hypotheses.refine(state, cloud, JointTargets.none(fitter.model), 15)


@LEARN
@pytest.mark.slow
@pytest.mark.parametrize(
    ("outfit", "max_change"), [(("jacket", "wide trousers", "shoes"), -0.003), (("shirt", "skirt", "hair"), 0.003)]
)
def test_joints_move_from_the_garments_to_the_body(
    source: BodySource, outfit: tuple[str, ...], max_change: float
) -> None:
    """A skirt says nothing about the legs; what it leaves to choose must not make them worse."""
    fitter = BodyFitter(StitchedPuppet.load(), FitterSettings(clip_factor=0.0))
    model, body = fitter.model, stand(source)
    named = [list(source.joint_names).index(name) for name in model.joint_names]
    cloud = scan(fitter, source, outfit)
    plain = fit_to(fitter, source, cloud)
    beneath = BodyBeneath(model, fitter.gauss_newton).find(plain, cloud)
    before, after = (
        np.linalg.norm(model.joints(model.vertices(state)) - body.joints[named], axis=1).mean()
        for state in (plain, beneath)
    )
    assert after < 0.025 and after < before + max_change
    assert np.linalg.norm(model.vertices(beneath) - body.template_vertices(model.name), axis=1).mean() < 0.025
    assert np.ptp(beneath.shape, axis=0).max() == 0, "one shape"
    assert np.abs(beneath.shape).max() <= 3.5, "within human limits"
    # The surface follows the garments, which lie outside of the body.
    surface = fitter.assess_surface(plain, cloud).vertices
    gaps = dict(zip(model.tree.names, measure_part_gaps(model, model.vertices(beneath), surface), strict=True))
    assert gaps["torso"] > 0.006
    again = BodyBeneath(model, fitter.gauss_newton).find(plain, cloud)
    assert again.center.tobytes() == beneath.center.tobytes()


@LEARN
@pytest.mark.slow
def test_who_wears_nothing_stays_as_fitted(source: BodySource) -> None:
    fitter = BodyFitter(StitchedPuppet.load(), FitterSettings(clip_factor=0.0))
    cloud = scan(fitter, source, ())
    state = fit_to(fitter, source, cloud)
    assert BodyBeneath(fitter.model, fitter.gauss_newton).find(state, cloud) is state


def test_gaps_are_distances_outwards() -> None:
    model = StitchedPuppet.load()
    body = model.vertices(model.rest_state())
    middle = body.mean(axis=0)
    wider = middle + 1.1 * (body - middle)
    gaps = measure_gaps(model, body, wider)
    # By the divergence theorem, the mean over the surface of x . n is three times the volume over the area.
    a, b, c = (body[model.faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    volume, area = (np.cross(a, b) * c).sum() / 6, np.linalg.norm(cross, axis=1).sum() / 2
    share = np.zeros(len(body))
    for corner in range(3):
        np.add.at(share, model.faces[:, corner], np.linalg.norm(cross, axis=1) / 6)
    assert (gaps * share).sum() / area == pytest.approx(0.1 * 3 * volume / area, rel=0.05)
    parts = measure_part_gaps(model, body, wider)
    assert parts.shape == (16,)
    count = np.bincount(model.part_of_vertex)
    assert (parts * count).sum() / count.sum() == pytest.approx(gaps.mean())
