# SPDX-License-Identifier: Apache-2.0
"""Write people as JSON that needs no body model to be read: joints, parts and bones by name, and their measurements."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.exchange.bones import NAMES, PARENTS
from flowing_puppet_ros.exchange.motion import BodyMotion

_DIGITS = 5


def write_json(path: Path, people: Sequence[BodyMotion]) -> None:
    """Write people of one recording: metres, y up, quaternions as x y z w."""
    model = people[0].model
    document = {
        "unit": "m",
        "up": "y",
        "joint_names": list(model.joint_names),
        "part_names": list(model.tree.names),
        "bone_names": list(NAMES),
        "bone_parents": list(PARENTS),
        "people": [_describe(person) for person in people],
    }
    path.write_text(json.dumps(document), "utf8")


def _describe(motion: BodyMotion) -> dict[str, Any]:
    bones = motion.bones
    frames = []
    for t, stamp in enumerate(motion.stamps_ns):
        frames.append(
            {
                "stamp_ns": int(stamp),
                "confidence": round(float(motion.confidence[t]), _DIGITS),
                "reliable": bool(motion.reliable[t]),
                "joints": _round(motion.joints[t]),
                "parts": {"center": _round(motion.part_center[t]), "rotation": _turn(motion.part_rotation[t])},
                "bones": {"position": _round(bones.position[t]), "rotation": _turn(bones.rotation[t])},
            }
        )
    return {"id": motion.identity, "name": motion.name, "model": motion.model.name, "frames": frames}


def _turn(rotation: Array) -> Any:
    return _round(Rotation.from_matrix(rotation).as_quat())


def _round(values: Array) -> Any:
    return np.round(values, _DIGITS).tolist()
