# SPDX-License-Identifier: Apache-2.0
"""Builds silhouettes, triangulated joints and a visual hull from the tracked puppets of several calibrated cameras."""

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
from flowing_puppet_ros.settings import Settings, nested


@dataclass(frozen=True)
class HullBuilderSettings(Settings):
    """Settings from puppets to a hull."""

    silhouette: SilhouetteSettings = nested(SilhouetteSettings)
    triangulation: TriangulationSettings = nested(TriangulationSettings)
    hull: HullSettings = nested(HullSettings)


@dataclass(frozen=True, slots=True, eq=False)
class CameraObservation:
    """One camera's observation of a person.

    Attributes:
        observation: the frame at working scale.
        joints: (J, 2) pixels of the camera's full image, NaN where unknown.
        confidence: (J,) in [0, 1].
    """

    observation: Observation
    joints: F64
    confidence: F64


@dataclass(frozen=True, slots=True, eq=False)
class MultiViewPerson:
    """One person in the cameras at one instant, in the world frame of the cameras' extrinsics.

    Attributes:
        joints: (J, 3) metres, NaN where fewer than two views agree.
        confidence: (J,) in [0, 1], 0 where fewer than two views agree.
        silhouettes: of all cameras.
        problem: one sentence that says why fewer than two masks can be used; empty when there are enough.
    """

    joints: F64
    confidence: F64
    silhouettes: dict[str, Silhouette]
    problem: str = ""

    @property
    def masks(self) -> dict[str, U8]:
        """Usable masks (h, w) by camera."""
        return {name: each.mask for name, each in self.silhouettes.items() if not each.problem}


@dataclass(frozen=True, slots=True, eq=False)
class Hull:
    """Surface `points` (N, 3) m and outward `normals` (N, 3); none when `problem` says why in one sentence."""

    points: F64
    normals: F64
    problem: str = ""


class HullBuilder:
    """The cameras with their backgrounds; segments a person in a set of images and carves the hull.

    Every frame of every camera goes through `update_background`, which is cheap; `segment` takes the observations of
    one instant, and `carve` its result.
    """

    def __init__(self, settings: HullBuilderSettings | None = None) -> None:
        """Start without cameras."""
        self.settings = settings or HullBuilderSettings()
        self.cameras: dict[str, Camera] = {}
        self._estimators: dict[str, SilhouetteEstimator] = {}

    def set_camera(self, name: str, camera: Camera) -> None:
        """Set a camera's calibration; a known camera whose calibration changes loses its background."""
        known = self.cameras.get(name)
        if known is not None and not known.equals(camera):
            self._estimators.pop(name, None)
        self.cameras[name] = camera

    def reset(self) -> None:
        """Forget all backgrounds, as after a jump back in time, but keep the calibrations."""
        self._estimators.clear()

    def background_share(self, name: str) -> float:
        """Return the share of camera `name`'s image with a known background, 0 to 1."""
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
        """Learn camera `name`'s background from a frame, with the arguments of `SilhouetteEstimator.update_background`.

        Raises InputError when the image does not have the size of the camera's calibration.
        """
        camera = self.cameras.get(name)
        if camera is not None and image.shape[1::-1] != camera.size:
            raise InputError(
                f"the image of camera {name} is {image.shape[1]} x {image.shape[0]}, "
                f"its camera_info says {camera.size[0]} x {camera.size[1]}"
            )
        return self._get_estimator(name).update_background(image, labels, scale, person)

    def observe(self, name: str, image: U8, labels: U8, scale: float, person: U8) -> Observation:
        """Return another person of a frame from which camera `name` has learned; see `SilhouetteEstimator.observe`."""
        return self._get_estimator(name).observe(image, labels, scale, person)

    def segment(
        self, views: Mapping[str, CameraObservation], identity: str = "", joints: tuple[F64, F64] | None = None
    ) -> MultiViewPerson:
        """Segment the silhouettes of one person in one set.

        `views` maps camera names to their observations of the person called `identity` at one instant, and `joints` are
        its joints (J, 3) m and confidences (J,), triangulated from the views if not given. Raises InputError for a
        camera without calibration.
        """
        missing = sorted(set(views) - set(self.cameras))
        if missing:
            raise InputError(f"camera {missing[0]} has no calibration; check that its camera_info is published")
        silhouettes = {
            name: self._get_estimator(name).segment(view.observation, identity) for name, view in views.items()
        }
        usable = sum(not silhouette.problem for silhouette in silhouettes.values())
        problem = ""
        if usable < MIN_VIEWS:
            reasons = "; ".join(f"{name}: {each.problem}" for name, each in silhouettes.items() if each.problem)
            problem = f"a person needs {MIN_VIEWS} usable silhouettes, got {usable} ({reasons})"
        return MultiViewPerson(*(joints or self._triangulate(views)), silhouettes, problem)

    def carve(self, person: MultiViewPerson) -> Hull:
        """Carve the hull of a person; cameras with an unusable mask are left out."""
        empty = np.zeros((0, 3))
        if person.problem:
            return Hull(empty, empty, person.problem)
        cameras, masks = [self.cameras[name] for name in person.masks], list(person.masks.values())
        try:
            bounds = bounds_of_joints(person.joints, self.settings.hull.margin)
            if bounds is None:
                bounds = bounds_of_masks(cameras, masks, self.settings.hull.margin)
            return Hull(*visual_hull(cameras, masks, bounds, self.settings.hull))
        except PuppetError as error:
            return Hull(empty, empty, str(error))

    def _get_estimator(self, name: str) -> SilhouetteEstimator:
        return self._estimators.setdefault(name, SilhouetteEstimator(self.settings.silhouette))

    def _triangulate(self, views: Mapping[str, CameraObservation]) -> tuple[F64, F64]:
        if len(views) < MIN_VIEWS:
            count = max((len(view.joints) for view in views.values()), default=0)
            return np.full((count, 3), np.nan), np.zeros(count)
        pixels = np.stack([view.joints for view in views.values()])
        weights = np.stack([view.confidence for view in views.values()])
        return triangulate([self.cameras[name] for name in views], pixels, weights, self.settings.triangulation)
