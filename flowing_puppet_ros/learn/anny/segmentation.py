# SPDX-License-Identifier: Apache-2.0
"""Segmentation of the Anny body into the 16 parts of the Stitched Puppet.

Skin weights assign vertices to limbs; planes through the joints of the average body cut the limbs, so that interfaces
are clean rings. Shoulder parts are wide caps: torso and upper arm, left and right leg never touch.
"""

from __future__ import annotations

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.learn.anny.body import AnnyBody
from flowing_puppet_ros.learn.anny.poses import normalise
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
CAP_LENGTH = 0.3  # extent of the shoulder part down the arm, as a share of the upper arm
COLLAR_TILT, COLLAR_HEIGHT = 0.45, -0.005  # slope, and metres above the neck joint, of the cut below the head
CAP_INNER = (0.6, 0.0)  # upper end of the shoulder's inner cut: share of the shoulder's y, metres above the neck joint
CAP_LOWER = (0.92, -0.16)  # its lower end, under the armpit: share of the shoulder's y, metres above the shoulder joint
LEG_INNER = 0.02  # metres: half the width of the strip of torso between the legs
LEG_OUTER = (0.2, 0.09)  # metres, y and height above the hip joint of the outer end of the leg's cut
LEG_TILT = 0.3  # slope of the leg's cut, which is lower behind than in front


def assign_vertices_to_parts(body: AnnyBody) -> Array:
    """Return the part (V,) uint8 of each vertex, in the order of SP_PARENTS; exactly left-right symmetric."""
    rest = body.make_rest_body(body.mean_phenotype())
    names = tuple(SP_PARENTS)
    owner = np.full(len(rest.vertices), names.index("torso"), dtype=np.uint8)
    owner[_is_head(body, rest.vertices, rest.joints)] = names.index("head")
    for name, where in _segment_left_side(body, rest.vertices, rest.joints).items():
        owner[where] = names.index(name)
        owner[body.mirror_vertex[where]] = names.index(mirrored_name(name))
    return owner


def _segment_left_side(body: AnnyBody, vertices: Array, joints: Array) -> dict[str, Array]:
    weight = np.stack(
        [_sum_skin_weights(body, TORSO), *(_sum_skin_weights(body, bones) for bones in LEFT_BONES.values())], axis=1
    )
    weight[vertices[:, 1] <= 0, 1:] = -1.0
    parts = {name: weight.argmax(axis=1) == k for k, name in enumerate(LEFT_BONES, start=1)}
    for above, below, upper, lower, tail in LIMB_CUTS:
        start, joint = joints[body.bone_index(upper)], joints[body.bone_index(lower)]
        along = normalise(joint - start)
        across = along if tail is None else normalise(along + normalise(joints[body.bone_index(tail)] - joint))
        limb, beyond = parts[above] | parts[below], (vertices - joint) @ across > 0
        parts[above], parts[below] = limb & ~beyond, limb & beyond
    trunk = (weight.argmax(axis=1) == 0) & (vertices[:, 1] > 0) & ~_is_head(body, vertices, joints)
    leg = (parts["left_upper_leg"] | trunk) & (_height_above_leg_cut(body, vertices, joints) < 0)
    arm = joints[body.bone_index("LeftForeArm")] - joints[body.bone_index("LeftArm")]
    beyond = (vertices - joints[body.bone_index("LeftArm")] - CAP_LENGTH * arm) @ arm > 0
    cap = (parts["left_upper_arm"] & ~beyond) | (trunk & (_offset_from_shoulder_cut(body, vertices, joints) > 0))
    return parts | {
        "left_shoulder": cap,
        "left_upper_arm": parts["left_upper_arm"] & beyond,
        "left_upper_leg": leg & ~parts["left_lower_leg"],
    }


def _is_head(body: AnnyBody, vertices: Array, joints: Array) -> Array:
    above = (vertices - joints[body.bone_index("Neck")]) @ np.array([COLLAR_TILT, 0.0, 1.0]) > COLLAR_HEIGHT
    return np.asarray((_sum_skin_weights(body, ("Neck", "Neck1", "Head")) > 0.2) & above)


def _offset_from_shoulder_cut(body: AnnyBody, vertices: Array, joints: Array) -> Array:
    neck, shoulder = joints[body.bone_index("Neck")], joints[body.bone_index("LeftArm")]
    upper = np.array([CAP_INNER[0] * shoulder[1], neck[2] + CAP_INNER[1]])
    lower = np.array([CAP_LOWER[0] * shoulder[1], shoulder[2] + CAP_LOWER[1]])
    along = lower - upper
    return np.asarray((vertices[:, 1:] - upper) @ np.array([-along[1], along[0]]))


def _height_above_leg_cut(body: AnnyBody, vertices: Array, joints: Array) -> Array:
    midline = vertices[np.abs(vertices[:, 1]) < 1e-9]
    crotch, hip = midline[midline[:, 2].argmin()], joints[body.bone_index("LeftUpLeg")]
    slope = (hip[2] + LEG_OUTER[1] - crotch[2]) / (LEG_OUTER[0] - LEG_INNER)
    level = crotch[2] + slope * (vertices[:, 1] - LEG_INNER) + LEG_TILT * (vertices[:, 0] - crotch[0])
    return np.asarray(vertices[:, 2] - level)


def _sum_skin_weights(body: AnnyBody, bones: tuple[str, ...]) -> Array:
    return np.asarray(body.skin_weights[:, [body.bone_index(bone) for bone in bones]].sum(axis=1))
