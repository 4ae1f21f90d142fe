# SPDX-License-Identifier: Apache-2.0
"""Weights of the energy of flowing puppets, by search on a validation set (thesis, video chapter, "Inference").

Every annotated person gives a set of puppets around the true one, some with a wrist drawn from the hand maps. Weights
are good when the puppet of least energy has its elbows and wrists where they are. The detector's score is left out: it
was learned on such images, and would seem better than it is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from zlib import crc32

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.blas import one_blas_thread
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.image.hands import HandDetectors
from flowing_puppet_ros.evidence.image.likelihood import PartLikelihood
from flowing_puppet_ros.flow.estimate import OpticalFlow, working_size
from flowing_puppet_ros.image.formats.annotations import source_of
from flowing_puppet_ros.image.pose.evidence import PersonWindow
from flowing_puppet_ros.image.thesis_loop.energy import EnergySettings, FlowingEnergy, FrameEvidence
from flowing_puppet_ros.image.thesis_loop.flow_moments import FlowMoments
from flowing_puppet_ros.image.thesis_loop.hand_maps import hand_maps
from flowing_puppet_ros.image.thesis_loop.upper_body import UpperBodyParameters
from flowing_puppet_ros.image.thesis_loop.wrist_proposals import WristProposals
from flowing_puppet_ros.image.tracking.propagation import ImageScale
from flowing_puppet_ros.learn.likelihood.samples import Posed
from flowing_puppet_ros.learn.thesis_loop.hands import SURE
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.settings import Settings, setting

SEARCHED = ("prior", "colour", "hand")
"""What is searched for; the weight of contours is 1, for only ratios matter here."""

RANGE = {"prior": (3e-3, 3.0), "colour": (0.03, 10.0), "hand": (0.03, 10.0)}
FAR = 0.3  # m: misses beyond count no more
ANGLE, LENGTH, PLACE = 0.4, 0.02, 0.02  # deviations of puppets around the true one: rad, m, m
FEWEST = 10


@dataclass(frozen=True, slots=True)
class WeightSettings(Settings):
    """How the weights are searched for."""

    every: int = setting(20, "use every so manieth annotated frame of a video", low=1, high=1000)
    puppets: int = setting(60, "puppets around each true one", low=4, high=1000)
    draws: int = setting(500, "sets of weights that are tried", low=1, high=100000)
    seed: int = setting(0, "seed of puppets and weights", low=0, high=2**31 - 1)


@dataclass(frozen=True, slots=True, eq=False)
class Choices:
    """N people with P puppets each: `terms` (N,P,7), mean miss of the arm joints `miss` (N,P) m, `half` (N,).

    Terms are the prior's energy, then log likelihoods of contour, colour and hands, and the same three carried.
    """

    terms: Array
    miss: Array
    half: Array

    def cost(self, weights: Array, carried: float = 1.0) -> Array:
        """Miss (N,) of the puppet of least energy, for weights (4,) of prior, contour, colour and hands."""
        evidence = self.terms[..., 1:4] + carried * self.terms[..., 4:]
        energy = weights[0] * self.terms[..., 0] - evidence @ weights[1:]
        return np.asarray(np.take_along_axis(self.miss, energy.argmin(axis=1)[:, None], axis=1)[:, 0])


def gather(
    model: DeformableStructures, people: Iterable[Posed], settings: WeightSettings, say: Callable[[str], None]
) -> Choices:
    """Puppets around annotated people who have an image before theirs; InputError when there are too few."""
    likelihood, hands, optical_flow = PartLikelihood.load(), HandDetectors.load(), OpticalFlow()
    bodies = {"front": UpperBodyParameters(model, "front"), "back": UpperBodyParameters(model, "back")}
    rng = np.random.default_rng(settings.seed)
    rows: list[tuple[Array, Array, int]] = []
    for posed in people:
        arms = [model.joint_names.index(f"{s}_{j}") for s in ("right", "left") for j in ("elbow", "wrist")]
        sure = [joint for joint in arms if posed.confidence[joint] >= SURE]
        if posed.before is None or not sure:
            continue
        with one_blas_thread():
            found = _of_person(bodies[posed.puppet.view], posed, likelihood, hands, optical_flow, settings, rng)
        if found is None:
            continue
        joints, terms = found
        miss = np.linalg.norm(joints[:, sure] - posed.puppet.joints[sure], axis=2) / posed.puppet.scale
        rows.append((terms, np.minimum(miss, FAR).mean(axis=1), crc32(source_of(posed.file).encode()) % 2))
    if len(rows) < FEWEST:
        raise InputError(f"the annotations show {len(rows)} people with an image before theirs; {FEWEST} are needed")
    say(f"{len(rows)} people")
    return Choices(*(np.stack([row[k] for row in rows]) for k in range(3)))


def _of_person(
    body: UpperBodyParameters,
    posed: Posed,
    likelihood: PartLikelihood,
    hands: HandDetectors,
    optical_flow: OpticalFlow,
    settings: WeightSettings,
    rng: np.random.Generator,
) -> tuple[Array, Array] | None:
    """Joints (P,J,2) and terms (P,7) of puppets around one person; None outside of the image."""
    puppet, earlier = posed.puppet, posed.before
    assert earlier is not None
    windows = [PersonWindow.around(likelihood, image, puppet.joints, puppet.scale) for image in (earlier, posed.image)]
    if windows[0] is None or windows[1] is None:
        return None
    before, now = (window.with_torso(*puppet.contours[:2]) for window in windows if window is not None)
    size = (posed.image.shape[1], posed.image.shape[0])
    grid = ImageScale(size, working_size(posed.image.shape, optical_flow.settings.max_side))
    flow = optical_flow.at_working_scale(earlier, posed.image)
    low, high = puppet.joints.min(axis=0) - puppet.scale, puppet.joints.max(axis=0) + puppet.scale
    frames = [
        FrameEvidence(before, hand_maps(hands, before, [flow[0]], grid, puppet.scale), None),
        FrameEvidence(now, hand_maps(hands, now, [flow[1]], grid, puppet.scale), None),
    ]
    frames[1].before = FlowMoments.of((flow[1], flow[0]), grid, low, high)
    vectors = body.vectors(puppet.joints[None], np.array([puppet.scale]))
    box, legs = body.box(vectors[0]), body.legs_of(puppet.joints)
    drawn = np.repeat(vectors, settings.puppets, axis=0)
    where = body.slices()
    for name, deviation in (("angle", ANGLE), ("length", LENGTH), ("center", PLACE * puppet.scale)):
        part = drawn[:, where[name]]
        drawn[:, where[name]] = part + deviation * rng.standard_normal(part.shape)
    if frames[1].hands is not None:
        moves = WristProposals.of(body, box, legs, frames[1].hands, puppet.joints[0], puppet.scale)
        drawn[::3] = moves(drawn[::3], rng)
    joints, scale = body.joints(box.inside(drawn), legs)
    prior, own, elsewhere = FlowingEnergy(body, frames, EnergySettings(forward=False)).terms(1, joints, scale)
    return joints, np.column_stack([prior, own[:, :3], elsewhere[:, :3]])


def search(choices: Choices, settings: WeightSettings) -> dict[str, float]:
    """The best weights by name, and the mean misses in metres by what is left out ("miss", "miss without hands", ...).

    "miss held out" is of weights that were chosen on the other half of the source videos.
    """
    rng = np.random.default_rng(settings.seed)
    low, high = np.log([RANGE[name] for name in SEARCHED]).T
    drawn = np.exp(rng.uniform(low, high, (settings.draws, len(SEARCHED))))
    weights = np.column_stack([drawn[:, 0], np.ones(len(drawn)), drawn[:, 1:]])
    costs = np.array([choices.cost(one) for one in weights])
    best = weights[costs.mean(axis=1).argmin()]
    held_out = [
        costs[costs[:, choices.half == half].mean(axis=1).argmin(), choices.half != half]
        for half in (0, 1)
        if (choices.half == half).any() and (choices.half != half).any()
    ]
    figures = {"prior_weight": best[0], "contour_weight": 1.0, "colour_weight": best[2], "hand_weight": best[3]}
    figures["miss"] = choices.cost(best).mean()
    figures["miss held out"] = np.concatenate(held_out).mean() if held_out else np.nan
    figures["miss without the neighbour's evidence"] = choices.cost(best, carried=0.0).mean()
    for name, index in (("prior", 0), ("contour", 1), ("colour", 2), ("hands", 3)):
        figures[f"miss without {name}"] = choices.cost(np.where(np.arange(4) == index, 0.0, best)).mean()
    figures["miss of a random puppet"] = choices.miss.mean()
    figures["miss of the best puppet"] = choices.miss.min(axis=1).mean()
    return {name: round(float(value), 4) for name, value in figures.items()}
