# SPDX-License-Identifier: Apache-2.0
"""People in the JSON of other detectors, whatever is in the file: `read_detector_json` tells the forms apart.

    COCO            {"images": [{"id", "file_name"}], "annotations": [{"image_id", "keypoints": [x, y, v, ...]}]}
    COCO results    [{"image_id": 139, "keypoints": [x, y, score, ...], "score": s}], one entry a person
    AlphaPose       the same with an image's name as `image_id`; by name {"0.jpg": {"people" or "bodies": [...]}}
    OpenPose        {"people": [{"pose_keypoints_2d": [x, y, c, ...]}]}, one frame
    MediaPipe       [{"landmarks": [{"x", "y", "visibility"}, ...]}, ...], in frames, by index or by image, under
                    `landmarks`, `pose_landmarks` or `landmark`; also points by name, or rows [x, y, z, visibility]

Points have the names that COCO's `categories` give, or those of the order with so many points (`ORDERS`). Confidences
are mapped to [0, 1]:
- COCO's visibility, if all values are 0, 1 and 2: 2 is 1, 1 (hidden) is HIDDEN_CONFIDENCE, 0 is absent;
- scores and MediaPipe's visibility as they are, those over 1 (AlphaPose's heat maps) are 1; without any they are 1.

A point at (0, 0), of no confidence, or not finite was not found: it is absent, not in the corner. People without any
point are left out, and so are results with a person's score under MIN_SCORE, which COCO's measures ask for.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.annotations import HIDDEN_CONFIDENCE
from flowing_puppet_ros.image.formats.frame_names import MAX_INDEX_DIGITS, Label, Size
from flowing_puppet_ros.image.formats.keypoints import Keypoints, normalise_name
from flowing_puppet_ros.image.formats.skeletons import (
    COCO_17,
    COCO_WHOLEBODY,
    HALPE_26,
    MEDIAPIPE_33,
    OPENPOSE_18,
    OPENPOSE_25,
)

ORDERS: Mapping[int, tuple[str, ...]] = {
    17: COCO_17,
    18: OPENPOSE_18,
    25: OPENPOSE_25,
    26: HALPE_26,
    133: COCO_WHOLEBODY,
    136: HALPE_26,
}
"""Names of the first points by number of points; what follows are faces and fingers."""

MIN_SCORE = 0.1  # of a person in results
MAX_NORMALISED = 2.0  # half of the coordinates of people in pixels are beyond; normalised ones reach 1
MAX_DEPTH = 6  # of landmarks in lists and objects
MAX_NEGATIVE = 1 / 3  # share of normalised coordinates under 0; more are metres or reach from -1 to 1

type Row = tuple[tuple[str, ...], F64]
"""Names and (K, 3) x, y, the file's own confidence of a person's points."""

_PEOPLE = ("people", "bodies")
_POINTS = ("pose_keypoints_2d", "pose_keypoints", "joints")
_LANDMARKS = ("pose_landmarks", "poseLandmarks", "landmarks", "landmark")
_FRAME = ("image_id", "file_name", "filename", "image", "frame", "frame_index", "frame_number", "frame_id", "index")
_SIZES = (("width", "height"), ("image_width", "image_height"))
_CONFIDENCES = ("visibility", "score", "confidence", "presence")
_COCO_FORM = 'COCO needs "images": [{"id", "file_name"}], "annotations": [{"image_id", "keypoints": [x, y, v, ...]}]'
_RESULT_FORM = 'results need "image_id", an image\'s name or number, and "keypoints": [x, y, score, ...]'
FRAME_FORM = '{"people": [{"pose_keypoints_2d": [x, y, c, ...]}]} or {"landmarks": [{"x", "y", "visibility"}, ...]}'


@dataclass(frozen=True, slots=True, eq=False)
class LabelledPeople:
    """People by what the file calls their frame. Frames of `normalised` people are 1 wide and 1 high, `sizes` in px."""

    people: Mapping[Label, list[Keypoints]]
    normalised: bool = False
    sizes: Mapping[Label, Size] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class DetectorFrames:
    """What was read so far: the people of each frame, and its size px where the file says it."""

    rows: dict[Label, list[Row]] = field(default_factory=dict)
    sizes: dict[Label, Size] = field(default_factory=dict)

    def open_frame(self, label: Label, about: Mapping[str, Any]) -> list[Row]:
        """Return the list of a frame's people; `about` may have its size."""
        for names in _SIZES:
            width, height = (_as_number(about.get(name)) for name in names)
            if width > 0 and height > 0:
                self.sizes[label] = width, height
        return self.rows.setdefault(label, [])

    def finish(self, place: str) -> LabelledPeople:
        """Return the people, see above for confidences and missing points; InputError for metres."""
        every = [rows for people in self.rows.values() for _, rows in people]
        values = np.concatenate([np.empty((0, 3)), *every])
        present = values[_is_present(values)]
        flags = bool(np.isin(values[:, 2], (0, 1, 2)).all() and (values[:, 2] == 2).any())
        normalised = len(present) > 0 and float(np.median(np.abs(present[:, :2]))) < MAX_NORMALISED
        if normalised and (present[:, :2] < 0).mean() > MAX_NEGATIVE:
            raise InputError(
                f"{place} has coordinates around 0, as of landmarks in metres or scaled from -1 to 1; "
                "give those of the image, in pixels or from 0 to 1"
            )
        people = {label: [_make_keypoints(*one, flags) for one in found] for label, found in self.rows.items()}
        usable = {label: [one for one in found if one.select_usable()] for label, found in people.items()}
        return LabelledPeople(usable, normalised, self.sizes)


def read_detector_json(data: Any, label: Label, place: str, into: DetectorFrames) -> bool:
    """Add the people in parsed JSON to `into`; return False if it has none of the forms above.

    `label` is the frame's where the file holds only one and does not say which. InputError, which begins with `place`,
    says what is wrong with an entry and which form it should have.
    """
    if isinstance(data, dict) and "annotations" in data:
        _read_coco(data, place, into)
        return True
    if isinstance(data, list) and data and isinstance(data[0], dict) and {"image_id", "keypoints"} <= data[0].keys():
        _read_results(data, place, into)
        return True
    alone = isinstance(data, dict) or (isinstance(data, list) and data and _is_point(data[0]))
    return (alone and read_detector_frame(data, label, {}, place, into)) or _read_frames(data, place, into)


def read_detector_frame(frame: Any, label: Label, about: Mapping[str, Any], place: str, into: DetectorFrames) -> bool:
    """Add the people of one frame, in OpenPose's form or as landmarks; return False if it is no frame.

    `about` or the frame itself may have its size. InputError as of `read_detector_json`.
    """
    people = None
    if isinstance(frame, dict):
        about = {**about, **frame}
        people = next((frame[key] for key in _PEOPLE if isinstance(frame.get(key), list)), None)
    if people is not None:
        into.open_frame(label, about).extend(_read_openpose(people, place))
        return True
    landmarks = _split_people(frame)
    if landmarks is not None:
        into.open_frame(label, about).extend(_read_landmarks(person, place) for person in landmarks)
    return landmarks is not None


def _read_coco(data: Mapping[str, Any], place: str, into: DetectorFrames) -> None:
    labels: dict[Any, str] = {}
    try:
        for image in data.get("images", []):
            labels[image["id"]] = str(image.get("file_name", image["id"]))
            into.open_frame(labels[image["id"]], image)
        names = {kind.get("id"): tuple(map(str, kind.get("keypoints", ()))) for kind in data.get("categories", [])}
        entries = [one for one in data["annotations"] if one.get("keypoints") and not one.get("iscrowd")]
        found = [
            (labels.get(one["image_id"], str(one["image_id"])), names.get(one.get("category_id"), ()), one)
            for one in entries
        ]
    except (TypeError, KeyError, AttributeError) as error:
        raise InputError(f"{place} is not complete ({type(error).__name__} {error}); {_COCO_FORM}") from error
    for number, (label, given, one) in enumerate(found):
        where = f"{place}, annotation {one.get('id', number)}"
        into.open_frame(label, {}).append(_read_triples(one["keypoints"], given, where))


def _read_results(data: Sequence[Any], place: str, into: DetectorFrames) -> None:
    for number, one in enumerate(data):
        where = f"{place}, entry {number}"
        if not isinstance(one, dict) or not isinstance(one.get("image_id"), int | str) or "keypoints" not in one:
            raise InputError(f"{where} is incomplete; {_RESULT_FORM}")
        row = _read_triples(one["keypoints"], (), where)
        found = into.open_frame(str(one["image_id"]), one)
        if not _as_number(one.get("score")) < MIN_SCORE:
            found.append(row)


def _read_frames(data: Any, place: str, into: DetectorFrames) -> bool:
    """Read frames in a list, or by index or name; return False if the first is none."""
    frames = data["frames"] if isinstance(data, dict) and "frames" in data else data
    if not isinstance(frames, dict | list) or not frames or (isinstance(data, dict) and not any(data.values())):
        return False
    everywhere = data if isinstance(data, dict) else {}
    for number, (key, frame) in enumerate(frames.items() if isinstance(frames, dict) else enumerate(frames)):
        about = frame if isinstance(frame, dict) else {}
        label: Label = int(key) if isinstance(key, str) and key.isdecimal() and len(key) <= MAX_INDEX_DIGITS else key
        if isinstance(frames, list):
            label = next((about[name] for name in _FRAME if isinstance(about.get(name), int | str)), number)
        # null or {} where nobody was found
        if not read_detector_frame(frame or [], label, {**everywhere, **about}, f"{place}, frame {key}", into):
            if number == 0:
                return False
            raise InputError(f"{place}, frame {key} is of another form than those before; each needs {FRAME_FORM}")
    return True


def _read_openpose(people: Sequence[Any], place: str) -> Iterator[Row]:
    for number, person in enumerate(people):
        points = next((person[key] for key in _POINTS if key in person), None) if isinstance(person, dict) else None
        if points is None:
            raise InputError(f"{place}: person {number} has no points; a frame needs {FRAME_FORM}")
        if points:
            yield _read_triples(points, (), f"{place}, person {number}")


def _split_people(value: Any, depth: int = MAX_DEPTH) -> list[Any] | None:
    """Return the landmarks of each person in a frame, however they are nested; None for anything else."""
    if depth == 0:
        return None
    if isinstance(value, dict):
        for key in _LANDMARKS:
            if key in value:
                return _split_people(value[key] or [], depth - 1)
        return [value] if value and all(map(_is_point, value.values())) else None
    if not isinstance(value, list):
        return None
    if value and _is_point(value[0]):
        # Boxes too are lists of four numbers.
        return [value] if isinstance(value[0], dict) or len(value) == len(MEDIAPIPE_33) else None
    people: list[Any] = []
    for one in value:
        found = _split_people(one, depth - 1)
        if found is None:
            return None
        people += found
    return people


def _is_point(value: Any) -> bool:
    """Return whether this is a landmark: an object with x and y, or x, y, z, visibility."""
    if isinstance(value, dict):
        return "x" in value and "y" in value
    return isinstance(value, list) and len(value) == 4 and not any(isinstance(one, list | dict) for one in value)


def _read_landmarks(person: Mapping[str, Any] | Sequence[Any], place: str) -> Row:
    points = list(person.values()) if isinstance(person, Mapping) else person
    if not all(map(_is_point, points)):
        raise InputError(f"{place} has a landmark without place; a frame needs {FRAME_FORM}")
    rows = [
        (one["x"], one["y"], next((one[key] for key in _CONFIDENCES if key in one), 1.0))
        if isinstance(one, dict)
        else (one[0], one[1], one[3])
        for one in points
    ]
    named = (
        list(person) if isinstance(person, Mapping) else [one.get("name") for one in points if isinstance(one, dict)]
    )
    names = tuple(name for name in named if isinstance(name, str))
    if len(names) < len(rows):
        names = MEDIAPIPE_33
    if len(names) != len(rows):
        raise InputError(f"{place}: a person has {len(rows)} landmarks without names; MediaPipe's have {len(names)}")
    numbers = _as_numbers(rows, place)
    if numbers.ndim != 2:
        raise InputError(f"{place} has a landmark whose x, y or visibility is a list; each must be one number")
    return names, numbers


def _read_triples(values: Any, names: Sequence[str], place: str) -> tuple[tuple[str, ...], F64]:
    """Return the names of the points that have one, and their rows (K, 3)."""
    numbers = _as_numbers(values, place).ravel()
    count = len(numbers) / 3
    order = ORDERS.get(int(count), ())
    # Halpe's own names call the top of the head "head".
    if order != HALPE_26 and len(names) == count and any(map(normalise_name, names)):
        order = tuple(names)
    if not order or count != int(count):
        counts = ", ".join(map(str, ORDERS))
        raise InputError(
            f"{place}: {len(numbers)} keypoint values; give x, y and confidence of each of {counts} points (COCO, "
            "OpenPose BODY_18 and BODY_25, Halpe, whole bodies)"
        )
    return order, numbers.reshape(-1, 3)[: len(order)]


def _as_numbers(values: Any, place: str) -> F64:
    try:
        return np.array(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{place}: keypoints must be numbers: x, y, confidence, ...") from error


def _as_number(value: Any) -> float:
    """Return a finite number, NaN for anything else."""
    # Integers in JSON may be too long for a float.
    return float(value) if isinstance(value, int | float) and abs(value) < sys.float_info.max else math.nan


def _is_present(rows: F64) -> np.ndarray[Any, np.dtype[np.bool_]]:
    return np.isfinite(rows).all(axis=1) & (rows[:, 2] > 0) & (rows[:, :2] != 0).any(axis=1)


def _make_keypoints(names: tuple[str, ...], rows: F64, flags: bool) -> Keypoints:
    present = _is_present(rows)
    confidence = np.where(rows[:, 2] == 1, HIDDEN_CONFIDENCE, 1.0) if flags else np.clip(rows[:, 2], 0.0, 1.0)
    return Keypoints(names, np.where(present[:, None], rows[:, :2], np.nan), np.where(present, confidence, 0.0))
