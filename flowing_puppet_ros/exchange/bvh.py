# SPDX-License-Identifier: Apache-2.0
"""Write a person's skeleton and its motion as BVH (Biovision Hierarchy): centimetres, y up, z forward at rest.

The rest pose is the model's: legs and arms a little apart. Turns are about Z, X, Y, degrees. Only the hips move, and
bones keep their mean length, so joints differ from those of bodies whose lengths vary from frame to frame by that.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.exchange.bones import NAMES, PARENTS, keep_lengths
from flowing_puppet_ros.exchange.motion import BodyMotion
from flowing_puppet_ros.units import NANOSECONDS

CM = 100.0
_ORDER = "ZXY"


def write_bvh(path: Path, motion: BodyMotion) -> None:
    """Write the skeleton and its motion at the median rate of the frames."""
    motion = motion.resample()
    bones = keep_lengths(motion.bones, motion.joints, motion.model.joint_names)
    ends = bones.ends(motion.joints, motion.model.joint_names)
    lines = ["HIERARCHY", *_list_bone(0, CM * bones.offsets(), CM * ends, "")]
    turns = bones.local_rotations()
    angles = Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_euler(_ORDER).reshape(*turns.shape[:2], 3)
    angles = np.degrees(np.unwrap(angles, axis=0))
    lines += ["MOTION", f"Frames: {len(angles)}", f"Frame Time: {motion.step_ns / NANOSECONDS:.9g}"]
    order = list(_walk(0))
    for place, turn in zip(CM * bones.position[:, 0], angles, strict=True):
        values = np.concatenate([place, turn[order].reshape(-1)])
        lines.append(" ".join(f"{value:.6f}" for value in values))
    path.write_text("\n".join(lines) + "\n", "utf8")


def _walk(bone: int) -> Iterator[int]:
    """Yield a bone and all that hang on it, in the order of the file."""
    yield bone
    for child in _children(bone):
        yield from _walk(child)


def _children(bone: int) -> list[int]:
    return [child for child, parent in enumerate(PARENTS) if parent == bone]


def _list_bone(bone: int, offsets: Array, ends: Array, indent: str) -> Iterator[str]:
    """Yield the lines of a bone and of all that hang on it."""
    channels = [f"{axis}rotation" for axis in _ORDER]
    if PARENTS[bone] < 0:
        channels = [f"{axis}position" for axis in "XYZ"] + channels
    inner = indent + "\t"
    yield f"{indent}{'ROOT' if PARENTS[bone] < 0 else 'JOINT'} {NAMES[bone]}"
    yield f"{indent}{{"
    yield f"{inner}OFFSET {_numbers(offsets[bone])}"
    yield f"{inner}CHANNELS {len(channels)} {' '.join(channels)}"
    for child in _children(bone):
        yield from _list_bone(child, offsets, ends, inner)
    if not _children(bone):
        yield from (f"{inner}End Site", f"{inner}{{", f"{inner}\tOFFSET {_numbers(ends[bone])}", f"{inner}}}")
    yield f"{indent}}}"


def _numbers(values: Array) -> str:
    return " ".join(f"{value:.6f}" for value in values)
