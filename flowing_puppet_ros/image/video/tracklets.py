# SPDX-License-Identifier: Apache-2.0
"""Who is where in a whole clip: places that the detector thinks of in single images, joined over time.

In one image a person is now and then missed, or taken for a smaller one; over many images the place that is always
there at the same size wins. A path takes one place an image, or none; the best one is found exactly (Viterbi), its
places are taken away, and the next person is looked for. Only places are kept of an image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.image.detector.detection import PersonCandidate
from flowing_puppet_ros.image.detector.scoring import SAME_PLACE

MOVE, FASTEST = 3.0, 1.2  # cost of a move by S from look to look, and the farthest that anybody moves
GROW = 2.0  # cost of an octave of change in scale
LONGEST_GAP = 12  # looks from one place of a path to the next
EXTRAPOLATED_FRAMES = (
    15  # looks before and after a path through which the person is supposed to stand where it begins and ends
)
LOSS = 1.5  # score that a pose may lack where a person is only supposed to be, in units of the margin
ABSENT = 0.5  # cost of a look in which a person is missed
SURE, LEAST_ODDS = 4.0, -3.5  # log-odds above which a place counts no more, and from which it counts
LASTING = 0.5  # log-odds that a path of twice as many looks has more than its places have on average
FIRST = 1 / 3  # of the probability that others need: how sure the surest person must be
SPAN = 15  # looks before and after one over which the scale is averaged


@dataclass(frozen=True, slots=True, eq=False)
class Tracklet:
    """One person over a clip: `places` by number of the image looked at, in order, `step` images from look to look."""

    places: dict[int, PersonCandidate]
    step: int

    def at(self, image: int) -> PersonCandidate | None:
        """The place in an image; between two looks the mean of both, and for some time before and after all of them.

        Where no look found the person nearby, the place is only supposed. None long before and after.
        """
        numbers = np.array(list(self.places))
        reach = EXTRAPOLATED_FRAMES * self.step
        if not numbers[0] - reach <= image <= numbers[-1] + reach:
            return None
        inside = int(np.clip(image, numbers[0], numbers[-1]))
        after = int(np.searchsorted(numbers, inside))
        low, high = int(numbers[max(after - 1, 0)]), int(numbers[after])
        share = 1.0 if low == high else (inside - low) / (high - low)
        place = self.places[low].interpolate(self.places[high], share)
        away = min(abs(image - number) for number in (low, high))
        return place if away < self.step else replace(place, min_score=place.score - LOSS)


@dataclass(slots=True, eq=False)
class TrackletLinker:
    """Collects the places of the images that were looked at, one in `step`, and tells the people.

    Up to `most` of them with a probability of `least`; of the first a third of it is enough.
    """

    least: float
    most: int
    step: int
    _looks: dict[int, list[PersonCandidate]] = field(default_factory=dict)

    def add(self, image: int, places: Sequence[PersonCandidate]) -> None:
        """Take the places of image number `image`; numbers grow.

        A place that costs more than to miss the person there is on no best path, and is not kept.
        """
        self._looks[image] = [place for place in places if _gain(place) >= -ABSENT]

    def keep(self, looks: int) -> None:
        """Forget all but the last looks."""
        for image in list(self._looks)[:-looks]:
            del self._looks[image]

    def paths(self) -> list[Tracklet]:
        """The people, the surest first."""
        images, looks = list(self._looks), [list(places) for places in self._looks.values()]
        found: list[Tracklet] = []
        while len(found) < self.most and (path := _best_path(looks)):
            log_odds = float(np.mean([place.log_odds for place in path.values()]))
            lasting = log_odds + LASTING * np.log2(len(path))
            probability = 1 / (1 + np.exp(-(log_odds if found else lasting)))
            if probability < (self.least if found else FIRST * self.least):
                break
            steady = zip(path, _steady(list(path.values()), lasting), strict=True)
            found.append(Tracklet({images[number]: place for number, place in steady}, self.step))
            for number, place in path.items():
                looks[number] = [other for other in looks[number] if other.neck_distance(place) >= SAME_PLACE]
        return found


def _steady(path: Sequence[PersonCandidate], log_odds: float) -> list[PersonCandidate]:
    """The same places with the scale that most looks around agree on, as sure as the whole path and of its score."""
    logs = np.log([place.scale for place in path])
    score = float(np.median([place.score for place in path]))
    weight = np.exp(np.minimum([place.log_odds for place in path], 0.0))
    steady = []
    for k, place in enumerate(path):
        around = slice(max(0, k - SPAN), k + SPAN + 1)
        scale = float(np.exp(_weighted_median(logs[around], weight[around])))
        steady.append(replace(place.with_scale(scale), log_odds=log_odds, score=score))
    return steady


def _weighted_median(values: F64, weight: F64) -> float:
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weight[order])
    return float(values[order[np.searchsorted(total, 0.5 * total[-1])]])


def _best_path(looks: Sequence[Sequence[PersonCandidate]]) -> dict[int, PersonCandidate]:
    """One place for some of the looks, by number, so that the sum of gains less the costs of moves is largest."""
    best: list[F64] = []
    before: list[list[tuple[int, int] | None]] = []
    for number, places in enumerate(looks):
        total = np.zeros(len(places))
        origin: list[tuple[int, int] | None] = [None] * len(places)
        for gap in range(1, min(LONGEST_GAP, number) + 1):
            last = looks[number - gap]
            if not last or not places:
                continue
            score = best[number - gap][:, None] - _costs(last, places, gap)
            for own in np.flatnonzero(score.max(axis=0) > total).tolist():
                k = int(score[:, own].argmax())
                total[own], origin[own] = score[k, own], (number - gap, k)
        best.append(total + np.array([_gain(place) for place in places]))
        before.append(origin)
    tops = [float(total.max(initial=-np.inf)) for total in best]
    if not tops or max(tops) <= 0.0:
        return {}
    number = int(np.argmax(tops))
    at: tuple[int, int] | None = (number, int(best[number].argmax()))
    path = {}
    while at is not None:
        path[at[0]] = looks[at[0]][at[1]]
        at = before[at[0]][at[1]]
    return dict(sorted(path.items()))


def _gain(place: PersonCandidate) -> float:
    return min(place.log_odds, SURE) - LEAST_ODDS


def _costs(last: Sequence[PersonCandidate], places: Sequence[PersonCandidate], gap: int) -> F64:
    """Costs (L, P) of going from one place to another one `gap` looks later; infinite where nobody moves so fast."""
    scale, own_scale = (np.array([place.scale for place in those]) for those in (last, places))
    neck, own_neck = (np.array([place.neck for place in those]) for those in (last, places))
    step = neck[:, None] - own_neck
    moved = np.hypot(step[..., 0], step[..., 1]) / np.maximum(scale[:, None], own_scale) / gap
    costs = ABSENT * (gap - 1) + MOVE * moved + GROW * np.abs(np.log2(own_scale / scale[:, None]))
    return np.where(moved > FASTEST, np.inf, costs)
