# SPDX-License-Identifier: Apache-2.0
"""People in the middle of a room, as depth cameras around them see them: each by itself, and all of them together."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter
from flowing_puppet_ros.body.scene.rig_scene import RigScene
from flowing_puppet_ros.body.scene.scene_cloud import SceneCloud
from flowing_puppet_ros.body.track.scene_tracker import SceneSettings, SceneTracker
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.body.synthetic_bodies import TrueBody
from flowing_puppet_ros.evaluate.body.synthetic_scans import make_box
from flowing_puppet_ros.evaluate.rgbd.clothing import paint_surroundings
from flowing_puppet_ros.evaluate.rgbd.keypoints import LIMB_JOINTS
from flowing_puppet_ros.evaluate.rgbd.methods import SensedScene
from flowing_puppet_ros.evaluate.rgbd.views import RgbdFrame, RgbdStudio, look_along
from flowing_puppet_ros.evaluate.scene.synthetic_scenes import draw_upright
from flowing_puppet_ros.process.threads import one_blas_thread

DISTANCE_M, EYE_HEIGHT_M = (2.4, 3.4), (0.9, 1.8)  # of the cameras, from the middle
JITTER_RAD = 0.2  # of their places on the ring
CIRCLE_M, FIRST_GAP_M = (0.45, 0.8), 1.0  # of the people about the middle; between two of them at least
AIM_HEIGHT_M = 0.9
MAX_MATCH_M = 0.5  # between the mean joints of a body and of the person that it is
CUPBOARDS_M = (((4.0, 0.6, 0.4), (0.5, 0.8, 0.8)), ((-2.0, -3.7, 0.9), (0.4, 0.6, 1.8)))  # middle and size


class CameraRing:
    """Draws what so many depth cameras around some people see."""

    def __init__(self, studio: RgbdStudio, cameras: int) -> None:
        """Place `cameras` of the studio's cameras evenly around the people."""
        self.studio, self.cameras = studio, cameras

    def look(self, rng: np.random.Generator, people: int) -> list[RgbdFrame]:
        """Return what each camera sees of the same people at the same time; one generator gives one moment."""
        bodies = self._place_people(rng, people)
        boxes = [make_box(np.array([0.0, 0.0, -0.05]), np.array([9.0, 9.0, 0.1]), np.eye(3))]
        boxes += [make_box(np.array(middle), np.array(size), np.eye(3)) for middle, size in CUPBOARDS_M]
        room = paint_surroundings(boxes, rng)
        start, frames = rng.uniform(-np.pi, np.pi), []
        for number in range(self.cameras):
            angle = start + 2 * np.pi * number / self.cameras + rng.uniform(-JITTER_RAD, JITTER_RAD)
            away, height = rng.uniform(*DISTANCE_M), rng.uniform(*EYE_HEIGHT_M)
            eye = np.array([away * np.cos(angle), away * np.sin(angle), height])
            axes = look_along(-eye, float(np.arctan2(height - AIM_HEIGHT_M, away)))
            frames.append(self.studio.look(rng, bodies, room, self.studio.cameras.place(axes, eye)))
        return frames

    def _place_people(self, rng: np.random.Generator, people: int) -> list[TrueBody]:
        bodies, turn = [], rng.uniform(-np.pi, np.pi)
        # Neighbours on the circle are at least so far apart that nobody is in anybody.
        least = FIRST_GAP_M / (2 * np.sin(np.pi / people)) if people > 1 else 0.0
        for number in range(people):
            angle = turn + 2 * np.pi * number / people
            away = max(least, rng.uniform(*CIRCLE_M)) if people > 1 else 0.0
            place = np.array([away * np.cos(angle), away * np.sin(angle), 0.0])
            bodies.append(draw_upright(self.studio.source, rng).translate(place))
        return bodies


@dataclass(frozen=True, slots=True)
class RingScore:
    """What the fits of one moment are worth.

    Attributes:
        joints: (P,) m, mean error of the limbs' joints of each person, NaN without a body.
        vertices: (P,) m, mean error of the vertices.
        ghosts: bodies that are nobody.
        reliable: bodies that are somebody and say that they are reliable.
        seconds: processor time.
    """

    joints: F64
    vertices: F64
    ghosts: int
    reliable: int
    seconds: float


def make_scene(frame: RgbdFrame) -> SceneCloud:
    """Return the cloud of one camera in the world."""
    sensed = SensedScene.of(frame)
    eye = sensed.to_world[:3, 3]
    return SceneCloud(sensed.points + eye, None, 1, True, sensed.image.move(eye), eye)


def score_scene(fitter: BodyFitter, scene: SceneCloud, studio: RgbdStudio, bodies: Sequence[TrueBody]) -> RingScore:
    """Find the people of a scene in the world and compare them with those who are there."""
    begin = time.process_time()
    with one_blas_thread():
        try:
            fits = [body.fit for body in SceneTracker(fitter, SceneSettings()).fit_once(scene, 0)]
        except InputError:  # nobody
            fits = []
    return score_fits(fitter, fits, studio, bodies, time.process_time() - begin)


def score_fits(
    fitter: BodyFitter, fits: Sequence[BodyFit], studio: RgbdStudio, bodies: Sequence[TrueBody], seconds: float
) -> RingScore:
    """Compare fits in the world with those who are there; each person has the nearest one, the surest first."""
    own = [fitter.model.joint_names.index(name) for name in LIMB_JOINTS]
    limbs = [studio.source.joint_names.index(name) for name in LIMB_JOINTS]
    true = np.stack([body.joints[limbs] for body in bodies])
    joints, vertices = np.full(len(bodies), np.nan), np.full(len(bodies), np.nan)
    ghosts, reliable = 0, 0
    for fit in sorted(fits, key=lambda fit: -fit.confidence):
        away = np.linalg.norm(fit.joints[own].mean(axis=0) - true.mean(axis=1), axis=1)
        person = int(away.argmin())
        if away[person] > MAX_MATCH_M or np.isfinite(joints[person]):
            ghosts += 1
            continue
        joints[person] = np.linalg.norm(fit.joints[own] - true[person], axis=1).mean()
        template = bodies[person].template_vertices(fitter.model.name)
        vertices[person] = np.linalg.norm(fit.vertices - template, axis=1).mean()
        reliable += fit.reliable
    return RingScore(joints, vertices, ghosts, reliable, seconds)


def compare_cameras(
    fitter: BodyFitter, ring: CameraRing, rng: np.random.Generator, people: int
) -> dict[int, list[RingScore]]:
    """Draw a moment; return, by number of cameras, the scores of each camera alone and of all together."""
    frames = ring.look(rng, people)
    scenes = [make_scene(frame) for frame in frames]
    bodies = frames[0].bodies
    found = {1: [score_scene(fitter, scene, ring.studio, bodies) for scene in scenes]}
    if len(scenes) > 1:
        found[len(scenes)] = [score_scene(fitter, RigScene.merge(scenes, 1), ring.studio, bodies)]
    return found


def summarise_ring(cameras: int, scores: Sequence[RingScore]) -> dict[str, Any]:
    """Return the figures of some moments seen by so many cameras at a time, in centimetres."""
    joints = np.concatenate([score.joints for score in scores])
    vertices = np.concatenate([score.vertices for score in scores])
    known = np.isfinite(joints)
    return {
        "cameras": cameras,
        "people": len(joints),
        "found": int(np.count_nonzero(known)),
        "joints_cm": 100 * float(joints[known].mean()) if known.any() else float("nan"),
        "vertices_cm": 100 * float(vertices[known].mean()) if known.any() else float("nan"),
        "median_cm": 100 * float(np.median(vertices[known])) if known.any() else float("nan"),
        "worst_cm": 100 * float(vertices[known].max()) if known.any() else float("nan"),
        "ghosts": sum(score.ghosts for score in scores),
        "reliable": sum(score.reliable for score in scores),
        "seconds": float(np.mean([score.seconds for score in scores])),
    }
