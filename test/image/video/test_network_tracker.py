# SPDX-License-Identifier: Apache-2.0
"""Keypoint networks beside the tracking of a stream: when they run, on whom, and that a replay gives the same."""

from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cache
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.flow.settings import FlowSettings
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.formats.video_reader import VideoFrame
from flowing_puppet_ros.image.networks.agreement import calibrate
from flowing_puppet_ros.image.networks.keypoint_networks import FoundPerson
from flowing_puppet_ros.image.tracking.tracker import FlowingPuppetTracker, TrackResult
from flowing_puppet_ros.image.video.clip import Clip, track_clip, track_live
from flowing_puppet_ros.image.video.network_tracker import NetworkTracker
from flowing_puppet_ros.image.video.settings import ClipSettings, LiveDetectionSettings, NetworkTimingSettings
from test.helpers.drawn_people import BACKGROUND, NAMES, CapsuleModel, draw, pose

SCENES = ("one", "two", "crossing", "later", "nobody", "elsewhere")
SECOND = 1_000_000_000
QUICK = FlowSettings(preset="fast", max_side=160)
LEFT, RIGHT = (80.0, 118.0), (240.0, 118.0)
NECK = NAMES.index("neck")
SHIRTS = ((1.0, 0.35, 0.35), (0.35, 0.35, 1.0))


def place_people(number: int, scene: str) -> list[np.ndarray]:
    """Return the joints of the people of image `number`, ten steps a second."""
    if scene in ("nobody", "elsewhere"):
        return []
    if scene == "later" and number < 9:
        return [pose(0.2 * number, LEFT)]
    if scene in ("two", "later"):
        return [pose(0.2 * number, LEFT), pose(-0.2 * number, RIGHT)]
    if scene == "crossing":
        return [pose(0.0, (70.0 + 6 * number, 118.0)), pose(0.0, (250.0 - 6 * number, 118.0))]
    return [pose(number)]


@cache
def image(number: int, scene: str = "one") -> np.ndarray:
    """Return image `number` of a scene, both written into its first pixel."""
    people = place_people(number, scene)
    pixels = draw(*people, shirts=SHIRTS[: len(people)]) if scene != "elsewhere" else 255 - BACKGROUND // 2
    pixels[0, 0] = number, SCENES.index(scene), 0
    return pixels


@dataclass
class Seer:
    """Knows the people of the drawn images; sees those near to the known ones, or everybody, and remembers it all."""

    looks: list[tuple[int, list[int], bool]] = field(default_factory=list)
    blind: bool = False
    confidence: float = 0.9

    def find(
        self, image: np.ndarray, known: Sequence[Keypoints] = (), everybody: bool = True, max_people: int = 6
    ) -> list[FoundPerson]:
        if image.ndim < 3:
            return []
        number = int(image[0, 0, 0])
        true = place_people(number, SCENES[image[0, 0, 1]])
        necks = [person.xy[person.names.index("neck")] for person in known]
        self.looks.append((number, sorted(round(float(neck[0])) for neck in necks), everybody))
        if self.blind:
            return []
        near = [person for person in true if any(np.hypot(*(person[NECK] - neck)) < 40 for neck in necks)]
        seen = true if everybody else near
        sure = np.full(len(NAMES), self.confidence)
        return [FoundPerson(Keypoints(NAMES, person.copy(), sure), 0.9) for person in seen][:max_people]

    @property
    def searches(self) -> list[int]:
        """Numbers of the images in which everybody was looked for."""
        return [number for number, _, everybody in self.looks if everybody]

    @property
    def counts(self) -> list[int]:
        """How many known people each run looked at."""
        return [len(necks) for _, necks, _ in self.looks]


def tracking(seer: Seer | None = None, **timing: float) -> tuple[NetworkTracker, Seer]:
    seer = seer or Seer()
    settings = LiveDetectionSettings(networks=NetworkTimingSettings(**timing))
    model: Any = CapsuleModel()
    return NetworkTracker(FlowingPuppetTracker(model, flow_settings=QUICK), settings, seer, Counter()), seer


def play(live: NetworkTracker, numbers: Sequence[int], scene: str = "one", rate: float = 30.0) -> list[TrackResult]:
    return [live.step(image(k, scene), round(k * SECOND / rate)) for k in numbers]


def neck_errors(results: Sequence[TrackResult], numbers: Sequence[int], scene: str = "one") -> np.ndarray:
    """Return for each puppet how far its neck is from the nearest true one."""
    return np.array([
        min(np.hypot(*(puppet.joints[NECK] - person[NECK])) for person in place_people(k, scene))
        for k, result in zip(numbers, results, strict=True)
        for puppet in result.puppets
    ])  # fmt: skip


def test_in_a_fast_stream_the_next_image_uses_what_was_found_in_a_slow_one_the_image_itself() -> None:
    live, _ = tracking()
    fast = play(live, range(8))
    assert [len(result.puppets) for result in fast] == [1] * 8, "the first image waits"
    assert live.people is None and neck_errors(fast, range(8)).max() < 3
    live, seer = tracking()
    for k in range(8):
        (result,) = play(live, [k], rate=10.0)
        assert live.people is not None and len(result.puppets) == 1 and result.puppets[0].detection == 0
    assert [number for number, _, _ in seer.looks] == list(range(8))


def test_two_people_are_looked_at_in_turn_in_a_fast_stream_and_both_in_each_image_of_a_slow_one() -> None:
    live, seer = tracking(everybody_interval=100.0, looks=60.0)
    play(live, range(12), "two")
    assert seer.counts[0] == 0 and set(seer.counts[2:]) == {1}, "half of 60 looks a second at 30 images a second"
    sides = [necks[0] < 160 for _, necks, _ in seer.looks if necks]
    assert all(one != other for one, other in pairwise(sides)), "the two in turn"
    assert not any(track.missed for track in live._tracker.tracks), "who is not looked at is not missed"
    live, seer = tracking(everybody_interval=100.0, looks=60.0)
    play(live, range(6), "two", rate=10.0)
    assert seer.counts == [0] + [2] * 5
    live, seer = tracking(everybody_interval=100.0)
    play(live, range(12), "two")
    assert len(seer.looks) == pytest.approx(7, abs=1), "half as many looks as images"


def test_searches_for_everybody_are_frequent_while_nobody_is_there_and_rare_then() -> None:
    live, seer = tracking()
    play(live, range(13), "nobody")
    assert seer.searches == [0, 3, 6, 9, 12] and len(seer.looks) == 5
    live, seer = tracking(everybody_interval=0.5)
    play(live, range(31))
    assert seer.searches == [0, 15, 30]
    live, seer = tracking(looks=1000.0, everybody_interval=0.0)
    play(live, range(5), rate=10.0)
    assert seer.searches == list(range(5)) and seer.counts[1:] == [1] * 4, "a search beside a look at the person"


def test_who_comes_later_is_found_by_the_next_search() -> None:
    live, seer = tracking(everybody_interval=0.3)
    results = play(live, range(12), "later")
    assert [len(result.puppets) for result in results] == [1] * 10 + [2] * 2
    assert seer.searches == [0, 9]


def test_who_is_lost_is_dropped_and_found_again_under_a_new_id() -> None:
    live, seer = tracking()
    (first,) = {puppet.id for result in play(live, range(5)) for puppet in result.puppets}
    seer.blind = True
    lost = play(live, range(5, 60))
    assert len(lost[0].puppets) == 1 and not lost[-1].puppets
    seer.blind = False
    (again,) = {puppet.id for puppet in play(live, range(60, 70))[-1].puppets}
    assert again != first


def test_after_a_cut_nobody_stays_and_everybody_is_looked_for_in_the_next_image() -> None:
    live, seer = tracking(everybody_interval=0.2, search_interval=0.1)
    play(live, range(7))
    assert seer.searches == [0, 6]
    after = play(live, range(7, 10), "elsewhere")
    assert after[0].restarted and not any(result.puppets for result in after)
    assert seer.searches == [0, 6, 8]


@pytest.mark.parametrize("change", ["stamp", "size"])
def test_a_stream_that_starts_anew_is_searched_in_its_first_image(change: str) -> None:
    live, seer = tracking()
    play(live, range(6))
    pixels = image(6) if change == "stamp" else image(6)[:200]
    result = live.step(pixels, 0 if change == "stamp" else 6 * SECOND // 30)
    assert result.warnings and len(result.puppets) == 1 and seer.searches == [0, 6]
    assert len(live.step(image(7) if change == "stamp" else image(7)[:200], 7 * SECOND // 30).puppets) == 1


def test_stamps_that_stand_still_do_not_stop_the_networks() -> None:
    live, seer = tracking()
    for k in range(40):
        result = live.step(image(k), 0)
    assert len(result.puppets) == 1 and len(seer.searches) >= 2 and len(seer.looks) > 30


def test_two_people_who_cross_keep_their_ids() -> None:
    live, _ = tracking()
    results = play(live, range(31), "crossing")
    assert {len(result.puppets) for result in results[1:]} == {2}
    sides = []
    for number in (1, 30):
        left, right = sorted(results[number].puppets, key=lambda puppet: puppet.joints[NECK, 0])
        sides.append((left.id, right.id))
    assert sides[0] == sides[1][::-1] and len({puppet.id for result in results for puppet in result.puppets}) == 2


def test_many_people_who_come_and_go_leave_nothing_behind() -> None:
    live, _ = tracking(search_interval=0.0)
    ids = set()
    for k in range(24):
        ids |= {puppet.id for puppet in live.step(image(k % 6, "two"), 2 * k * SECOND).puppets}
        live.step(image(0, "elsewhere"), (2 * k + 1) * SECOND)
    assert len(ids) == 48
    assert len(live._looked_ns) <= 2 and live._looks <= 2


def test_told_confidence_is_the_probability_of_the_fused_one() -> None:
    live, _ = tracking(Seer(confidence=0.5))
    (result,) = play(live, [0])
    (puppet,) = result.puppets
    (track,) = live._tracker.tracks
    np.testing.assert_allclose(puppet.confidence, calibrate(track.confidence) * puppet.visible)
    assert not np.allclose(puppet.confidence, track.confidence * puppet.visible)


def test_what_is_no_image_is_refused_and_changes_nothing() -> None:
    live, seer = tracking()
    (before,) = play(live, [0])[0].puppets
    for wrong in (image(1).astype(float), image(1)[:10], np.zeros((240, 320, 4), np.uint8)):
        with pytest.raises(InputError, match="an image must be"):
            live.step(wrong, SECOND // 30)
    (after,) = play(live, [1])[0].puppets
    assert after.id == before.id and len(seer.looks) == 2
    assert not live.step(np.ascontiguousarray(image(0)[..., 0]), SECOND).warnings


def test_a_warm_up_runs_the_networks_and_leaves_no_trace() -> None:
    live, seer = tracking()
    puppet = play(live, [0])[0].puppets[0]
    live, seer = tracking()
    live.warm_up(image(0), puppet)
    assert seer.counts == [1, 1] and not live._tracker.tracks and live._everybody_ns is None
    live.reconfigure(LiveDetectionSettings(networks=NetworkTimingSettings(search_interval=0.2)))
    play(live, range(7), "nobody")
    assert seer.searches[2:] == [0, 6]


class LastMoment(Executor):
    """Does its work when somebody asks for the result."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Any:
        return SimpleNamespace(result=cache(lambda: fn(*args, **kwargs)))


def joints_of(executor: Executor | None) -> tuple[list[bytes], Counter[str]]:
    """Return the puppets of a stream of changing rate, with a cut and a restart, and what was counted."""
    live, _ = tracking(everybody_interval=0.2)
    stamps = [k * SECOND // 30 for k in range(10)] + [SECOND + k * SECOND // 10 for k in range(3)]
    scenes = ["two"] * 6 + ["one"] * 7
    told = [live.step(image(k, scene), stamps[k], executor=executor) for k, scene in enumerate(scenes)]
    told.append(live.step(image(0, "one"), 0, executor=executor))
    told += [live.step(image(k, "one"), k * SECOND // 30, executor=executor) for k in range(1, 4)]
    found = [puppet.joints.tobytes() + puppet.confidence.tobytes() for one in told for puppet in one.puppets]
    return found, live._counters


def test_beside_the_tracking_the_networks_give_the_same_as_in_a_replay() -> None:
    replayed, counted = joints_of(None)
    with ThreadPoolExecutor(2) as threads:
        assert joints_of(threads) == (replayed, counted)
    assert joints_of(LastMoment()) == (replayed, counted)
    assert len(replayed) > 15 and counted["close looks"] > 5 and counted["searches for everybody"] >= 4


def frames(count: int) -> list[VideoFrame]:
    return [VideoFrame(k, k * SECOND // 30, image(k), "") for k in range(count)]


@pytest.mark.parametrize("live", [False, True])
def test_clips_are_tracked_by_a_close_look_at_every_image(live: bool) -> None:
    seer, model = Seer(), CapsuleModel()
    track: Any = track_live if live else track_clip
    told = list(track(Clip.of(frames(5)), model, ClipSettings(flow=QUICK), networks=seer))
    assert [number for number, _, _ in seer.looks] == list(range(5))
    assert seer.counts == [0, 1, 1, 1, 1] and seer.searches == [0]
    assert [[puppet.id for puppet in frame.puppets] for frame in told] == [["a1"]] * 5
    for k, frame in enumerate(told):
        assert np.hypot(*(frame.puppets[0].joints[NECK] - pose(k)[NECK])) < 3
    seer.looks.clear()
    given = {0: [Keypoints(NAMES, pose(0), np.ones(15))]}
    list(track(Clip.of(frames(2), given), model, networks=seer))
    assert not seer.looks, "who comes with the clip is not looked for"
