# SPDX-License-Identifier: Apache-2.0
"""A detector that finds the walking person of `drawn_people` and now and then takes the left arm for another."""

from dataclasses import dataclass, field

import numpy as np

from flowing_puppet_ros.image.detector.detection import PersonCandidate
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from test.helpers.drawn_people import NAMES, draw, pose


@dataclass
class Guesser:
    """A detection whose arms and scores are given; the scores fall with the distance from the nearest guess."""

    joints: np.ndarray
    guesses: dict[str, np.ndarray]
    scores: np.ndarray
    confidence: float = 0.9
    scale: float = 50.0
    score: float = 3.0

    @property
    def keypoints(self) -> Keypoints:
        return Keypoints(NAMES, self.joints, np.full(len(self.joints), self.confidence))

    @property
    def candidate(self) -> PersonCandidate:
        neck, face = (self.joints[NAMES.index(name)] for name in ("neck", "face"))
        return PersonCandidate(neck, face, self.scale, 2.0)

    def arm_hypotheses(self, side: str, count: int) -> np.ndarray:
        return self.guesses[side][:count]

    @property
    def joints_are_independent(self) -> bool:
        return False

    def joint_score(self, joint: str, xy: np.ndarray) -> np.ndarray:
        side, _, name = joint.partition("_")
        at = self.guesses[side][:, ("elbow", "wrist").index(name)]
        distance = np.linalg.norm(np.asarray(xy)[:, None] - at, axis=2)
        return np.asarray((self.scores - 0.02 * distance).max(axis=1))


class NoEvidence:
    """An image that says nothing of any part."""

    def prepare(self, image: np.ndarray) -> "NoEvidence":
        return self

    def with_torso(self, torso: np.ndarray, head: np.ndarray) -> "NoEvidence":
        return self

    def log_likelihood(self, part: int, contours: np.ndarray, scale: np.ndarray) -> np.ndarray:
        return np.zeros(len(contours))

    def hand_map(self, scale: float) -> np.ndarray:
        return np.ones((1, 1))


def negative(image: np.ndarray) -> np.ndarray:
    """Return the negative of an image, in which the detector finds the same person."""
    return np.asarray(255 - image)


@dataclass
class GuessingDetector:
    """Knows the drawn images of some times; every third one it takes the left arm for another."""

    times: range
    full_frames: list[int] = field(default_factory=list)
    detections: list[int] = field(default_factory=list)
    _known: dict[bytes, int] = field(init=False)

    def __post_init__(self) -> None:
        """Draw the images."""
        self.images = [draw(pose(time)) for time in self.times]
        self._known = {image.tobytes(): time for image, time in zip(self.images, self.times, strict=True)}
        self._known |= {negative(image).tobytes(): time for image, time in zip(self.images, self.times, strict=True)}

    def detect(self, image: np.ndarray, settings: object) -> list[Guesser]:
        """Return whom it finds anywhere."""
        return [self._guess(self._known[image.tobytes()])]

    def propose(self, image: np.ndarray) -> list[PersonCandidate]:
        """Return where the person stands."""
        time = self._known[image.tobytes()]
        self.full_frames.append(time)
        truth = pose(time)
        return [PersonCandidate(truth[NAMES.index("neck")], truth[NAMES.index("face")], 50.0, 3.0)]

    def detect_at(self, image: np.ndarray, candidates: list[PersonCandidate]) -> list[Guesser]:
        """Return the person, who must be asked for where they stand."""
        time = self._known[image.tobytes()]
        neck = pose(time)[NAMES.index("neck")]
        assert all(np.linalg.norm(candidate.neck - neck) < 20 for candidate in candidates)
        self.detections.append(time)
        return [self._guess(time) for _ in candidates[:1]]

    def _guess(self, time: int) -> Guesser:
        truth = pose(time)
        rows = {side: [NAMES.index(f"{side}_{name}") for name in ("elbow", "wrist")] for side in ("left", "right")}
        right = truth[rows["right"]][None]
        true = truth[rows["left"]]
        wrong = true + np.array([[0.0, -25.0], [15.0, -60.0]])
        slips = time % 3 == 2
        found = truth.copy()
        found[rows["left"]] = wrong if slips else true
        guesses = np.array([wrong, true] if slips else [true, wrong])
        return Guesser(found, {"left": guesses, "right": right}, np.array([0.0, -0.3]))
