# SPDX-License-Identifier: Apache-2.0
"""Silhouettes of one person in calibrated cameras to and from messages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import U8
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.stream.messages.geometry import make_pose, rotation_matrix
from flowing_puppet_ros.stream.messages.images import decode_labels, make_image
from flowing_puppet_ros.stream.messages.message_types import CAMERA_INFO, SILHOUETTES, MessageFactory

Masks = Mapping[str, U8]


def make_silhouettes(
    factory: MessageFactory,
    header: Any,
    person: Any,
    cameras: Mapping[str, Camera],
    masks: Masks,
    headers: Any,
    people: Sequence[str] = (),
) -> Any:
    """Return the SilhouetteSet of `person` (a Body with joints) from the mask (h, w) of each camera, by camera name.

    `header` has the stamp and the common frame; `headers` (camera name -> header) are those of the images. `people`
    are the ids of all who have a set of this stamp.
    """
    silhouettes = [
        factory.make(
            "flowing_puppet_msgs/msg/Silhouette",
            camera=name,
            info=_make_info(factory, headers[name], cameras[name].resize(mask.shape[::-1])),
            pose=make_pose(factory, cameras[name].centre, cameras[name].rotation.T),
            mask=make_image(factory, headers[name], mask, "mono8"),
        )
        for name, mask in masks.items()
    ]
    return factory.make(SILHOUETTES, header=header, person=person, silhouettes=silhouettes, people=people)


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


def decode_silhouettes(message: Any) -> list[tuple[Camera, U8]]:
    """Return the cameras and masks (h, w) of a SilhouetteSet; InputError names the camera that cannot be used."""
    views = []
    for silhouette in message.silhouettes:
        info, position, orientation = silhouette.info, silhouette.pose.position, silhouette.pose.orientation
        try:
            rotation = rotation_matrix((orientation.x, orientation.y, orientation.z, orientation.w)).T
            translation = -rotation @ np.array([position.x, position.y, position.z])
            camera = Camera.from_info(
                info.k, info.d, info.width, info.height, rotation, translation, info.distortion_model
            )
            mask = decode_labels(silhouette.mask)
        except InputError as error:
            raise InputError(f"{silhouette.camera}: {error}") from error
        if mask.shape[::-1] != camera.size:
            raise InputError(
                f"{silhouette.camera}: the mask is {mask.shape[1]} x {mask.shape[0]}, its camera_info says"
                f" {camera.size[0]} x {camera.size[1]}"
            )
        views.append((camera, mask))
    return views
