# SPDX-License-Identifier: Apache-2.0
"""Limbs that were put in wrong places on the cloud of a man made of capsules, and come back."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from capsule_man import Joints, cloud_of, joints_of  # type: ignore[import-not-found]

from flowing_puppet_ros.body.cloud.correspondence import Cloud
from flowing_puppet_ros.body.fit.fitter import BodyFitter
from flowing_puppet_ros.body.fit.hypotheses import BodyCandidate, BodyHypotheses
from flowing_puppet_ros.body.fit.quality import assess_fit
from flowing_puppet_ros.body.search.limb_search import limb_groups
from flowing_puppet_ros.body.settings import FitterSettings
from flowing_puppet_ros.evidence.cloud.data_term import CloudGrid
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet


@pytest.fixture(scope="module")
def hypotheses(model: StitchedPuppet) -> BodyHypotheses:
    return BodyHypotheses(model, FitterSettings(max_limb_repairs=2))


@pytest.fixture(scope="module")
def joints() -> Joints:
    return joints_of(raise_left=0.9)


@pytest.fixture(scope="module")
def cloud(joints: Joints) -> Cloud:
    return Cloud.of(*cloud_of(joints, 4000))


@pytest.fixture(scope="module")
def body(model: StitchedPuppet, joints: Joints, cloud: Cloud) -> BodyState:
    initial = {name: (float(x), float(y), float(z), 1.0) for name, (x, y, z) in joints.items()}
    small = FitterSettings(local_particles=8, local_iterations=4)
    return BodyFitter(model, small).fit(cloud.points, cloud.normals, initial=initial).state


def placed_like(model: StitchedPuppet, body: BodyState, side: str, other: str, names: tuple[str, ...]) -> BodyState:
    """The body with one side's limb in the place of the other's."""
    own, places = ([model.tree.index(f"{s}_{name}") for name in names] for s in (side, other))
    center, rotation = body.center.copy(), body.rotation.copy()
    center[own], rotation[own] = center[places], rotation[places]
    return replace(body, center=center, rotation=rotation)


def off(model: StitchedPuppet, body: BodyState, joints: Joints, names: tuple[str, ...]) -> float:
    found = dict(zip(model.joint_names, model.joints(model.vertices(body)), strict=True))
    return max(float(np.linalg.norm(found[name] - joints[name])) for name in names)


@pytest.mark.slow
def test_two_legs_on_one_come_apart(
    model: StitchedPuppet, hypotheses: BodyHypotheses, joints: Joints, cloud: Cloud, body: BodyState
) -> None:
    wrong = placed_like(model, body, "right", "left", ("upper_leg", "lower_leg", "foot"))
    names = ("right_knee", "right_ankle", "left_knee", "left_ankle")
    assert off(model, wrong, joints, names) > 0.2
    start = hypotheses.evaluate(wrong, cloud)
    assert start.quality.limb_suspect
    grid = CloudGrid.build(cloud.points, cloud.normals)
    repaired = hypotheses.repair_limbs(start, cloud, grid, np.random.default_rng(0))
    assert off(model, repaired.state, joints, names) < 0.1
    assert repaired.cost < 0.7 * start.cost


def test_an_arm_is_found_in_what_the_rest_leaves_and_the_rest_stays(
    model: StitchedPuppet, hypotheses: BodyHypotheses, joints: Joints, cloud: Cloud, body: BodyState
) -> None:
    arm = limb_groups(model.tree)[2]
    assert [model.tree.names[part] for part in arm] == [
        "left_shoulder", "left_upper_arm", "left_lower_arm", "left_hand"
    ]  # fmt: skip
    center = body.center.copy()
    center[list(arm[1:])] += [0.0, 0.1, 0.5]
    wrong = replace(body, center=center)
    grid = CloudGrid.build(cloud.points, cloud.normals)
    found = hypotheses.limb_search.run(wrong, arm, cloud, grid, np.random.default_rng(0))
    assert found is not None
    assert off(model, found, joints, ("left_elbow", "left_wrist")) < 0.12 < off(model, wrong, joints, ("left_wrist",))
    others = np.setdiff1d(np.arange(16), arm)
    np.testing.assert_array_equal(found.center[others], wrong.center[others])
    np.testing.assert_array_equal(found.rotation[others], wrong.rotation[others])


@pytest.mark.slow
def test_no_limb_is_sought_where_nothing_is_left(
    model: StitchedPuppet, hypotheses: BodyHypotheses, cloud: Cloud, body: BodyState
) -> None:
    arm = limb_groups(model.tree)[2]
    rest = model.vertices(body)[~np.isin(model.part_of_vertex, arm)]
    near = np.linalg.norm(cloud.points[:, None] - rest, axis=2).min(axis=1) < 0.03
    armless = Cloud.of(cloud.points[near], cloud.normals[near])
    grid = CloudGrid.build(armless.points, armless.normals)
    assert hypotheses.limb_search.run(body, arm, armless, grid, np.random.default_rng(0)) is None


def test_a_body_without_fault_stays_as_it_is(
    model: StitchedPuppet, hypotheses: BodyHypotheses, cloud: Cloud, body: BodyState
) -> None:
    vertices = model.vertices(body)
    own = Cloud.of(vertices, np.zeros_like(vertices))
    candidate = replace(hypotheses.evaluate(body, cloud), quality=assess_fit(model, vertices, own))
    candidate = replace(candidate, quality=replace(candidate.quality, part_confidence=np.ones(16)))
    grid = CloudGrid.build(cloud.points, cloud.normals)
    assert hypotheses.repair_limbs(candidate, cloud, grid, np.random.default_rng(0)) is candidate


def test_groups_hold_every_limb_from_the_trunk_outwards(model: StitchedPuppet) -> None:
    groups = limb_groups(model.tree)
    assert [len(group) for group in groups] == [3, 3, 4, 4, 6, 8, 14]
    for group in groups:
        for at, part in enumerate(group):
            assert model.tree.parents[part] in (0, *group[:at])
    assert set(groups[-1]) == set(range(2, 16))


@dataclass
class FoundQuality:
    """What a search asks a quality for."""

    cost: float
    reliable: bool = True


@pytest.mark.parametrize(
    ("first", "second", "repaired_second", "chosen"),
    [
        (0.0135, 0.0161, 0.008, 1),  # may face the other way: both are repaired, and the closer one is taken
        (0.0135, 0.0200, 0.008, 0),  # clearly not
        (0.0060, 0.0061, 0.001, 0),  # close enough
    ],
)
def test_a_body_that_may_face_the_other_way_is_compared_with_that_one_repaired(
    model: StitchedPuppet,
    cloud: Cloud,
    monkeypatch: pytest.MonkeyPatch,
    first: float,
    second: float,
    repaired_second: float,
    chosen: int,
) -> None:
    states = [model.rest_state(), model.rest_state()]
    repaired = {id(states[0]): first, id(states[1]): repaired_second}

    def candidate(state: BodyState, cost: float) -> BodyCandidate:
        quality: Any = FoundQuality(cost)
        return BodyCandidate(state, quality)

    found = [candidate(states[0], first), candidate(states[1], second)]
    own = BodyHypotheses(model, FitterSettings())
    monkeypatch.setattr(own, "_search_both_headings", lambda *_: found)
    monkeypatch.setattr(own, "repair_limbs", lambda body, *_: candidate(body.state, repaired[id(body.state)]))
    monkeypatch.setattr(own, "refine", lambda state, *_: state)
    assert own.search(cloud, np.random.default_rng(0), lambda _: None)[0] is states[chosen]
