# SPDX-License-Identifier: Apache-2.0
"""Limbs of capsule men that are in a wrong place, found by the joints of a puppet and hung anew."""

from dataclasses import replace

import numpy as np
import pytest
from capsule_man import joints_of  # type: ignore[import-not-found]
from watched_people import find_puppet, make_colour_camera, stand_at, watch  # type: ignore[import-not-found]

from flowing_puppet_ros.body.fit.fitter import BodyFitter
from flowing_puppet_ros.body.settings import FitterSettings
from flowing_puppet_ros.fusion.limb_depths import DepthChoices
from flowing_puppet_ros.fusion.people_fitter import FusionSettings, PeopleFitter, make_person
from flowing_puppet_ros.model import rotation
from flowing_puppet_ros.model.sp import StitchedPuppet

pytestmark = pytest.mark.slow


def test_an_arm_in_a_wrong_place_is_noticed_and_found(model: StitchedPuppet) -> None:
    people = PeopleFitter(BodyFitter(model, FitterSettings()), FusionSettings())
    fitter, person = people.joint_fitter, stand_at(joints_of(), 2.5, 0.0)
    seen, camera = watch([person]), make_colour_camera(0.0)
    cloud = seen.seen_by(camera)
    clear, floor = people.find_clear(cloud.points)
    (claim,), _ = people.claim(cloud, [find_puppet(model, person, camera, "a0", 2.0, 0)], clear)
    points = make_person(cloud, seen.image, claim.own, floor, 0)
    good = people.fit_claim(claim, points)
    assert good is not None
    assert fitter.limbs.find_lost(good.state, claim.joints) == []
    # The whole left arm is turned up about the shoulder, by 70 degrees in the image.
    number = next(n for n in range(4) if model.tree.index("left_hand") in fitter.limbs.list_parts(n))
    parts = [part for part in fitter.limbs.list_parts(number) if "shoulder" not in model.tree.names[part]]
    pivot, turn = good.joints[model.joint_names.index("left_shoulder")], rotation.exp(np.array([1.2, 0.0, 0.0]))
    center, turned = good.state.center.copy(), good.state.rotation.copy()
    center[parts] = pivot + (center[parts] - pivot) @ turn.T
    turned[parts] = turn @ turned[parts]
    wrong = replace(good.state, center=center, rotation=turned)
    wrist = model.joint_names.index("left_wrist")
    assert np.linalg.norm(model.joints(model.vertices(wrong))[wrist] - person.joints["left_wrist"]) > 0.3
    assert fitter.limbs.find_lost(wrong, claim.joints) == [number]
    # Pointed back to its joints, bone by bone, without a look at the cloud; the other limbs stay where they are.
    assert fitter.limbs.find_strayed(good.state, claim.joints) == []
    assert fitter.limbs.find_strayed(wrong, claim.joints) == [number]
    pointed = fitter.limbs.point(wrong, claim.joints, [number])
    back = model.joints(model.vertices(pointed))
    assert np.linalg.norm(back[wrist] - person.joints["left_wrist"]) < 0.1
    others = [part for part in range(len(model.tree)) if part not in fitter.limbs.list_parts(number)]
    np.testing.assert_allclose(pointed.center[others], wrong.center[others])
    # The wrist is lifted onto where the body has it, though the body leaves out another surface at its pixel.
    single = fitter.make_cloud(points.points, points.field)
    wrong_fit, place = fitter.fitter.assess(wrong, single), claim.joints.points.copy()
    place[wrist] = wrong_fit.joints[wrist]
    both = DepthChoices(
        np.stack([place[wrist], claim.joints.points[wrist]]), np.zeros(2), np.zeros(2), np.ones(2, dtype=bool)
    )
    mistaken = replace(claim.joints, points=place, choices={**claim.joints.choices, wrist: both})
    lifted = fitter.limbs.lift_left_out(wrong_fit, points.points, mistaken)
    np.testing.assert_array_equal(lifted.points[wrist], claim.joints.points[wrist])
    same = fitter.limbs.lift_left_out(good, points.points, claim.joints)
    np.testing.assert_array_equal(same.points, claim.joints.points)
    found = fitter.hang_anew(single, wrong, claim.joints, [number])
    assert found is not None
    assert np.linalg.norm(found.joints[wrist] - person.joints["left_wrist"]) < 0.07
