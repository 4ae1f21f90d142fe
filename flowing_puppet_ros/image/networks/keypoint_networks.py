# SPDX-License-Identifier: Apache-2.0
"""People by MoveNet and BlazePose together: everybody in an image, or known people again.

MoveNet finds people in the whole image, and once more in a square around each, where small people have all the pixels
that they need. BlazePose looks at each person too; it has hands, heels and toes. The joints are the mean of all poses,
weighted by their scores, and their confidence is how well the poses agree.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from flowing_puppet_ros.arrays import F64, Image
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.formats.skeletons import COCO_17, MEDIAPIPE_33
from flowing_puppet_ros.image.networks.agreement import combine, turn_sides
from flowing_puppet_ros.image.networks.pose_networks import EXTRA, BlazePose, Landmarks, MoveNet
from flowing_puppet_ros.image.networks.poses import (
    NetworkPose,
    as_pose,
    drop_duplicates,
    drop_repeated,
    find_square,
    pose_distance,
)
from flowing_puppet_ros.images import as_rgb

SQUARE_SIDE_PX = 192  # of MoveNet's input for one person: larger ones are no better
TRUNK_REACH, JOINT_REACH = 1.9, 1.2  # half side of a person's square: trunks, distances of the farthest joint
MIN_HALF_SIDE_PX = 8.0
SMALL_TRUNK_PX = 30.0  # of a trunk in the reduced image, below which the square sees more

MIN_CANDIDATE_SCORE = 0.1  # of a person in the whole image, who is looked at again ...
MIN_SCORE = 0.2  # ... and of the person in the square
MAX_MOVE = 0.6  # median distance of joints, in shoulder widths, from a person to the same person in the square
MAX_KNOWN_MOVE = 1.5  # the same from where a known person is expected
MIN_PRESENCE = 0.3  # of BlazePose's landmarks
MAX_LANDMARK_DISTANCE = 1.0  # shoulder widths between the landmarks and MoveNet's joints of one person
MAX_OTHER_SHARE = 0.5  # of the distance from the landmarks to another person, from which on they are not surely of one
LANDMARK_TRUST: F64 = np.array([{"elbow": 0.5, "knee": 0.3}.get(name.partition("_")[2], 1.0) for name in COCO_17])
"""Weight of BlazePose's joints relative to MoveNet's of the same score: it is worse at elbows and knees."""
MAX_PEOPLE = 6
UNKNOWN: F64 = np.array([np.nan, np.nan])
MIN_CONFIDENCE = 0.08  # joints below it are unknown

DARK_LEVEL = 40.0  # mean of an image, 0 to 255, below which it is brightened
BRIGHT_LEVEL, BRIGHT_SHARE, GAMMA = 255.0, 99.5, 0.6


@dataclass(frozen=True, slots=True, eq=False)
class FoundPerson:
    """A person: `keypoints` px with the probability that each is right, and the `score` of the person in [0, 1]."""

    keypoints: Keypoints
    score: float


@dataclass(frozen=True, slots=True, eq=False)
class _Person:
    """MoveNet's poses of one person, and for a known person the `expected` one."""

    poses: list[NetworkPose]
    expected: NetworkPose | None

    @property
    def score(self) -> float:
        """Score of the best pose."""
        return max(pose.score for pose in self.poses)

    @property
    def rank(self) -> tuple[bool, float]:
        """Order in which people are kept: known ones by their distance from where expected, new ones by score."""
        if self.expected is None:
            return True, -self.score
        return False, pose_distance(self.poses[-1], self.expected)


class KeypointSource(Protocol):
    """Finds the keypoints of people in images (H, W, 3) RGB or (H, W) grey."""

    def find(
        self, image: Image, known: Sequence[Keypoints] = (), everybody: bool = True, max_people: int = MAX_PEOPLE
    ) -> list[FoundPerson]:
        """Return the people in an image: the `known` ones, whose joints are known roughly, and with `everybody` all."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class KeypointNetworks:
    """MoveNet and BlazePose.

    Attributes:
        movenet: finds people.
        blazepose: looks at each of them.
        side: longer side px to which the whole image is reduced.
        thorough: whether everybody is looked at in a square too, however large, and once more in the mirror image:
            more accurate, three times as slow.
    """

    movenet: MoveNet
    blazepose: BlazePose
    side: int = 256
    thorough: bool = False

    @classmethod
    def load(cls, side: int = 256, thorough: bool = False) -> KeypointNetworks:
        """Load the installed networks; InputError where they are not installed."""
        return cls(MoveNet.load(), BlazePose.load(), side, thorough)

    def find(
        self, image: Image, known: Sequence[Keypoints] = (), everybody: bool = True, max_people: int = MAX_PEOPLE
    ) -> list[FoundPerson]:
        """Return the people in an image (H, W, 3) RGB or (H, W) grey, known ones first, then the most certain first.

        `known` people, whose joints are known roughly, are looked at closely; `everybody` else only on demand.
        InputError if `image` is not an image.
        """
        image = brighten(as_rgb(image))
        found = self.movenet.detect(image, self.side) if everybody else []
        candidates = drop_duplicates([pose for pose in found if pose.score >= MIN_CANDIDATE_SCORE])
        people: list[_Person] = []
        for expected in (pose for person in known if (pose := as_pose(person)) is not None):
            people.append(_Person(self._look_again(image, expected, candidates), expected))
        for pose in candidates:
            people.append(_Person(self._confirm(image, pose), None))
        # Of two in one place the one who is nearer to where expected.
        ranked = sorted((person for person in people if person.poses), key=lambda person: person.rank)
        kept = drop_repeated(ranked, lambda person: person.poses[-1])[:max_people]
        found = [person.poses[-1] for person in kept]
        return [
            FoundPerson(self._finish(image, person, found[:k] + found[k + 1 :]), person.score)
            for k, person in enumerate(kept)
        ]

    def _look_again(self, image: Image, expected: NetworkPose, candidates: list[NetworkPose]) -> list[NetworkPose]:
        """Return the pose of a known person: in the square, or else one of the `candidates`, who is then taken."""
        own = [pose for pose in candidates if pose_distance(pose, expected) <= MAX_MOVE and pose.score >= MIN_SCORE]
        best = min(own, key=lambda pose: pose_distance(pose, expected), default=None)
        candidates[:] = [pose for pose in candidates if pose is not best]
        again = self._find_in_square(image, expected, MAX_KNOWN_MOVE)
        return [pose for pose in (again, best) if pose is not None][:1]

    def _confirm(self, image: Image, pose: NetworkPose) -> list[NetworkPose]:
        """Return a person of the whole image, with another look where one is needed; nothing if it is nobody."""
        is_sure = pose.score >= MIN_SCORE
        if is_sure and not self.thorough and not _is_small(pose, image, self.side):
            return [pose]
        again = self._find_in_square(image, pose, MAX_MOVE)
        if again is not None:
            return [pose, again]
        return [pose] if is_sure else []

    def _find_in_square(self, image: Image, pose: NetworkPose, max_move: float) -> NetworkPose | None:
        """Return a person again, by a look at the square around them; None when nobody or somebody else is there."""
        square = find_square(pose, TRUNK_REACH, JOINT_REACH, MIN_HALF_SIDE_PX)
        seen = self.movenet.detect_in_square(image, *square, SQUARE_SIDE_PX)
        found = [one for one in seen if one.score >= MIN_CANDIDATE_SCORE]
        if not found:
            return None
        nearest = min(found, key=lambda one: pose_distance(one, pose))
        return nearest if pose_distance(nearest, pose) <= max_move and nearest.score >= MIN_SCORE else None

    def _finish(self, image: Image, person: _Person, others: Sequence[NetworkPose]) -> Keypoints:
        """Return the keypoints of a person from MoveNet's poses and BlazePose's landmarks.

        Among people side by side, landmarks may be those of one of the `others`, or half of each.
        """
        landmarks = self.blazepose.locate(image, person.poses[-1])
        poses, seen = [*person.poses], [landmarks.pose]
        if self.thorough:
            more, again = self._look_in_mirror(image, person.poses[-1])
            poses, seen = [*poses, *more], [again, *seen]
        turned = turn_sides([*poses, *seen], None if person.expected is None else person.expected.joints)
        away = pose_distance(turned[-1], turned[0])
        apart = min((_distance_either_way(turned[-1], other) for other in others), default=np.inf)
        agree = landmarks.presence >= MIN_PRESENCE and away <= min(MAX_LANDMARK_DISTANCE, MAX_OTHER_SHARE * apart)
        networks = [turned[: len(poses)], turned[len(poses) :]] if agree else [turned[: len(poses)]]
        trusts = [np.ones(len(COCO_17)), LANDMARK_TRUST][: len(networks)]
        joints, confidence = combine(networks, trusts, turned[0].size)
        found = dict(zip(COCO_17, zip(joints, confidence.tolist(), strict=True), strict=True))
        if agree:
            found |= _place_extremities(landmarks, found, crossed=turned[-1] is not seen[-1])
        known = {name: place if sure >= MIN_CONFIDENCE else UNKNOWN for name, (place, sure) in found.items()}
        sure = [found[name][1] if np.isfinite(place).all() else 0.0 for name, place in known.items()]
        mask = landmarks.mask if agree else None
        return Keypoints(tuple(known), np.array(list(known.values())), np.array(sure), mask=mask)

    def _look_in_mirror(self, image: Image, pose: NetworkPose) -> tuple[list[NetworkPose], NetworkPose]:
        """Return a person by MoveNet, unless it finds nobody, and by BlazePose in the mirror image."""
        mirrored, width = np.ascontiguousarray(image[:, ::-1]), image.shape[1]
        expected = pose.mirror(width)
        same = self._find_in_square(mirrored, expected, MAX_MOVE)
        landmarks = self.blazepose.locate(mirrored, expected)
        return [] if same is None else [same.mirror(width)], landmarks.pose.mirror(width)


def _distance_either_way(one: NetworkPose, other: NetworkPose) -> float:
    """Return the distance of two poses, whichever sides are called left."""
    return min(pose_distance(one, other), pose_distance(one, other.exchange_sides()))


def _is_small(pose: NetworkPose, image: Image, side: int) -> bool:
    """Return whether a person is small in the reduced image."""
    return pose.trunk * side / max(image.shape[:2]) < SMALL_TRUNK_PX


def _place_extremities(
    landmarks: Landmarks, joints: Mapping[str, tuple[F64, float]], crossed: bool
) -> dict[str, tuple[F64, float]]:
    """Return place (2,) px and confidence of hands, heels and toes: no better than that of wrist or ankle.

    They lie beside wrist and ankle as the landmarks say, wherever the landmarks have those two: the limbs of `joints`,
    by both networks, are better.
    """
    found = {}
    for name, row in EXTRA.items():
        side, _, part = name.partition("_")
        limb = "wrist" if part == "hand" else "ankle"
        own = landmarks.points[MEDIAPIPE_33.index(f"{side}_{limb}")]
        side = {"left": "right", "right": "left"}[side] if crossed else side
        place, confidence = joints[f"{side}_{limb}"]
        beside = place + landmarks.points[row] - own
        found[f"{side}_{part}"] = beside, float(landmarks.visibility[row]) * confidence
    return found


def brighten(image: Image) -> Image:
    """Return an image (H, W, 3) as it is, or a nearly black one with its contrast stretched."""
    small = image[:: max(1, image.shape[0] // 120), :: max(1, image.shape[1] // 160)]
    if float(small.mean()) >= DARK_LEVEL:
        return image
    top = max(float(np.percentile(small, BRIGHT_SHARE)), 1.0)
    levels = BRIGHT_LEVEL * np.clip(np.arange(256) / top, 0.0, 1.0) ** GAMMA
    return np.asarray(cv2.LUT(image, np.rint(levels).astype(np.uint8)))
