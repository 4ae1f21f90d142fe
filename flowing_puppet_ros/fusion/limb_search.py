# SPDX-License-Identifier: Apache-2.0
"""Limbs that may be in a wrong place, hung anew: likely poses that cloud and joints agree with.

Gauss-Newton finds the nearest pose only. A limb that the joints leave open, because they are hidden or because the body
has not come to them, is sampled from the joints' prior. What the cloud and the joints contradict least is refined, and
kept if the whole body then costs less.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from flowing_puppet_ros.arrays import F64, Bools
from flowing_puppet_ros.body.fit.fitter import BodyFit
from flowing_puppet_ros.body.fit.hypotheses import BodyHypotheses
from flowing_puppet_ros.body.fit.pose_bank import CoarseCloud
from flowing_puppet_ros.body.search.particles import Particles, particles_to_state, states_to_particles
from flowing_puppet_ros.evidence.cloud.nearest import find_beside
from flowing_puppet_ros.fusion.lift import LiftedJoints
from flowing_puppet_ros.fusion.limb_depths import (
    HALF_SEEN_CONFIDENCE,
    SLOPE_M,
    measure_bone_cost,
    measure_limb_cost,
    measure_seen_share,
)
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet

LIMB_PARTS = {
    "arm": (("shoulder", "upper_arm", "lower_arm", "hand"), ("shoulder", "elbow", "wrist")),
    "leg": (("upper_leg", "lower_leg", "foot"), ("hip", "knee", "ankle")),
}
"""Parts and joints of each kind of limb, from the trunk outwards."""
FAR_JOINTS = {"upper_arm": "elbow", "lower_arm": "wrist", "upper_leg": "knee", "lower_leg": "ankle"}
SAMPLES, KEPT = 300, 2
"""Poses that are sampled of a limb, and those that are refined."""
FREE_SHARE = 0.2
"""Of the samples that do not point to the joints."""
ACROSS_M, HIDDEN_ACROSS_M, ALONG_M = 0.02, 0.05, 0.03
"""Standard deviation of the places to which samples point, across and along the ray of a joint."""
MIN_APART_M = 0.15
"""Between the joints of two poses that are refined."""
JOINT_COST_M, FULL_COST_M, ALONG_SHARE = 0.01, 0.12, 0.3
"""Cost of a certain joint that is as far as this from its ray, or farther, beside the cost of a body in a cloud; and
the share that a gap along the ray counts."""
HIDDEN_ALONG_SHARE = 0.2
"""The same of a hidden joint from the depth that its limb makes likely: else it is hung along its ray, where the body
hides it and nothing contradicts it."""
MAX_GAP_M, MAX_SEEN_GAP_M = 0.06, 0.12
"""Between a joint and its ray, and its place on a surface, beyond which a limb may be in a wrong place."""
LOST_GAP_M, LOST_SEEN_GAP_M = 0.09, 0.15
"""The same of a tracked body, beyond which its limb is lost."""
GUESSED_GAP_M = 0.2
"""Between a joint that is as likely hidden as seen and its ray, which a guess of it misses by less."""
STRAYED_GAP_M, STRAYED_SEEN_GAP_M = 0.1, 0.2
"""Between a joint and its ray, and its place on a surface, beyond which closest points would not bring a limb back."""
WRONG_GAP_M, WRONG_SEEN_GAP_M = 0.12, 0.2
"""The same, beyond which a body cannot be relied on."""
LEFT_OUT_RADIUS_M, LEFT_OUT_GAP_M, MIN_LEFT_OUT, MIN_LEFT_OUT_SHARE = 0.08, 0.06, 10, 0.5
"""About a joint's place on a surface, and from the body: points within the former that are farther from the latter,
and share of all that are within, from which on the body leaves out the limb that is there."""
MIN_SEEN_SHARE = 0.9  # probability that a joint is seen, below which its limb may be in a wrong place
MIN_GAIN_M = 0.0005  # by which a body with a limb hung anew costs less
MIN_CONFIDENCE = 0.2  # of joints that count


class LimbSearcher:
    """Hangs limbs of one model's bodies anew."""

    def __init__(self, hypotheses: BodyHypotheses, model: StitchedPuppet) -> None:
        """Sample and judge with the parts of `hypotheses`."""
        self._model, self._bank, self._proposer = model, hypotheses.pose_bank, hypotheses.proposer
        self._limbs = [
            (
                tuple(model.tree.index(f"{side}_{part}") for part in parts),
                np.array([model.joint_names.index(f"{side}_{joint}") for joint in joints]),
            )
            for parts, joints in LIMB_PARTS.values()
            for side in ("left", "right")
        ]
        self._far_joint = {
            model.tree.index(f"{side}_{part}"): model.joint_names.index(f"{side}_{joint}")
            for side in ("left", "right")
            for part, joint in FAR_JOINTS.items()
        }

    def improve(
        self,
        body: BodyState,
        coarse: CoarseCloud,
        joints: LiftedJoints,
        limbs: Sequence[int],
        refine: Callable[[BodyState], BodyState],
    ) -> BodyState:
        """Return the body with `limbs` hung anew, each if the body costs less after `refine`; else `body` itself."""
        if not limbs:
            return body
        rng = np.random.default_rng(0)
        given, refined_once = body, refine(body)
        body = refined_once  # as those that it is compared with
        cost = self.measure_cost(body, coarse, joints)
        for limb in limbs:
            for tried in self._sample(body, *self._limbs[limb], coarse, joints, rng):
                refined = refine(tried)
                new_cost = self.measure_cost(refined, coarse, joints)
                if new_cost < cost - MIN_GAIN_M:
                    body, cost = refined, new_cost
        return given if body is refined_once else body

    def list_parts(self, limb: int) -> tuple[int, ...]:
        """Return the parts of a limb."""
        return self._limbs[limb][0]

    def find_doubtful(self, body: BodyState, joints: LiftedJoints) -> list[int]:
        """Return the limbs of a fitted body that may be in a wrong place: joints left them open, or it is off them.

        Where the cloud has nothing at a joint's pixel, it would tell no pose from another.
        """
        across, gap = self._measure_gaps(body, joints)
        open_or_off = _find_doubtful(joints) | (across > MAX_GAP_M) | (gap > MAX_SEEN_GAP_M)
        return self._find_limbs(open_or_off & find_on_surface(joints), joints)

    def find_lost(self, body: BodyState, joints: LiftedJoints) -> list[int]:
        """Return the limbs of a tracked body of which a joint is certainly not where the puppet sees it."""
        return self._find_far(body, joints, LOST_GAP_M, LOST_SEEN_GAP_M)

    def lift_left_out(self, fit: BodyFit, points: F64, joints: LiftedJoints) -> LiftedJoints:
        """Return the joints with those lifted anew at whose pixels a tracked body leaves out one of the surfaces.

        A track keeps a limb on the surface where the clouds before had it: a forearm that comes to point at the camera
        would stay at the trunk behind it.

        Args:
            fit: the body.
            points: (N, 3) metres, the person's.
            joints: of the person.
        """
        places, hidden, choices = joints.points.copy(), joints.hidden.copy(), dict(joints.choices)
        for row in np.concatenate([rows[1:] for _, rows in self._limbs]).tolist():
            if row not in joints.choices or joints.confidence[row] < HALF_SEEN_CONFIDENCE:
                continue
            own = joints.choices[row]
            elsewhere = own.seen & (np.linalg.norm(own.points - fit.joints[row], axis=1) > LOST_SEEN_GAP_M)
            left_out = [int(k) for k in np.flatnonzero(elsewhere) if _is_left_out(own.points[k], points, fit.vertices)]
            if left_out:
                places[row], hidden[row], choices[row] = own.points[left_out[0]], False, own.take(left_out[:1])
        return replace(joints, points=places, hidden=hidden, choices=choices)

    def find_strayed(self, body: BodyState, joints: LiftedJoints) -> list[int]:
        """Return the limbs of which a joint is certainly not where a tracked body's motion would bring it."""
        return self._find_far(body, joints, STRAYED_GAP_M, STRAYED_SEEN_GAP_M)

    def _find_far(self, body: BodyState, joints: LiftedJoints, max_across: float, max_gap: float) -> list[int]:
        across, gap = self._measure_gaps(body, joints)
        far = np.where(joints.confidence < HALF_SEEN_CONFIDENCE, GUESSED_GAP_M, max_across)
        return self._find_limbs((across > far) | (~_find_doubtful(joints) & (gap > max_gap)), joints)

    def point(self, body: BodyState, joints: LiftedJoints, limbs: Sequence[int]) -> BodyState:
        """Return the body with `limbs` pointed from where they join the trunk to where their joints are.

        That is where they were lifted to, or, where that is in doubt, the nearest place on their rays; joints that do
        not count leave their part as it is bent.
        """
        before, used, doubtful = states_to_particles(self._model, [body]), _can_count(joints), _find_doubtful(joints)
        groups, places = list(before), self._model.joints(self._model.vertices(body))
        along = ((places - joints.centre) * joints.rays).sum(axis=1, keepdims=True)
        places = np.where(doubtful[:, None], joints.centre + along * joints.rays, joints.points)
        for limb in limbs:
            for part in self._limbs[limb][0]:
                above = self._model.tree.parents[part]
                groups[part] = self._proposer.reattach(part, groups[above], before, above)
                joint = self._far_joint.get(part)
                if joint is not None and used[joint]:
                    groups[part] = self._proposer.point_to(part, groups[part], joint, places[joint][None])
        return particles_to_state(self._model, groups, np.zeros(len(groups), dtype=np.int64))

    def contradicts(self, body: BodyState, joints: LiftedJoints) -> bool:
        """Return whether a joint of a limb is far from where the puppet surely sees it."""
        across, gap = self._measure_gaps(body, joints)
        wrong = (across > WRONG_GAP_M) | (gap > WRONG_SEEN_GAP_M)
        return bool(self._find_limbs(wrong & ~_find_doubtful(joints), joints))

    def _measure_gaps(self, body: BodyState, joints: LiftedJoints) -> tuple[F64, F64]:
        """Return the distances (J,) m of a body's joints from their rays, and from where they were lifted to."""
        gap = self._model.joints(self._model.vertices(body)) - joints.points
        along = (gap * joints.rays).sum(axis=1, keepdims=True) * joints.rays
        return np.linalg.norm(gap - along, axis=1), np.linalg.norm(gap, axis=1)

    def _find_limbs(self, wrong: Bools, joints: LiftedJoints) -> list[int]:
        used = wrong & _can_count(joints)
        return [number for number, (_, rows) in enumerate(self._limbs) if used[rows[1:]].any()]

    def measure_cost(self, body: BodyState, coarse: CoarseCloud, joints: LiftedJoints) -> float:
        """Return the cost of a body in a cloud plus that of its joints, metres."""
        places = self._model.joints(self._model.vertices(body))
        return self._bank.cost(body, coarse) + float(measure_joint_cost(places[None], joints, _can_count(joints))[0])

    def _sample(
        self,
        body: BodyState,
        limb: tuple[int, ...],
        rows: np.ndarray,
        coarse: CoarseCloud,
        joints: LiftedJoints,
        rng: np.random.Generator,
    ) -> list[BodyState]:
        """Return the body with the best of many poses of one limb."""
        groups = states_to_particles(self._model, [body])
        rest = [part for part in range(len(groups)) if part not in limb]
        without = self._bank.coverage_cost(groups, coarse, rest)
        places = np.tile(self._model.joints(self._model.vertices(body)), (SAMPLES, 1, 1))
        targets = self._draw_targets(places[0], rows, joints, rng)
        for part in limb:
            above = groups[self._model.tree.parents[part]]
            above = above if len(above) > 1 else above.take(np.zeros(SAMPLES, dtype=np.int64))
            groups[part] = self._proposer.attach_likely(part, above, body.shape[part], rng)
            for joint, target in targets.items():
                if joint == self._far_joint.get(part):
                    groups[part] = self._proposer.point_to(part, groups[part], joint, target)
            index, found = self._proposer.find_joints(part, groups[part])
            places[:, index] = found
        cost = self._bank.coverage_cost(groups, coarse, limb, without.distance).cost
        counted = np.zeros(places.shape[1], dtype=bool)
        counted[rows[1:]] = True
        cost = cost + measure_joint_cost(places, joints, counted & _can_count(joints))
        chosen: list[int] = []
        for row in np.argsort(cost, kind="stable"):
            apart = [np.linalg.norm(places[row, rows] - places[other, rows], axis=1).max() for other in chosen]
            if all(gap > MIN_APART_M for gap in apart):
                chosen.append(int(row))
            if len(chosen) == KEPT:
                break
        return [self._take(groups, limb, row) for row in chosen]

    def _draw_targets(
        self, places: F64, rows: np.ndarray, joints: LiftedJoints, rng: np.random.Generator
    ) -> dict[int, F64]:
        """Draw places (SAMPLES, 3) m of a limb's two outer joints, NaN for samples that do not point to them.

        `places` (J, 3) m are those of the body's joints, and `rows` the limb's joints from the trunk outwards.
        """
        root, middle, end = (int(row) for row in rows)
        known = [row for row in (middle, end) if row in joints.choices and joints.confidence[row] >= MIN_CONFIDENCE]
        if not known:
            return {}
        length = np.linalg.norm(places[[middle, end]] - places[[root, middle]], axis=1)
        lists = {row: joints.choices[row] for row in known}
        cost = np.zeros((1, 1))
        if middle in lists:
            inner = lists[middle]
            slope = (inner.points - places[root]) @ joints.rays[middle] / SLOPE_M
            bone = measure_bone_cost(places[root][None], inner.points, float(length[0]), inner.spread)[0]
            cost = (inner.cost + bone + 0.5 * slope**2)[:, None]
        if end in lists:
            outer = lists[end]
            cost = cost + outer.cost
            if middle in lists:
                cost = cost + measure_limb_cost(lists[middle], outer, float(length[1]))
        share = np.exp(cost.min() - cost).ravel()
        drawn = np.unravel_index(rng.choice(len(share), SAMPLES, p=share / share.sum()), cost.shape)
        free = rng.random(SAMPLES) < FREE_SHARE
        targets = {}
        for row, index in zip((middle, end), drawn, strict=True):
            if row not in lists:
                continue
            noise = rng.standard_normal((SAMPLES, 3))
            along = (noise @ joints.rays[row])[:, None] * joints.rays[row]
            across = HIDDEN_ACROSS_M if joints.hidden[row] else ACROSS_M
            targets[row] = lists[row].points[index] + across * (noise - along) + ALONG_M * along
            targets[row][free] = np.nan
        return targets

    def _take(self, groups: list[Particles], limb: tuple[int, ...], row: int) -> BodyState:
        pick = np.zeros(len(groups), dtype=np.int64)
        pick[list(limb)] = row
        return particles_to_state(self._model, groups, pick)


def _is_left_out(place: F64, points: F64, vertices: F64) -> bool:
    """Return whether a body with `vertices` (V, 3) m leaves out what `points` (N, 3) m show about a place (3,)."""
    near = points[np.linalg.norm(points - place, axis=1) < LEFT_OUT_RADIUS_M]
    if len(near) < MIN_LEFT_OUT:
        return False
    away = ~find_beside(near, vertices, LEFT_OUT_GAP_M)
    return bool(np.count_nonzero(away) >= max(MIN_LEFT_OUT, MIN_LEFT_OUT_SHARE * len(near)))


def _find_doubtful(joints: LiftedJoints) -> Bools:
    """Return which joints (J,) may well be elsewhere on their rays."""
    doubtful = joints.guessed | (measure_seen_share(joints.confidence) < MIN_SEEN_SHARE)
    doubtful[[row for row, choices in joints.choices.items() if np.count_nonzero(choices.seen) > 1]] = True
    return np.asarray(doubtful)


def find_on_surface(joints: LiftedJoints) -> Bools:
    """Return which joints (J,) have a surface at their pixels."""
    on = np.zeros(len(joints.points), dtype=bool)
    on[[row for row, choices in joints.choices.items() if choices.seen.any()]] = True
    return on


def _can_count(joints: LiftedJoints) -> Bools:
    return np.asarray(joints.found & (joints.confidence >= MIN_CONFIDENCE))


def measure_joint_cost(places: F64, joints: LiftedJoints, counted: Bools) -> F64:
    """Return what the `counted` (J,) joints of bodies, at `places` (P, J, 3) m, cost each of them (P,), metres."""
    cost = np.zeros(len(places))
    seen_share = measure_seen_share(joints.confidence)
    for row in np.flatnonzero(counted):
        ray, confidence = joints.rays[row], joints.confidence[row]
        gap = places[:, row] - joints.points[row]
        along = gap @ ray
        cost += confidence**2 * _saturate(np.linalg.norm(gap - along[:, None] * ray, axis=1))
        choices = joints.choices.get(int(row))
        if choices is not None and choices.seen.any():
            surfaces = (choices.points[choices.seen] - joints.points[row]) @ ray
            off_surface = np.abs(along[:, None] - surfaces).min(axis=1)
            cost += ALONG_SHARE * seen_share[row] * _saturate(off_surface)
        if joints.hidden[row]:
            cost += HIDDEN_ALONG_SHARE * _saturate(along, SLOPE_M)
    return JOINT_COST_M * cost


def _saturate(distance: F64, full: float = FULL_COST_M) -> F64:
    return np.asarray(np.minimum(np.abs(distance) / full, 1.0) ** 2)
