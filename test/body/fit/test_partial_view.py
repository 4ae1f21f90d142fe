# SPDX-License-Identifier: Apache-2.0
"""Bodies of which the sensor could see a part only: a man of capsules cut off by the border of the image."""

import numpy as np
import pytest
from capsule_man import cloud_of, joints_of  # type: ignore[import-not-found]

from flowing_puppet_ros.body.cloud.correspondence import TwoWayCorrespondence, two_way_distance
from flowing_puppet_ros.body.cloud.mesh_geometry import vertex_normals
from flowing_puppet_ros.body.cloud.single_view import SingleViewCloud
from flowing_puppet_ros.body.fit.fitter import BodyFitter
from flowing_puppet_ros.body.fit.partial_view import measure_unknown_share, strengthen_priors
from flowing_puppet_ros.body.fit.pose_bank import CoarseCloud, PoseBank
from flowing_puppet_ros.body.fit.quality import assess_fit
from flowing_puppet_ros.body.fit.visibility import Visibility
from flowing_puppet_ros.body.refine.gauss_newton import RefineWeights
from flowing_puppet_ros.body.search.part_points import build_part_points
from flowing_puppet_ros.body.settings import FitterSettings
from flowing_puppet_ros.evidence.cloud.sensor_field import PINHOLE, SensorField, SensorProjection
from flowing_puppet_ros.model.sp import StitchedPuppet

SENSOR = np.array([3.0, 0.0, 0.3])
AXES = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
"""Right, down and forward of a camera that looks along -x at a man who faces it."""
CUT = -0.3  # above the knees
OPEN = np.array([-np.inf, -np.inf, np.inf, np.inf])


@pytest.fixture(scope="module")
def fitter() -> BodyFitter:
    return BodyFitter(StitchedPuppet.load("neutral"), FitterSettings(threads=1))


def ends_at(height: float, top: float = np.inf) -> SensorField:
    """The field of a camera whose image, 3 m away, ends at a height in metres, and at the top."""
    bounds = np.array([-np.inf, (SENSOR[2] - top) * 100 if np.isfinite(top) else -np.inf, np.inf, np.inf])
    bounds[3] = (SENSOR[2] - height) / 3.0 * 300
    return SensorField(
        SensorProjection(SENSOR, AXES, np.full(2, 300.0), np.zeros(2), PINHOLE), bounds, np.zeros((0, 0), np.float32)
    )


def front(low: float) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    joints = joints_of(raise_left=0.5, bend=0.2)
    points, normals = cloud_of(joints, 6000)
    seen = ((SENSOR - points) * normals).sum(axis=1) > 0
    return points[seen & ~ends_at(low).find_unknown(points)], joints


def leg_of(joints: dict[str, np.ndarray]) -> float:
    """Metres from the left hip over the knee to the ankle."""
    hip, knee, ankle = (joints[f"left_{name}"] for name in ("hip", "knee", "ankle"))
    return float(np.linalg.norm(hip - knee) + np.linalg.norm(knee - ankle))


@pytest.mark.slow
def test_a_man_cut_off_above_the_knees_keeps_his_legs(fitter: BodyFitter) -> None:
    points, joints = front(CUT)
    upper = {name: (*place, 0.8) for name, place in joints.items() if place[2] > CUT}
    assert "left_hip" in upper and "left_knee" not in upper
    names, found = fitter.model.joint_names, {}
    for field in (ends_at(CUT), None):
        fit = fitter.fit(points, None, viewpoint=SENSOR, initial=upper, field=field)
        found[field is not None] = fit, dict(zip(names, fit.joints, strict=True))
    fit, placed = found[True]
    assert abs(leg_of(placed) - leg_of(joints)) < 0.08
    assert np.mean([np.linalg.norm(placed[name] - joints[name]) for name in upper]) < 0.05
    assert np.linalg.norm(placed["left_ankle"] - joints["left_ankle"]) < 0.2
    assert fit.reliable and fit.visibility is not None
    state = dict(zip(names, fit.visibility.joints, strict=True))
    assert state["left_ankle"] == state["right_toe"] == Visibility.INFERRED
    assert state["left_wrist"] == state["right_shoulder"] == Visibility.SEEN
    # Without the field the feet must be in the cloud, which ends above the knees.
    drawn = found[False][1]
    assert np.linalg.norm(drawn["left_ankle"] - joints["left_ankle"]) > 0.5
    assert found[False][0].confidence < fit.confidence - 0.1


def test_what_is_out_of_view_is_neither_drawn_nor_judged(fitter: BodyFitter) -> None:
    model = fitter.model
    vertices = model.vertices(model.rest_state())
    normals = vertex_normals(vertices, model.faces)
    knees = float(model.joints(vertices)[model.joint_names.index("left_knee"), 2])
    field = ends_at(knees)
    shown = ((SENSOR - vertices) * normals).sum(axis=1) > 0
    shown &= ~field.find_unknown(vertices)
    clouds = {
        limit: SingleViewCloud.seen_from(vertices[shown], normals[shown], SENSOR, field=limit)
        for limit in (field, None)
    }
    below = field.find_unknown(vertices)
    feet = np.isin(model.part_of_vertex, [model.tree.index("left_foot"), model.tree.index("right_foot")])
    assert below[feet].all() and 0.1 < below.mean() < 0.4
    assert measure_unknown_share(model, model.rest_state(), clouds[field]) == pytest.approx(below.mean())
    assert measure_unknown_share(model, model.rest_state(), clouds[None]) == 0
    for limit, drawn in ((field, False), (None, True)):
        cloud = clouds[limit]
        assert bool(cloud.free_space_term(vertices, 0.1).matrix[feet].any()) == drawn
        quality = assess_fit(model, vertices, cloud)
        assert bool(quality.seen[model.tree.index("left_foot")]) == drawn
        assert quality.reliable != drawn
    assert not clouds[field].sees(vertices, normals)[below].any()
    # From the cloud's side its lowest points may be matched to a vertex just below; nothing of the feet is drawn to it.
    attracted = TwoWayCorrespondence(clouds[field]).attract(vertices, model.faces, 0.1)
    assert not attracted.matrix[feet].any()
    assert two_way_distance(vertices, model.faces, clouds[field]) < 0.02
    assert two_way_distance(vertices, model.faces, clouds[None]) > 0.02


@pytest.mark.slow
def test_the_bank_lays_the_seen_part_of_a_body_on_a_partial_cloud(fitter: BodyFitter) -> None:
    bank = PoseBank(fitter.model, build_part_points(fitter.model))
    points, joints = front(0.0)
    normals = np.zeros_like(points)
    heads = {}
    for name, field in (("cut", ends_at(0.0)), ("whole", None)):
        cloud = SingleViewCloud.seen_from(points, normals, SENSOR, field=field)
        best = bank.find_best(CoarseCloud.of(cloud), 1)[0]
        heads[name] = fitter.model.joints(fitter.model.vertices(best))[fitter.model.joint_names.index("head_top"), 2]
    assert abs(heads["cut"] - joints["head_top"][2]) < 0.1
    # The middle of a whole body on that of the upper half: the head is far above the cloud.
    assert heads["whole"] > joints["head_top"][2] + 0.2


def test_priors_grow_with_what_is_out_of_sight() -> None:
    plain = RefineWeights()
    assert strengthen_priors(plain, 0.0) == plain
    half, most = strengthen_priors(plain, 0.4), strengthen_priors(plain, 0.9)
    assert (most.pose, most.pairwise, most.shape) == pytest.approx((1e-6, 1e-6, 2e-5))
    assert plain.pose < half.pose < most.pose and plain.shape < half.shape < most.shape
    strong = strengthen_priors(RefineWeights(pose=1e-3, shape=1e-3, pairwise=1e-3), 0.9)
    assert (strong.pose, strong.shape, strong.pairwise) == (1e-3, 1e-3, 1e-3)


@pytest.mark.slow
def test_a_field_in_which_all_is_known_changes_nothing(fitter: BodyFitter) -> None:
    points, _ = front(-2.0)
    everywhere = SensorField(
        SensorProjection(SENSOR, AXES, np.ones(2), np.zeros(2), PINHOLE), OPEN, np.zeros((0, 0), np.float32)
    )
    rough = [
        fitter.hypotheses.find_roughly(fitter.prepare_cloud(points, None, SENSOR, field), thorough=False)
        for field in (None, everywhere)
    ]
    assert rough[0].state.center.tobytes() == rough[1].state.center.tobytes()
