# SPDX-License-Identifier: Apache-2.0
"""From the tracked puppets of several calibrated cameras to silhouettes, triangulated joints and a visual hull."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import F64, U8
from flowing_puppet_ros.errors import InputError, PuppetError
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.silhouette import Observation, Silhouette, SilhouetteEstimator, SilhouetteSettings
from flowing_puppet_ros.multiview.triangulation import TriangulationSettings, triangulate
from flowing_puppet_ros.multiview.visual_hull import (
    MIN_VIEWS,
    HullSettings,
    bounds_of_joints,
    bounds_of_masks,
    visual_hull,
)


# The parts of a composed settings class must not be slotted: Python cannot merge the layouts of several slotted bases.
@dataclass(frozen=True)
class HullBuilderSettings(HullSettings, SilhouetteSettings, TriangulationSettings):
    """Everything that leads from puppets to a hull."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraObservation:
    """What one camera contributes to a set: its observed frame, and the joints of the puppet in it.

    `joints` (J,2) are pixels of the camera's full image, NaN where unknown; `confidence` (J,) is in [0,1].
    """

    observation: Observation
    joints: F64
    confidence: F64


@dataclass(frozen=True, slots=True, eq=False)
class MultiViewPerson:
    """One person in the cameras at one instant, in the world frame of the cameras' extrinsics, metres.

    `joints` (J,3) and `confidence` (J,), NaN and 0 where fewer than two views agree; the `silhouettes` of all cameras;
    `masks` (h,w) of those that can be used, fewer than two when `problem` says why in one sentence.
    """

    joints: F64
    confidence: F64
    silhouettes: dict[str, Silhouette]
    problem: str = ""

    @property
    def masks(self) -> dict[str, U8]:
        """The masks by camera that can be used."""
        return {name: each.mask for name, each in self.silhouettes.items() if not each.problem}


@dataclass(frozen=True, slots=True, eq=False)
class Hull:
    """Surface `points` (N,3) and outward `normals` (N,3); none when `problem` says why in one sentence."""

    points: F64
    normals: F64
    problem: str = ""


class HullBuilder:
    """Keeps the cameras and their backgrounds, cuts one person out of each set that is asked for and carves its hull.

    Every frame of every camera goes through `observe`, which is cheap; `cut` takes the observations of one instant, and
    `carve` what it found.
    """

    def __init__(self, settings: HullBuilderSettings | None = None) -> None:
        """Know no camera yet."""
        self.settings = settings or HullBuilderSettings()
        self.cameras: dict[str, Camera] = {}
        self._estimators: dict[str, SilhouetteEstimator] = {}

    def set_camera(self, name: str, camera: Camera) -> None:
        """Take a camera's calibration; when a known camera's changes, its background is forgotten."""
        known = self.cameras.get(name)
        if known is not None and not known.same_as(camera):
            self._estimators.pop(name, None)
        self.cameras[name] = camera

    def reset(self) -> None:
        """Forget all backgrounds, as after a jump back in time; the calibrations stay."""
        self._estimators.clear()

    def background_share(self, name: str) -> float:
        """The share of camera `name`'s image whose background is known, 0 to 1."""
        estimator = self._estimators.get(name)
        return float(estimator.background.known.mean()) if estimator and estimator.background.count.size else 0.0

    def update_background(
        self,
        name: str,
        image: U8,
        labels: U8,
        scale: float,
        person: U8 | None = None,
    ) -> Observation:
        """Learn camera `name`'s background from a frame; see `SilhouetteEstimator.observe` for the arguments.

        Raises InputError when the image has another size than the camera's calibration.
        """
        camera = self.cameras.get(name)
        if camera is not None and image.shape[1::-1] != camera.size:
            raise InputError(
                f"the image of camera {name} is {image.shape[1]} x {image.shape[0]}, "
                f"its camera_info says {camera.size[0]} x {camera.size[1]}"
            )
        return self._estimator(name).update_background(image, labels, scale, person)

    def segment(self, views: Mapping[str, CameraObservation]) -> MultiViewPerson:
        """Cut the silhouettes of one set and triangulate its joints.

        `views` maps camera names to what they saw at one instant. Raises InputError for a camera without
        calibration.
        """
        missing = sorted(set(views) - set(self.cameras))
        if missing:
            raise InputError(f"camera {missing[0]} has no calibration; is its camera_info published?")
        silhouettes = {name: self._estimator(name).segment(view.observation) for name, view in views.items()}
        usable = sum(not silhouette.problem for silhouette in silhouettes.values())
        problem = ""
        if usable < MIN_VIEWS:
            reasons = "; ".join(f"{name}: {each.problem}" for name, each in silhouettes.items() if each.problem)
            problem = f"a person needs {MIN_VIEWS} usable silhouettes, got {usable} ({reasons})"
        return MultiViewPerson(*self._joints(views), silhouettes, problem)

    def carve(self, person: MultiViewPerson) -> Hull:
        """Carve the hull of a person; cameras with an unusable mask are left out."""
        empty = np.zeros((0, 3))
        if person.problem:
            return Hull(empty, empty, person.problem)
        cameras, masks = [self.cameras[name] for name in person.masks], list(person.masks.values())
        try:
            bounds = bounds_of_joints(person.joints, self.settings.margin)
            if bounds is None:
                bounds = bounds_of_masks(cameras, masks, self.settings.margin)
            return Hull(*visual_hull(cameras, masks, bounds, self.settings))
        except PuppetError as error:
            return Hull(empty, empty, str(error))

    def _estimator(self, name: str) -> SilhouetteEstimator:
        return self._estimators.setdefault(name, SilhouetteEstimator(self.settings))

    def _joints(self, views: Mapping[str, CameraObservation]) -> tuple[F64, F64]:
        if len(views) < MIN_VIEWS:
            count = max((len(view.joints) for view in views.values()), default=0)
            return np.full((count, 3), np.nan), np.zeros(count)
        pixels = np.stack([view.joints for view in views.values()])
        weights = np.stack([view.confidence for view in views.values()])
        return triangulate([self.cameras[name] for name in views], pixels, weights, self.settings)
