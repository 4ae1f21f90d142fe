# SPDX-License-Identifier: Apache-2.0
"""One person of several who are tracked: where they are, what tracks their body, and whether they are a person."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.body.cloud.person_cloud import PersonCloud
from flowing_puppet_ros.body.fit.fitter import BodyFit
from flowing_puppet_ros.body.scene.rig_scene import shows_person
from flowing_puppet_ros.body.track.body_tracker import BodyTracker
from flowing_puppet_ros.body.track.person_belief import EVERY_SCAN, PersonBelief
from flowing_puppet_ros.body.track.tracked_body import TorsoMotion, TrackedBody
from flowing_puppet_ros.body.upright.found_body import ExpectedPerson, JudgedFit
from flowing_puppet_ros.body.upright.upright_fit import MIN_MANY_POINTS
from flowing_puppet_ros.errors import InputError

VELOCITY_HALF_LIFE_NS = 100_000_000  # in which half of a velocity is replaced by a new one
MAX_VELOCITY_GAP_NS = 2_000_000_000  # between clouds that give a velocity
REACH_M, SPEED_M_PER_S, CHANGE_M_PER_S = 0.4, 2.0, 1.0
"""From where somebody is expected to where they may be: by how the middle of what is seen differs, by the speed of one
whose velocity is not known yet, and by how a known one changes while nobody sees them."""
MAX_CLAIM_GAP_NS = 150_000_000
"""Time within which the body of somebody whose velocity is not known yet tells which points are theirs."""
REFIT_INTERVAL_NS = 5_000_000_000  # from one full fit of an unreliable body to the next
LOST_INTERVAL_NS, MAX_DOUBLINGS = 1_000_000_000, 4
"""The same of a lost body where full fits are to be seldom, from the second on; each doubles both, so many times: what
several full fits did not mend, more of them hardly will."""
AT_ONCE_INTERVAL_NS = 1_000_000_000  # between attempts at a body at once: people soon stand otherwise
UPRIGHT_FITS = 2
"""Full fits of somebody who had a rough body at once that try upright bodies only, in a tenth of the time."""
TURN_INTERVAL_NS = 1_000_000_000  # between attempts to turn a body round that walks backwards

DOUBLE_M = 0.2  # between the middles of two bodies, up to which one of the two people is none

Judge = Callable[[PersonCloud, BodyFit, bool], JudgedFit]
"""What a scan says about a body, or about a better one that it has instead; if wanted, also about one turned round."""


@dataclass(slots=True, eq=False)
class PersonTrack:
    """One person.

    The middle (3,) m of their cloud at `stamp` ns, its `velocity` m/s, what tracks the body, its `motion`, the number
    of full fits and the stamp of the last, those of the last attempts to turn it round and at a body at once, whether
    it is `proven` to be a person, what scans said about that, whether the velocity is known (`moves`), whether the body
    is a `rough` one that came at once, and how many of the next full fits try upright bodies only.
    """

    id: str
    number: int
    middle: F64
    stamp: int
    tracker: BodyTracker
    velocity: F64 = field(default_factory=lambda: np.zeros(3))
    motion: TorsoMotion = field(default_factory=TorsoMotion)
    fits: int = 0
    fitted: int = 0
    turned: int = -TURN_INTERVAL_NS
    tried: int = -AT_ONCE_INTERVAL_NS
    proven: bool = True
    belief: PersonBelief | None = None
    moves: bool = False
    rough: bool = False
    uprights: int = 0

    @property
    def shows_reliable(self) -> bool:
        """Whether the last body is reliable."""
        return self.tracker.last is not None and self.tracker.last.reliable

    def predict_middle(self, stamp: int) -> F64:
        """Return where the middle should be at a later time in nanoseconds."""
        return np.asarray(self.middle + self.velocity * 1e-9 * (stamp - self.stamp))

    def expect(self, stamp: int) -> ExpectedPerson:
        """Return where the person may be at a time in nanoseconds; nowhere without a body, as that needs a fit."""
        gap = stamp - self.stamp
        speed = CHANGE_M_PER_S if self.moves else SPEED_M_PER_S
        reach = REACH_M + speed * 1e-9 * gap if self.tracker.last is not None else 0.0
        return ExpectedPerson(self.predict_middle(stamp)[:2], reach, self.moves or gap <= MAX_CLAIM_GAP_NS)

    def is_due(self, stamp: int) -> bool:
        """Return whether a scan of a time in nanoseconds should be asked whether this is a person."""
        return self.belief is None or self.belief.is_due(stamp)

    @property
    def is_shown(self) -> bool:
        """Whether it was taken for a person."""
        return self.belief is not None and self.belief.shown

    def rank_asked(self) -> tuple[bool, int, int]:
        """Return what is the less, the sooner a scan is to be asked: who is not shown, by how often and when it was."""
        if self.belief is None:
            return False, 0, 0
        return self.is_shown, min(self.belief.count, EVERY_SCAN), self.belief.asked

    def is_double_of(self, other: PersonTrack) -> bool:
        """Return whether another track, of which more is known, was seen with its body where this one has its own."""
        own, known = self.tracker.last, other.tracker.last
        if own is None or known is None or other.stamp != self.stamp or self._standing >= other._standing:
            return False
        return bool(np.hypot(*(own.vertices.mean(axis=0) - known.vertices.mean(axis=0))[:2]) < DOUBLE_M)

    @property
    def _standing(self) -> tuple[bool, int, int]:
        """What is the more, the more is known of the person: whether it is shown, how often that was asked, its age."""
        return self.is_shown, 0 if self.belief is None else self.belief.count, -self.number

    def wants_fit(self, fit: BodyFit | None, stamp: int, seldom: bool) -> bool:
        """Return whether a full fit may give a better body than that of the cloud of a time in nanoseconds."""
        if fit is None or self.rough:
            return True
        passed, doubled = stamp - self.fitted, 2 ** min(self.fits, MAX_DOUBLINGS) if seldom else 1
        # A full fit to the little that is seen of a hidden person would bend the body.
        if not fit.reliable and not self.tracker.hidden and passed >= REFIT_INTERVAL_NS * doubled:
            return True
        return self.tracker.lost and (not seldom or self.fits < 2 or passed >= LOST_INTERVAL_NS * doubled)

    def prove(self, person: PersonCloud, fit: BodyFit) -> bool:
        """Return whether it is known to be a person, as a body of theirs may show from then on."""
        self.proven = self.proven or shows_person(person, fit)
        return self.proven and (self.belief is None or self.belief.decide())

    def start(self, person: PersonCloud, fit: BodyFit, rough: bool) -> None:
        """Start with a body that was found in the person's cloud, and what was said about it there."""
        self.tracker.start(person, fit)
        self.rough = rough and not fit.reliable
        self.uprights = UPRIGHT_FITS if rough else 0
        # Many points tell more than an upright body shows: a full fit may follow at once.
        doubtful = not fit.reliable and len(person.points) >= MIN_MANY_POINTS
        self.fitted = person.stamp - REFIT_INTERVAL_NS if doubtful else person.stamp
        if person.proven:
            self.belief = PersonBelief(person.middle[:2])
            self.belief.add(person.score, fit.confidence, self.stamp, len(person.points))

    def adopt(self, tracker: BodyTracker) -> None:
        """Go on with the tracker that a full fit has led to; a rough body is turned by that without being a jump."""
        self.tracker = tracker
        if self.rough:
            self.motion.allow_turn()

    def weigh(self, person: PersonCloud, fit: BodyFit, judge: Judge | None, sensor_moves: bool) -> BodyFit:
        """Ask a scan, if any, whether it is a person, unless too little is seen; return its body."""
        if self.belief is None:
            self.belief = PersonBelief(person.middle[:2])
        self.belief.visit(person.points, self.stamp, sensor_moves)
        if judge is not None and not self.tracker.hidden:
            judged = judge(person, fit, self.belief.asks_facing(len(person.points)))
            self.belief.add(judged.probability, judged.confidence, self.stamp, len(person.points))
            if judged.turned is not None and self.belief.turns(judged.turned[1]):
                self.tracker.start(person, judged.turned[0])
                self.motion.allow_turn()
                return judged.turned[0]
            if judged.fit is not fit:
                self.tracker.start(person, judged.fit)
            return judged.fit
        return fit

    def show(self, fit: BodyFit) -> TrackedBody:
        """Return its body at the time of the last cloud, with what is known of its motion."""
        if self.belief is not None and self.belief.confidence is not None:
            fit = replace(fit, confidence=self.belief.confidence)
        return self.motion.add(self.id, self.stamp, fit, self.tracker.hidden)

    def update(self, middle: F64, stamp: int) -> None:
        """Take where the person is now."""
        if 0 < stamp - self.stamp <= MAX_VELOCITY_GAP_NS:
            measured = (middle - self.middle) / (1e-9 * (stamp - self.stamp))
            kept = 0.5 ** ((stamp - self.stamp) / VELOCITY_HALF_LIFE_NS) if self.moves else 0.0
            self.velocity, self.moves = measured + kept * (self.velocity - measured), True
        else:
            self.velocity, self.moves = np.zeros(3), False
        self.middle, self.stamp = middle, stamp


def track_person(pair: tuple[PersonTrack, PersonCloud]) -> BodyFit | InputError | None:
    """Track a person to their next cloud and return the body, None where there is none yet, or what is wrong."""
    track, person = pair
    try:
        if person.stamp - track.turned >= TURN_INTERVAL_NS and track.motion.walks_backwards():
            track.turned = person.stamp
            turned = track.tracker.turn_round(person)
            if turned is not None:
                track.motion.allow_turn()
                return turned
        return track.tracker.track(person)
    except InputError as error:
        return error
