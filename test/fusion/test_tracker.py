# SPDX-License-Identifier: Apache-2.0
"""A capsule man tracked through dropouts of puppets and of depth."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from capsule_man import joints_of  # type: ignore[import-not-found]
from watched_people import (  # type: ignore[import-not-found]
    Watched,
    find_puppet,
    make_colour_camera,
    stand_at,
    watch,
)

from flowing_puppet_ros.body.cloud.person_cloud import PersonCloud
from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter
from flowing_puppet_ros.body.settings import FitterSettings
from flowing_puppet_ros.body.track.body_tracker import BodyTracker
from flowing_puppet_ros.body.track.multi_body_tracker import MultiBodyTrackerSettings
from flowing_puppet_ros.body.track.tracked_body import TrackedBody
from flowing_puppet_ros.fusion.joint_fit import JointFitter
from flowing_puppet_ros.fusion.people_fitter import Claim, FusionSettings, PeopleFitter
from flowing_puppet_ros.fusion.tracker import FusedTracker
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.units import NANOSECONDS

pytestmark = pytest.mark.slow

FRAME_NS = 66_666_667
HOLD_S = 0.3
CAMERA = make_colour_camera()


def tracker(model: StitchedPuppet, hold: float = HOLD_S) -> FusedTracker:
    people = PeopleFitter(BodyFitter(model, FitterSettings()), FusionSettings())
    return FusedTracker(people, MultiBodyTrackerSettings(), hold)


class Walk:
    """A man who walks to the left at 0.9 m/s and lifts his left arm, and what a tracker makes of him."""

    def __init__(self, model: StitchedPuppet) -> None:
        self.model, self.tracker = model, tracker(model)

    def see(self, frame: int, identity: str | None = "a1", depth: bool = True) -> list[TrackedBody]:
        """Track the frame, with the puppet under an id, or without one (None), with or without depth of him."""
        self.man = stand_at(joints_of(raise_left=0.3 + 0.06 * frame), 2.4, -0.3 + 0.06 * frame)
        seen: Watched = watch([self.man] if depth else [], seed=frame)
        puppets = [] if identity is None else [find_puppet(self.model, self.man, CAMERA, identity, 5.0, frame)]
        return self.tracker.step(seen.seen_by(CAMERA), seen.image, puppets, (1 + frame) * FRAME_NS)[0]

    def stand(self, second: int) -> list[TrackedBody]:
        """Track the man of frame 0, who stands still, at a time in seconds."""
        self.man = stand_at(joints_of(raise_left=0.3), 2.4, -0.3)
        seen: Watched = watch([self.man], seed=0)
        puppets = [find_puppet(self.model, self.man, CAMERA, "a1", 5.0, 0)]
        return self.tracker.step(seen.seen_by(CAMERA), seen.image, puppets, (1 + second) * NANOSECONDS)[0]

    def error(self, body: TrackedBody) -> float:
        """Return the mean error of the arms' joints, metres."""
        names = [f"{side}_{name}" for side in ("left", "right") for name in ("shoulder", "elbow", "wrist")]
        fitted = body.fit.joints[[self.model.joint_names.index(name) for name in names]]
        return float(np.linalg.norm(fitted - np.array([self.man.joints[name] for name in names]), axis=1).mean())


def test_a_man_is_tracked_under_his_puppets_id_whatever_drops_out(model: StitchedPuppet) -> None:
    walk = Walk(model)
    for frame in range(3):
        (body,) = walk.see(frame)
        assert body.id == "a1"
        assert walk.error(body) < 0.045
    assert walk.see(3, depth=False) == []
    assert walk.tracker.occluded_ids == ["a1"]
    (body,) = walk.see(4, identity=None)  # the puppet is lost, the depth is there
    assert body.id == "a1"
    (body,) = walk.see(5)
    assert walk.error(body) < 0.045
    assert body.velocity[1] == pytest.approx(0.9, abs=0.25)
    for frame in (6, 7, 8, 9, 10, 11):
        assert walk.see(frame, identity=None, depth=False) == []
    assert walk.tracker.occluded_ids == []  # given up after 0.3 s
    assert walk.see(12, identity=None) == []  # and nobody is new without a puppet


def test_after_a_gap_a_body_moves_to_its_joints(model: StitchedPuppet, monkeypatch: pytest.MonkeyPatch) -> None:
    walk = Walk(model)
    walk.see(0)
    walk.see(1)
    fits: list[Claim] = []
    monkeypatch.setattr(PeopleFitter, "fit_claim", lambda self, claim, person: fits.append(claim))
    (body,) = walk.see(7)  # 0.4 s later, and 36 cm on
    assert walk.error(body) < 0.045
    assert not fits


def test_fits_that_find_nothing_better_become_rare(model: StitchedPuppet, monkeypatch: pytest.MonkeyPatch) -> None:
    walk, found, fitted = Walk(model), PeopleFitter.fit_claim, list[int]()
    track = BodyTracker.track

    def fit(people: PeopleFitter, claim: Claim, person: PersonCloud, *given: Any) -> BodyFit | None:
        made = None if fitted else found(people, claim, person, *given)
        fitted.append(person.stamp // NANOSECONDS - 1)
        return made

    def doubt(*given: Any) -> BodyFit | None:
        tracked = track(*given)
        return None if tracked is None else replace(tracked, reliable=False)

    monkeypatch.setattr(PeopleFitter, "fit_claim", fit)
    monkeypatch.setattr(BodyTracker, "track", doubt)
    for second in range(9):
        assert len(walk.stand(second)) == 1
    assert fitted == [0, 1, 3, 7]


def test_in_a_running_stream_a_new_body_comes_quickly_and_is_checked_in_the_next_cloud(
    model: StitchedPuppet, monkeypatch: pytest.MonkeyPatch
) -> None:
    walk, tried = Walk(model), list[str]()
    for name in ("fit", "fit_quickly"):
        way = getattr(JointFitter, name)

        def note(fitter: JointFitter, *given: Any, name: str = name, way: Any = way) -> BodyFit:
            tried.append(name)
            fit: BodyFit = way(fitter, *given)
            return fit

        monkeypatch.setattr(JointFitter, name, note)
    assert walk.see(0, identity=None) == []
    for frame in (1, 2, 3):
        (body,) = walk.see(frame)
        assert walk.error(body) < 0.045
    assert tried == ["fit_quickly", "fit"]
    tried.clear()
    Walk(model).see(0)  # there may be no other cloud
    assert tried == ["fit"]


def test_puppets_without_ids_get_some_that_stay(model: StitchedPuppet) -> None:
    walk = Walk(model)
    ids = [[body.id for body in walk.see(frame, identity="")] for frame in range(3)]
    assert ids == [["p1"]] * 3
    walk.tracker.reset()
    assert [body.id for body in walk.see(0, identity="")] == ["p2"]
