# SPDX-License-Identifier: Apache-2.0
"""The detector beside the tracker: searches, glances, how they are carried, the same live and replayed."""

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
from flowing_puppet_ros.image.video.detection_jobs import DetectedPerson
from flowing_puppet_ros.image.video.detection_memory import KnownPeople
from flowing_puppet_ros.image.video.live_tracker import FRAME_NS, LiveTracker, LiveTrackerSettings, propagate_points
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
    pixels = DRAWN.image(number / 10)
    if of == "nobody":
        pixels = np.random.default_rng(5).integers(0, 80, pixels.shape, dtype=np.uint8)
    if of == "two":
        pixels = np.concatenate([DRAWN.image(0.0)] * 2, axis=1)
    pixels[0, 0, 0] = number
    return pixels


def joints(number: int) -> np.ndarray:
    return DRAWN.joints(number / 10)


@dataclass
class TrueLooker:
    """Sees the drawn people where they are, and remembers the images that it was shown."""

    searched: list[int] = field(default_factory=list)
    glanced: list[tuple[int, int]] = field(default_factory=list)
    unseen: tuple[int, ...] = ()

    def detect_full_frame(self, image: Any, watch: KnownPeople, number: int) -> list[DetectedPerson]:
        self.searched.append(int(image[0, 0, 0]))
        return self._people(image)

    def detect_in_rois(
        self,
        image: Any,
        places: Sequence[PersonCandidate],
        puppets: Sequence[TrackedPuppet],
        arms: Mapping[str, ArmFilter],
    ) -> list[DetectedPerson]:
        self.glanced.append((int(image[0, 0, 0]), len(places)))
        people = self._people(image)
        near = [min(people, key=lambda person: person.candidate.neck_distance(place)) for place in places if people]
        return [self._with_arms(person, puppets) for person in near]

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
    return SimpleNamespace(place=place, confidence=0.95, scale=45.0)


MODEL = DeformableStructures.load()


def watching(**settings: Any) -> tuple[LiveTracker, TrueLooker]:
    looker = TrueLooker()
    return LiveTracker(LiveTrackerSettings(**settings), FlowingPuppetTracker(MODEL), Counter(), looker), looker  # type: ignore[arg-type]


def neck_of(result: TrackResult) -> np.ndarray:
    (puppet,) = result.puppets
    return np.asarray(puppet.joints[MODEL.joint_names.index("neck")])


def test_tracks_begin_in_the_image_that_was_searched_and_glances_follow() -> None:
    lookout, looker = watching(detect_delay=0.25, glance_interval=0.3, glance_delay=0.15, detect_interval=0.7)
    results = [lookout.step(image(number), number * TENTH, None, None) for number in range(12)]
    assert [len(result.puppets) for result in results] == [0] * 3 + [1] * 9
    assert looker.searched == [0, 7] and [number for number, _ in looker.glanced] == [3, 6, 9]
    for number, result in enumerate(results[3:], start=3):
        np.testing.assert_allclose(neck_of(result), joints(number)[JOINTS.index("neck")], atol=4.0)


def test_a_glance_moves_the_arms_to_where_they_are_in_the_image_it_is_used_with() -> None:
    lookout, looker = watching(detect_delay=0.0, glance_interval=0.0, glance_delay=0.15)
    wrist, used = MODEL.joint_names.index("left_wrist"), 0
    for number in range(12):
        (puppet,) = lookout.step(image(number), number * TENTH, None, None).puppets or (None,)
        if puppet is not None and looker.glanced and number == looker.glanced[0][0] + 2 * (used + 1):
            used += 1
            np.testing.assert_allclose(puppet.joints[wrist], joints(number)[JOINTS.index("left_wrist")], atol=8.0)
            assert puppet.confidence[wrist] > 0.5
    assert used >= 4


def test_who_comes_later_is_found_by_a_search_and_seen_by_the_next_glance() -> None:
    lookout, looker = watching(
        detect_delay=0.1, search_interval=0.5, detect_interval=0.5, glance_interval=0.0, glance_delay=0.05
    )
    looker._people = lambda image, known=looker._people: known(image)[: 1 + (image[0, 0, 0] >= 4)]  # type: ignore
    results = [lookout.step(image(number, "two"), number * TENTH, None, None) for number in range(12)]
    assert looker.searched[:2] == [0, 5]
    first = next(number for number, result in enumerate(results) if len(result.puppets) == 2)
    assert first == 5 + 3 + 1, "a search takes thrice as long while somebody is tracked, a glance an image"
    assert max(count for _, count in looker.glanced) == 2
    assert {puppet.id for puppet in results[-1].puppets} == {"a1", "a2"}


def test_who_is_found_no_more_is_not_glanced_at() -> None:
    lookout, looker = watching(detect_delay=0.1, search_interval=0.4, detect_interval=0.4, glance_delay=0.05)
    looker.unseen = tuple(range(3, 30))
    for number in range(14):
        lookout.step(image(number), number * TENTH, None, None)
    assert looker.glanced and max(number for number, _ in looker.glanced) <= 6


def test_after_a_cut_nobody_stands_where_they_stood_and_it_is_searched_at_once() -> None:
    lookout, looker = watching(detect_delay=0.1, glance_interval=0.0, glance_delay=0.15)
    for number in range(6):
        before = lookout.step(image(number), number * TENTH, None, None)
    assert len(before.puppets) == 1
    for number in range(6, 12):
        after = lookout.step(image(number, "nobody"), number * TENTH, None, None)
        assert not after.puppets
    assert 6 in looker.searched


@pytest.mark.parametrize("stamps", [[0] * 100, list(range(0, -100, -1))])
def test_stamps_that_stand_still_or_go_back_do_not_stop_the_looks(stamps: list[int]) -> None:
    lookout, looker = watching(search_interval=FRAME_NS * 10e-9, detect_delay=0.0)
    looker.unseen = tuple(range(256))
    for number, stamp in enumerate(stamps):
        lookout.step(image(number % 30), stamp * SECOND, None, None)
    assert 8 <= len(looker.searched) <= 100


def test_who_is_sure_enough_can_change_between_searches() -> None:
    lookout, _ = watching(least_person=0.3)
    lookout.reconfigure(LiveTrackerSettings(least_person=0.8))
    assert lookout._watch.searches.least == 0.8


def test_an_image_of_another_size_starts_anew() -> None:
    lookout, looker = watching(detect_delay=0.0)
    lookout.step(image(0), 0, None, None)
    assert not lookout.step(image(1)[:200], SECOND, None, None).puppets
    assert looker.searched == [0, 1]


def test_places_are_carried_in_shares_of_the_image_and_lost_or_kept_where_the_flow_is_unknown() -> None:
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
    settings = PuppetTrackerSettings(preset="fast", detect_delay=0.1, detect_interval=0.4, search_interval=0.4)
    component = PuppetTrackerComponent(settings, FACTORY)
    component.background = threads
    found = []
    for number in range(10):
        header = make_header(FACTORY, number * SECOND // 10, "camera")
        made = component.handle("image", make_image(FACTORY, header, DRAWN.image(number / 10), "rgb8"))
        found += [message for port, message in made if port == "puppets"]
    assert component.counters["searches with people"] == 2 and component.counters["glances"] >= 2
    return [bytes(typestore().serialize_cdr(message, PUPPETS)) for message in found], found


def test_people_are_found_without_detections_and_the_same_beside_the_work_as_in_a_replay() -> None:
    with ThreadPoolExecutor(1) as threads:
        live, _ = puppets(threads)
    replayed, messages = puppets(None)
    assert live == replayed and puppets(LastMoment())[0] == replayed
    assert [len(message.puppets) for message in messages] == [0] + [1] * 9
    assert {puppet.id for message in messages for puppet in message.puppets} == {"a1"}
    neck = np.array([next((j.x, j.y) for j in m.puppets[0].joints if j.name == "neck") for m in messages[1:]])
    truth = np.array([DRAWN.joints(stamp_ns(m) / SECOND)[0] for m in messages[1:]])
    assert np.abs(neck - truth).max() < 10
