# SPDX-License-Identifier: Apache-2.0
"""Learning of the 2D puppet on people of cardboard, whose shape law is known, and on the Anny body if there is one."""

import argparse
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.learn.ds import command, fit, samples
from flowing_puppet_ros.learn.ds.multiview import fit_views
from flowing_puppet_ros.learn.ds.samples import Projection, RandomCamera, TrainingSet, collect
from flowing_puppet_ros.model.ds.energy import PairwiseEnergy
from flowing_puppet_ros.model.ds.joints import JOINT_NAMES, PART_JOINTS, part_tree
from flowing_puppet_ros.model.ds.multiview import MultiViewStructures
from flowing_puppet_ros.model.ds.puppet import DeformableStructures

TREE = part_tree(10)
LENGTHS = {"upper_arm": 0.28, "lower_arm": 0.25, "upper_leg": 0.4, "lower_leg": 0.4}
TORSO = {
    **{"neck": (0.0, -0.5), "belly": (0.0, 0.0)},
    **{"right_shoulder": (-0.18, -0.45), "left_shoulder": (0.18, -0.45)},
    **{"right_hip": (-0.1, 0.1), "left_hip": (0.1, 0.1)},
}


def width(bend: float) -> float:
    """Return half the width of a cardboard upper arm, which swells as the elbow bends."""
    return 0.04 + 0.02 * (1 - np.cos(bend))


def ellipse(start: np.ndarray, end: np.ndarray, half_width: float) -> np.ndarray:
    """Return the closed outline around a bone, 3 cm longer at both ends."""
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    axis = (end - start) / np.linalg.norm(end - start)
    across = np.array([-axis[1], axis[0]])
    long = np.linalg.norm(end - start) / 2 + 0.03
    return (start + end) / 2 + long * np.cos(angle)[:, None] * axis + half_width * np.sin(angle)[:, None] * across


def cardboard(rng: np.random.Generator) -> tuple[Projection, dict[str, float]]:
    """Make a flat person in a random pose; also return the bend of each elbow."""
    joints = {name: np.array(xy) * rng.normal(1, 0.02) for name, xy in TORSO.items()}
    joints["face"] = joints["neck"] + [rng.normal(0, 0.01), -0.15]
    bends = {}
    for side, sign in (("right", -1.0), ("left", 1.0)):
        for limb, names in (("arm", ("shoulder", "elbow", "wrist")), ("leg", ("hip", "knee", "ankle"))):
            first, bend = rng.uniform(-0.3, 1.5), rng.uniform(0.0, 2.0)
            bends[f"{side}_{limb}"] = bend
            point, angle = joints[f"{side}_{names[0]}"], sign * first
            for name, part in zip(names[1:], ("upper", "lower"), strict=True):
                step = LENGTHS[f"{part}_{limb}"] * rng.normal(1, 0.05) * np.array([np.sin(angle), np.cos(angle)])
                point = joints[f"{side}_{name}"] = point + step
                angle += sign * bend
    contours = {}
    for part in TREE.names:
        near, far = (joints[name] for name in PART_JOINTS[part][:2])
        half = {"torso": 0.17, "head": 0.08}.get(part, 0.05)
        if part.endswith("upper_arm"):
            half = width(bends[part.removesuffix("_upper_arm") + "_arm"])
        contours[part] = ellipse(near, far, half)
    return Projection(contours, joints), bends


@pytest.fixture(scope="module")
def training() -> TrainingSet:
    rng = np.random.default_rng(0)
    people = [cardboard(rng)[0] for _ in range(200)]
    return collect(TREE, [image for one in people for image in (one, one.mirror())])


@pytest.fixture(scope="module")
def model(training: TrainingSet) -> DeformableStructures:
    return fit.fit_puppet("neutral", training)


def test_parts_are_aligned_to_their_bones(training: TrainingSet) -> None:
    for name, part in zip(TREE.names, training.parts, strict=True):
        ends = part.points[:, -len(PART_JOINTS[name]) :][:, :2]
        half = 0.5 * part.length
        np.testing.assert_allclose(ends[:, 0], np.stack([-half, 0 * half], axis=1), atol=1e-12)
        np.testing.assert_allclose(ends[:, 1], np.stack([half, 0 * half], axis=1), atol=1e-12)
        turn = np.exp(1j * part.angle)
        placed = (ends[..., 0] + 1j * ends[..., 1]) * turn[:, None] + (part.center @ [1, 1j])[:, None]
        expected = training.joints[:, [training.joint_names.index(joint) for joint in PART_JOINTS[name][:2]]]
        np.testing.assert_allclose(np.stack([placed.real, placed.imag], axis=-1), expected, atol=1e-12)


def test_mirrored_training_gives_a_symmetric_model(model: DeformableStructures) -> None:
    left, right = (model.shapes[TREE.index(f"{side}_lower_arm")] for side in ("left", "right"))
    np.testing.assert_allclose(left.joints(np.zeros(10)), right.joints(np.zeros(10)), atol=1e-9)
    assert model.mean_joints()[model.joint_names.index("neck"), 0] == pytest.approx(0.0, abs=1e-3)


def test_arms_swell_with_the_bend_of_unseen_poses(model: DeformableStructures) -> None:
    rng = np.random.default_rng(99)
    errors, spread = [], []
    for _ in range(40):
        person, bends = cardboard(rng)
        joints = np.array([person.joints[name] for name in model.joint_names])
        puppet = model.puppet_from_joints(joints, 1.0)
        for side in ("left", "right"):
            near, far = (person.joints[name] for name in PART_JOINTS[f"{side}_upper_arm"])
            axis = (far - near) / np.linalg.norm(far - near)
            contour = puppet.contours[TREE.index(f"{side}_upper_arm")]
            half = np.ptp((contour - near) @ [-axis[1], axis[0]]) / 2
            errors.append(half - width(bends[f"{side}_arm"]))
            spread.append(width(bends[f"{side}_arm"]))
    assert np.std(errors) < 0.35 * np.std(spread), "the pairwise Gaussians carry the bend into the width"
    assert abs(np.mean(errors)) < 0.002


@pytest.mark.slow
def test_views_have_torsos_of_their_own_and_limbs_in_common() -> None:
    rng = np.random.default_rng(1)
    people = [cardboard(rng)[0] for _ in range(30)]

    def narrowed(image: Projection, factor: float) -> Projection:
        """Narrow shoulders and hips of a cardboard person, and move arms and legs along with them."""
        joints = {}
        for name, xy in image.joints.items():
            side, _, joint = name.partition("_")
            root = {"elbow": "shoulder", "wrist": "shoulder", "knee": "hip", "ankle": "hip"}.get(joint, joint)
            hung = image.joints[f"{side}_{root}"] if root else np.zeros(2)
            joints[name] = xy - [(1 - factor) * hung[0], 0.0]
        contours = {}
        for part in TREE.names:
            near, far = (joints[name] for name in PART_JOINTS[part][:2])
            contours[part] = ellipse(near, far, 0.17 * factor if part == "torso" else 0.05)
        return Projection(contours, joints)

    factors = np.cos(np.linspace(-1.2, 1.2, 9))
    sets = [collect(TREE, [narrowed(one, factor) for one in people]) for factor in factors]
    sides = MultiViewStructures.from_arrays("neutral", 10, fit_views(sets, 4))
    left, right = (sides.views[0].joint_names.index(f"{side}_shoulder") for side in ("left", "right"))
    widths = [view.likely_puppet().joints[left, 0] - view.likely_puppet().joints[right, 0] for view in sides.views]
    np.testing.assert_allclose(widths, 0.36 * factors, atol=0.02)
    for view, training in zip(sides.views, sets, strict=True):
        middle = training.joints[:, :2].mean(axis=1, keepdims=True)
        expected = (training.joints - middle).mean(axis=0).ravel()
        np.testing.assert_allclose(view.joint_prior.mean, expected, atol=1e-6)
        assert view.pairwise[3] is sides.views[0].pairwise[3], "lower arms hang from upper arms alike in all views"


def test_energy_is_the_density_of_the_pairwise_gaussians(training: TrainingSet, model: DeformableStructures) -> None:
    energy = PairwiseEnergy(TREE, model.shapes, model.pairwise, model.part_joints)
    coefficients = []
    for part, shape in zip(training.parts, model.shapes, strict=True):
        basis = shape.basis.reshape(-1, 10)
        centred = (part.points - shape.mean).reshape(len(part.points), -1)
        coefficients.append(np.linalg.lstsq(basis, centred.T, rcond=None)[0].T)
    per_sample = np.stack(coefficients, axis=1)
    variables = np.stack([energy.variables(*pair) for pair in zip(training.joints, per_sample, strict=True)])
    for edge, pair in enumerate(model.pairwise):
        np.testing.assert_allclose(variables[:, edge].mean(axis=0), pair.mean, atol=1e-6)
        np.testing.assert_allclose(np.cov(variables[:, edge].T), pair.covariance, atol=2e-3)
    expected = -sum(
        float(multivariate_normal(pair.mean, pair.covariance).logpdf(variables[7, edge]))
        for edge, pair in enumerate(model.pairwise)
    )
    assert energy(training.joints[7], per_sample[7]) == pytest.approx(expected)


def test_scale_and_hidden_joints_of_unseen_people(model: DeformableStructures) -> None:
    rng = np.random.default_rng(98)
    for _ in range(20):
        person, _ = cardboard(rng)
        joints = np.array([person.joints[name] for name in model.joint_names]) * 150 + 40
        sure = np.ones(len(joints))
        assert model.estimate_scale(joints, sure) == pytest.approx(150, rel=0.05)
        gap = joints.copy()
        gap[model.joint_names.index("left_hip")] = np.nan
        filled = model.complete_joints(gap, sure, 150.0)
        assert np.linalg.norm(filled - joints, axis=1).max() < 0.05 * 150


def test_camera_keeps_left_on_the_right_and_up_on_top() -> None:
    camera = RandomCamera(np.eye(3), 4.0)
    left_up, nearer = np.array([0.0, 0.5, 1.0]), np.array([1.0, 0.5, 1.0])
    np.testing.assert_allclose(camera.project(left_up), [0.5, -1.0])
    np.testing.assert_allclose(camera.project(nearer), [0.5 * 4 / 3, -4 / 3])


def test_mirror_image_exchanges_sides() -> None:
    person, _ = cardboard(np.random.default_rng(4))
    mirrored = person.mirror()
    np.testing.assert_allclose(mirrored.joints["left_wrist"], person.joints["right_wrist"] * [-1, 1])
    np.testing.assert_allclose(mirrored.contours["torso"], person.contours["torso"] * [-1, 1])
    np.testing.assert_allclose(mirrored.mirror().joints["left_knee"], person.joints["left_knee"])


@pytest.mark.parametrize(
    ("flag", "value", "message"),
    [
        ("poses", 3, "at least 20"),
        ("components", 0, "--components is 0"),
        ("seed", -1, "--seed is -1"),
        ("out", None, "--out"),
    ],
)
def test_unusable_arguments_are_told_before_any_work(tmp_path: Path, flag: str, value: object, message: str) -> None:
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    arguments = parser.parse_args(["--out", str(tmp_path)])
    if flag == "out":
        value = tmp_path / "file"
        value.write_text("not a folder")
    setattr(arguments, flag, value)
    with pytest.raises(InputError, match=message):
        command.run(arguments)


@pytest.mark.slow
@pytest.mark.skipif(
    find_spec("anny") is None or find_spec("body_models") is None, reason="the Anny body is for learning"
)
def test_projected_bodies_hold_their_joints() -> None:
    people = samples.BodySampler("female", 14)
    first, again = (samples.make_training_set(people, 4, np.random.default_rng(3)) for _ in range(2))
    np.testing.assert_array_equal(first.joints, again.joints)
    assert first.joint_names == JOINT_NAMES[14] and len(first.joints) == 8
    for name, part in zip(first.tree.names, first.parts, strict=True):
        count = len(PART_JOINTS[name])
        for sample in part.points:
            contour = np.asarray(sample[:-count], np.float32)[:, None]
            for x, y in sample[-count:][:2]:
                assert cv2.pointPolygonTest(contour, (float(x), float(y)), True) > -0.03, name
    np.testing.assert_allclose(first.joints[1::2, 0], first.joints[::2, 0] * [-1, 1])
