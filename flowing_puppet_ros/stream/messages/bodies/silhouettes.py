# SPDX-License-Identifier: Apache-2.0
"""Silhouettes of one person in calibrated cameras to and from messages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import U8
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.stream.messages.geometry import make_camera_info, make_pose, rotation_matrix
from flowing_puppet_ros.stream.messages.images import decode_labels, make_image
from flowing_puppet_ros.stream.messages.message_types import SILHOUETTES, MessageFactory

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
    scaled = {name: cameras[name].resize(mask.shape[::-1]) for name, mask in masks.items()}
    silhouettes = [
        factory.make(
            "flowing_puppet_msgs/msg/Silhouette",
            camera=name,
            info=make_camera_info(factory, headers[name], camera.size, camera.matrix, camera.distortion),
            pose=make_pose(factory, camera.centre, camera.rotation.T),
            mask=make_image(factory, headers[name], masks[name], "mono8"),
        )
        for name, camera in scaled.items()
    ]
    return factory.make(SILHOUETTES, header=header, person=person, silhouettes=silhouettes, people=people)


def decode_silhouettes(message: Any) -> list[tuple[Camera, U8]]:
    """Return the cameras and masks (h, w) of a SilhouetteSet; InputError names the camera that cannot be used."""
    views = []
    for view in decode_views(message).values():
        if isinstance(view, InputError):
            raise view
        views.append(view)
    return views


def decode_views(message: Any) -> dict[str, tuple[Camera, U8] | InputError]:
    """Return the cameras and masks (h, w) of a SilhouetteSet by name, or why one cannot be used."""
    views: dict[str, tuple[Camera, U8] | InputError] = {}
    for silhouette in message.silhouettes:
        try:
            views[silhouette.camera] = _decode_one(silhouette)
        except InputError as error:
            views[silhouette.camera] = InputError(f"{silhouette.camera}: {error}")
    return views


def _decode_one(silhouette: Any) -> tuple[Camera, U8]:
    info, position, orientation = silhouette.info, silhouette.pose.position, silhouette.pose.orientation
    rotation = rotation_matrix((orientation.x, orientation.y, orientation.z, orientation.w)).T
    translation = -rotation @ np.array([position.x, position.y, position.z])
    camera = Camera.from_info(info.k, info.d, info.width, info.height, rotation, translation, info.distortion_model)
    mask = decode_labels(silhouette.mask)
    if mask.shape[::-1] != camera.size:
        raise InputError(
            f"the mask is {mask.shape[1]} x {mask.shape[0]}, its camera_info says {camera.size[0]} x {camera.size[1]}"
        )
    return camera, mask
