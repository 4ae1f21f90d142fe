# SPDX-License-Identifier: Apache-2.0
"""A network of your own as the source of people, described by a small YAML file beside it.

file: yolo11n-pose.onnx      # .onnx or .tflite, relative to this file
decoder: yolo                # yolo, movenet, simcc or heatmap
input: [640, 640]            # width and height of the network's input
joints: coco                 # or a list of names in the order of the output
colours: rgb                 # or bgr
mean: 0.0                    # subtracted from values of 0 to 255 ...
deviation: 255.0             # ... which are then divided by this; numbers, or one per colour
min_score: 0.3               # of a person
"""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from flowing_puppet_ros.arrays import F64, Image
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.keypoints import Keypoints, normalise_name
from flowing_puppet_ros.image.formats.skeletons import COCO_17
from flowing_puppet_ros.image.networks.decoders import DECODERS, ONE_PERSON, DecodedPerson
from flowing_puppet_ros.image.networks.keypoint_networks import MAX_PEOPLE, FoundPerson, KeypointSource
from flowing_puppet_ros.image.networks.poses import Warp, cut_rectangle, fit_to_rectangle
from flowing_puppet_ros.image.networks.runtime import LiteRtNetwork, Network, OnnxNetwork
from flowing_puppet_ros.images import as_rgb

KEYS = ("file", "decoder", "input", "joints", "colours", "mean", "deviation", "min_score")
BOX_MARGIN = 1.25  # of the box around a person's joints that a network for one person sees
MAX_SIDE_PX = 4096


@dataclass(frozen=True, slots=True, eq=False)
class NetworkDescription:
    """What a description file says; see the module's text."""

    file: Path
    decoder: str
    size: tuple[int, int]
    joints: tuple[str, ...]
    reversed_colours: bool
    mean: F64
    deviation: F64
    min_score: float

    @classmethod
    def read(cls, path: Path) -> NetworkDescription:
        """Read a description file; InputError when it cannot be read or something in it cannot be."""
        try:
            data = YAML(typ="safe", pure=True).load(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise InputError(f"{path} cannot be read: {error.strerror}") from error
        except (YAMLError, ValueError) as error:  # of the encoding, or of a date that is none
            raise InputError(f"{path} is not a YAML file; it describes a network by {', '.join(KEYS)}") from error
        if not isinstance(data, dict) or not {"file", "decoder", "input"} <= set(data):
            raise InputError(f"{path} needs at least file, decoder and input (width and height)")
        unknown = sorted(map(str, set(data) - set(KEYS)))
        if unknown:
            raise InputError(f"{path} has {unknown[0]!r}; known are {', '.join(KEYS)}")
        return cls._check(path, data)

    @classmethod
    def _check(cls, path: Path, data: Mapping[str, Any]) -> NetworkDescription:
        if data["decoder"] not in tuple(DECODERS):  # a list in its place is not hashable
            raise InputError(f"{path}: there is no decoder {data['decoder']!r}; known are {', '.join(DECODERS)}")
        colours = data.get("colours", "rgb")
        if colours not in ("rgb", "bgr"):
            raise InputError(f"{path}: colours are {colours!r}; they are rgb or bgr")
        try:
            width, height = (operator.index(side) for side in data["input"])
            mean, deviation = (
                np.broadcast_to(np.asarray(data.get(key, default), np.float64), (3,))
                for key, default in (("mean", 0.0), ("deviation", 255.0))
            )
            min_score = float(data.get("min_score", 0.3))
        except (TypeError, ValueError, OverflowError) as error:
            raise InputError(
                f"{path}: input is two whole numbers; mean and deviation are one number or three, min_score is one"
            ) from error
        if not (0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX):
            raise InputError(f"{path}: input {width} x {height} cannot be; its sides are 1 to {MAX_SIDE_PX} px")
        if not (np.isfinite([*mean, *deviation, min_score]).all() and (deviation != 0).all()):
            raise InputError(f"{path}: mean, deviation and min_score are finite numbers, and deviation is not 0")
        joints = _check_joints(path, data.get("joints", "coco"))
        file = path.parent / str(data["file"])
        return cls(file, data["decoder"], (width, height), joints, colours == "bgr", mean, deviation, min_score)


def _check_joints(path: Path, given: object) -> tuple[str, ...]:
    if given == "coco":
        return COCO_17
    if not isinstance(given, list) or not any(normalise_name(str(name)) for name in given):
        raise InputError(f"{path}: joints are `coco` or a list of names, such as left_shoulder; it has {given!r}")
    return tuple(str(name) for name in given)


class UserNetwork:
    """A network of the user's as a source of people."""

    def __init__(self, description: NetworkDescription, network: Network, finder: KeypointSource | None) -> None:
        """Take a network, and for one that sees one person at a time who finds people."""
        self._description, self._network, self._finder = description, network, finder

    @classmethod
    def load(cls, path: Path, finder: KeypointSource | None) -> UserNetwork:
        """Load the network that a description file names.

        Raises:
            InputError: when file or network cannot be used, or the network sees one person at a time and there is
                nobody to find people.
        """
        description = NetworkDescription.read(path)
        if description.decoder in ONE_PERSON and finder is None:
            raise InputError(
                f"{path} describes a network that sees one person at a time: the package's own networks find people for"
                " it, run `flowing-puppet networks --install`"
            )
        try:
            data = description.file.read_bytes()
        except OSError as error:
            raise InputError(f"{description.file}, which {path} names, cannot be read: {error.strerror}") from error
        try:
            network = LiteRtNetwork(data) if description.file.suffix.lower() == ".tflite" else OnnxNetwork(data)
        except InputError as error:
            raise InputError(f"{description.file}, which {path} names, cannot be used: {error}") from error
        whole = isinstance(network, LiteRtNetwork) and network.input_type.kind in "iu"
        if whole and (description.deviation != 1).any():
            raise InputError(f"{path}: the network's input is whole numbers: set deviation to 1")
        return cls(description, network, finder)

    def find(
        self, image: Image, known: Sequence[Keypoints] = (), everybody: bool = True, max_people: int = MAX_PEOPLE
    ) -> list[FoundPerson]:
        """Return the people in an image (H, W, 3) RGB or (H, W) grey; InputError if `image` is not one.

        A network that sees one person at a time looks at the `known` ones, and with `everybody` at whom the finder
        finds.
        """
        image = as_rgb(image)
        if self._description.decoder not in ONE_PERSON:
            people = self._run(*fit_to_rectangle(image, self._description.size))
            return sorted(people, key=lambda person: -person.score)[:max_people]
        boxes = list(known)
        if everybody:
            assert self._finder is not None
            boxes = [person.keypoints for person in self._finder.find(image, known, True, max_people)]
        found = [person for box in boxes for person in self._look_at(image, box)]
        return found[:max_people]

    def _look_at(self, image: Image, person: Keypoints) -> list[FoundPerson]:
        """Return a person by a look at the box around known joints."""
        points = person.xy[np.isfinite(person.xy).all(axis=1)]
        if len(points) < 2:
            return []
        low, high = points.min(axis=0), points.max(axis=0)
        return self._run(*cut_rectangle(image, (low + high) / 2, BOX_MARGIN * (high - low), self._description.size))

    def _run(self, canvas: Image, warp: Warp) -> list[FoundPerson]:
        told = self._description
        values = (canvas[..., ::-1] if told.reversed_colours else canvas).astype(np.float32)
        values = ((values - told.mean) / told.deviation).astype(np.float32)
        batch = values[None] if isinstance(self._network, LiteRtNetwork) else values.transpose(2, 0, 1)[None]
        outputs = self._network.run(np.ascontiguousarray(batch))
        people = DECODERS[told.decoder](outputs, told.size, len(told.joints))
        return [self._place(person, warp) for person in people if person[2] >= told.min_score]

    def _place(self, person: DecodedPerson, warp: Warp) -> FoundPerson:
        joints, scores, score = person
        sure = np.clip(np.nan_to_num(scores), 0.0, 1.0)
        known = np.isfinite(joints).all(axis=1) & (sure > 0)
        xy = np.where(known[:, None], warp.to_image(np.nan_to_num(joints)), np.nan)
        return FoundPerson(Keypoints(self._description.joints, xy, np.where(known, sure, 0.0)), score)
