# SPDX-License-Identifier: Apache-2.0
"""Which frame of a video or folder an entry in somebody's file of keypoints belongs to: by name, or else by index."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.video_reader import IMAGE_SUFFIXES, FrameSource

type Label = int | str
"""A frame as a file of keypoints calls it: by its index from 0, or by its image's name or number."""

type Size = tuple[float, float]
"""Width and height, px."""

MAX_INDEX_DIGITS = 18  # of a frame's index; longer numbers are none
_INDEX = rf"\d{{1,{MAX_INDEX_DIGITS}}}"
_OPENPOSE_INDEX = re.compile(r".+_(\d{12})")  # OpenPose numbers the frames of a video so


@dataclass(frozen=True, slots=True)
class FrameNames:
    """What is known of frames before they are read.

    Attributes:
        stem: name of the video or folder without its suffix.
        files: the image of each frame; empty for a video or bag.
        count: number of frames, 0 when unknown.
        read_size: returns width and height of a frame, px, None where it cannot be read; None if nobody knows.
    """

    stem: str = ""
    files: tuple[Path, ...] = ()
    count: int = 0
    read_size: Callable[[int], Size | None] | None = None

    @classmethod
    def of(cls, source: FrameSource) -> FrameNames:
        """Describe the frames of a video or folder."""
        return cls(source.path.stem, source.files, len(source.files) or source.count, source.read_size)

    def includes(self, label: Label) -> bool:
        """Return whether a name says that its image is of this clip: "walk/12.png", "walk_000000000012"."""
        path = _as_path(label)
        return self.stem in (path.parent.name, _strip_number(_stem(path)))

    def match(self, labels: Iterable[Label], place: str | Path) -> dict[Label, list[int]]:
        """Return the frames that each label means; labels of other images are absent.

        An index means itself. Names mean the images with that name, or with that name but for suffix and leading zeros
        of numbers; of such images in several folders, the one whose folders agree most with the label's. Names that are
        bare numbers (AlphaPose on a video, COCO's ids) mean the numbers in the images' names, or indices if some are
        not there and all of them can be indices. Where frames have no names, and for what OpenPose calls
        `NAME_000000000012`, the number at the end is the index.

        InputError, which begins with `place`, when no label fits, or when one fits images in several folders.
        """
        names = [label for label in labels if isinstance(label, str)]
        found: dict[Label, list[int]] = {label: [label] for label in labels if isinstance(label, int) and label >= 0}
        if not names:
            return found
        by_name = self._match_images(names, place) if self.files else self._match_indices(names, place)
        if not by_name:
            raise InputError(
                f"{place} names images such as {names[0]!r}, but the frames are called {self.files[0].name!r} and the "
                "like; names must agree but for suffix and leading zeros"
            )
        return found | by_name

    def _match_images(self, names: Sequence[str], place: str | Path) -> dict[Label, list[int]]:
        exact = _look_up(names, self.files, lambda path: path.name, place)
        if not exact and all(re.fullmatch(_INDEX, _stem(_as_path(name))) for name in names):
            return self._match_numbers(names)
        found = exact
        for key in (_stem, lambda path: _strip_zeros(_stem(path))):
            # An image that has been found by a better rule is not looked for by a worse one.
            taken = {index for indices in found.values() for index in indices}
            rest = [name for name in names if name not in found]
            loose = _look_up(rest, self.files, key, place)
            found |= {name: indices for name, indices in loose.items() if not taken & set(indices)}
        if not found:
            indices = {name: match for name in names if (match := _OPENPOSE_INDEX.fullmatch(_stem(_as_path(name))))}
            if len(indices) == len(names):
                return {name: [int(match[1])] for name, match in indices.items()}
        return found

    def _match_numbers(self, names: Sequence[str]) -> dict[Label, list[int]]:
        """Match bare numbers with the numbers at the end of the images' names, or else with indices."""
        numbers = [_number_at_end(_stem(_as_path(file))) for file in self.files]
        wanted = {name: int(_stem(_as_path(name))) for name in names}
        index_of = {number: index for index, number in enumerate(numbers) if number is not None}
        numbered = len(index_of) == len(self.files)
        among = numbered and set(wanted.values()) <= set(index_of)
        # Indices have no leading zeros, unlike the names of images.
        plain = all(_stem(_as_path(name)) == str(number) for name, number in wanted.items())
        if plain and not among and (not numbered or all(number < len(self.files) for number in wanted.values())):
            return {name: [number] for name, number in wanted.items()}
        return {name: [index_of[number]] for name, number in wanted.items() if numbered and number in index_of}

    def _match_indices(self, names: Sequence[str], place: str | Path) -> dict[Label, list[int]]:
        """Match names with frames that have none, by the number at the end."""
        own = [name for name in names if self.includes(name)] or names
        sources = sorted({str(_as_path(name).parent / _strip_number(_stem(_as_path(name)))) for name in own})
        if len(sources) > 1:
            raise InputError(
                f"{place} names images of several videos ({sources[0]!r}, {sources[1]!r} ...), none of which is called "
                f"{self.stem!r}; give the keypoints of one"
            )
        found: dict[Label, list[int]] = {}
        for name in own:
            number = _number_at_end(_stem(_as_path(name)))
            if number is None:
                raise InputError(
                    f"{place} names the image {name!r}, but the frames here have no names; give the folder of images, "
                    "or names that end with the frame's index"
                )
            found[name] = [number]
        return found


def _look_up(
    names: Sequence[str], files: Sequence[Path], key: Callable[[PurePosixPath], str], place: str | Path
) -> dict[Label, list[int]]:
    """Return the images with the same key as each name; of several, those whose folders agree most with the name's."""
    indices: dict[str, list[int]] = {}
    for index, file in enumerate(files):
        indices.setdefault(key(_as_path(file)), []).append(index)
    found: dict[Label, list[int]] = {}
    for name in names:
        path = _as_path(name)
        same = indices.get(key(path), [])
        if len({files[index].parent for index in same}) > 1:
            shared = [_count_shared(path.parent, _as_path(files[index].absolute()).parent) for index in same]
            same = [index for index, count in zip(same, shared, strict=True) if count == max(shared)]
            if len({files[index].parent for index in same}) > 1:
                raise InputError(
                    f"{place} names the image {name!r}, which several folders have; give its folder with the name, or "
                    "one folder of images at a time"
                )
        if same:
            found[name] = same
    return found


def _count_shared(one: PurePosixPath, other: PurePosixPath) -> int:
    """Return how many folders at the end of two paths are the same."""
    count = 0
    for a, b in zip(reversed(one.parts), reversed(other.parts), strict=False):
        if a != b:
            break
        count += 1
    return count


def _as_path(name: Label | Path) -> PurePosixPath:
    """Return a name as a path, whichever way its slashes lean."""
    return PurePosixPath(str(name).replace("\\", "/"))


def _stem(path: PurePosixPath) -> str:
    """Return a file's name without the suffix of an image: "a.b.png" gives "a.b", "a.b" stays."""
    return path.stem if path.suffix.lower() in IMAGE_SUFFIXES else path.name


def _strip_zeros(stem: str) -> str:
    return re.sub(r"\d+", lambda digits: digits[0].lstrip("0") or "0", stem)


def _number_at_end(stem: str) -> int | None:
    """Return the last number in a name; None without one."""
    digits = re.findall(r"\d+", stem)
    return int(digits[-1]) if digits and len(digits[-1]) <= MAX_INDEX_DIGITS else None


def _strip_number(stem: str) -> str:
    """Return a name up to its last number: "walk_000000000012" gives "walk"."""
    return re.sub(r"\d+\D*$", "", stem).rstrip("_-. ")
