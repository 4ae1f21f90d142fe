# SPDX-License-Identifier: Apache-2.0
"""Joints of puppets and detectors in the body model's order, and puppets between two images."""

import numpy as np
import pytest

from flowing_puppet_ros.fusion.puppet_joints import PuppetJoints, carry_puppets, place_joints
from flowing_puppet_ros.image.formats.skeletons import COCO_17
from flowing_puppet_ros.model.sp import StitchedPuppet


def put(model: StitchedPuppet, identity: str, x: float) -> PuppetJoints:
    """Return a puppet all of whose joints are at (x, 50) px."""
    count = len(model.joint_names)
    return PuppetJoints(identity, np.tile([x, 50.0], (count, 1)), np.ones(count), np.zeros(count, dtype=bool))


def test_a_puppets_own_joints_are_taken_by_name_and_ankles_lie_lower(model: StitchedPuppet) -> None:
    names = ["belly", "neck", "left_knee", "left_ankle", "right_wrist"]
    pixels = np.array([[100, 200], [100, 100], [110, 300], [110, 400], [50, 210.0]])
    made = place_joints(model, "a1", names, pixels, np.array([0.9, 0.8, 0.7, 0.6, 0.5]), ["right_wrist"])
    assert made is not None
    row = model.joint_names.index
    np.testing.assert_allclose(made.pixels[row("neck")], [100, 100])
    np.testing.assert_allclose(made.pixels[row("left_ankle")], [110, 410])  # a tenth of the shank beyond
    assert made.confidence[row("right_wrist")] == 0.5
    assert made.hidden[row("right_wrist")]
    assert made.hidden.sum() == 1
    assert not made.known[row("right_knee")]
    assert made.confidence[row("right_knee")] == 0


def test_a_detectors_trunk_is_completed(model: StitchedPuppet) -> None:
    pixels = np.full((17, 2), np.nan)
    for name, place in {
        "left_shoulder": (140, 100), "right_shoulder": (60, 100), "left_hip": (120, 200), "right_hip": (80, 200),
        "left_ear": (110, 60), "right_ear": (90, 60),
    }.items():  # fmt: skip
        pixels[COCO_17.index(name)] = place
    made = place_joints(model, "", COCO_17, pixels, np.ones(17))
    assert made is not None
    row = model.joint_names.index
    assert 100 < made.pixels[row("belly")][1] < 200
    np.testing.assert_allclose(made.pixels[row("face")], [100, 60])


@pytest.mark.parametrize(("names", "value"), [((), 1.0), (("left_wrist",), 1.0), (COCO_17, np.nan)])
def test_too_few_joints_are_no_person(model: StitchedPuppet, names: tuple[str, ...], value: float) -> None:
    assert place_joints(model, "a1", names, np.full((len(names), 2), value), np.ones(len(names))) is None


def test_sides_swap_in_pairs(model: StitchedPuppet) -> None:
    puppet = put(model, "a1", 0.0)
    puppet.pixels[:, 0] = np.arange(len(model.joint_names))
    swapped = puppet.swap_sides(model)
    for index, name in enumerate(model.joint_names):
        other = name.replace("left", "?").replace("right", "left").replace("?", "right")
        assert swapped.pixels[index, 0] == model.joint_names.index(other)


def test_joints_move_evenly_between_images_and_whoever_came_or_left_is_where_the_nearer_image_has_them(
    model: StitchedPuppet,
) -> None:
    earlier, later = [put(model, "a1", 10.0), put(model, "left", 5.0)], [put(model, "a1", 20.0), put(model, "new", 7.0)]
    at_quarter = {puppet.id: puppet.pixels[0, 0] for puppet in carry_puppets(earlier, later, 0.25)}
    assert at_quarter == {"a1": 12.5, "left": 5.0}
    assert {puppet.id for puppet in carry_puppets(earlier, later, 0.75)} == {"a1", "new"}


def test_a_joint_that_one_image_lacks_stays_where_the_other_has_it(model: StitchedPuppet) -> None:
    earlier, later = put(model, "a1", 10.0), put(model, "a1", 20.0)
    earlier.pixels[3] = np.nan
    (carried,) = carry_puppets([earlier], [later], 0.6)
    assert carried.pixels[3, 0] == 20.0
    assert carried.pixels[4, 0] == pytest.approx(16.0)
