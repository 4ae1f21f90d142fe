# SPDX-License-Identifier: Apache-2.0
"""Weights of the energy of flowing puppets, by search on a validation set (thesis, video chapter, "Inference").

Every annotated person gives a set of puppets around the true one, some with a wrist drawn from the hand maps. Weights
are good if the puppet of minimum energy has correct elbows and wrists. The detector's score is left out: the detector
was learned on such images and would seem better than it is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from zlib import crc32

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.image.hands import HandDetectors
from flowing_puppet_ros.evidence.image.likelihood import PartLikelihood
from flowing_puppet_ros.flow.estimate import OpticalFlow, working_size
from flowing_puppet_ros.image.formats.annotations import source_video
from flowing_puppet_ros.image.pose.evidence import PersonWindow
from flowing_puppet_ros.image.thesis_loop.energy import EnergySettings, FlowingEnergy, FrameEvidence
from flowing_puppet_ros.image.thesis_loop.flow_moments import FlowMoments
from flowing_puppet_ros.image.thesis_loop.hand_maps import make_hand_maps
from flowing_puppet_ros.image.thesis_loop.upper_body import UpperBodyParameters
from flowing_puppet_ros.image.thesis_loop.wrist_proposals import WristProposals
from flowing_puppet_ros.image.tracking.propagation import ImageScale
from flowing_puppet_ros.learn.likelihood.samples import PosedPerson
from flowing_puppet_ros.learn.thesis_loop.hand_samples import MIN_CONFIDENCE
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.process.threads import one_blas_thread
from flowing_puppet_ros.settings import Settings, setting

SEARCHED_TERMS = ("prior", "colour", "hand")
"""Terms whose weights are searched; the weight of contours is 1, since only ratios matter."""

WEIGHT_RANGES = {"prior": (3e-3, 3.0), "colour": (0.03, 10.0), "hand": (0.03, 10.0)}
MAX_MISS_M = 0.3  # a joint's miss is clipped here
# Deviations of puppets around the true one; the angle in radians.
ANGLE_DEVIATION, LENGTH_DEVIATION_M, PLACE_DEVIATION_M = 0.4, 0.02, 0.02
MIN_PEOPLE = 10  # with an image before theirs


@dataclass(frozen=True, slots=True)
class WeightSettings(Settings):
    """How the weights are searched for."""

    every: int = setting(20, "use every n-th annotated frame of a video", low=1, high=1000)
    puppets: int = setting(60, "puppets around each true one", low=4, high=1000)
    draws: int = setting(500, "sets of weights to try", low=1, high=100000)
    seed: int = setting(0, "seed of puppets and weights", low=0, high=2**31 - 1)


@dataclass(frozen=True, slots=True, eq=False)
class PuppetChoices:
    """N people with P candidate puppets each.

    Attributes:
        terms: (N, P, 7) the prior's energy, log likelihoods of contour, colour and hands, and the same three of the
            puppet propagated to the neighbouring frame.
        miss: (N, P) m, mean miss of the arm joints.
        half: (N,) 0 or 1, the half of the source videos.
    """

    terms: Array
    miss: Array
    half: Array

    def measure_miss(self, weights: Array, neighbour_weight: float = 1.0) -> Array:
        """Return the miss (N,) m of the minimum-energy puppets for weights (4,) of prior, contour, colour and hands."""
        evidence = self.terms[..., 1:4] + neighbour_weight * self.terms[..., 4:]
        energy = weights[0] * self.terms[..., 0] - evidence @ weights[1:]
        return np.asarray(np.take_along_axis(self.miss, energy.argmin(axis=1)[:, None], axis=1)[:, 0])


def gather_choices(
    model: DeformableStructures, people: Iterable[PosedPerson], settings: WeightSettings, report: Callable[[str], None]
) -> PuppetChoices:
    """Draw puppets around annotated people with an image before theirs; InputError if there are too few people."""
    likelihood, hands, optical_flow = PartLikelihood.load(), HandDetectors.load(), OpticalFlow()
    bodies = {"front": UpperBodyParameters(model, "front"), "back": UpperBodyParameters(model, "back")}
    rng = np.random.default_rng(settings.seed)
    rows: list[tuple[Array, Array, int]] = []
    for posed in people:
        arms = [model.joint_names.index(f"{s}_{j}") for s in ("right", "left") for j in ("elbow", "wrist")]
        sure = [joint for joint in arms if posed.confidence[joint] >= MIN_CONFIDENCE]
        if posed.previous_image is None or not sure:
            continue
        with one_blas_thread():
            found = _sample_puppets(bodies[posed.puppet.view], posed, likelihood, hands, optical_flow, settings, rng)
        if found is None:
            continue
        joints, terms = found
        miss = np.linalg.norm(joints[:, sure] - posed.puppet.joints[sure], axis=2) / posed.puppet.scale
        rows.append((terms, np.minimum(miss, MAX_MISS_M).mean(axis=1), crc32(source_video(posed.file).encode()) % 2))
    if len(rows) < MIN_PEOPLE:
        raise InputError(
            f"the annotations show {len(rows)} people with an image before theirs; {MIN_PEOPLE} are needed"
        )
    report(f"{len(rows)} people")
    return PuppetChoices(*(np.stack([row[k] for row in rows]) for k in range(3)))


def _sample_puppets(
    body: UpperBodyParameters,
    posed: PosedPerson,
    likelihood: PartLikelihood,
    hands: HandDetectors,
    optical_flow: OpticalFlow,
    settings: WeightSettings,
    rng: np.random.Generator,
) -> tuple[Array, Array] | None:
    """Return joints (P, J, 2) px and terms (P, 7) of puppets around one person; None if outside the image."""
    puppet, earlier = posed.puppet, posed.previous_image
    assert earlier is not None
    windows = [PersonWindow.around(likelihood, image, puppet.joints, puppet.scale) for image in (earlier, posed.image)]
    if windows[0] is None or windows[1] is None:
        return None
    before, now = (window.with_torso(*puppet.contours[:2]) for window in windows if window is not None)
    size = (posed.image.shape[1], posed.image.shape[0])
    grid = ImageScale(size, working_size(posed.image.shape, optical_flow.settings.max_side))
    flow = optical_flow.estimate_at_working_scale(earlier, posed.image)
    low, high = puppet.joints.min(axis=0) - puppet.scale, puppet.joints.max(axis=0) + puppet.scale
    frames = [
        FrameEvidence(before, make_hand_maps(hands, before, [flow[0]], grid, puppet.scale), None),
        FrameEvidence(now, make_hand_maps(hands, now, [flow[1]], grid, puppet.scale), None),
    ]
    frames[1].before = FlowMoments.of((flow[1], flow[0]), grid, low, high)
    vectors = body.to_vectors(puppet.joints[None], np.array([puppet.scale]))
    box, legs = body.make_bounds(vectors[0]), body.leg_offsets(puppet.joints)
    drawn = np.repeat(vectors, settings.puppets, axis=0)
    where = body.slices()
    for name, deviation in (
        ("angle", ANGLE_DEVIATION),
        ("length", LENGTH_DEVIATION_M),
        ("center", PLACE_DEVIATION_M * puppet.scale),
    ):
        part = drawn[:, where[name]]
        drawn[:, where[name]] = part + deviation * rng.standard_normal(part.shape)
    if frames[1].hands is not None:
        moves = WristProposals.of(body, box, legs, frames[1].hands, puppet.joints[0], puppet.scale)
        drawn[::3] = moves(drawn[::3], rng)
    joints, scale = body.to_joints(box.clip(drawn), legs)
    prior, own, elsewhere = FlowingEnergy(body, frames, EnergySettings(forward_flow=False)).terms(1, joints, scale)
    return joints, np.column_stack([prior, own[:, :3], elsewhere[:, :3]])


def search_weights(choices: PuppetChoices, settings: WeightSettings) -> dict[str, float]:
    """Search the best weights; return them by name with mean misses in metres ("miss", "miss without hands", ...).

    "miss held out" is measured with weights that were chosen on the other half of the source videos.
    """
    rng = np.random.default_rng(settings.seed)
    low, high = np.log([WEIGHT_RANGES[name] for name in SEARCHED_TERMS]).T
    drawn = np.exp(rng.uniform(low, high, (settings.draws, len(SEARCHED_TERMS))))
    weights = np.column_stack([drawn[:, 0], np.ones(len(drawn)), drawn[:, 1:]])
    costs = np.array([choices.measure_miss(one) for one in weights])
    best = weights[costs.mean(axis=1).argmin()]
    held_out = [
        costs[costs[:, choices.half == half].mean(axis=1).argmin(), choices.half != half]
        for half in (0, 1)
        if (choices.half == half).any() and (choices.half != half).any()
    ]
    figures = {"prior_weight": best[0], "contour_weight": 1.0, "colour_weight": best[2], "hand_weight": best[3]}
    figures["miss"] = choices.measure_miss(best).mean()
    figures["miss held out"] = np.concatenate(held_out).mean() if held_out else np.nan
    figures["miss without the neighbour's evidence"] = choices.measure_miss(best, neighbour_weight=0.0).mean()
    for name, index in (("prior", 0), ("contour", 1), ("colour", 2), ("hands", 3)):
        figures[f"miss without {name}"] = choices.measure_miss(np.where(np.arange(4) == index, 0.0, best)).mean()
    figures["miss of a random puppet"] = choices.miss.mean()
    figures["miss of the best puppet"] = choices.miss.min(axis=1).mean()
    return {name: round(float(value), 4) for name, value in figures.items()}
