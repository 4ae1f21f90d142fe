# SPDX-License-Identifier: Apache-2.0
"""The thesis's loop: vectors are bodies, motions by sums, evidence in neighbouring images, and the whole loop."""

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np
import pytest

from flowing_puppet_ros.flow.affine import apply_affine
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.pose.evidence import KeypointPerson
from flowing_puppet_ros.image.thesis_loop.energy import EnergySettings, FlowingEnergy, FrameEvidence, propagate_joints
from flowing_puppet_ros.image.thesis_loop.flow_moments import FlowMoments
from flowing_puppet_ros.image.thesis_loop.loop import InitialPose, LoopSettings, ThesisLoop
from flowing_puppet_ros.image.thesis_loop.upper_body import PARTS, UpperBodyParameters
from flowing_puppet_ros.image.thesis_loop.wrist_proposals import WristProposals
from flowing_puppet_ros.image.tracking.propagation import ImageScale
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.shape import View

MODEL = DeformableStructures.load()
NAMES = MODEL.joint_names
FRONT = UpperBodyParameters(MODEL, "front")
SCALE = 150.0
GRID = ImageScale((320, 240), (320, 240))
ARMS = [NAMES.index(f"{side}_{name}") for side in ("right", "left") for name in ("elbow", "wrist")]


def bodies(count: int, view: View = "front") -> np.ndarray:
    """Joints (P,J,2) px of bodies that the model draws."""
    rng = np.random.default_rng(5)
    sign = np.array([1.0 if view == "front" else -1.0, 1.0])
    return np.array([MODEL.sample(rng).joints for _ in range(count)]) * sign * SCALE + np.array([160.0, 90.0])


@pytest.mark.parametrize("view", ["front", "back"])
def test_vectors_are_bodies_and_bodies_vectors(view: View) -> None:
    body = FRONT if view == "front" else UpperBodyParameters(MODEL, "back")
    joints = bodies(20, view)
    vectors = body.to_vectors(joints, np.full(20, SCALE))
    back, scale = body.to_joints(vectors, body.leg_offsets(joints[0]))
    np.testing.assert_allclose(scale, SCALE)
    for name in ("neck", "belly", "face", "right_wrist", "left_wrist", "right_elbow", "left_elbow"):
        np.testing.assert_allclose(back[:, NAMES.index(name)], joints[:, NAMES.index(name)], atol=0.02 * SCALE)
    shoulders = [NAMES.index(f"{side}_shoulder") for side in ("right", "left")]
    np.testing.assert_allclose(back[:, shoulders], joints[:, shoulders], atol=0.05 * SCALE)
    again = body.to_vectors(back, scale)
    np.testing.assert_allclose(body.to_joints(again, body.leg_offsets(joints[0]))[0], back, atol=0.02 * SCALE)


def test_bounds_are_learned_and_hold_most_bodies() -> None:
    vectors = FRONT.to_vectors(bodies(40), np.full(40, SCALE))
    box = FRONT.make_bounds(vectors[0])
    limbs = slice(1, 2 * len(PARTS))
    inside = (vectors[:, limbs] >= box.low[limbs]) & (vectors[:, limbs] <= box.high[limbs])
    assert inside.mean() > 0.96
    assert (box.high > box.low).all()
    head = PARTS.index("head")
    assert box.high[head] - box.low[head] < 2.5, "heads do not turn upside down"
    assert FRONT.select_values(PARTS).all()
    assert not FRONT.select_values(PARTS[:4])[
        [PARTS.index("left_upper_arm"), len(PARTS) + PARTS.index("left_lower_arm")]
    ].any()


def moving(shift: tuple[float, float], turn: float, shape_of: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Flow there and back: the part within a contour turns and moves, the background rests; and the motion (2,3)."""
    centre = shape_of.mean(axis=0)
    c, s = np.cos(turn), np.sin(turn)
    linear = np.array([[c, -s], [s, c]])
    affine = np.column_stack([linear, centre - linear @ centre + shift])
    y, x = np.mgrid[:240, :320].astype(float)
    places = np.stack([x, y], axis=2).reshape(1, -1, 2)
    motion = (apply_affine(affine, places) - places).reshape(240, 320, 2)
    inverse = np.linalg.inv(linear)
    away = (places - affine[:, 2]) @ inverse.T - places
    fields = []
    for field, contour in ((motion, shape_of), (away.reshape(240, 320, 2), apply_affine(affine, shape_of[None])[0])):
        mask = np.zeros((240, 320), np.uint8)
        cv2.fillPoly(mask, [np.round(contour).astype(np.int32)], 1)
        fields.append(np.where(mask[..., None] > 0, field, 0.0).astype(np.float32))
    return fields[0], fields[1], affine


def test_motions_by_sums_are_those_of_the_flow() -> None:
    puppet = MODEL.puppet_from_joints(bodies(1)[0], SCALE)
    torso = puppet.contours[0]
    forward, backward, affine = moving((6.0, -3.0), 0.05, torso)
    moments = FlowMoments.of((forward, backward), GRID, np.zeros(2), np.array([319.0, 239.0]))
    found, weight = moments.fit_affine(np.stack([torso, torso + 1000.0]))
    np.testing.assert_allclose(apply_affine(found[0], torso[None])[0], apply_affine(affine, torso[None])[0], atol=0.7)
    assert weight[0] > 500
    assert weight[1] == 0.0
    np.testing.assert_allclose(found[1], np.eye(2, 3), atol=1e-9)
    half = ImageScale((640, 480), (320, 240))
    twice = FlowMoments.of((forward, backward), half, np.zeros(2), np.array([639.0, 479.0]))
    large = (torso + 0.5) * 2 - 0.5
    expected = (apply_affine(affine, torso[None])[0] + 0.5) * 2 - 0.5
    np.testing.assert_allclose(apply_affine(twice.fit_affine(large[None])[0][0], large[None])[0], expected, atol=1.5)


def test_puppets_are_carried_joint_by_joint() -> None:
    joints = bodies(2)
    flow = np.full((240, 320, 2), (4.0, 2.0), np.float32)
    # A part that moves with the background weighs less, but there is nothing else to say how it moves.
    moments = FlowMoments.of((flow, -flow), GRID, np.zeros(2), np.array([319.0, 239.0]))
    contours, _ = MODEL.puppets_from_joints(joints, np.full(2, SCALE))
    moved = propagate_joints(FRONT, moments, joints, contours) - joints
    inside = (joints > 5).all(axis=2) & (joints < (315, 235)).all(axis=2)
    upper = np.isin(np.arange(len(NAMES)), [NAMES.index(n) for n in NAMES if "knee" not in n and "ankle" not in n])
    np.testing.assert_allclose(moved[inside & upper], np.tile([4.0, 2.0], (int(np.sum(inside & upper)), 1)), atol=0.5)


class GivenDetection:
    """A detection with the true joints and an additional false pose."""

    def __init__(self, joints: np.ndarray, modes: Sequence[np.ndarray]) -> None:
        self._given = KeypointPerson(Keypoints(NAMES, joints, np.ones(len(NAMES))), 0.4 * SCALE)
        self._modes = modes
        self.keypoints, self.confidence = self._given.keypoints, 1.0

    def modes(self, count: int) -> list[tuple[Keypoints, float]]:
        return [(Keypoints(NAMES, joints, np.ones(len(NAMES))), 0.0) for joints in self._modes][:count]

    @property
    def joints_are_independent(self) -> bool:
        return False

    def joint_score(self, joint: str, xy: np.ndarray) -> np.ndarray:
        return self._given.joint_score(joint, xy)


def clip(lost: int) -> tuple[list[InitialPose], list[FrameEvidence], np.ndarray]:
    """Five images of a person moving by 3 px per image; in the image `lost` the detector misses the arms."""
    first = bodies(1)[0]
    truth = first + 3.0 * np.arange(5)[:, None, None] * [1.0, 0.0]
    false = truth.copy()
    false[:, ARMS] += [0.0, -25.0]
    flow = np.full((240, 320, 2), (3.0, 0.0), np.float32)
    frames = []
    for t, joints in enumerate(truth):
        given = GivenDetection(np.full_like(joints, np.nan) if t == lost else joints, [false[t]])
        frames.append(FrameEvidence(None, None, given))
    for a, b in pairwise(frames):
        a.after = FlowMoments.of((flow, -flow), GRID, np.zeros(2), np.array([319.0, 239.0]))
        b.before = FlowMoments.of((-flow, flow), GRID, np.zeros(2), np.array([319.0, 239.0]))
    starts = [InitialPose(joints, SCALE) for joints in false]
    return starts, frames, truth


QUICK = {"particles": 20, "max_propagated": 4, "rounds": 2, "restarts": 1, "iterations": 3}


@pytest.mark.slow
def test_the_loop_finds_the_arms_and_repeats_itself() -> None:
    starts, frames, truth = clip(lost=9)
    energy = EnergySettings(prior_weight=0.01)
    loop = ThesisLoop(MODEL, "front", LoopSettings(**QUICK), energy)
    runs = [loop.run(starts, frames) for _ in range(2)]
    assert runs[0][0].tobytes() == runs[1][0].tobytes()
    joints, agreed, _ = runs[0]
    off = np.linalg.norm(joints - truth, axis=2)[:, ARMS]
    assert np.median(off) < 12.0, "the start is 25 px off"
    assert ((agreed >= 0) & (agreed <= 1)).all()
    more = ThesisLoop(MODEL, "front", LoopSettings(**QUICK | {"restarts": 2}), energy).run(starts, frames)
    assert more[2].sum() <= runs[0][2].sum() + 1e-9, "of several seeds the best is taken"


@pytest.mark.slow
def test_an_image_that_tells_nothing_learns_from_its_neighbours() -> None:
    starts, frames, truth = clip(lost=2)
    loop = ThesisLoop(MODEL, "front", LoopSettings(**QUICK), EnergySettings(prior_weight=0.01))
    alone = ThesisLoop(MODEL, "front", LoopSettings(**QUICK | {"max_propagated": 0}), EnergySettings(prior_weight=0.01))
    off = [np.linalg.norm(one.run(starts, frames)[0][2] - truth[2], axis=1)[ARMS].mean() for one in (loop, alone)]
    assert off[0] < off[1]


def test_the_energy_adds_the_evidence_at_the_carried_puppet() -> None:
    _, frames, truth = clip(lost=9)
    energies = {}
    for name, settings in (
        ("none", EnergySettings(forward_flow=False, backward_flow=False)),
        ("forward", EnergySettings(backward_flow=False)),
        ("two", EnergySettings(backward_flow=False, flow_steps=2)),
    ):
        energy = FlowingEnergy(FRONT, frames, settings)
        energies[name] = energy.terms(1, truth[1:2], np.array([SCALE]))
    assert not energies["none"][2].any()
    right, wrong = truth[1:2], truth[1:2] + 10.0
    terms = FlowingEnergy(FRONT, frames, EnergySettings(backward_flow=False)).terms(1, np.concatenate([right, wrong]),
                                                                              np.full(2, SCALE))[2]  # fmt: skip
    assert terms[0, 3] > terms[1, 3], "the true puppet is propagated onto the next image's detection"
    assert energies["two"][2][0, 3] <= energies["forward"][2][0, 3] <= 0.0
    last = FlowingEnergy(FRONT, frames, EnergySettings(backward_flow=False)).terms(4, truth[4:], np.array([SCALE]))
    assert not last[2].any(), "after the last image there is nothing"


def test_wrists_go_where_hands_are_and_arms_follow() -> None:
    joints = bodies(1)
    vectors = np.repeat(FRONT.to_vectors(joints, np.full(1, SCALE)), 50, axis=0)
    box, legs = FRONT.make_bounds(vectors[0]), FRONT.leg_offsets(joints[0])
    neck = joints[0, NAMES.index("neck")]
    places = neck + np.array([[40.0, 60.0], [-40.0, 60.0]])
    moves = WristProposals(FRONT, box, legs, places, (np.array([1.0, 1.0]), np.array([0.0, 1.0])))
    moved = moves(vectors, np.random.default_rng(0))
    assert ((moved >= box.low) & (moved <= box.high)).mean() > 0.9
    after, _ = FRONT.to_joints(moved, legs)
    wrists = after[:, [NAMES.index("right_wrist"), NAMES.index("left_wrist")]]
    reached = np.linalg.norm(wrists[:, :, None] - places, axis=3).min(axis=2) < 1.0
    assert reached.any(axis=1).all()
    trunk = [NAMES.index(name) for name in ("neck", "belly", "face")]
    np.testing.assert_allclose(after[:, trunk], np.repeat(FRONT.to_joints(vectors[:1], legs)[0][:, trunk], 50, axis=0))
