# SPDX-License-Identifier: Apache-2.0
"""Put people into MoveIt's planning scene: a capsule around every part of every body.

A capsule is a cylinder between two spheres, since `shape_msgs/SolidPrimitive` has none. Run this beside `body_fitter`,
with MoveIt 2 sourced; `capsules` and `make_shapes` need no MoveIt:

    python3 people_in_moveit.py --ros-args -r bodies:=/bodies -p padding:=0.05
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from geometry_msgs.msg import Pose
from shape_msgs.msg import SolidPrimitive

from flowing_puppet_ros.model.rotation import quaternion
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.stream.messages.geometry import rotation_matrix


@dataclass(frozen=True, slots=True, eq=False)
class Capsule:
    """All points within `radius` of the segment from `start` (3,) to `end` (3,), metres."""

    part: str
    start: np.ndarray
    end: np.ndarray
    radius: float


load_model = cache(StitchedPuppet.load)


def capsules(body: Any, padding: float = 0.0) -> list[Capsule]:
    """Return a capsule around the surface of each part of a Body message, in its frame, larger by `padding` metres.

    No capsules where the body has joints only.
    """
    if not body.parts:
        return []
    model = load_model(body.model)
    return [enclose(part.name, place(model, index, part), padding) for index, part in enumerate(body.parts)]


def place(model: StitchedPuppet, index: int, part: Any) -> np.ndarray:
    """Return the vertices (N, 3) of a BodyPart message."""
    at, turn = part.pose.position, part.pose.orientation
    center, rotation = np.array([at.x, at.y, at.z]), rotation_matrix((turn.x, turn.y, turn.z, turn.w))
    pose, shape = np.asarray(part.pose_coefficients), np.asarray(part.shape_coefficients)
    return model.part_mesh(index, center, rotation, pose, shape)


def enclose(name: str, points: np.ndarray, padding: float) -> Capsule:
    """Return the capsule of least radius about the main axis of `points` (N, 3) that contains all of them."""
    middle = points.mean(axis=0)
    axis = np.linalg.svd(points - middle, full_matrices=False)[2][0]
    along = (points - middle) @ axis
    across = np.linalg.norm(points - middle - along[:, None] * axis, axis=1)
    radius = float(across.max())
    reach = np.sqrt(radius**2 - across**2)  # of the ball at the end of the axis, at a point's distance from the axis
    low, high = float((along + reach).min()), float((along - reach).max())
    if low > high:  # one ball contains them
        low = high = (low + high) / 2
    return Capsule(name, middle + low * axis, middle + high * axis, radius + padding)


def make_shapes(capsule: Capsule) -> tuple[list[SolidPrimitive], list[Pose]]:
    """Return two spheres and, if there is anything between them, a cylinder, with their poses."""
    ball = SolidPrimitive(type=SolidPrimitive.SPHERE, dimensions=[capsule.radius])
    shapes, poses = [ball, ball], [make_pose(capsule.start), make_pose(capsule.end)]
    along = capsule.end - capsule.start
    length = float(np.linalg.norm(along))
    if length > 0:
        dimensions = [0.0, 0.0]
        dimensions[SolidPrimitive.CYLINDER_HEIGHT] = length
        dimensions[SolidPrimitive.CYLINDER_RADIUS] = capsule.radius
        shapes.append(SolidPrimitive(type=SolidPrimitive.CYLINDER, dimensions=dimensions))
        poses.append(make_pose((capsule.start + capsule.end) / 2, turn_z_to(along / length)))
    return shapes, poses


def turn_z_to(direction: np.ndarray) -> np.ndarray:
    """Return a rotation (3, 3) that turns z, along which cylinders lie, into a unit vector (3,)."""
    other = np.eye(3)[np.argmin(np.abs(direction))]
    x = np.cross(other, direction)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(direction, x), direction], axis=1)


def make_pose(position: np.ndarray, rotation: np.ndarray | None = None) -> Pose:
    """Return a Pose message."""
    pose = Pose()
    pose.position.x, pose.position.y, pose.position.z = map(float, position)
    if rotation is not None:
        turn = pose.orientation
        turn.w, turn.x, turn.y, turn.z = map(float, quaternion(rotation))
    return pose


def main() -> None:
    """Keep the planning scene as the bodies are."""
    import rclpy
    from flowing_puppet_msgs.msg import BodyArray
    from moveit_msgs.msg import CollisionObject, PlanningScene

    rclpy.init()
    node = rclpy.create_node("people_in_moveit")
    padding = node.declare_parameter("padding", 0.05).value
    publisher = node.create_publisher(PlanningScene, "/planning_scene", 10)
    known: set[str] = set()

    def update(message: Any) -> None:
        objects = [
            CollisionObject(header=message.header, id=identity, operation=CollisionObject.REMOVE)
            for identity in known - {body.id for body in message.bodies}
        ]
        for body in message.bodies:
            # Adding an object that is there replaces it.
            person = CollisionObject(header=message.header, id=body.id, operation=CollisionObject.ADD)
            person.pose.orientation.w = 1.0
            for capsule in capsules(body, padding):
                shapes, poses = make_shapes(capsule)
                person.primitives += shapes
                person.primitive_poses += poses
            objects.append(person)
        known.clear()
        known.update(body.id for body in message.bodies)
        scene = PlanningScene(is_diff=True)
        scene.world.collision_objects = objects
        publisher.publish(scene)

    node.create_subscription(BodyArray, "bodies", update, 10)
    rclpy.spin(node)


if __name__ == "__main__":
    main()
