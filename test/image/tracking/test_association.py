# SPDX-License-Identifier: Apache-2.0
"""Which detection belongs to which track: by distance, and by the detector's ids where distance does not tell."""

from collections.abc import Sequence

import numpy as np
import pytest

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.tracking.association import associate
from flowing_puppet_ros.image.tracking.settings import TrackerSettings
from flowing_puppet_ros.image.tracking.track import Track
from flowing_puppet_ros.image.tracking.tracker import FlowingPuppetTracker
from flowing_puppet_ros.model.ds.puppet import DeformableStructures

MODEL = DeformableStructures.load("neutral", 10)
SCALE = 100.0
LIMIT = 0.5


def pose(x_m: float) -> F64:
    """The joints (J, 2) px of an average person `x_m` metres to the right."""
    return np.asarray(SCALE * (MODEL.mean_joints() + np.array([1.5 + x_m, 1.2])))


def detections(*places_m: float) -> list[tuple[F64, F64]]:
    return [(pose(x), np.full(len(MODEL.joint_names), 0.9)) for x in places_m]


def tracks(*places_m: float, ids: Sequence[str] = ("1", "2")) -> list[Track]:
    """Tracks at these places, last matched with detections of these ids."""
    made = []
    for name, identity, (joints, confidence) in zip("ab", ids, detections(*places_m), strict=True):
        made.append(Track.start(name, MODEL, joints, confidence, TrackerSettings()))
        made[-1].detector_id = identity
    return made


def match(place: Sequence[float], found: Sequence[float], ids: Sequence[str]) -> dict[int, int]:
    return associate(tracks(*place), detections(*found), LIMIT, None, ids)[0]


def test_ids_decide_between_people_at_the_same_distance() -> None:
    # Two people who stand close and come still closer: without ids 0.03 m each decide.
    place, found = (0.0, 0.16), (0.065, 0.095)
    assert match(place, found, ["", ""]) == {0: 0, 1: 1}
    assert match(place, found, ["1", "2"]) == {0: 0, 1: 1}
    assert match(place, found, ["2", "1"]) == {0: 1, 1: 0}


def test_one_id_is_enough() -> None:
    assert match((0.0, 0.1), (0.04, 0.06), ["2", "9"]) == {0: 1, 1: 0}
    assert match((0.0, 0.1), (0.04, 0.06), ["9", "8"]) == {0: 0, 1: 1}, "unknown ids say nothing"


def test_ids_that_jump_do_not_override_geometry() -> None:
    for apart in (0.12, 0.25, 0.8):
        assert match((0.0, apart), (0.01, apart - 0.01), ["2", "1"]) == {0: 0, 1: 1}, apart


def test_an_id_far_away_is_no_match_and_takes_no_place() -> None:
    matched, free = associate(tracks(0.0, 2.0), detections(0.1, 1.0), LIMIT, None, ["2", "1"])
    assert (matched, free) == ({0: 0}, [1])


def test_no_ids_is_as_before() -> None:
    for ids in (None, ["", ""]):
        one = tracks(0.0, 0.3, ids=("", ""))
        assert associate(one, detections(0.2, 0.1), LIMIT, None, ids) == ({0: 1, 1: 0}, [])


@pytest.mark.parametrize("second", ["7", ""])
def test_a_track_keeps_the_last_id_that_it_was_matched_with(second: str) -> None:
    tracker = FlowingPuppetTracker(MODEL)
    image = np.random.default_rng(0).integers(0, 255, (240, 320, 3)).astype(np.uint8)
    for time, identity in enumerate(("4", second)):
        joints, confidence = detections(0.01 * time)[0]
        tracker.step(image, time * 33_000_000, [Keypoints(MODEL.joint_names, joints, confidence, identity)])
    (track,) = tracker.tracks
    assert track.detector_id == (second or "4")
