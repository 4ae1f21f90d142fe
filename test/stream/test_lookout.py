# SPDX-License-Identifier: Apache-2.0
"""The detector beside the tracker: when it looks, how its answer is carried, the same live and replayed."""

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.bag.typestore import BagMessageFactory, typestore
from flowing_puppet_ros.evaluate.drawn_person import DrawnPerson
from flowing_puppet_ros.flow.estimate import FlowSettings, OpticalFlow
from flowing_puppet_ros.image.keypoints import Keypoints
from flowing_puppet_ros.stream.component import PUPPETS
from flowing_puppet_ros.stream.images import make_image
from flowing_puppet_ros.stream.lookout import FRAME_NS, Lookout, LookoutSettings, carried
from flowing_puppet_ros.stream.messages import make_header, stamp_ns
from flowing_puppet_ros.stream.puppet_tracker import PuppetTrackerComponent, PuppetTrackerSettings

FACTORY = BagMessageFactory()
SECOND = 1_000_000_000


class Watched(Lookout):
    """A lookout whose detector sees one keypoint, at the brightest pixel, and remembers which images it was shown."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(LookoutSettings(**settings), 8, OpticalFlow(FlowSettings()))
        self.shown: list[int] = []

    def _detect(self, image: Any, least_person: float | None = None) -> list[Keypoints]:
        self.shown.append(int(image[0, 0, 0]))
        y, x = np.unravel_index(image[..., 1].argmax(), image.shape[:2])
        return [Keypoints(("neck",), np.array([[x, y]], float), np.ones(1))]


def image(number: int) -> Any:
    """An image with its number in the first pixel and a bright spot that moves 2 px to the right each time."""
    pixels = np.zeros((64, 96, 3), np.uint8)
    pixels[:, :, 2] = np.random.default_rng(0).integers(0, 255, (64, 96))
    pixels = np.roll(pixels, 2 * number, axis=1)
    pixels[30, 20 + 2 * number, 1] = 255
    pixels[0, 0, 0] = number
    return pixels


def flow(right: float) -> Any:
    """A flow pair of everything that moves to the right."""
    field = np.zeros((64, 96, 2), np.float32)
    field[..., 0] = right
    return field, -field


def test_an_answer_is_carried_along_the_flow_to_the_image_that_it_is_used_with() -> None:
    lookout = Watched(detect_delay=0.29, detect_interval=1.0)
    found = {}
    for number in range(14):
        pair = flow(2.0)
        answer = lookout.ask(image(number), number * SECOND // 10, True, pair, None)
        lookout.tracked(number * SECOND // 10, pair if number else None)
        if answer is not None:
            found[number] = answer.people[0].xy[0]
            assert answer.seen_in is None and answer.flow is pair
    assert lookout.shown == [0, 10]
    assert list(found) == [3, 13]
    for number, place in found.items():
        np.testing.assert_allclose(place, (20 + 2 * number, 30), atol=1e-3)


def test_while_nobody_is_tracked_the_answer_is_for_the_image_that_was_looked_at() -> None:
    lookout = Watched(detect_delay=0.15, search_interval=0.3)
    answers = [lookout.ask(image(number), number * SECOND // 10, False, None, None) for number in range(6)]
    assert lookout.shown == [0, 3]
    (first, second) = [answer for answer in answers if answer is not None]
    assert first.seen_in is not None and second.seen_in is not None
    assert (first.seen_in[1], second.seen_in[1]) == (0, 3 * SECOND // 10)
    assert first.people[0].xy.tolist() == [[20, 30]]


def test_a_track_that_broke_off_makes_the_answer_worthless() -> None:
    lookout = Watched(detect_delay=0.25)
    for number in range(4):
        assert lookout.ask(image(number), number * SECOND // 10, number != 1, flow(2.0), None) is None
        lookout.tracked(number * SECOND // 10, None if number == 1 else flow(2.0))


@pytest.mark.parametrize("stamps", [[0] * 100, list(range(0, -100, -1))])
def test_stamps_that_stand_still_or_go_back_do_not_stop_the_looks(stamps: list[int]) -> None:
    lookout = Watched(search_interval=FRAME_NS * 10e-9, detect_delay=0.0)
    for number, stamp in enumerate(stamps):
        lookout.ask(image(number % 30), stamp * SECOND, False, None, None)
    assert 8 <= len(lookout.shown) <= 100


def test_an_image_of_another_size_starts_anew() -> None:
    lookout = Watched(detect_delay=0.0)
    lookout.ask(image(0), 0, False, None, None)
    assert lookout.ask(image(1)[:32], SECOND, False, None, None) is None
    assert lookout.shown == [0, 1]


def test_keypoints_are_carried_in_shares_of_the_image_and_lost_where_the_flow_is_unknown() -> None:
    person = Keypoints(("neck", "face", "belly"), np.array([[10.0, 20], [np.nan, np.nan], [90, 20]]), np.ones(3))
    field = np.zeros((16, 25, 2), np.float32)
    field[..., 0] = 0.05
    field[:, 20:] = np.nan
    moved = carried(person, [field, field], (100, 64))
    np.testing.assert_allclose(moved.xy, np.array([[20, 20], [np.nan, np.nan], [np.nan, np.nan]]), atol=1e-4)


def puppets(threads: ThreadPoolExecutor | None) -> tuple[list[bytes], list[Any]]:
    """Return what the tracker says of a drawn person, as bytes and as messages."""
    drawn = DrawnPerson((320, 240))
    settings = PuppetTrackerSettings(preset="fast", detect_delay=0.2, detect_interval=0.4, search_interval=0.4)
    component = PuppetTrackerComponent(settings, FACTORY)
    component.background = threads
    found = []
    for number in range(10):
        header = make_header(FACTORY, number * SECOND // 10, "camera")
        made = component.handle("image", make_image(FACTORY, header, drawn.image(number / 10), "rgb8"))
        found += [message for port, message in made if port == "puppets"]
    assert component.counters["looks with people"] == 2
    return [bytes(typestore().serialize_cdr(message, PUPPETS)) for message in found], found


def test_people_are_found_without_detections_and_the_same_beside_the_work_as_in_a_replay() -> None:
    with ThreadPoolExecutor(1) as threads:
        live, _ = puppets(threads)
    replayed, messages = puppets(None)
    assert live == replayed
    assert [len(message.puppets) for message in messages] == [0, 0] + [1] * 8
    assert {puppet.id for message in messages for puppet in message.puppets} == {"a1"}
    neck = np.array([next((j.x, j.y) for j in m.puppets[0].joints if j.name == "neck") for m in messages[2:]])
    truth = np.array([DrawnPerson((320, 240)).joints(stamp_ns(m) / SECOND)[0] for m in messages[2:]])
    assert np.abs(neck - truth).max() < 10
