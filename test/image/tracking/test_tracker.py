# SPDX-License-Identifier: Apache-2.0
"""The tracker on drawn people that move in known ways."""

from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest
from drawn_people import NAMES, SCALE, SIZE, CapsuleModel, Floats, detection, draw, error, pose, tracker  # type: ignore[import-not-found]

from flowing_puppet_ros.ids import letters_of_seed
from flowing_puppet_ros.image.person_mask import PersonMask
from flowing_puppet_ros.image.tracking.track import MAX_MASK_AGE


def test_flow_alone_carries_a_moving_forearm() -> None:
    follower = tracker()
    for time in range(13):
        result = follower.step(draw(pose(time)), time, [detection(pose(0))] if time == 0 else None)
    start, truth = pose(0), pose(12)
    for name in ("left_wrist", "left_elbow", "right_wrist", "neck", "left_hip"):
        moved = np.linalg.norm((truth - start)[NAMES.index(name)])
        assert error(result, truth, name) < 0.4 * moved, name
    (puppet,) = result.puppets
    assert puppet.id == "a1"
    assert puppet.view == "front"
    assert puppet.scale == pytest.approx(SCALE, rel=0.05)
    flow = result.puppet_flow()
    assert flow is not None
    assert flow.explained > 0.7
    assert flow.affine.shape == (10, 2, 3)


def test_confidence_falls_while_unseen_and_returns_with_a_detection() -> None:
    follower = tracker()
    confidence = []
    for time in range(8):
        detected = [detection(pose(time))] if time in (0, 7) else None
        confidence.append(follower.step(draw(pose(time)), time, detected).puppets[0].confidence.mean())
    assert all(later < earlier for earlier, later in pairwise(confidence[:7]))
    assert confidence[7] > confidence[6]


def test_a_joint_that_detections_do_not_have_is_less_sure_and_the_others_are_not() -> None:
    """The detector looks and does not find one wrist, which is hidden; the flow goes on with what hides it."""
    follower, wrist = tracker(), NAMES.index("right_wrist")
    sure = []
    for time in range(9):
        joints = pose(time)
        seen = joints.copy()
        seen[wrist] = np.nan if 2 <= time < 8 else joints[wrist]
        puppet = follower.step(draw(joints), time, [detection(seen)]).puppets[0]
        sure.append((puppet.confidence[wrist], np.delete(puppet.confidence, wrist).min()))
    hidden, others = np.array(sure).T
    assert (np.diff(hidden[1:8]) < -0.1 * hidden[1:7]).all() and hidden[7] < 0.3 * hidden[1] < hidden[8]
    assert np.ptp(others[2:]) < 0.05


def test_fusion_is_better_than_noisy_detections() -> None:
    follower, noise, fused, raw = tracker(), np.random.default_rng(3), [], []
    for time in range(14):
        truth = pose(time)
        noisy = truth + noise.normal(0, 0.02 * SCALE, truth.shape)
        result = follower.step(draw(truth), time, [detection(noisy)])
        fused.append(np.linalg.norm(result.puppets[0].joints - truth, axis=1).mean())
        raw.append(np.linalg.norm(noisy - truth, axis=1).mean())
    assert np.mean(fused[4:]) < 0.8 * np.mean(raw[4:])


def wild(joints: Floats, shift: tuple[float, float] = (60, -50)) -> Floats:
    changed = joints.copy()
    changed[NAMES.index("left_wrist")] += shift
    return changed


def test_one_wild_detection_does_not_take_the_limb_away_but_persistent_ones_do() -> None:
    follower = tracker()
    still = draw(pose(0))
    for time in range(6):
        follower.step(still, time, [detection(pose(0))])
    assert error(follower.step(still, 6, [detection(wild(pose(0)))]), pose(0), "left_wrist") < 5
    for time in range(7, 10):
        follower.step(still, time, [detection(pose(0))])
    for time in range(10, 13):
        result = follower.step(still, time, [detection(wild(pose(0)))])
    assert error(result, wild(pose(0)), "left_wrist") < 5


def test_the_gate_opens_while_no_detection_comes() -> None:
    still, apart = draw(pose(0)), (0.0, -16.0)
    for missed, accepted in ((0, False), (4, True)):
        follower = tracker()
        for time in range(3):
            follower.step(still, time, [detection(pose(0))])
        for time in range(3, 3 + missed):
            follower.step(still, time, None)
        result = follower.step(still, 3 + missed, [detection(wild(pose(0), apart))])
        assert (error(result, wild(pose(0), apart), "left_wrist") < 3) == accepted


def test_wild_detections_that_disagree_are_not_persistent() -> None:
    follower = tracker()
    still = draw(pose(0))
    for time in range(4):
        follower.step(still, time, [detection(pose(0))])
    for time, shift in enumerate([(60, -50), (-70, 40), (50, 60), (-60, -60)], start=4):
        result = follower.step(still, time, [detection(wild(pose(0), shift))])
        assert error(result, pose(0), "left_wrist") < 5


def test_the_flow_carries_a_mask_until_it_is_too_old() -> None:
    follower = tracker()
    places = [(100.0 + 3 * time, 118.0) for time in range(MAX_MASK_AGE + 2)]
    start = pose(0, places[0])
    height, width = draw(start).shape[:2]
    person = (
        np.abs(draw(start).astype(int) - draw(start + np.array([0.0, 500.0]))).max(axis=2) > 0
    )  # against the background alone
    values = np.where(person, np.uint8(255), np.uint8(0))
    shown = PersonMask.of_grid(values, (width, height))
    for time, place in enumerate(places):
        detected = [replace(detection(start), mask=shown)] if time == 0 else None
        (puppet,) = follower.step(draw(pose(0, place)), time, detected).puppets
        assert (puppet.mask is None) == (time > MAX_MASK_AGE)
        if puppet.mask is not None:
            columns = np.nonzero(puppet.mask.draw((width, height), (width, height)) >= 128)[1]
            assert columns.mean() == pytest.approx(np.nonzero(values)[1].mean() + 3 * time, abs=3)
            assert puppet.mask.area == pytest.approx(shown.area, rel=0.15)
    # Where a detector does not say it, the one before goes on.
    follower.step(draw(start), 20, [replace(detection(start), mask=shown)])
    result = follower.step(draw(start), 21, [detection(start)])
    assert result.puppets[0].mask is not None
    labels = result.render_person_masks()
    assert labels.max() == 1
    assert labels.shape == result.grid.work[::-1]


def test_two_people_keep_their_ids_whatever_the_order_of_detections() -> None:
    follower = tracker()
    left, right = (70, 118), (215, 118)
    for time in range(5):
        first, second = pose(time, left), pose(time, right)
        people = [detection(first), detection(second)]
        result = follower.step(draw(first, second), time, people[:: 1 if time % 2 == 0 else -1])
        assert [puppet.id for puppet in result.puppets] == ["a1", "a2"]
        assert result.puppets[0].joints[:, 0].mean() < result.puppets[1].joints[:, 0].mean()
    labels = result.render_part_labels()
    assert labels.shape == (240, 320)
    assert labels.max() <= 10
    assert (labels[:, :140] == 1).any()
    assert (labels[:, 170:] == 1).any()


def test_a_second_detection_of_a_person_starts_nobody() -> None:
    follower = tracker()
    follower.step(draw(pose(0)), 0, [detection(pose(0))])
    result = follower.step(draw(pose(0)), 1, [detection(pose(0)), detection(pose(0) + 4.0)])
    assert len(result.puppets) == 1


def test_people_end_when_missed_often_and_ids_are_not_used_again() -> None:
    follower = tracker(max_missed_detections=2)
    image = draw(pose(0))
    follower.step(image, 0, [detection(pose(0))])
    counts = [len(follower.step(image, time, []).puppets) for time in range(1, 4)]
    assert counts == [1, 1, 0]
    assert follower.step(image, 9, [detection(pose(0))]).puppets[0].id == "a2"
    follower.reset()
    assert follower.step(image, 10, [detection(pose(0))]).puppets[0].id == "a3"


def test_people_end_when_unseen_for_long_or_outside_the_image() -> None:
    follower = tracker(max_unmatched_images=2)
    image = draw(pose(0))
    follower.step(image, 0, [detection(pose(0))])
    assert [len(follower.step(image, time).puppets) for time in range(1, 4)] == [1, 1, 0]
    assert not follower.step(image, 4, [detection(pose(0) + 2000.0)]).puppets


def test_view_turns_only_after_repeated_evidence() -> None:
    follower = tracker()
    image = draw(pose(0))
    mirrored = pose(0)
    mirrored[:, 0] = 2 * 150 - mirrored[:, 0]
    for time in range(4):
        assert follower.step(image, time, [detection(pose(0))]).puppets[0].view == "front"
    views = [follower.step(image, time, [detection(mirrored)]).puppets[0].view for time in range(4, 20)]
    assert views[0] == views[1] == "front"
    assert views[-1] == "back"
    assert views.index("back") == len(views) - views.count("back")


def test_joints_outside_the_image_keep_a_low_confidence() -> None:
    follower = tracker()
    low = pose(0, (150, 200))
    result = follower.step(draw(low), 0, [detection(low)])
    (puppet,) = result.puppets
    outside = puppet.joints[:, 1] > SIZE[1]
    assert outside.any()
    assert puppet.confidence[outside].max() < 0.1 < puppet.confidence[~outside].min()
    assert result.render_part_labels().shape == (240, 320)


def test_unknown_joints_are_completed_and_doubtful() -> None:
    joints = pose(0)
    joints[NAMES.index("right_ankle")] = np.nan
    (puppet,) = tracker().step(draw(pose(0)), 0, [detection(joints)]).puppets
    assert np.isfinite(puppet.joints).all()
    assert puppet.confidence[NAMES.index("right_ankle")] == 0
    assert error(tracker().step(draw(pose(0)), 0, [detection(joints)]), pose(0), "right_ankle") < 10


def test_same_input_same_bits() -> None:
    images = [draw(pose(time)) for time in range(4)]
    runs = []
    for _ in range(2):
        follower = tracker()
        steps = [follower.step(image, t, [detection(pose(0))] if t == 0 else None) for t, image in enumerate(images)]
        runs.append(np.concatenate([step.puppets[0].joints.ravel() for step in steps]))
    np.testing.assert_array_equal(runs[0], runs[1])


def test_nearer_parts_cover_farther_ones_in_depth_and_labels() -> None:
    joints = pose(0)
    joints[NAMES.index("left_elbow")], joints[NAMES.index("left_wrist")] = (170, 80), (150, 85)
    result = tracker().step(draw(joints), 0, [detection(joints)])
    (puppet,) = result.puppets
    index = CapsuleModel.tree.index
    assert puppet.depth[index("left_lower_arm")] > puppet.depth[index("torso")]
    assert result.render_part_labels()[84, 155] == index("left_lower_arm") + 1


def test_larger_people_are_nearer() -> None:
    far, near = pose(0, (150, 118)), (pose(0) - [150, 118]) * 1.4 + [165, 118]
    follower = tracker()
    result = follower.step(draw(far, near), 0, [detection(near), detection(far)])
    if len(result.puppets) == 2:
        alone = tracker().step(draw(near), 0, [detection(near)])
        inside = alone.render_part_labels() > 0
        np.testing.assert_array_equal(result.render_part_labels()[inside], alone.render_part_labels()[inside])


def test_ids_begin_with_the_seed() -> None:
    assert [letters_of_seed(seed) for seed in (0, 1, 25, 26, 701, 702)] == ["a", "b", "z", "aa", "zz", "aaa"]
    (puppet,) = tracker(seed=2).step(draw(pose(0)), 0, [detection(pose(0))]).puppets
    assert puppet.id == "c1"


def test_joints_behind_a_nearer_person_are_doubted() -> None:
    far, near = pose(0, (150, 118)), (pose(0) - [150, 118]) * 1.4 + [175, 118]
    alone = tracker().step(draw(far), 0, [detection(far)]).puppets[0]
    both = tracker().step(draw(far, near), 0, [detection(near), detection(far)]).puppets
    assert len(both) == 2
    behind, before = sorted(both, key=lambda puppet: puppet.scale)
    covered = behind.confidence < 0.5 * alone.confidence
    assert covered.any()
    assert not covered.all()
    contours = [np.asarray(contour, np.float32) for contour in before.contours]
    for point, hidden in zip(behind.joints, covered, strict=True):
        depths = [cv2.pointPolygonTest(contour, (float(point[0]), float(point[1])), True) for contour in contours]
        if abs(max(depths)) > 2.0:
            assert hidden == (max(depths) > 0)
