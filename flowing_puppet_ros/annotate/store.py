# SPDX-License-Identifier: Apache-2.0
"""The annotations of a folder, in one JSON file that is replaced as a whole at every change.

{"joint_names": [...], "images": {"name.jpg": [{"joints": [[x, y, visible], ...], "gender": ..., "view": ...}]}}
"""

from __future__ import annotations

import fcntl
import json
import math
import os
import re
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from flowing_puppet_ros.annotate.folder import split_key
from flowing_puppet_ros.errors import InputError, PuppetError
from flowing_puppet_ros.image.formats.stickmen import sticks_from_joints, write_sticks

FILE_NAME = "annotations.json"
GENDERS = ("neutral", "female", "male")
VIEWS = ("front", "back")
MAX_PEOPLE = 50  # of an image
MAX_COORDINATE_PX = 1e5  # of a joint

type Person = dict[str, Any]


class ConflictError(PuppetError):
    """The annotation was changed elsewhere since it was read."""


class AnnotationStore:
    """People by image key, with a revision per image that reveals conflicting changes. Thread-safe.

    Annotations of images that no longer exist are kept. Only one program at a time may use the folder.
    """

    def __init__(self, folder: Path, joint_names: Sequence[str]) -> None:
        """Open or create the folder's annotations; InputError when they are broken, of other joints, or in use."""
        self.path = folder / FILE_NAME
        self.joint_names = tuple(joint_names)
        self._lock = threading.Lock()
        self._lock_file = _lock_folder(folder)
        self._images = self._read()
        self._revision = dict.fromkeys(self._images, 1)

    def close(self) -> None:
        """Release the folder for other programs."""
        self._lock_file.close()

    def get(self, key: str) -> tuple[int, list[Person]]:
        """Return the revision (0 before the first) and the people of an image."""
        with self._lock:
            return self._revision.get(key, 0), self._images.get(key, [])

    def count_people(self) -> dict[str, int]:
        """Return the number of people in every image that has any."""
        with self._lock:
            return {key: len(people) for key, people in self._images.items() if people}

    def put(self, key: str, revision: int, people: object) -> int:
        """Replace the people of an image and return the new revision; they are on disk when this returns.

        ConflictError when `revision` is not the current one, InputError when `people` are invalid, PuppetError when the
        file cannot be written. In each case the annotation stays as it was.
        """
        checked = check_people(people, len(self.joint_names))
        with self._lock:
            if revision != self._revision.get(key, 0):
                raise ConflictError(f"{key} was changed elsewhere in the meantime")
            before = self._images.get(key)
            self._images[key] = checked
            try:
                self._write()
            except OSError as error:
                if before is None:
                    del self._images[key]
                else:
                    self._images[key] = before
                raise PuppetError(f"{self.path} cannot be written: {error.strerror}") from error
            self._revision[key] = revision + 1
            return revision + 1

    def write_sticks(self, path: Path, items: Sequence[str]) -> None:
        """Write all stick figures; a frame's number is the one in its name, or its index if these are not unique."""
        numbers = [_frame_number(key) for key in items]
        if None in numbers or len(set(numbers)) < len(numbers):
            numbers = list(range(len(items)))
        frames = {}
        for key, number in zip(items, numbers, strict=True):
            people = [np.array(person["joints"], dtype=np.float64)[:, :2] for person in self.get(key)[1]]
            if people and number is not None:
                frames[number] = [sticks_from_joints(self.joint_names, joints) for joints in people]
        write_sticks(path, frames)

    def _read(self) -> dict[str, list[Person]]:
        if not self.path.exists():
            return {}
        try:
            data = json.loads(self.path.read_text())
            names, images = tuple(data["joint_names"]), dict(data["images"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(f"{self.path} is not an annotations file ({error}); move it away or repair it") from error
        if names != self.joint_names:
            raise InputError(
                f"{self.path} has {len(names)} joints per person and this puppet has {len(self.joint_names)}; "
                "choose the other number of --parts"
            )
        return {key: check_people(people, len(names)) for key, people in images.items()}

    def _write(self) -> None:
        draft = self.path.with_name(FILE_NAME + ".part")
        with draft.open("w") as file:
            json.dump({"joint_names": self.joint_names, "images": self._images}, file, separators=(",", ":"))
            file.flush()
            os.fsync(file.fileno())
        draft.replace(self.path)


def check_people(people: object, joint_count: int) -> list[Person]:
    """Return the people of a page or a file with their known fields alone; InputError when they are invalid."""
    if not isinstance(people, list) or len(people) > MAX_PEOPLE:
        raise InputError(f"the people of an image must be a list of at most {MAX_PEOPLE}")
    return [_check_person(person, joint_count) for person in people]


def _check_person(person: object, joint_count: int) -> Person:
    if not isinstance(person, dict):
        raise InputError("a person must be an object with joints, gender and view")
    gender, view, joints = person.get("gender"), person.get("view"), person.get("joints")
    if gender not in GENDERS or view not in VIEWS:
        raise InputError(
            f"a person must be {' or '.join(GENDERS)} with the view {' or '.join(VIEWS)}, not {gender!r}, {view!r}"
        )
    if not isinstance(joints, list) or len(joints) != joint_count:
        raise InputError(f"a person must have {joint_count} joints")
    return {"joints": [_check_joint(joint) for joint in joints], "gender": gender, "view": view}


def _check_joint(joint: object) -> list[float]:
    if not isinstance(joint, list) or len(joint) != 3:
        raise InputError("a joint must be [x, y, visible]")
    for number in joint:
        if isinstance(number, bool) or not isinstance(number, int | float) or not math.isfinite(number):
            raise InputError(f"a joint must be three finite numbers, this one has {number!r}")
    x, y, visible = joint
    if abs(x) > MAX_COORDINATE_PX or abs(y) > MAX_COORDINATE_PX or visible not in (0, 1):
        raise InputError(
            f"a joint must be within {MAX_COORDINATE_PX:g} px and visible 0 or 1, not ({x:g}, {y:g}) and {visible:g}"
        )
    return [round(float(x), 2), round(float(y), 2), int(visible)]


def _frame_number(key: str) -> int | None:
    """Return the last number of an item's name, or the frame of a video; None without a number."""
    name, frame = split_key(key)
    digits = re.findall(r"\d+", Path(name).stem)
    if frame is not None:
        return frame
    return int(digits[-1]) if digits and len(digits[-1]) < 10 else None


def _lock_folder(folder: Path) -> IO[str]:
    """Lock the folder; the system releases the lock when the program ends, however it ends."""
    try:
        file = (folder / ".annotations.lock").open("w")
    except OSError as error:
        raise InputError(f"{folder} cannot be written, but the annotations are kept there: {error.strerror}") from error
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        file.close()
        raise InputError(f"{folder} is in use by another run of this tool; stop that one first") from error
    return file
