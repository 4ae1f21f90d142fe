# SPDX-License-Identifier: Apache-2.0
"""The shipped 2D puppets: anatomy, symmetries, and the poses they infer from joints written down by hand."""

import cv2
import numpy as np
import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.model.ds.joints import part_tree
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.render import depth_order, render_labels
from flowing_puppet_ros.model.ds.shape import View
from flowing_puppet_ros.model.tree import mirrored_name

MODELS = [(gender, parts) for gender in ("neutral", "female", "male") for parts in (10, 14)]

# A person of 1.7 m who waves with the right arm and folds the left one in front of the belly; 200 px/m.
STANDING = {
    "neck": (300, 100), "belly": (300, 192), "face": (300, 72),
    "right_shoulder": (265, 119), "left_shoulder": (335, 119), "right_hip": (278, 210), "left_hip": (322, 210),
    "right_elbow": (222, 92), "left_elbow": (350, 170), "right_wrist": (215, 42), "left_wrist": (305, 178),
    "right_knee": (272, 288), "left_knee": (328, 288), "right_ankle": (268, 372), "left_ankle": (332, 372),
    "right_hand": (213, 25), "left_hand": (287, 180), "right_foot": (262, 384), "left_foot": (338, 384),
}  # fmt: skip
SCALE = 200.0


@pytest.fixture(scope="module", params=MODELS, ids=lambda pair: f"{pair[0]}-{pair[1]}")
def model(request: pytest.FixtureRequest) -> DeformableStructures:
    return DeformableStructures.load(*request.param)


@pytest.fixture(scope="module")
def neutral() -> DeformableStructures:
    return DeformableStructures.load("neutral", 10)


def standing(model: DeformableStructures) -> np.ndarray:
    return np.array([STANDING[name] for name in model.joint_names], float)


def signed_distance(contour: np.ndarray, point: np.ndarray) -> float:
    """Distance from a point to a contour, positive inside."""
    x, y = (float(value) for value in point)
    return cv2.pointPolygonTest(np.asarray(contour, np.float32)[:, None], (x, y), True)


def overlap(first: np.ndarray, second: np.ndarray) -> float:
    """Intersection over union of two filled contours in a 640 x 480 image."""
    a, b = (render_labels([contour], (0,), (480, 640)) > 0 for contour in (first, second))
    return float((a & b).sum() / (a | b).sum())


def test_structure(model: DeformableStructures) -> None:
    assert len(model.tree) == len(model.shapes) == len(model.part_joints) == len(model.pairwise) + 1
    assert model.name == f"{model.gender}-{len(model.tree)}"
    assert len(model.joint_names) == {10: 15, 14: 19}[len(model.tree)]
    for parent, child in model.tree.edges:
        assert model.part_joints[child][0] in model.part_joints[parent]
    assert model.bone.shape == (len(model.tree), 2)


def test_left_and_right_are_mirror_images(model: DeformableStructures) -> None:
    for shape, other in zip(model.shapes, model.tree.mirror, strict=True):
        length = np.ptp(shape.mean[-shape.joint_count :, 0])
        contour, opposite = model.shapes[other].mean, shape.mean * [1, -1]
        for part in (contour, opposite):
            assert np.ptp(part[:, 0]) >= length
        scaled = [300 + 400 * part[: -shape.joint_count] for part in (contour, opposite)]
        assert overlap(*scaled) > 0.97
    mean = dict(zip(model.joint_names, model.mean_joints(), strict=True))
    for name, (x, y) in mean.items():
        assert mean[mirrored_name(name)] == pytest.approx((-x, y), abs=0.01)


def test_mean_puppet_has_human_proportions(model: DeformableStructures) -> None:
    joint = dict(zip(model.joint_names, model.mean_joints(), strict=True))
    assert joint["left_shoulder"][0] > 0.1 and joint["right_shoulder"][0] < -0.1
    assert joint["face"][1] < joint["neck"][1] < joint["belly"][1] < joint["left_hip"][1] < joint["left_knee"][1]
    assert 1.1 < joint["left_ankle"][1] - joint["neck"][1] < 1.5
    assert 0.25 < np.linalg.norm(joint["left_knee"] - joint["left_hip"]) < 0.5


@pytest.mark.slow
def test_samples_hold_together(model: DeformableStructures) -> None:
    rng = np.random.default_rng(5)
    for _ in range(40):
        puppet = model.sample(rng)
        for contour, joints in zip(puppet.contours, model.part_joints, strict=True):
            assert signed_distance(contour, puppet.joints[joints[0]]) > -0.04
            drawn = render_labels([500 * (contour - contour.min(axis=0))], (0,), (1000, 1000))
            assert (drawn > 0).sum() / 500**2 > 0.0015
        order = depth_order(model)
        labels = render_labels([400 + 150 * contour for contour in puppet.contours], order, (900, 900))
        assert cv2.connectedComponents((labels > 0).astype(np.uint8))[0] == 2


def test_samples_repeat_with_the_seed_and_vary_without(neutral: DeformableStructures) -> None:
    first, again, other = (neutral.sample(np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(np.vstack(first.contours), np.vstack(again.contours))
    assert abs(first.joints - other.joints).max() > 0.05


def test_puppet_stands_on_the_given_joints(model: DeformableStructures) -> None:
    joints = standing(model)
    puppet = model.puppet_from_joints(joints, SCALE)
    np.testing.assert_array_equal(puppet.joints, joints)
    for name, contour, own in zip(model.tree.names, puppet.contours, model.part_joints, strict=True):
        for joint in own:
            assert signed_distance(contour, joints[joint]) > -4, (name, model.joint_names[joint])
        length = np.linalg.norm(joints[own[1]] - joints[own[0]])
        inflated = length + 0.35 * SCALE
        assert max(np.linalg.norm(np.ptp(contour, axis=0)), 1) < 1.5 * inflated, name


def test_labels_of_a_waving_person(model: DeformableStructures) -> None:
    puppet = model.puppet_from_joints(standing(model), SCALE)
    labels = render_labels(puppet.contours, depth_order(model, "front"), (480, 640))

    def part_at(x: int, y: int) -> str:
        return ("background", *model.tree.names)[labels[y, x]]

    assert part_at(218, 67) == "right_lower_arm"
    assert part_at(330, 174) == "left_lower_arm", "the folded arm is in front of the torso"
    assert part_at(300, 150) == "torso"
    assert part_at(300, 65) == "head"
    assert part_at(330, 330) == "left_lower_leg"
    assert part_at(218, 130) == part_at(420, 150) == "background"


def test_puppet_moves_with_its_joints(neutral: DeformableStructures) -> None:
    joints = standing(neutral)
    puppet = neutral.puppet_from_joints(joints, SCALE)
    doubled = neutral.puppet_from_joints(2 * joints + [30, -700], 2 * SCALE)
    for contour, other in zip(puppet.contours, doubled.contours, strict=True):
        np.testing.assert_allclose(other, 2 * contour + [30, -700], atol=1e-6)


def test_puppet_from_behind_is_the_mirror_image(neutral: DeformableStructures) -> None:
    joints = standing(neutral)
    front = neutral.puppet_from_joints(joints, SCALE, "front")
    back = neutral.puppet_from_joints(joints * [-1, 1], SCALE, "back")
    for contour, other in zip(front.contours, back.contours, strict=True):
        np.testing.assert_allclose(other, contour * [-1, 1], atol=1e-9)


def test_shape_follows_the_pose(neutral: DeformableStructures) -> None:
    straight, bent = standing(neutral), standing(neutral)
    wrist, elbow, shoulder = (neutral.joint_names.index(f"left_{name}") for name in ("wrist", "elbow", "shoulder"))
    straight[wrist] = 2 * straight[elbow] - straight[shoulder]
    arm = neutral.tree.index("left_upper_arm")
    shapes = [neutral.puppet_from_joints(joints, SCALE).contours[arm] for joints in (straight, bent)]
    assert 0.5 < overlap(*shapes) < 0.995


@pytest.mark.parametrize("kind", ["coincident", "long", "profile"])
def test_unlikely_joints_give_finite_puppets(neutral: DeformableStructures, kind: str) -> None:
    joints = standing(neutral)
    wrist, elbow = (neutral.joint_names.index(name) for name in ("left_wrist", "left_elbow"))
    if kind == "coincident":
        joints[wrist] = joints[elbow]
    elif kind == "long":
        joints[wrist] = joints[elbow] + [300, 0]
    else:
        joints[:, 0] = 300
    puppet = neutral.puppet_from_joints(joints, SCALE)
    for contour in puppet.contours:
        assert np.isfinite(contour).all()
        assert cv2.contourArea(np.asarray(contour, np.float32)) > 100
    everything = np.vstack(puppet.contours)
    assert (everything.min(axis=0) > joints.min(axis=0) - 150).all()
    assert (everything.max(axis=0) < joints.max(axis=0) + 150).all()


def test_scale_of_a_person_with_foreshortened_limbs(model: DeformableStructures) -> None:
    joints, sure = standing(model), np.ones(len(model.joint_names))
    scale = model.estimate_scale(joints, sure)
    assert scale == pytest.approx(SCALE, rel=0.12)
    assert model.estimate_scale(3.7 * joints + 11, sure) == pytest.approx(3.7 * scale)
    pointing = joints.copy()
    for name in ("left_wrist", "left_elbow"):
        pointing[model.joint_names.index(name)] = joints[model.joint_names.index("left_shoulder")] + 1
    assert model.estimate_scale(pointing, sure) == pytest.approx(scale, rel=0.05)
    upper = np.array([not name.endswith(("knee", "ankle", "foot")) for name in model.joint_names])
    assert model.estimate_scale(np.where(upper[:, None], joints, np.nan), sure) == pytest.approx(scale, rel=0.1)


def test_view_is_estimated_from_the_sides(model: DeformableStructures) -> None:
    joints, sure = standing(model), np.ones(len(model.joint_names))
    assert model.estimate_view(joints, sure) == "front"
    assert model.estimate_view(joints * [-1, 1], sure) == "back"
    assert model.estimate_view(np.full_like(joints, np.nan), sure) == "front"


@pytest.mark.parametrize("view", ["front", "back"])
@pytest.mark.parametrize(
    ("hidden", "within"),
    [("face", 0.06), ("belly", 0.06), ("left_hip", 0.06), ("right_knee", 0.15), ("left_wrist", 0.5)],
)
def test_hidden_joints_are_put_near_their_place(
    neutral: DeformableStructures, hidden: str, within: float, view: View
) -> None:
    joints = standing(neutral) * ([1, 1] if view == "front" else [-1, 1])
    index = neutral.joint_names.index(hidden)
    gap = joints.copy()
    gap[index] = np.nan
    filled = neutral.complete_joints(gap, np.ones(len(gap)), SCALE, view)
    np.testing.assert_array_equal(np.delete(filled, index, axis=0), np.delete(joints, index, axis=0))
    assert np.linalg.norm(filled[index] - joints[index]) < within * SCALE


def test_completed_legs_hang_below_an_upper_body(model: DeformableStructures) -> None:
    joints, confidence = standing(model), np.ones(len(model.joint_names))
    legs = np.array([name.endswith(("hip", "knee", "ankle", "foot")) for name in model.joint_names])
    confidence[legs] = 0.0
    filled = model.complete_joints(joints, confidence, SCALE)
    assert np.linalg.norm(filled[legs] - joints[legs], axis=1).max() < 0.3 * SCALE


@pytest.mark.parametrize("view", ["front", "back"])
@pytest.mark.parametrize("degrees", range(0, 360, 45))
def test_a_hidden_hand_extends_the_forearm_wherever_it_points(view: View, degrees: int) -> None:
    model = DeformableStructures.load("neutral", 14)
    side = np.array([1.0 if view == "front" else -1.0, 1.0])
    joints, index = standing(model) * side, {name: k for k, name in enumerate(model.joint_names)}
    reach = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
    joints[index["left_wrist"]] = joints[index["left_elbow"]] + 0.2 * SCALE * reach
    joints[index["left_hand"]] = np.nan
    hand = model.complete_joints(joints, np.ones(len(joints)), SCALE, view)[index["left_hand"]]
    assert np.linalg.norm(hand - joints[index["left_wrist"]] - 0.08 * SCALE * reach) < 0.02 * SCALE


def test_uncertain_joints_pull_less(neutral: DeformableStructures) -> None:
    joints, index = standing(neutral), {name: k for k, name in enumerate(neutral.joint_names)}
    joints[index["left_hip"]] = np.nan
    wrong = joints.copy()
    wrong[index["right_hip"]] += [0, 60]
    confidence = np.ones(len(joints))
    true = neutral.complete_joints(joints, confidence, SCALE)[index["left_hip"]]
    trusting = neutral.complete_joints(wrong, confidence, SCALE)[index["left_hip"]]
    confidence[index["right_hip"]] = 0.05
    wary = neutral.complete_joints(wrong, confidence, SCALE)[index["left_hip"]]
    assert np.linalg.norm(wary - true) < 0.5 * np.linalg.norm(trusting - true)


def test_energy_is_that_of_the_pose_alone(model: DeformableStructures) -> None:
    joints = standing(model)
    energy = model.energy(model.puppet_from_joints(joints, SCALE))
    assert model.energy(model.puppet_from_joints(2 * joints + 50, 2 * SCALE)) == pytest.approx(energy)
    assert model.energy(model.puppet_from_joints(joints * [-1, 1], SCALE, "back")) == pytest.approx(energy)


@pytest.mark.parametrize(
    ("joint", "place"), [("left_knee", (328, 130)), ("face", (300, 130)), ("right_wrist", (50, 92))]
)
def test_impossible_poses_have_more_energy(model: DeformableStructures, joint: str, place: tuple[int, int]) -> None:
    joints = standing(model)
    energy = model.energy(model.puppet_from_joints(joints, SCALE))
    joints[model.joint_names.index(joint)] = place
    assert model.energy(model.puppet_from_joints(joints, SCALE)) > energy + 10


def test_arrays_round_trip(neutral: DeformableStructures) -> None:
    again = DeformableStructures.from_arrays("neutral", 10, neutral.to_arrays())
    joints = standing(neutral)
    first, second = (model.puppet_from_joints(joints, SCALE) for model in (neutral, again))
    np.testing.assert_array_equal(np.vstack(first.contours), np.vstack(second.contours))


def test_bad_input_is_refused_in_one_sentence(neutral: DeformableStructures) -> None:
    joints, sure = standing(neutral), np.ones(15)
    with pytest.raises(InputError, match=r"needs \(15, 2\)"):
        neutral.puppet_from_joints(joints[:5], SCALE)
    with pytest.raises(InputError, match="scale of a puppet is nan"):
        neutral.puppet_from_joints(joints, float("nan"))
    with pytest.raises(InputError, match="no joint of the person is known"):
        neutral.complete_joints(joints, np.zeros(15), SCALE)
    with pytest.raises(InputError, match="at least two connected joints"):
        neutral.estimate_scale(np.full((15, 2), np.nan), sure)
    joints[4] = np.nan
    with pytest.raises(InputError, match="left_shoulder is unknown"):
        neutral.puppet_from_joints(joints, SCALE)
    with pytest.raises(InputError, match="no ds model called 'child-10'"):
        DeformableStructures.load("child", 10)
    with pytest.raises(InputError, match="no puppet of 12 parts"):
        part_tree(12)
