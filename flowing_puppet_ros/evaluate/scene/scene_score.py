# SPDX-License-Identifier: Apache-2.0
"""Who of the people in scans is found, by points and range, who is found that is not there, and how well."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from flowing_puppet_ros.body.scans.scene_labels import LabelledPerson, LabelledScene

MATCH_DISTANCE_M = 0.5  # between a body's middle and a label's, beyond which they are different people
POINT_BINS = ((25, 40), (40, 80), (80, 400), (400, 10**9))
RANGE_BINS_M = ((0, 5), (5, 10), (10, 20), (20, 30))
MIN_TOP_M = 1.2  # over the floor, of people who count: others show no head
MAX_STANDING_M = 0.25  # that somebody who stands strays from the first place


@dataclass(frozen=True, slots=True, eq=False)
class ReportedPerson:
    """A body in a scan: `joints` by name (3,) m, its `vertices` (V, 3) m, stature, track and confidence."""

    joints: Mapping[str, np.ndarray]
    vertices: np.ndarray
    stature: float
    identity: str
    confidence: float


@dataclass(frozen=True, slots=True)
class PersonScore:
    """A labelled person at (x, y) and what was found there; metres, NaN where nothing was found or is known."""

    scan: str
    person: int
    x: float
    y: float
    points: int
    range: float
    counts: bool
    found: bool
    identity: str
    place_error: float
    stature_error: float
    top_error: float
    joint_error: float
    flipped: bool
    confidence: float


@dataclass(frozen=True, slots=True)
class GhostScore:
    """A body where nobody is: its place (m), range (m) and confidence."""

    scan: str
    x: float
    y: float
    range: float
    confidence: float


def score_scene(
    name: str,
    truth: LabelledScene,
    found: Sequence[ReportedPerson],
    min_points: int,
    sector: float,
    min_top: float = MIN_TOP_M,
) -> tuple[list[PersonScore], list[GhostScore]]:
    """Match the found people to the labels of a scan.

    Args:
        name: of the scan.
        truth: its labels.
        found: the bodies.
        min_points: points that a person needs to count; others may be found or missed.
        sector: half angle in radians about x, beyond which nobody was labelled.
        min_top: metres over the floor of the topmost point that a person needs to count.
    """
    found = [body for body in found if abs(_bearing(body.vertices, truth.sensor)) <= sector]
    middles = np.array([body.vertices.mean(axis=0)[:2] for body in found]).reshape(-1, 2)
    places = np.array([person.middle for person in truth.people]).reshape(-1, 2)
    distance = np.linalg.norm(places[:, None] - middles[None], axis=2)
    rows, columns = linear_sum_assignment(np.where(distance < MATCH_DISTANCE_M, distance, 1e3))
    match = {int(r): int(c) for r, c in zip(rows, columns, strict=True) if distance[r, c] < MATCH_DISTANCE_M}
    people = []
    for row, person in enumerate(truth.people):
        away = float(np.hypot(*(person.middle - truth.sensor[:2])))
        counts = person.points >= min_points and person.top >= min_top
        body = found[match[row]] if row in match else None
        gap = float(distance[row, match[row]]) if row in match else np.nan
        people.append(_score_person(name, row, person, away, counts, body, gap))
    ghosts = []
    for column, body in enumerate(found):
        if column not in match.values():
            x, y = middles[column]
            away = float(np.hypot(x - truth.sensor[0], y - truth.sensor[1]))
            ghosts.append(GhostScore(name, float(x), float(y), away, body.confidence))
    return people, ghosts


def _bearing(vertices: np.ndarray, sensor: np.ndarray) -> float:
    ahead = vertices.mean(axis=0) - sensor
    return float(np.arctan2(ahead[1], ahead[0]))


def _score_person(
    name: str, row: int, person: LabelledPerson, away: float, counts: bool, body: ReportedPerson | None, gap: float
) -> PersonScore:
    x, y = float(person.middle[0]), float(person.middle[1])
    if body is None:
        nothing = (gap, np.nan, np.nan, np.nan, False, np.nan)
        return PersonScore(name, row, x, y, person.points, away, counts, False, "", *nothing)
    top = float(body.vertices[:, 2].max()) - person.floor
    error, flipped = np.nan, False
    names = [joint for joint in person.joints if joint in body.joints]
    if names:
        swapped = [_mirror(joint) for joint in names]
        truth = np.array([person.joints[joint] for joint in names])
        error = float(np.linalg.norm(np.array([body.joints[joint] for joint in names]) - truth, axis=1).mean())
        turned = float(np.linalg.norm(np.array([body.joints[joint] for joint in swapped]) - truth, axis=1).mean())
        flipped = turned < error
    return PersonScore(
        name, row, x, y, person.points, away, counts, True, body.identity, gap, body.stature - person.stature,
        top - person.top, error, flipped, body.confidence,
    )  # fmt: skip


def _mirror(joint: str) -> str:
    if joint.startswith("left_"):
        return "right_" + joint.removeprefix("left_")
    return "left_" + joint.removeprefix("right_") if joint.startswith("right_") else joint


def summarise_scenes(people: Sequence[PersonScore], ghosts: Sequence[GhostScore], scans: int) -> dict[str, float]:
    """Summarise many scans: recall in percent, ghosts a scan, errors in centimetres of those who count."""
    counted = [person for person in people if person.counts]
    found = [person for person in counted if person.found]
    return {
        "scans": scans,
        "people": len(counted),
        "found": len(found),
        "recall_percent": _percent(counted),
        "standing_percent": _percent(find_standing(counted)),
        "ghosts_per_scan": len(ghosts) / max(scans, 1),
        "id_switches": count_id_switches(people),
        "place_median_cm": _median(found, "place_error"),
        "stature_error_mean_cm": _mean(found, "stature_error"),
        "top_error_mean_cm": _mean(found, "top_error"),
        "joints_mean_cm": _mean(found, "joint_error"),
        "joints_median_cm": _median(found, "joint_error"),
        "flipped_percent": 100 * sum(person.flipped for person in found) / max(len(found), 1),
    }


def tabulate_bins(people: Sequence[PersonScore]) -> list[dict[str, float | str]]:
    """Tabulate recall and errors by the points on a person, and by range; people of every size count here."""
    rows: list[dict[str, float | str]] = []
    for label, bins in (("points", POINT_BINS), ("range", RANGE_BINS_M)):
        for low, high in bins:
            inside = [
                person
                for person in people
                if low <= getattr(person, label) < high and (person.counts or label == "points")
            ]
            if inside:
                found = [person for person in inside if person.found]
                rows.append(
                    {
                        "bin": f"{label} {low} to {high}" if high < 10**9 else f"{label} from {low}",
                        "people": len(inside),
                        "recall_percent": _percent(inside),
                        "stature_error_mean_cm": _mean(found, "stature_error"),
                        "joints_mean_cm": _mean(found, "joint_error"),
                        "joints_median_cm": _median(found, "joint_error"),
                        "flipped_percent": 100 * sum(person.flipped for person in found) / max(len(found), 1),
                    }
                )
    return rows


def count_id_switches(people: Sequence[PersonScore]) -> int:
    """Count how often a labelled person, known by their number through the scans, is found under another id.

    Scans whose names differ in what follows the last hyphen are of one sequence.
    """
    last: dict[tuple[str, int], str] = {}
    switches = 0
    for person in people:
        if person.found:
            who = person.scan.rpartition("-")[0], person.person
            switches += last.get(who, person.identity) != person.identity
            last[who] = person.identity
    return switches


def find_standing(people: Sequence[PersonScore]) -> list[PersonScore]:
    """Return those who stand through all scans of a sequence in which they are; see `count_id_switches` for those."""
    places: dict[tuple[str, int], list[tuple[float, float]]] = {}
    for person in people:
        places.setdefault((person.scan.rpartition("-")[0], person.person), []).append((person.x, person.y))
    standing = {
        who
        for who, seen in places.items()
        if len(seen) > 1 and np.linalg.norm(np.array(seen) - seen[0], axis=1).max() < MAX_STANDING_M
    }
    return [person for person in people if (person.scan.rpartition("-")[0], person.person) in standing]


def _percent(people: Sequence[PersonScore]) -> float:
    return 100 * sum(person.found for person in people) / len(people) if people else np.nan


def _values(people: Sequence[PersonScore], name: str) -> np.ndarray:
    values = np.abs(np.array([getattr(person, name) for person in people], dtype=np.float64))
    return 100 * values[np.isfinite(values)]


def _mean(people: Sequence[PersonScore], name: str) -> float:
    values = _values(people, name)
    return float(values.mean()) if len(values) else np.nan


def _median(people: Sequence[PersonScore], name: str) -> float:
    values = _values(people, name)
    return float(np.median(values)) if len(values) else np.nan
