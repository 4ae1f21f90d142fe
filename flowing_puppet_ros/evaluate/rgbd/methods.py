# SPDX-License-Identifier: Apache-2.0
"""Ways to find the bodies in a frame of colour and depth, as `evaluate rgbd` compares them."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.rgbd.keypoints import LIMB_JOINTS, SeenKeypoints
from flowing_puppet_ros.evaluate.rgbd.views import RgbdFrame
from flowing_puppet_ros.evidence.cloud.depth_smoothing import smooth_depth
from flowing_puppet_ros.evidence.cloud.range_image import RangeImage
from flowing_puppet_ros.fusion.people_fitter import FusionSettings, PeopleFitter
from flowing_puppet_ros.fusion.puppet_joints import PuppetJoints, place_joints
from flowing_puppet_ros.fusion.seen_cloud import SeenCloud
from flowing_puppet_ros.image.networks.keypoint_networks import KeypointSource
from flowing_puppet_ros.multiview.camera import Camera

PIXEL_STEP = 2  # every n-th row and column of the depth image, as the nodes take it
MAX_MATCH_PX = 60.0  # mean distance of a network's person from a true one, at a focal length of 525 px


@dataclass(frozen=True, slots=True, eq=False)
class SensedScene:
    """The cloud of a frame with z up and the depth camera at the origin.

    Attributes:
        points: (N, 3) metres.
        pixel: (N,) index into the flattened depth image.
        image: the range image of the points.
        colour: the colour camera in this frame.
        to_world: (4, 4).
    """

    points: F64
    pixel: np.ndarray
    image: RangeImage
    colour: Camera
    to_world: F64

    @classmethod
    def of(cls, frame: RgbdFrame) -> SensedScene:
        """Take a frame as the nodes do; InputError if it shows no depth."""
        camera = frame.cameras.depth
        index = np.arange(frame.depth.size).reshape(frame.depth.shape)
        pixel = index[PIXEL_STEP // 2 :: PIXEL_STEP, PIXEL_STEP // 2 :: PIXEL_STEP]
        known = np.isfinite(frame.depth.ravel()[pixel])
        if not known.any():
            raise InputError("the depth image shows nothing")
        points, own = frame.points.reshape(-1, 3)[pixel[known]], np.flatnonzero(known)
        image = RangeImage.of_organised(points, own, pixel.shape)
        if image is None:
            raise InputError("the depth image is no pinhole camera's")
        upright = camera.rotation.T
        eye = camera.centre
        other = frame.cameras.colour
        colour = Camera(
            other.matrix, other.distortion, other.size, other.rotation, other.translation + other.rotation @ eye
        )
        to_world = np.eye(4)
        to_world[:3, 3] = eye
        return cls(points @ upright.T, pixel[known], image.turn(upright), colour, to_world)


class RgbdMethod(Protocol):
    """Finds a body for each true person of a frame."""

    def find(self, frame: RgbdFrame) -> tuple[list[BodyFit | None], F64, float]:
        """Return a fit or None per person, the transform (4, 4) of their frame to the world, and processor seconds."""
        ...


class FusionMethod:
    """Bodies from keypoints and depth together."""

    def __init__(self, fitter: BodyFitter, networks: KeypointSource | None = None) -> None:
        """Take true joints with noise, or what `networks` find in the drawn image."""
        self._people = PeopleFitter(fitter, FusionSettings())
        self._networks = networks

    def find(self, frame: RgbdFrame) -> tuple[list[BodyFit | None], F64, float]:
        """Return a fit or None per person, the transform (4, 4) of their frame to the world, and processor seconds."""
        scene = SensedScene.of(frame)
        puppets = self._find_puppets(frame)
        started = time.process_time()
        found = dict(self._people.fit_people(SeenCloud.of(scene.points, scene.colour), puppets, scene.image))
        seconds = time.process_time() - started
        return [found.get(str(person)) for person in range(len(frame.bodies))], scene.to_world, seconds

    def _find_puppets(self, frame: RgbdFrame) -> list[PuppetJoints]:
        """Return the puppets with the true person's number as id."""
        model = self._people.model
        if self._networks is None:
            return [as_puppet(model.joint_names, str(k), person) for k, person in enumerate(frame.keypoints)]
        puppets: dict[int, tuple[float, PuppetJoints]] = {}
        for person in self._networks.find(frame.rgb):
            keypoints = person.keypoints
            placed = np.array([keypoints.xy[list(keypoints.names).index(name)] for name in LIMB_JOINTS])
            number, away = _find_nearest(placed, frame)
            places = keypoints.names, keypoints.xy, keypoints.confidence
            puppet = place_joints(model, str(number), *places, mask=keypoints.mask)
            if puppet is not None and away < puppets.get(number, (np.inf, None))[0]:
                puppets[number] = (away, puppet)
        return [puppet for _, puppet in puppets.values()]


class SearchMethod:
    """Bodies from the geometry alone, of people whose points are given."""

    def __init__(self, fitter: BodyFitter) -> None:
        self._fitter = fitter

    def find(self, frame: RgbdFrame) -> tuple[list[BodyFit | None], F64, float]:
        """Return a fit or None per person, the transform (4, 4) of their frame to the world, and processor seconds."""
        scene = SensedScene.of(frame)
        fits: list[BodyFit | None] = []
        started = time.process_time()
        for person in range(len(frame.bodies)):
            own = frame.clean(person).ravel()[scene.pixel]
            try:
                field = scene.image.make_field(own)
                points = smooth_depth(scene.image, scene.points, own)
                fits.append(self._fitter.fit(points, viewpoint=np.zeros(3), field=field))
            except InputError:
                fits.append(None)
        return fits, scene.to_world, time.process_time() - started


def as_puppet(names: tuple[str, ...], identity: str, person: SeenKeypoints) -> PuppetJoints:
    """Return keypoints, which are the model's own joints, as a puppet."""
    pixels, confidence = np.full((len(names), 2), np.nan), np.zeros(len(names))
    rows = [names.index(name) for name in LIMB_JOINTS]
    pixels[rows], confidence[rows] = person.pixels, person.confidence
    return PuppetJoints(identity, pixels, confidence, np.zeros(len(names), dtype=bool), person.mask)


def _find_nearest(pixels: F64, frame: RgbdFrame) -> tuple[int, float]:
    """Return the true person whose joints are nearest to LIMB_JOINTS (12, 2) px in the colour image, and how near."""
    camera = frame.cameras.colour
    distance = []
    for joints in frame.joints:
        apart = np.linalg.norm(camera.project(joints)[0] - pixels, axis=1) * 525.0 / camera.focal
        distance.append(float(np.nanmean(apart)) if np.isfinite(apart).any() else np.inf)
    number = int(np.argmin(distance))
    return (number, distance[number]) if distance[number] < MAX_MATCH_PX else (len(distance), distance[number])
