# SPDX-License-Identifier: Apache-2.0
"""Candidates of single images linked over time: who is where in a clip.

In a single image a person is now and then missed, or detected too small; over many images the candidate that is always
there at the same size wins. A tracklet takes one candidate of an image, or none. The best one is found exactly
(Viterbi), its candidates are removed, and the next person is sought. Nothing but candidates is kept of an image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.image.detector.detection import PersonCandidate
from flowing_puppet_ros.image.detector.scoring import MIN_NECK_DISTANCE

# A detector run is one image in `stride`; distances are in units of the shoulder scale S.
MOVE_COST = 3.0  # of a move by S from run to run
MAX_MOVE = 1.2  # S a run
SCALE_COST = 2.0  # of an octave of change in scale
MISS_COST = 0.5  # of a run in which the person is missed
MAX_GAP = 12  # runs from one candidate of a tracklet to the next
EXTRAPOLATED_FRAMES = 15  # runs by which a tracklet is extrapolated at both ends
MAX_SCORE_LOSS = 1.5  # by which a pose at an extrapolated place may score less, in units of the margin
MIN_LOG_ODDS, MAX_LOG_ODDS = -3.5, 4.0  # a candidate gains from the first on, and no more beyond the second
DURATION_LOG_ODDS = 0.5  # that a tracklet of twice as many runs has more than its candidates have on average
FIRST = 1 / 3  # of the minimum probability: what the most probable person needs
SCALE_WINDOW = 15  # runs before and after one over which its scale is averaged


@dataclass(frozen=True, slots=True, eq=False)
class Tracklet:
    """One person over a clip: `places` by number of the image, in order, `stride` images from run to run."""

    places: dict[int, PersonCandidate]
    stride: int

    def at(self, image: int) -> PersonCandidate | None:
        """Return the place in an image: interpolated between two runs, extrapolated for a while at both ends.

        Where no run found the person nearby, the pose there has a minimum score. None beyond the extrapolation.
        """
        numbers = np.array(list(self.places))
        margin = EXTRAPOLATED_FRAMES * self.stride
        if not numbers[0] - margin <= image <= numbers[-1] + margin:
            return None
        inside = int(np.clip(image, numbers[0], numbers[-1]))
        after = int(np.searchsorted(numbers, inside))
        low, high = int(numbers[max(after - 1, 0)]), int(numbers[after])
        share = 1.0 if low == high else (inside - low) / (high - low)
        place = self.places[low].interpolate(self.places[high], share)
        away = min(abs(image - number) for number in (low, high))
        return place if away < self.stride else replace(place, min_score=place.score - MAX_SCORE_LOSS)


@dataclass(slots=True, eq=False)
class TrackletLinker:
    """Collects the candidates of detector runs, one image in `stride`, and links them to tracklets.

    There are at most `max_people`, each with a probability of at least `min_probability`, the first of a third of it.
    """

    min_probability: float
    max_people: int
    stride: int
    _runs: dict[int, list[PersonCandidate]] = field(default_factory=dict)

    def add(self, image: int, candidates: Sequence[PersonCandidate]) -> None:
        """Take the candidates of image number `image`; numbers increase.

        Candidates that cost more than a missed detection can never be on the best path; drop them.
        """
        self._runs[image] = [candidate for candidate in candidates if _gain(candidate) >= -MISS_COST]

    def keep_last(self, runs: int) -> None:
        """Forget all but the last runs."""
        for image in list(self._runs)[:-runs]:
            del self._runs[image]

    def link(self) -> list[Tracklet]:
        """Return the tracklets, most probable person first."""
        images, runs = list(self._runs), [list(candidates) for candidates in self._runs.values()]
        found: list[Tracklet] = []
        while len(found) < self.max_people and (path := _find_best_path(runs)):
            mean_log_odds = float(np.mean([place.log_odds for place in path.values()]))
            log_odds = mean_log_odds + DURATION_LOG_ODDS * np.log2(len(path))
            probability = 1 / (1 + np.exp(-(mean_log_odds if found else log_odds)))
            if probability < (self.min_probability if found else FIRST * self.min_probability):
                break
            steady = zip(path, _smooth_scales(list(path.values()), log_odds), strict=True)
            found.append(Tracklet({images[number]: place for number, place in steady}, self.stride))
            for number, place in path.items():
                runs[number] = [other for other in runs[number] if other.neck_distance(place) >= MIN_NECK_DISTANCE]
        return found


def _smooth_scales(path: Sequence[PersonCandidate], log_odds: float) -> list[PersonCandidate]:
    """Return the places with the scale that most runs around agree on, and with the log-odds and score of the path."""
    logs = np.log([place.scale for place in path])
    score = float(np.median([place.score for place in path]))
    weight = np.exp(np.minimum([place.log_odds for place in path], 0.0))
    smooth = []
    for k, place in enumerate(path):
        around = slice(max(0, k - SCALE_WINDOW), k + SCALE_WINDOW + 1)
        scale = float(np.exp(_weighted_median(logs[around], weight[around])))
        smooth.append(replace(place.with_scale(scale), log_odds=log_odds, score=score))
    return smooth


def _weighted_median(values: F64, weight: F64) -> float:
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weight[order])
    return float(values[order[np.searchsorted(total, 0.5 * total[-1])]])


def _find_best_path(runs: Sequence[Sequence[PersonCandidate]]) -> dict[int, PersonCandidate]:
    """Return one candidate for some of the runs, by number, so that gains minus costs of moves are maximal."""
    best: list[F64] = []
    before: list[list[tuple[int, int] | None]] = []
    for number, places in enumerate(runs):
        total = np.zeros(len(places))
        origin: list[tuple[int, int] | None] = [None] * len(places)
        for gap in range(1, min(MAX_GAP, number) + 1):
            last = runs[number - gap]
            if not last or not places:
                continue
            score = best[number - gap][:, None] - _transition_costs(last, places, gap)
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
        path[at[0]] = runs[at[0]][at[1]]
        at = before[at[0]][at[1]]
    return dict(sorted(path.items()))


def _gain(place: PersonCandidate) -> float:
    return min(place.log_odds, MAX_LOG_ODDS) - MIN_LOG_ODDS


def _transition_costs(last: Sequence[PersonCandidate], places: Sequence[PersonCandidate], gap: int) -> F64:
    """Return the costs (L, P) of each move to a candidate `gap` runs later; infinite where nobody moves so fast."""
    scale, own_scale = (np.array([place.scale for place in those]) for those in (last, places))
    neck, own_neck = (np.array([place.neck for place in those]) for those in (last, places))
    step = neck[:, None] - own_neck
    moved = np.hypot(step[..., 0], step[..., 1]) / np.maximum(scale[:, None], own_scale) / gap
    costs = MISS_COST * (gap - 1) + MOVE_COST * moved + SCALE_COST * np.abs(np.log2(own_scale / scale[:, None]))
    return np.where(moved > MAX_MOVE, np.inf, costs)
