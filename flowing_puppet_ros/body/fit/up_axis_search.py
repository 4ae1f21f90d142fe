# SPDX-License-Identifier: Apache-2.0
"""Fits clouds whose up axis or unit is not known, in the frame in which a body explains them best."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter, check_cloud
from flowing_puppet_ros.body.fit.hypotheses import Progress, sub_progress
from flowing_puppet_ros.body.scans.scan_frame import ScanFrame, rotation_to_z_up
from flowing_puppet_ros.body.scans.unit import GUESS, ScanUnit
from flowing_puppet_ros.model.sp import StitchedPuppet

MAX_UPS, MAX_FITS = 3, 3  # directions that are compared by rough bodies, and frames that are fitted in
MAX_COARSE_RATIO, MIN_PRIOR_RATIO = 1.25, 1.18
"""Coarse cost of a direction, in that of the best one, up to which it is compared further; from the second on it is not
when the best one is also the likelier axis. Another axis costs 1.2 to 1.8 times as much as the right one, that axis
upside down 0.9 to 1.2 times."""
MAX_ROUGH_RATIO, MAX_ROUGH_RATIO_IF_WRONG = 1.3, 1.7
"""Cost of a rough body, in that of the best one, up to which a frame is fitted in, and if the fits before are not
reliable. Upside down it is 1.6 to 3 times as much as upright."""
MAX_CLOSE_RATIO = 1.6
"""Cost of a rough body up to which more are tried; `MAX_ROUGH_RATIO` when the best frame is also the likelier one."""
MIN_CLEAR_RATIO = 1.25
"""Cost of the best fit in another direction or unit, in that of the best fit, from which the answer is clear."""
MIN_ADULT_STATURE_M = 1.4
SIDES = ("left", "right")
GUESS_COST_RATIO = 1.2
"""How much farther than a body in a unit of measure one of guessed size counts to be."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameHypothesis:
    """A frame that a cloud may be in.

    Attributes:
        up: (3,) direction in the scan's frame.
        unit: the scan's unit.
        cost: how far the closest body in it is from the cloud, in the scan's unit; 0 before bodies are compared.
    """

    up: np.ndarray
    unit: ScanUnit
    cost: float = 0.0

    @property
    def frame(self) -> ScanFrame:
        """Return the map to metres, z up, in which a body is fitted."""
        return ScanFrame(self.unit.fitted, rotation_to_z_up(self.up))


@dataclass(frozen=True, slots=True, eq=False)
class FrameFit:
    """A fit and the frame that it was found in.

    Attributes:
        frame: from the scan to metres, z up, as fitted.
        unit: the scan's unit.
        fit: in metres, z up.
        up_clear, unit_clear: whether no other direction or unit explains the cloud about as well.
        stature: of the person standing, in metres of the scan's unit.
    """

    frame: ScanFrame
    unit: ScanUnit
    fit: BodyFit
    up_clear: bool
    unit_clear: bool
    stature: float

    @property
    def is_child(self) -> bool:
        """Whether the person is too small for an adult in a unit of measure."""
        return self.unit.name != GUESS and self.stature < MIN_ADULT_STATURE_M


def fit_in_best_frame(
    fitter: BodyFitter,
    points: np.ndarray,
    normals: np.ndarray | None,
    *,
    units: Sequence[ScanUnit],
    ups: Sequence[np.ndarray],
    sensor: np.ndarray | None = None,
    progress: Progress,
) -> FrameFit:
    """Fit a cloud of one person in the frame that explains it best.

    Directions are compared by `BodyFitter.coarse_cost`; what is left of them, in all units, by rough bodies; frames
    that are about as good by fits.

    Args:
        fitter: fitter of the model.
        points: (N, 3) in the scan's frame and unit.
        normals: (N, 3) in the scan's frame, or None.
        units: candidate units, the likelier first.
        ups: candidate directions (3,) in the scan's frame, the likelier first.
        sensor: (3,) position of the sensor in the scan's frame and unit, for a single view.
        progress: called with the fraction done.

    Raises:
        InputError: when the cloud cannot be the surface of a person.
    """
    points, normals = check_cloud(points, normals)
    cloud = _ScanCloud(fitter, points, normals, sensor)
    hypotheses = [FrameHypothesis(up, unit) for unit in units for up in cloud.find_ups(ups, units)]
    if len(hypotheses) > 1:
        hypotheses = _drop_other_guesses(cloud.compare_roughly(hypotheses))
    best = hypotheses[0]
    chosen = [other for other in hypotheses if other.cost <= MAX_ROUGH_RATIO_IF_WRONG * best.cost][:MAX_FITS]
    fits: list[tuple[FrameHypothesis, BodyFit]] = []
    for number, hypothesis in enumerate(chosen):
        right = any(fit.reliable for _, fit in fits)
        if right and hypothesis.cost > MAX_ROUGH_RATIO * best.cost:
            break
        step = sub_progress(progress, number / len(chosen), (number + 1) / len(chosen))
        fits.append((hypothesis, cloud.fit(hypothesis, step)))
    progress(1.0)
    costs = [_cost_of_fit(hypothesis, fit) for hypothesis, fit in fits]
    hypothesis, fit = fits[int(np.argmin(costs))]
    rivals = [other for (other, _), cost in zip(fits, costs, strict=True) if cost < MIN_CLEAR_RATIO * min(costs)]
    return FrameFit(
        hypothesis.frame,
        hypothesis.unit,
        fit,
        all(np.allclose(other.up, hypothesis.up) for other in rivals),
        hypothesis.unit.name != GUESS and all(other.unit == hypothesis.unit for other in rivals),
        measure_stature(fitter.model, fit.joints) * hypothesis.unit.metres / hypothesis.unit.fitted,
    )


def measure_stature(model: StitchedPuppet, joints: np.ndarray) -> float:
    """Return the stature of a person standing, by the lengths between joints (J, 3), in the unit of the joints."""
    rest = model.vertices(model.rest_state())
    share = float(np.ptp(rest[:, 2])) / _measure_bones(model, model.joints(rest))
    return share * _measure_bones(model, joints)


def _measure_bones(model: StitchedPuppet, joints: np.ndarray) -> float:
    place = dict(zip(model.joint_names, joints, strict=True))
    chains = [("head_top", "neck", "pelvis"), *((f"{side}_hip", f"{side}_knee", f"{side}_ankle") for side in SIDES)]
    lengths = [
        sum(float(np.linalg.norm(place[a] - place[b])) for a, b in itertools.pairwise(chain)) for chain in chains
    ]
    return lengths[0] + (lengths[1] + lengths[2]) / 2


def explain_roughly(
    fitter: BodyFitter,
    points: np.ndarray,
    unit: ScanUnit,
    ups: Sequence[np.ndarray],
    sensor: np.ndarray | None,
) -> FrameHypothesis:
    """Return the frame whose rough body is closest to a cloud, in one unit; other arguments as in the fit."""
    cloud = _ScanCloud(fitter, points, None, sensor)
    return cloud.compare_roughly([FrameHypothesis(up, unit) for up in cloud.find_ups(ups, [unit])])[0]


def choose_up_axis(
    fitter: BodyFitter,
    clouds: Sequence[np.ndarray],
    ups: Sequence[np.ndarray],
    unit: ScanUnit,
    sensors: Sequence[np.ndarray | None],
) -> np.ndarray:
    """Return the direction (3,) of `ups` in which bodies explain the people of one scan best.

    Args:
        fitter: fitter of the model.
        clouds: points (N, 3) of each person in the scan's frame and unit.
        ups: candidate directions (3,), the likelier first.
        unit: the scan's unit.
        sensors: for each person the position (3,) of the sensor in the scan's frame and unit, or None.
    """
    people = [_ScanCloud(fitter, points, None, sensor) for points, sensor in zip(clouds, sensors, strict=True)]
    costs = np.array([person.measure_ups(ups, unit.fitted) for person in people])
    near = _select_ups(ups, costs.min(axis=0))
    if len(near) == 1:
        return near[0]
    clearest = people[int(costs.min(axis=1).argmin())]
    return clearest.compare_roughly([FrameHypothesis(up, unit) for up in near])[0].up


@dataclass(frozen=True, slots=True, eq=False)
class _ScanCloud:
    """A cloud in a scan's frame and unit, with or without normals and its sensor's position, and its fitter."""

    fitter: BodyFitter
    points: np.ndarray
    normals: np.ndarray | None
    sensor: np.ndarray | None

    def find_ups(self, ups: Sequence[np.ndarray], units: Sequence[ScanUnit]) -> list[np.ndarray]:
        """Return the directions worth comparing further, in the size of an adult, the likelier first."""
        return list(ups) if len(ups) == 1 else _select_ups(ups, self.measure_ups(ups, max(u.fitted for u in units)))

    def measure_ups(self, ups: Sequence[np.ndarray], scale: float) -> np.ndarray:
        """Return the coarse cost (U,) of each direction, metres."""
        frames = [ScanFrame(scale, rotation_to_z_up(up)) for up in ups]
        return np.array([self.fitter.coarse_cost(frame.to_body(self.points), self._see(frame)) for frame in frames])

    def compare_roughly(self, hypotheses: Sequence[FrameHypothesis]) -> list[FrameHypothesis]:
        """Return hypotheses, the likelier first, by the costs of rough bodies; close ones from more starts."""
        explained = [self._explain(each, False) for each in hypotheses]
        best = int(np.argmin([each.cost for each in explained]))
        found = sorted(explained, key=lambda each: each.cost)
        near = [
            each
            for each in found
            if each.cost <= (MAX_ROUGH_RATIO if each in explained[best + 1 :] else MAX_CLOSE_RATIO) * found[0].cost
        ]
        if len(near) > 1:
            rest = [each for each in found if each not in near]
            found = sorted([*(self._explain(each, True) for each in near), *rest], key=lambda each: each.cost)
        return found

    def _explain(self, hypothesis: FrameHypothesis, thorough: bool) -> FrameHypothesis:
        """Return the hypothesis with the cost of a rough body."""
        frame = hypothesis.frame
        body = self.fitter.find_roughly(
            frame.to_body(self.points), self._turn_normals(frame), self._see(frame), thorough
        )
        return replace(hypothesis, cost=body.cost / frame.scale * _prefer(hypothesis.unit))

    def fit(self, hypothesis: FrameHypothesis, progress: Progress) -> BodyFit:
        """Fit a body in the frame of a hypothesis."""
        frame = hypothesis.frame
        return self.fitter.fit(
            frame.to_body(self.points), self._turn_normals(frame), viewpoint=self._see(frame), progress=progress
        )

    def _turn_normals(self, frame: ScanFrame) -> np.ndarray | None:
        return None if self.normals is None else self.normals @ frame.rotation.T

    def _see(self, frame: ScanFrame) -> np.ndarray | None:
        return None if self.sensor is None else frame.to_body(self.sensor)


def _select_ups(ups: Sequence[np.ndarray], costs: np.ndarray) -> list[np.ndarray]:
    """Return the directions that cost about as much as the best one, the likelier first."""
    order = np.argsort(costs, kind="stable")
    best = int(order[0])
    near = [
        k
        for k in map(int, order)
        if costs[k] < (MIN_PRIOR_RATIO if k > best else MAX_COARSE_RATIO) * costs[best] or k == best
    ]
    return [ups[k] for k in sorted(near[:MAX_UPS])]


def _drop_other_guesses(hypotheses: Sequence[FrameHypothesis]) -> list[FrameHypothesis]:
    """Return the hypotheses without those of guessed size that another guess before them explains better."""
    guess = next((found.unit for found in hypotheses if found.unit.name == GUESS), None)
    return [found for found in hypotheses if found.unit.name != GUESS or found.unit == guess]


def _cost_of_fit(hypothesis: FrameHypothesis, fit: BodyFit) -> float:
    """Return the distance between body and cloud in the scan's unit, the farther the less of both is explained."""
    distance = fit.two_way_distance / hypothesis.unit.fitted
    return distance * _prefer(hypothesis.unit) / max(fit.confidence, 0.01)


def _prefer(unit: ScanUnit) -> float:
    return 1.0 if unit.fitted == unit.metres and unit.name != GUESS else GUESS_COST_RATIO
