# SPDX-License-Identifier: Apache-2.0
"""Bodies of people in the middle of cameras from depth alone, silhouettes alone, and both, where depth is missing."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter
from flowing_puppet_ros.body.scene.rig_scene import RigScene
from flowing_puppet_ros.body.settings import BodyTrackerSettings
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.moving.camera_ring import CameraRing, RingScore, make_scene, score_fits, score_scene
from flowing_puppet_ros.evaluate.moving.drawn_silhouettes import draw_people
from flowing_puppet_ros.evaluate.moving.lost_depth import lose_depth
from flowing_puppet_ros.fusion.people_fitter import FusionSettings, PeopleFitter
from flowing_puppet_ros.fusion.rig.rig_people import RigPeople
from flowing_puppet_ros.fusion.rig.silhouette_person import SilhouettePerson
from flowing_puppet_ros.multiview.silhouette_fit import SilhouetteFitter, SilhouetteFitterSettings

SETTINGS = SilhouetteFitterSettings()


def compare_evidence(
    fitter: BodyFitter, ring: CameraRing, seed: tuple[int, int], people: int, losses: Sequence[str]
) -> dict[tuple[str, str], RingScore]:
    """Draw a moment by its seed; return the scores by loss (of `lost_depth.LOSSES`) and evidence."""
    drawing, losing, masking = (np.random.default_rng([seed[0], kind, seed[1]]) for kind in (500, 600, 700))
    frames = ring.look(drawing, people)
    bodies, shown = frames[0].bodies, draw_people(frames, masking)
    begin = time.process_time()
    fits = _fit_silhouettes(fitter, shown)
    alone = score_fits(fitter, fits, ring.studio, bodies, time.process_time() - begin)
    found: dict[tuple[str, str], RingScore] = {}
    for loss, own in zip(losses, losing.spawn(len(losses)), strict=True):
        left = lose_depth(frames, loss, own, fitter.model)
        scene = RigScene.merge([make_scene(frame) for frame in left if np.isfinite(frame.depth).any()], 1)
        found[loss, "depth"] = score_scene(fitter, scene, ring.studio, bodies)
        begin = time.process_time()
        fits = _fit_both(fitter, shown, scene)
        found[loss, "silhouettes"] = alone
        found[loss, "both"] = score_fits(fitter, fits, ring.studio, bodies, time.process_time() - begin)
    return found


def _fit_both(fitter: BodyFitter, shown: Sequence[SilhouettePerson], scene: RigScene) -> list[BodyFit]:
    """Return the bodies of whom silhouettes show, fitted to these and to a scene."""
    tracked = RigPeople(PeopleFitter(fitter, FusionSettings()), SETTINGS, BodyTrackerSettings(), 0.0)
    return [body.fit for body in tracked.step(scene, shown, 1)[0]]


def _fit_silhouettes(fitter: BodyFitter, shown: Sequence[SilhouettePerson]) -> list[BodyFit]:
    """Return the bodies of whom silhouettes show, fitted to these alone."""
    silhouettes, fits = SilhouetteFitter(fitter.model, SETTINGS), []
    for person in shown:
        try:
            fits.append(silhouettes.fit(list(person.views.values()), person.joints))
        except InputError:  # joints or silhouettes place no body
            continue
    return fits
