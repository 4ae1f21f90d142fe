# SPDX-License-Identifier: Apache-2.0
"""Detection beside tracking: full frames, ROIs, how results are propagated, the same live and replayed."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks.drawn_person import JOINTS, DrawnPerson
from flowing_puppet_ros.bag.typestore import BagMessageFactory, typestore
from flowing_puppet_ros.image.arms.hypotheses import ArmFilter
from flowing_puppet_ros.image.detector.detection import PersonCandidate
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.tracking.tracker import FlowingPuppetTracker, TrackedPuppet, TrackResult
from flowing_puppet_ros.image.video.detection_worker import DetectedPerson
from flowing_puppet_ros.image.video.known_people import KnownPeople
from flowing_puppet_ros.image.video.live_tracker import LiveTracker
from flowing_puppet_ros.image.video.pending_detection import FRAME_NS, propagate_points
from flowing_puppet_ros.image.video.settings import LiveDetectionSettings
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.stream.components.puppet_tracker import PuppetTrackerComponent, PuppetTrackerSettings
from flowing_puppet_ros.stream.messages.geometry import make_header, stamp_ns
from flowing_puppet_ros.stream.messages.images import make_image
from flowing_puppet_ros.stream.messages.message_types import PUPPETS

FACTORY = BagMessageFactory()
SECOND = 1_000_000_000
TENTH = SECOND // 10
DRAWN = DrawnPerson((320, 240))


@cache
def image(number: int, of: str = "person") -> Any:
    """Image `number` of ten a second, written into the first pixel: a person, nobody, or two who stand still."""
    pixels = DRAWN.draw(number / 10)
    if of == "nobody":
        pixels = np.random.default_rng(5).integers(0, 80, pixels.shape, dtype=np.uint8)
    if of == "two":
        pixels = np.concatenate([DRAWN.draw(0.0)] * 2, axis=1)
    pixels[0, 0, 0] = number
    return pixels


def joints(number: int) -> np.ndarray:
    return DRAWN.locate_joints(number / 10)


@dataclass
class TrueWorker:
    """Detects the drawn people where they are, and remembers the images that it ran on."""

    full_frames: list[int] = field(default_factory=list)
    rois: list[tuple[int, int]] = field(default_factory=list)
    unseen: tuple[int, ...] = ()

    def detect_full_frame(self, image: Any, known: KnownPeople, number: int) -> list[DetectedPerson]:
        self.full_frames.append(int(image[0, 0, 0]))
        return self._people(image)

    def detect_in_rois(
        self,
        image: Any,
        places: Sequence[PersonCandidate],
        puppets: Sequence[TrackedPuppet],
        arms: Mapping[str, ArmFilter],
    ) -> list[DetectedPerson]:
        self.rois.append((int(image[0, 0, 0]), len(places)))
        people = self._people(image)
        near = [min(people, key=lambda person: person.candidate.neck_distance(place)) for place in places if people]
        return [self._with_arms(person, puppets) for person in near]

    def step_arms(self, arms: ArmFilter, image: Any, puppet: TrackedPuppet, detection: Any) -> dict[int, Any]:
        return {}

    def _with_arms(self, person: DetectedPerson, puppets: Sequence[TrackedPuppet]) -> DetectedPerson:
        neck = person.keypoints.xy[JOINTS.index("neck")]
        near = [puppet.id for puppet in puppets if np.hypot(*(puppet.joints[0] - neck)) < 30]
        if not near:
            return person
        wrist = person.keypoints.xy[JOINTS.index("left_wrist")]
        return DetectedPerson(
            person.detection, person.keypoints, near[0], {MODEL.joint_names.index("left_wrist"): (wrist, 0.7)}
        )

    def _people(self, image: Any) -> list[DetectedPerson]:
        number = int(image[0, 0, 0])
        if number in self.unseen or image[60:].max() < 100:
            return []
        shifts = [0.0] if image.shape[1] == 320 else [0.0, 320.0]
        places = [joints(0 if len(shifts) == 2 else number) + np.array([shift, 0.0]) for shift in shifts]
        return [DetectedPerson(detection(xy), Keypoints(JOINTS, xy, np.full(len(JOINTS), 0.9))) for xy in places]


def detection(xy: np.ndarray) -> Any:
    place = PersonCandidate(xy[JOINTS.index("neck")], xy[JOINTS.index("face")], 45.0, 3.0)
    return SimpleNamespace(candidate=place, confidence=0.95, scale=45.0)


MODEL = DeformableStructures.load()


def tracking(**settings: Any) -> tuple[LiveTracker, TrueWorker]:
    worker = TrueWorker()
    return LiveTracker(FlowingPuppetTracker(MODEL), LiveDetectionSettings(**settings), Counter(), worker), worker  # type: ignore[arg-type]


def neck_of(result: TrackResult) -> np.ndarray:
    (puppet,) = result.puppets
    return np.asarray(puppet.joints[MODEL.joint_names.index("neck")])


def test_tracks_start_in_the_image_of_the_full_frame_and_roi_detections_follow() -> None:
    live, worker = tracking(full_frame_delay=0.25, roi_interval=0.3, roi_delay=0.15, full_frame_interval=0.7)
    results = [live.step(image(number), number * TENTH) for number in range(12)]
    assert [len(result.puppets) for result in results] == [0] * 3 + [1] * 9
    assert worker.full_frames == [0, 7] and [number for number, _ in worker.rois] == [3, 6, 9]
    for number, result in enumerate(results[3:], start=3):
        np.testing.assert_allclose(neck_of(result), joints(number)[JOINTS.index("neck")], atol=4.0)


def test_without_delay_tracks_start_in_the_first_image_and_after_a_cut_in_the_image_after_it() -> None:
    live, worker = tracking(full_frame_delay=0.0, search_interval=0.0, roi_interval=0.0, roi_delay=0.05)
    results = [live.step(image(number), number * TENTH) for number in range(4)]
    assert [len(result.puppets) for result in results] == [1] * 4
    assert not live.step(image(4, "nobody"), 4 * TENTH).puppets
    (again,) = live.step(image(5), 5 * TENTH).puppets
    assert again.id != results[0].puppets[0].id and 5 in worker.full_frames


def test_an_roi_detection_moves_the_arms_to_where_they_are_in_the_image_it_is_used_with() -> None:
    live, worker = tracking(full_frame_delay=0.0, roi_interval=0.0, roi_delay=0.15)
    wrist, used = MODEL.joint_names.index("left_wrist"), 0
    for number in range(12):
        (puppet,) = live.step(image(number), number * TENTH).puppets or (None,)
        if puppet is not None and worker.rois and number == worker.rois[0][0] + 2 * (used + 1):
            used += 1
            np.testing.assert_allclose(puppet.joints[wrist], joints(number)[JOINTS.index("left_wrist")], atol=8.0)
            assert puppet.confidence[wrist] > 0.5
    assert used >= 4


def test_who_comes_later_is_found_in_a_full_frame_and_re_detected_in_the_next_roi() -> None:
    live, worker = tracking(
        full_frame_delay=0.1, search_interval=0.5, full_frame_interval=0.5, roi_interval=0.0, roi_delay=0.05
    )
    worker._people = lambda image, people=worker._people: people(image)[: 1 + (image[0, 0, 0] >= 4)]  # type: ignore
    results = [live.step(image(number, "two"), number * TENTH) for number in range(12)]
    assert worker.full_frames[:2] == [0, 5]
    first = next(number for number, result in enumerate(results) if len(result.puppets) == 2)
    assert first == 5 + 3 + 1, "a full frame takes three times as long while people are tracked, an ROI one image"
    assert max(count for _, count in worker.rois) == 2
    assert {puppet.id for puppet in results[-1].puppets} == {"a1", "a2"}


def test_who_is_found_no_more_is_not_re_detected() -> None:
    live, worker = tracking(full_frame_delay=0.1, search_interval=0.4, full_frame_interval=0.4, roi_delay=0.05)
    worker.unseen = tuple(range(3, 30))
    for number in range(14):
        live.step(image(number), number * TENTH)
    assert worker.rois and max(number for number, _ in worker.rois) <= 6


def test_after_a_cut_nobody_is_where_they_were_and_the_full_frame_is_detected_at_once() -> None:
    live, worker = tracking(full_frame_delay=0.1, roi_interval=0.0, roi_delay=0.15)
    for number in range(6):
        before = live.step(image(number), number * TENTH)
    assert len(before.puppets) == 1
    for number in range(6, 12):
        after = live.step(image(number, "nobody"), number * TENTH)
        assert not after.puppets
    assert 6 in worker.full_frames


@pytest.mark.parametrize("stamps", [[0] * 100, list(range(0, -100, -1))])
def test_stamps_that_stand_still_or_go_back_do_not_stop_the_detector(stamps: list[int]) -> None:
    live, worker = tracking(search_interval=FRAME_NS * 10e-9, full_frame_delay=0.0)
    worker.unseen = tuple(range(256))
    for number, stamp in enumerate(stamps):
        live.step(image(number % 30), stamp * SECOND)
    assert 8 <= len(worker.full_frames) <= 100


def test_the_minimum_probability_can_change_between_full_frames() -> None:
    live, _ = tracking(min_probability=0.3)
    live.reconfigure(LiveDetectionSettings(min_probability=0.8))
    assert live._known.linker.min_probability == 0.8


def test_an_image_of_another_size_restarts() -> None:
    live, worker = tracking(full_frame_delay=0.05)
    live.step(image(0), 0)
    assert not live.step(image(1)[:200], SECOND).puppets
    assert worker.full_frames == [0, 1]


def test_points_move_in_fractions_of_the_image_and_are_lost_or_kept_where_the_flow_is_unknown() -> None:
    places = np.array([[10.0, 20], [np.nan, np.nan], [90, 20]])
    field = np.zeros((16, 25, 2), np.float32)
    field[..., 0] = 0.05
    field[:, 20:] = np.nan
    moved = propagate_points(places, [field, field], (100, 64))
    np.testing.assert_allclose(moved, np.array([[20, 20], [np.nan, np.nan], [np.nan, np.nan]]), atol=1e-4)
    np.testing.assert_allclose(propagate_points(places, [field], (100, 64), keep=True)[2], (90, 20), atol=1e-4)
    assert propagate_points(np.zeros((0, 2)), [field], (100, 64)).shape == (0, 2)


class LastMoment(Executor):
    """Does its work when somebody asks for the result."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Any:
        return SimpleNamespace(result=cache(lambda: fn(*args, **kwargs)))


def puppets(threads: Executor | None) -> tuple[list[bytes], list[Any]]:
    """Return what the tracker says of a drawn person, as bytes and as messages."""
    settings = PuppetTrackerSettings.from_mapping(
        {"flow.preset": "fast", "detection.source": "own"}
        | {
            f"detection.{name}": value
            for name, value in (("full_frame_delay", 0.1), ("full_frame_interval", 0.4), ("search_interval", 0.4))
        }
    )
    component = PuppetTrackerComponent(settings, FACTORY)
    component.background = threads
    found = []
    for number in range(10):
        header = make_header(FACTORY, number * SECOND // 10, "camera")
        made = component.handle("image", make_image(FACTORY, header, DRAWN.draw(number / 10), "rgb8"))
        found += [message for port, message in made if port == "puppets"]
    assert component.counters["full frames with people"] == 2 and component.counters["ROI re-detections"] >= 2
    return [bytes(typestore().serialize_cdr(message, PUPPETS)) for message in found], found


@pytest.mark.slow
def test_people_are_found_without_detections_and_the_same_beside_the_work_as_in_a_replay() -> None:
    with ThreadPoolExecutor(1) as threads:
        live, _ = puppets(threads)
    replayed, messages = puppets(None)
    assert live == replayed and puppets(LastMoment())[0] == replayed
    assert [len(message.puppets) for message in messages] == [0] + [1] * 9
    assert {puppet.id for message in messages for puppet in message.puppets} == {"a1"}
    neck = np.array([next((j.x, j.y) for j in m.puppets[0].joints if j.name == "neck") for m in messages[1:]])
    truth = np.array([DRAWN.locate_joints(stamp_ns(m) / SECOND)[0] for m in messages[1:]])
    assert np.abs(neck - truth).max() < 10
