# SPDX-License-Identifier: Apache-2.0
"""The rows of `evaluate video` whose people come from keypoint networks."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.video import methods
from flowing_puppet_ros.evaluate.video.methods import ClipRun, all_names, check_names, run_method
from flowing_puppet_ros.flow.settings import FlowSettings
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.formats.video_reader import VideoFrame
from flowing_puppet_ros.image.networks.keypoint_networks import FoundPerson
from flowing_puppet_ros.image.video.settings import ClipSettings
from flowing_puppet_ros.model.ds.puppet import DeformableStructures

NAMES = ("neck", "belly", "face", "right_shoulder", "left_shoulder", "right_hip", "left_hip")
JOINTS = np.array([[80, 40], [80, 75], [80, 25], [65, 45], [95, 45], [70, 100], [90, 100]], float)


class Fixed:
    """Finds the same person in every image."""

    def find(
        self, image: np.ndarray, known: Sequence[Keypoints] = (), everybody: bool = True, max_people: int = 6
    ) -> list[FoundPerson]:
        return [FoundPerson(Keypoints(NAMES, JOINTS, np.full(7, 0.9)), 0.9)]


@pytest.mark.parametrize("name", ["networks-detector", "networks-live", "networks-node", "networks-default"])
def test_people_of_a_row_come_from_the_networks_and_from_no_given_keypoints(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def load(source: str) -> Fixed:
        assert source == "neural"
        return Fixed()

    monkeypatch.setattr(methods, "load_networks", load)
    texture = np.random.default_rng(4).integers(100, 140, (120, 160, 3)).astype(np.uint8)
    frames = [VideoFrame(k, k * 33_333_333, texture, "") for k in range(3)]
    given = {0: [Keypoints(NAMES, JOINTS + 40, np.ones(7))]}
    no_worker: Any = None
    settings = ClipSettings(flow=FlowSettings(preset="fast", max_side=160))
    run = ClipRun(DeformableStructures.load(), frames, no_worker, given, settings)
    track = run_method(name, run)
    assert [len(people) for people in track] == [1] * 3 and run.networks is None
    for (person,) in track:
        assert np.hypot(*(person.joints[run.joint_names.index("neck")] - JOINTS[0])) < 3


def test_rows_of_networks_are_offered_where_these_are_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(methods, "are_installed", lambda: True)
    assert "networks-live" in all_names(with_init=False)
    assert check_names(["networks-live", "networks-live-median"], with_init=False) == [
        "networks-live",
        "networks-live-median",
    ]
    monkeypatch.setattr(methods, "are_installed", lambda: False)
    assert not any(name.startswith("networks-") for name in all_names(with_init=True))
    with pytest.raises(InputError, match=r"networks-live needs the keypoint networks.*networks --install"):
        check_names(["networks-live"], with_init=False)


@pytest.mark.parametrize("name", ["networks-magic", "networks-init-live", "init-networks-live", "networks-"])
def test_a_row_that_is_none_is_one_sentence(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(methods, "are_installed", lambda: True)
    with pytest.raises(InputError, match=f"there is no method '{name}'"):
        check_names([name], with_init=True)
