# SPDX-License-Identifier: Apache-2.0
"""Clips tracked as a whole and image by image, by a detector that is right in its second guess."""

import numpy as np
import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.arms.evidence import ArmEvidenceModel
from flowing_puppet_ros.image.arms.hypotheses import joint_correctness
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.formats.video_reader import VideoFrame
from flowing_puppet_ros.image.video.clip import Clip, TrackedFrame, track_clip, track_live
from flowing_puppet_ros.image.video.detection_worker import DetectionWorker
from flowing_puppet_ros.image.video.settings import ClipSettings
from test.helpers.drawn_people import NAMES, CapsuleModel, draw, pose
from test.helpers.guessing_detector import Guesser, GuessingDetector, NoEvidence, negative

MODEL = CapsuleModel()
WRIST = NAMES.index("left_wrist")


def frames(images: list[np.ndarray]) -> list[VideoFrame]:
    return [VideoFrame(index, index * 1_000_000_000 // 30, image, "") for index, image in enumerate(images)]


def worker(detector: GuessingDetector) -> DetectionWorker:
    return DetectionWorker(detector, ArmEvidenceModel(MODEL, NoEvidence()))  # type: ignore[arg-type]


def track(detector: GuessingDetector, images: list[np.ndarray]) -> list[TrackedFrame]:
    return list(track_live(Clip.of(frames(images)), MODEL, worker=worker(detector)))  # type: ignore[arg-type]


def test_a_clip_joins_the_guesses_that_move_with_the_person() -> None:
    detector = GuessingDetector(range(9))
    clip = Clip.of(frames(detector.images))
    for t, frame in enumerate(track_clip(clip, MODEL, worker=worker(detector))):  # type: ignore[arg-type]
        (puppet,) = frame.puppets
        assert frame.index == t
        assert np.linalg.norm(puppet.joints[WRIST] - pose(t)[WRIST]) < 6, t
        correct = [joint_correctness(score, Guesser.score)[1] for score in (-4.0, 0.0)]
        assert correct[0] < puppet.confidence[WRIST] <= correct[1], t
    assert detector.full_frames == [0, 2, 4, 6, 8] and detector.detections == list(range(9))


def test_between_frames_with_keypoints_people_are_propagated_and_no_detector_runs() -> None:
    known = {t: [Keypoints(NAMES, pose(t), np.ones(len(NAMES)))] for t in (0, 4)}
    clip = Clip.of(frames([draw(pose(t)) for t in range(6)]), known)
    for t, frame in enumerate(track_clip(clip, MODEL)):  # type: ignore[arg-type]
        (puppet,) = frame.puppets
        assert puppet.id == "a1"
        assert np.linalg.norm(puppet.joints[NAMES.index("neck")] - pose(t)[NAMES.index("neck")]) < 4


def test_live_arms_follow_the_guesses_that_move_with_the_person() -> None:
    detector = GuessingDetector(range(9))
    for t, frame in enumerate(track(detector, detector.images)):
        assert np.linalg.norm(frame.puppets[0].joints[WRIST] - pose(t)[WRIST]) < 8, t


@pytest.mark.slow
def test_live_known_people_are_re_detected_in_every_image_between_full_frames() -> None:
    detector = GuessingDetector(range(18))
    track(detector, detector.images)
    assert detector.full_frames == [0, 1, 2, 3, 4, 14]
    assert sorted(set(detector.detections)) == list(range(18))


def test_live_a_cut_makes_it_detect_at_once_and_nobody_is_left_behind() -> None:
    detector = GuessingDetector(range(9))
    found = track(detector, [*detector.images[:8], negative(detector.images[8])])
    assert detector.full_frames == [0, 1, 2, 3, 4, 8]
    before, after = found[7].puppets, found[8].puppets
    assert len(after) == 1 and before[0].id != after[0].id


def test_a_frame_that_cannot_be_used_is_an_error_or_is_left_out_with_a_warning() -> None:
    images = [draw(pose(0)), np.zeros((4, 4, 3), np.uint8), draw(pose(1))]
    known = {t: [Keypoints(NAMES, pose(0), np.ones(len(NAMES)))] for t in range(3)}
    clip, warnings = Clip.of(frames(images), known), list[str]()
    with pytest.raises(InputError):
        list(track_clip(clip, MODEL))  # type: ignore[arg-type]
    found = list(track_clip(clip, MODEL, warn=warnings.append))  # type: ignore[arg-type]
    assert [frame.index for frame in found] == [0, 2] and warnings[0].startswith("frame 1: ")


def test_the_settings_of_all_parts_have_one_name_each() -> None:
    settings = ClipSettings.from_mapping({"tracker.gate": 5, "smoothing": {"flow_weight": 2.0}, "arms.modes": 3})
    assert (settings.tracker.gate, settings.smoothing.flow_weight, settings.arms.modes) == (5.0, 2.0, 3)
    with pytest.raises(InputError, match=r"unknown setting .tracker\.door."):
        ClipSettings.from_mapping({"tracker": {"door": 1}})
