# SPDX-License-Identifier: Apache-2.0
"""Which of the 16 Stitched Puppet parts every vertex of the Anny body belongs to.

Skin weights say which limb a vertex is on; planes through the joints of the average body cut the limbs, so that
interfaces are clean rings. Shoulder parts are wide caps: torso and upper arm, left and right leg never touch.
"""

from __future__ import annotations

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.learn.anny.body import AnnyBody
from flowing_puppet_ros.model.tree import SP_PARENTS, mirrored_name

TORSO = ("Hips", "LHipJoint", "RHipJoint", "LowerBack", "Spine", "Spine1", "LeftShoulder", "RightShoulder")
LEFT_BONES = {
    "left_upper_arm": ("LeftArm",),
    "left_lower_arm": ("LeftForeArm",),
    "left_hand": ("LeftHand", "LThumb", "LeftFingerBase", "LeftHandFinger1"),
    "left_upper_leg": ("LeftUpLeg",),
    "left_lower_leg": ("LeftLeg",),
    "left_foot": ("LeftFoot", "LeftToeBase"),
}
LIMB_CUTS = (  # the two parts, the bones above and below the cut, the bone whose tail ends the lower one
    ("left_upper_arm", "left_lower_arm", "LeftArm", "LeftForeArm", "LeftHand"),
    ("left_lower_arm", "left_hand", "LeftForeArm", "LeftHand", "LeftHandFinger1"),
    ("left_upper_leg", "left_lower_leg", "LeftUpLeg", "LeftLeg", "LeftFoot"),
    ("left_lower_leg", "left_foot", "LeftLeg", "LeftFoot", None),
)
CAP_LENGTH = 0.3  # of the upper arm: how far the shoulder part reaches down the arm
COLLAR_TILT, COLLAR_HEIGHT = 0.45, -0.005  # metres a metre, metres: the cut of the head above the neck joint
CAP_INNER = (0.6, 0.0)  # of the shoulder's y, and metres above the neck joint: upper end of the shoulder's inner cut
CAP_LOWER = (0.92, -0.16)  # of the shoulder's y, and metres above the shoulder joint: its lower end, under the armpit
LEG_INNER = 0.02  # metres: half the width of the strip of torso between the legs
LEG_OUTER = (0.2, 0.09)  # metres, y and height above the hip joint of the outer end of the leg's cut
LEG_TILT = 0.3  # metres a metre: how much lower the leg's cut is behind than in front


def part_of_vertex(body: AnnyBody) -> Array:
    """Index (V,) uint8, in the order of SP_PARENTS, of the part that each vertex belongs to; left-right exact."""
    rest = body.rest(body.mean_phenotype())
    names = tuple(SP_PARENTS)
    owner = np.full(len(rest.vertices), names.index("torso"), dtype=np.uint8)
    owner[_is_head(body, rest.vertices, rest.joints)] = names.index("head")
    for name, where in _left_parts(body, rest.vertices, rest.joints).items():
        owner[where] = names.index(name)
        owner[body.mirror_vertex[where]] = names.index(mirrored_name(name))
    return owner


def _left_parts(body: AnnyBody, vertices: Array, joints: Array) -> dict[str, Array]:
    weight = np.stack([_weight(body, TORSO), *(_weight(body, bones) for bones in LEFT_BONES.values())], axis=1)
    weight[vertices[:, 1] <= 0, 1:] = -1.0
    parts = {name: weight.argmax(axis=1) == k for k, name in enumerate(LEFT_BONES, start=1)}
    for above, below, upper, lower, tail in LIMB_CUTS:
        start, joint = joints[body.bone(upper)], joints[body.bone(lower)]
        along = _unit(joint - start)
        across = along if tail is None else _unit(along + _unit(joints[body.bone(tail)] - joint))
        limb, beyond = parts[above] | parts[below], (vertices - joint) @ across > 0
        parts[above], parts[below] = limb & ~beyond, limb & beyond
    trunk = (weight.argmax(axis=1) == 0) & (vertices[:, 1] > 0) & ~_is_head(body, vertices, joints)
    leg = (parts["left_upper_leg"] | trunk) & (_above_leg_cut(body, vertices, joints) < 0)
    arm = joints[body.bone("LeftForeArm")] - joints[body.bone("LeftArm")]
    beyond = (vertices - joints[body.bone("LeftArm")] - CAP_LENGTH * arm) @ arm > 0
    cap = (parts["left_upper_arm"] & ~beyond) | (trunk & (_outside_shoulder_cut(body, vertices, joints) > 0))
    return parts | {
        "left_shoulder": cap,
        "left_upper_arm": parts["left_upper_arm"] & beyond,
        "left_upper_leg": leg & ~parts["left_lower_leg"],
    }


def _is_head(body: AnnyBody, vertices: Array, joints: Array) -> Array:
    above = (vertices - joints[body.bone("Neck")]) @ np.array([COLLAR_TILT, 0.0, 1.0]) > COLLAR_HEIGHT
    return np.asarray((_weight(body, ("Neck", "Neck1", "Head")) > 0.2) & above)


def _outside_shoulder_cut(body: AnnyBody, vertices: Array, joints: Array) -> Array:
    neck, shoulder = joints[body.bone("Neck")], joints[body.bone("LeftArm")]
    upper = np.array([CAP_INNER[0] * shoulder[1], neck[2] + CAP_INNER[1]])
    lower = np.array([CAP_LOWER[0] * shoulder[1], shoulder[2] + CAP_LOWER[1]])
    along = lower - upper
    return np.asarray((vertices[:, 1:] - upper) @ np.array([-along[1], along[0]]))


def _above_leg_cut(body: AnnyBody, vertices: Array, joints: Array) -> Array:
    midline = vertices[np.abs(vertices[:, 1]) < 1e-9]
    crotch, hip = midline[midline[:, 2].argmin()], joints[body.bone("LeftUpLeg")]
    slope = (hip[2] + LEG_OUTER[1] - crotch[2]) / (LEG_OUTER[0] - LEG_INNER)
    level = crotch[2] + slope * (vertices[:, 1] - LEG_INNER) + LEG_TILT * (vertices[:, 0] - crotch[0])
    return np.asarray(vertices[:, 2] - level)


def _weight(body: AnnyBody, bones: tuple[str, ...]) -> Array:
    return np.asarray(body.skin_weights[:, [body.bone(bone) for bone in bones]].sum(axis=1))


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))
