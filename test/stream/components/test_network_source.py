# SPDX-License-Identifier: Apache-2.0
"""The source of people that the puppet tracker's settings name: keypoint networks, or the own detector without them."""

import sys
from collections.abc import Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.bag.frames import open_bag_frames
from flowing_puppet_ros.bag.typestore import BagMessageFactory, typestore
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.networks import choice
from flowing_puppet_ros.image.networks.choice import are_installed
from flowing_puppet_ros.image.networks.keypoint_networks import FoundPerson
from flowing_puppet_ros.image.networks.sources import NOT_INSTALLED
from flowing_puppet_ros.image.person_mask import PersonMask
from flowing_puppet_ros.image.video import live_tracker
from flowing_puppet_ros.image.video.network_tracker import NetworkTracker
from flowing_puppet_ros.stream.components.puppet_tracker import PuppetTrackerComponent, PuppetTrackerSettings
from flowing_puppet_ros.stream.messages.geometry import make_header
from flowing_puppet_ros.stream.messages.images import decode_labels, make_image
from flowing_puppet_ros.stream.messages.message_types import PUPPETS

FACTORY = BagMessageFactory()
GOLDEN = Path(__file__).parents[3] / "bags" / "golden" / "golden.mcap"
NAMES = ("neck", "belly", "face", "right_shoulder", "left_shoulder", "right_hip", "left_hip")
JOINTS = np.array([[80, 40], [80, 75], [80, 25], [65, 45], [95, 45], [70, 100], [90, 100]], float)
STEP_NS = 33_333_333
SHOWN = np.zeros((60, 80), dtype=np.uint8)
SHOWN[8:55, 30:50] = 255


class Fixed:
    """Finds the same person in every image, and counts how often it was asked."""

    def __init__(self) -> None:
        self.asked = 0

    def find(
        self, image: np.ndarray, known: Sequence[Keypoints] = (), everybody: bool = True, max_people: int = 6
    ) -> list[FoundPerson]:
        self.asked += 1
        mask = PersonMask.of_grid(SHOWN, (image.shape[1], image.shape[0]))
        return [FoundPerson(Keypoints(NAMES, JOINTS, np.full(7, 0.9), mask=mask), 0.9)]


@pytest.fixture
def nothing_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FLOWING_PUPPET_NETWORKS", str(tmp_path / "networks"))
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "python"))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "user"))
    choice._load.cache_clear()


def settings(**values: Any) -> PuppetTrackerSettings:
    return PuppetTrackerSettings.from_mapping({"flow.preset": "fast", "flow.max_side": 160} | values)


def play(component: PuppetTrackerComponent, images: Sequence[np.ndarray]) -> list[Any]:
    """Return the messages about the people of images at 30 a second."""
    told = []
    for number, pixels in enumerate(images):
        header = make_header(FACTORY, 10**9 + number * STEP_NS, "camera")
        told += component.handle("image", make_image(FACTORY, header, pixels, "rgb8"))
    return [message for port, message in told if port == "puppets"]


def uses_networks(component: PuppetTrackerComponent) -> bool:
    return isinstance(component._live, NetworkTracker)


def plain(count: int) -> list[np.ndarray]:
    texture = np.random.default_rng(4).integers(100, 140, (120, 160, 3)).astype(np.uint8)
    return [texture] * count


def test_auto_without_networks_warns_once_and_takes_the_own_detector(nothing_installed: None) -> None:
    component = PuppetTrackerComponent(settings(), FACTORY)
    assert not uses_networks(component)
    assert len(play(component, plain(3))) == 3
    assert [text for text in component.report.warnings if "networks" in text] == [NOT_INSTALLED]
    assert component.counters["images"] == 3 and component.counters["unusable"] == 0


@pytest.mark.parametrize("source", ["own", "none"])
def test_who_chooses_otherwise_is_not_warned(source: str, nothing_installed: None) -> None:
    component = PuppetTrackerComponent(settings(**{"detection.source": source}), FACTORY)
    assert len(play(component, plain(2))) == 2 and not component.report.warnings


def test_neural_without_networks_is_one_sentence_and_changes_nothing_of_who_runs(nothing_installed: None) -> None:
    with pytest.raises(InputError, match="are not installed: run `flowing-puppet networks --install`"):
        PuppetTrackerComponent(settings(**{"detection.source": "neural"}), FACTORY)
    component = PuppetTrackerComponent(settings(**{"detection.source": "none"}), FACTORY)
    flow, live, before = component._tracker.optical_flow, component._live, component.settings
    with pytest.raises(InputError, match="are not installed"):
        component.reconfigure(settings(**{"detection.source": "neural", "flow.preset": "ultrafast"}))
    assert component._tracker.optical_flow is flow and component._live is live and component.settings is before


def test_the_source_can_change_while_the_tracker_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    fixed, asked = Fixed(), []

    def load(source: str, **_: Any) -> Fixed | None:
        asked.append(source)
        return fixed if source == "neural" else None

    monkeypatch.setattr(live_tracker, "load_networks", load)
    component = PuppetTrackerComponent(settings(**{"detection.source": "none"}), FACTORY)
    assert not uses_networks(component) and not asked
    component.reconfigure(settings(**{"detection.source": "neural"}))
    assert uses_networks(component) and asked == ["neural"]
    messages = play(component, plain(4))
    assert [len(message.puppets) for message in messages] == [1] * 4 and fixed.asked == 4
    assert component.counters["searches for everybody"] == 1 and component.counters["close looks"] == 3
    component.reconfigure(settings(**{"detection.source": "neural", "detection.min_probability": 0.5}))
    assert uses_networks(component) and asked == ["neural"], "they are not loaded again"
    component.set_expected("detections", True)
    play(component, plain(2))
    assert fixed.asked == 4, "while somebody publishes detections the networks rest"


def test_masks_are_told_before_the_puppets_where_somebody_wants_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_tracker, "load_networks", lambda source, **_: Fixed())
    component = PuppetTrackerComponent(settings(), FACTORY)
    told = []
    for number in range(4):
        component.set_subscribed("person_masks", number > 1)
        image = make_image(FACTORY, make_header(FACTORY, 10**9 + number * STEP_NS, "camera"), plain(1)[0], "rgb8")
        told.append([(port, message) for port, message in component.handle("image", image)])
    assert [[port for port, _ in each] for each in told] == [["puppets"]] * 2 + [["person_masks", "puppets"]] * 2
    (_, mask), (_, puppets) = told[3]
    assert mask.header == puppets.header
    labels = decode_labels(mask)
    assert (labels[60, 80], labels[60, 20]) == (1, 0)


def test_a_network_file_that_is_not_there_is_one_sentence(nothing_installed: None) -> None:
    with pytest.raises(InputError, match=r"absent.yaml cannot be read: No such file"):
        PuppetTrackerComponent(settings(**{"detection.network": "absent.yaml"}), FACTORY)


@pytest.mark.slow
@pytest.mark.skipif(not are_installed(), reason="no keypoint networks: `flowing-puppet networks --install`")
def test_the_installed_networks_tell_the_same_live_and_replayed() -> None:
    images = [frame.image for frame, _ in open_bag_frames(GOLDEN, "", False, pytest.fail)]

    def run(threads: Executor | None) -> list[Any]:
        component = PuppetTrackerComponent(settings(**{"detection.source": "neural"}), FACTORY)
        component.background = threads
        return play(component, images)

    replayed = run(None)
    assert [len(message.puppets) for message in replayed] == [1] * len(images)
    with ThreadPoolExecutor(2) as threads:
        live = run(threads)
    serialized = [[bytes(typestore().serialize_cdr(one, PUPPETS)) for one in told] for told in (replayed, live)]
    assert serialized[0] == serialized[1]
