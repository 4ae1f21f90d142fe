# SPDX-License-Identifier: Apache-2.0
"""Messages of a robot's cameras to the body fitter, and its bodies against the people who were there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.evaluate.moving.robot_view import RobotMoment, RobotView, Sensing
from flowing_puppet_ros.evaluate.rgbd.keypoints import LIMB_JOINTS, SeenKeypoints
from flowing_puppet_ros.fusion.puppet_joints import ANKLE_DROP
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.process.threads import one_blas_thread
from flowing_puppet_ros.stream.components.body_fitter import BodyFitterComponent, BodyFitterSettings
from flowing_puppet_ros.stream.messages.geometry import make_camera_info, make_header, make_transform, stamp_ns
from flowing_puppet_ros.stream.messages.images import make_image
from flowing_puppet_ros.stream.messages.message_types import PUPPETS, TRANSFORMS
from flowing_puppet_ros.stream.messages.puppets import decode_body_joints

BEGIN_NS = 1_000_000_000
TRANSFORM_RATE_HZ = 50.0
DEPTH_FRAME, COLOUR_FRAME, BASE_FRAME, WORLD_FRAME = "depth_optical_frame", "colour_optical_frame", "base", "map"
BELLY_SHARE = 0.4  # of the way from the hips to the shoulders
VELOCITY_WINDOW_S = 0.5  # over which velocities are measured
MAX_MATCH_M = 0.5  # between the mean joints of a body and of the person that it is
FACTORY = BagMessageFactory()


def to_ns(seconds: float) -> int:
    """Return the stamp, ns, of a time in seconds."""
    return BEGIN_NS + round(1e9 * seconds)


@dataclass(frozen=True, slots=True, eq=False)
class FitterRun:
    """What came of one way of seeing the people.

    Attributes:
        errors: (T, P, 12) m in the world, of the joints that are in view; NaN for others and without a body.
        ids: (T, P), "" without a body.
        velocity_errors: (T, P) m/s, NaN without a body and while none can be measured.
        ghosts: bodies that are nobody.
        warnings: what the body fitter said.
    """

    errors: F64
    ids: list[list[str]]
    velocity_errors: F64
    ghosts: int
    warnings: list[str]

    def summarise(self, name: str) -> dict[str, Any]:
        """Return the figures, in centimetres."""
        numbers = {identity for row in self.ids for identity in row} - {""}
        return {
            "seen": name,
            "joints_cm": 100 * float(np.nanmean(self.errors)),
            "walking_cm": 100 * float(np.nanmean(self.errors[:, 1])),
            "velocity_cm_s": 100 * float(np.nanmean(self.velocity_errors)),
            "missed": sum(identity == "" for row in self.ids for identity in row),
            "ids": len(numbers),
            "ghosts": self.ghosts,
        }


def run_fitter(view: RobotView, sensing: Sensing) -> FitterRun:
    """Let the body fitter see the people."""
    moments = list(view.look(sensing))
    messages = sorted(list_messages(view, sensing, moments), key=lambda item: item[:2])
    with one_blas_thread():  # as nodes and replays do
        component = BodyFitterComponent(BodyFitterSettings.from_mapping({"fixed_frame": sensing.fixed_frame}), FACTORY)
        for port in ("puppets", "puppets/camera_info"):
            component.set_expected(port, True)
        outputs = [made for _, _, port, message in messages for made in component.handle(port, message)]
        outputs += component.flush()
    found = {stamp_ns(message): message for name, message in outputs if name == "bodies"}
    return _compare(view, moments, found, component.report.drain_warnings())


def list_messages(
    view: RobotView, sensing: Sensing, moments: list[RobotMoment]
) -> list[tuple[int, int, str, Any]]:  # fmt: skip
    """Return (time of arrival in ns, a number that orders those of one time, port, message)."""
    first = moments[0].frame.cameras
    between = first.colour.rotation @ first.depth.rotation.T
    beside = first.colour.translation - between @ first.depth.translation
    static = make_transform(FACTORY, make_header(FACTORY, 0, DEPTH_FRAME), COLOUR_FRAME, -between.T @ beside, between.T)
    found: list[tuple[int, int, str, Any]] = [(0, 0, "/tf_static", FACTORY.make(TRANSFORMS, transforms=[static]))]
    for number in range(round((moments[-1].seconds + 0.3) * TRANSFORM_RATE_HZ)):
        seconds = (number + 0.3) / TRANSFORM_RATE_HZ - 0.1  # never at the stamp of an image
        found.append((to_ns(seconds), 0, "/tf", _make_moving(view, sensing, seconds)))
    for moment in moments:
        frame, stamp, late = moment.frame, to_ns(moment.seconds), to_ns(moment.seconds + sensing.lag)
        header = make_header(FACTORY, stamp, DEPTH_FRAME)
        colour = make_header(FACTORY, late, COLOUR_FRAME)
        image = make_image(FACTORY, header, frame.depth.astype(np.float32), "32FC1")
        puppets = [_make_puppet(f"a{k + 1}", seen) for k, seen in enumerate(frame.keypoints)]
        found += [
            (stamp, 1, "camera_info", _make_info(header, frame.cameras.depth)),
            (stamp, 2, "depth", image),
            (late, 3, "puppets/camera_info", _make_info(colour, frame.cameras.colour)),
            (late, 4, "puppets", FACTORY.make(PUPPETS, header=colour, puppets=puppets)),
        ]
    return found


def _make_moving(view: RobotView, sensing: Sensing, seconds: float) -> Any:
    """Return the base in the world, and the depth camera, which nods, on the base."""
    axes, eye = view.find_pose(sensing, seconds)
    heading = np.arctan2(axes[1, 2], axes[0, 2])
    c, s = np.cos(heading), np.sin(heading)
    base = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    stamp = to_ns(seconds)
    transforms = [
        make_transform(FACTORY, make_header(FACTORY, stamp, WORLD_FRAME), BASE_FRAME, eye * [1, 1, 0], base),
        make_transform(
            FACTORY, make_header(FACTORY, stamp, BASE_FRAME), DEPTH_FRAME, np.array([0, 0, eye[2]]), base.T @ axes
        ),
    ]
    return FACTORY.make(TRANSFORMS, transforms=transforms)


def _make_info(header: Any, camera: Camera) -> Any:
    return make_camera_info(FACTORY, header, camera.size, camera.matrix, camera.distortion)


def _make_puppet(identity: str, seen: SeenKeypoints) -> Any:
    """Return a puppet whose joints, as the body fitter takes them, are those that were seen."""
    places = dict(zip(LIMB_JOINTS, seen.pixels, strict=True))
    certain = dict(zip(LIMB_JOINTS, seen.confidence, strict=True))
    for side in ("left", "right"):
        knee, ankle = places[f"{side}_knee"], places[f"{side}_ankle"]
        places[f"{side}_ankle"] = (ankle + ANKLE_DROP * knee) / (1 + ANKLE_DROP)
    shoulders, hips = (
        (places[f"left_{name}"] + places[f"right_{name}"]) / 2 for name in ("shoulder", "hip")
    )  # fmt: skip
    places |= {"neck": shoulders, "belly": hips + BELLY_SHARE * (shoulders - hips)}
    certain |= {"neck": min(certain["left_shoulder"], certain["right_shoulder"]), "belly": certain["left_hip"]}
    joints = [
        FACTORY.make("flowing_puppet_msgs/msg/PuppetJoint", name=name, x=x, y=y, confidence=certain[name])
        for name, (x, y) in places.items()
        if np.isfinite(x)
    ]
    return FACTORY.make("flowing_puppet_msgs/msg/Puppet", id=identity, joints=joints)


def _compare(view: RobotView, moments: list[RobotMoment], found: dict[int, Any], warnings: list[str]) -> FitterRun:
    people = len(moments[0].frame.bodies)
    errors = np.full((len(moments), people, len(LIMB_JOINTS)), np.nan)
    velocities = np.full((len(moments), people), np.nan)
    ids = [[""] * people for _ in moments]
    ghosts = 0
    for row, moment in enumerate(moments):
        camera, truth = moment.frame.cameras.depth, moment.frame.joints
        array = found.get(to_ns(moment.seconds))
        for body in array.bodies if array else ():
            joints = decode_body_joints(body)
            placed = (np.array([joints[name][:3] for name in LIMB_JOINTS]) - camera.translation) @ camera.rotation
            away = np.linalg.norm(placed.mean(axis=0) - truth.mean(axis=1), axis=1)
            person = int(away.argmin())
            if away[person] > MAX_MATCH_M or ids[row][person]:
                ghosts += 1
                continue
            ids[row][person] = body.id
            seen = moment.frame.seen[person].in_view
            errors[row, person, seen] = np.linalg.norm(placed - truth[person], axis=1)[seen]
            if moment.seconds > VELOCITY_WINDOW_S:
                measured = np.array([body.velocity.x, body.velocity.y, body.velocity.z]) @ camera.rotation
                true = view.find_velocities(moment.seconds, VELOCITY_WINDOW_S)[person]
                velocities[row, person] = np.linalg.norm(measured - true)
    return FitterRun(errors, ids, velocities, ghosts, warnings)
