# SPDX-License-Identifier: Apache-2.0
"""Silhouettes of one person in calibrated cameras to and from messages, and the bodies that are fitted to them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flowing_puppet_ros.body.camera import Camera
from flowing_puppet_ros.body.fitter import BodyFit
from flowing_puppet_ros.body.silhouette_fit import SilhouetteFitter, SilhouetteFitterSettings
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet
from flowing_puppet_ros.stream.component import CAMERA_INFO, SILHOUETTES
from flowing_puppet_ros.stream.images import decode_labels, make_image
from flowing_puppet_ros.stream.messages import MessageFactory, make_pose, rotation_matrix, stamp_ns
from flowing_puppet_ros.stream.people import joints_of

Masks = Mapping[str, NDArray[np.uint8]]

_FORGET_NS = 1_000_000_000
"""A person seen longer ago than this, or later, tells nothing of a body's pose."""


def make_silhouettes(
    factory: MessageFactory, header: Any, person: Any, cameras: Mapping[str, Camera], masks: Masks, headers: Any
) -> Any:
    """Return the SilhouetteSet of a person (a Body of joints) whose masks (h,w) the cameras of these names cut out.

    `header` has the instant and the common frame, `headers` (camera name -> header) those of the images.
    """
    silhouettes = [
        factory.make(
            "flowing_puppet_msgs/msg/Silhouette",
            camera=name,
            info=_make_info(factory, headers[name], cameras[name].resized(mask.shape[::-1])),
            pose=make_pose(factory, cameras[name].centre, cameras[name].rotation.T),
            mask=make_image(factory, headers[name], mask, "mono8"),
        )
        for name, mask in masks.items()
    ]
    return factory.make(SILHOUETTES, header=header, person=person, silhouettes=silhouettes)


def _make_info(factory: MessageFactory, header: Any, camera: Camera) -> Any:
    return factory.make(
        CAMERA_INFO,
        header=header,
        height=camera.size[1],
        width=camera.size[0],
        distortion_model="plumb_bob",
        d=camera.distortion,
        k=camera.matrix,
        r=np.eye(3),
        p=np.hstack([camera.matrix, np.zeros((3, 1))]),
    )


def views_of(message: Any) -> list[tuple[Camera, NDArray[np.uint8]]]:
    """Return the cameras and masks (h,w) of a SilhouetteSet; InputError names the camera that cannot be used."""
    views = []
    for each in message.silhouettes:
        info, place, turn = each.info, each.pose.position, each.pose.orientation
        try:
            rotation = rotation_matrix((turn.x, turn.y, turn.z, turn.w)).T
            translation = -rotation @ np.array([place.x, place.y, place.z])
            camera = Camera.from_info(
                info.k, info.d, info.width, info.height, rotation, translation, info.distortion_model
            )
            mask = decode_labels(each.mask)
        except InputError as error:
            raise InputError(f"{each.camera}: {error}") from error
        if mask.shape[::-1] != camera.size:
            raise InputError(
                f"{each.camera}: the mask is {mask.shape[1]} x {mask.shape[0]}, its camera_info says"
                f" {camera.size[0]} x {camera.size[1]}"
            )
        views.append((camera, mask))
    return views


class SilhouetteBodies:
    """Fits the person of each SilhouetteSet; remembers the last good body of every person for about a second."""

    def __init__(self, model: StitchedPuppet, settings: SilhouetteFitterSettings) -> None:
        """Prepare the fit of `model`."""
        self._fitter = SilhouetteFitter(model, settings)
        self._last: dict[str, tuple[int, BodyState]] = {}

    def reset(self) -> None:
        """Forget everybody."""
        self._last.clear()

    def fit(self, message: Any) -> tuple[str, BodyFit]:
        """Return the id and the body of the person in a SilhouetteSet; InputError when it cannot be fitted."""
        identity, stamp = message.person.id or "b1", stamp_ns(message)
        seen, before = self._last.get(identity, (stamp, None))
        if not 0 <= stamp - seen <= _FORGET_NS:
            before = None
        fit = self._fitter.fit(views_of(message), joints_of(message.person), before)
        if fit.reliable:
            self._last[identity] = stamp, fit.state
        return identity, fit
