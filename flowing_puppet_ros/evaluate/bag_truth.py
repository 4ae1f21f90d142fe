# SPDX-License-Identifier: Apache-2.0
"""Bodies of a replay's bag against true 3D joints: mean distances, sides swapped, jitter."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from flowing_puppet_ros.bag.reader import Bag
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.from_bag import (
    Joints,
    body_joints,
    first_bodies,
    nearest,
    read_recording,
    triangulated,
)
from flowing_puppet_ros.evaluate.joints import ARM_JOINTS, LEG_JOINTS, JointErrors, joint_errors, swapped_share

WITHIN = (0.05, 0.1)  # metres


def read_truth(path: Path) -> dict[int, Joints]:
    """Read true joints, JSON {"stamp in ns": {"joint": [x, y, z in metres]}}; InputError when it has another form."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        return {
            int(stamp): {str(name): _place(place) for name, place in joints.items()} for stamp, joints in data.items()
        }
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f'{path} is not of the form {{"stamp in ns": {{"joint": [x, y, z]}}}}') from error


def measured(given: Bag, made: Bag, truth: dict[int, Joints] | None) -> tuple[JointErrors, dict[str, float]]:
    """Errors of the bodies in `made`, and figures of them, distances in metres.

    With several bodies at a stamp the one nearest to the truth counts. Without `truth` the reference are joints
    triangulated from the detections of both bags.

    Raises:
        InputError: when there is nothing to compare.
    """
    recording = read_recording(given, made)
    frames = {stamp: body_joints(body) for stamp, body in first_bodies(recording).items()}
    if truth is not None:
        for stamp, bodies in recording.bodies.items():
            candidates = [body_joints(body) for body in bodies]
            index = nearest(truth.get(stamp, {}), candidates)
            if index is not None:
                frames[stamp] = candidates[index]
    reference = triangulated(recording, frames) if truth is None else truth
    errors = joint_errors(frames, reference)
    if not errors.known.size:
        raise InputError(f"{made.path} has no body at a stamp of the truth; check that both come from one recording")
    figures = errors.summary(WITHIN) | {"true frames": float(len(reference)), "jitter": _jitter(frames)}
    for limbs, joints in (("arms", ARM_JOINTS), ("legs", LEG_JOINTS)):
        swapped, told = swapped_share(frames, reference, joints)
        figures[f"{limbs} swapped"] = swapped / told if told else float("nan")
    return errors, figures


def _jitter(frames: dict[int, Joints]) -> float:
    """Mean length of the second difference of the joints over successive frames, metres."""
    stamps = sorted(frames)
    lengths = []
    for before, now, after in zip(stamps, stamps[1:], stamps[2:], strict=False):
        for name in frames[now]:
            if name in frames[before] and name in frames[after]:
                lengths.append(np.linalg.norm(frames[before][name] - 2 * frames[now][name] + frames[after][name]))
    return float(np.mean(lengths)) if lengths else float("nan")


def _place(values: list[float]) -> np.ndarray:
    place = np.array(values, dtype=np.float64)
    if place.shape != (3,):
        raise ValueError("a place has three coordinates")
    return place
