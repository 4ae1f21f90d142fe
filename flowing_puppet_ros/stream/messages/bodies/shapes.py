# SPDX-License-Identifier: Apache-2.0
"""Bodies as messages for viewers and programs: triangle markers, part poses, the topology of the mesh."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from flowing_puppet_ros.arrays import I64, Array
from flowing_puppet_ros.stream.messages.bodies.mesh_preview import simplify_mesh
from flowing_puppet_ros.stream.messages.geometry import make_point, make_pose
from flowing_puppet_ros.stream.messages.message_types import MESH, MessageFactory

if TYPE_CHECKING:
    from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet

_MARKER = "visualization_msgs/msg/Marker"
_TRIANGLE_LIST, _ADD, _DELETE = 11, 0, 2  # of visualization_msgs/Marker
_NAMESPACE = "bodies"
_LIFETIME_S = 5  # viewers delete a marker that is not renewed
_SKIN_RGB, _PALE_RGB = (0.85, 0.68, 0.55), (0.86, 0.86, 0.88)


def make_mesh_marker(
    factory: MessageFactory, header: Any, number: int, faces: Array, vertices: Array, inferred: Array
) -> Any:
    """Return the TRIANGLE_LIST marker of a body: `faces` (F, 3), `vertices` (V, 3) in metres in the header's frame.

    `inferred` (V,) bool are the vertices that only the model tells: they are pale.
    """
    points = [make_point(factory, vertex) for vertex in vertices.tolist()]
    corners = np.asarray(faces).ravel()
    skin, pale = (factory.make("std_msgs/msg/ColorRGBA", r=r, g=g, b=b, a=1.0) for r, g, b in (_SKIN_RGB, _PALE_RGB))
    return factory.make(
        _MARKER,
        header=header,
        ns=_NAMESPACE,
        id=number,
        type=_TRIANGLE_LIST,
        action=_ADD,
        pose=make_pose(factory, np.zeros(3), np.eye(3)),
        scale=factory.make("geometry_msgs/msg/Vector3", x=1.0, y=1.0, z=1.0),
        color=skin,
        lifetime=factory.make("builtin_interfaces/msg/Duration", sec=_LIFETIME_S, nanosec=0),
        points=[points[index] for index in corners],
        colors=[pale if inferred[index] else skin for index in corners] if inferred[corners].any() else [],
    )


def make_deletions(factory: MessageFactory, header: Any, numbers: Sequence[int]) -> list[Any]:
    """Return the markers that delete the bodies with these marker ids from the viewer."""
    pose = make_pose(factory, np.zeros(3), np.eye(3))
    return [
        factory.make(_MARKER, header=header, ns=_NAMESPACE, id=number, action=_DELETE, pose=pose) for number in numbers
    ]


def make_part_poses(factory: MessageFactory, header: Any, states: Sequence[BodyState]) -> Any:
    """Return the PoseArray of the parts' centres and rotations: 16 per body, one body after the other."""
    poses = [
        make_pose(factory, center, rotation)
        for state in states
        for center, rotation in zip(state.center, state.rotation, strict=True)
    ]
    return factory.make("geometry_msgs/msg/PoseArray", header=header, poses=poses)


def make_topology(factory: MessageFactory, model: StitchedPuppet) -> Any:
    """Return the shape_msgs/Mesh of the model at rest; its triangles are valid for the vertices of every fit."""
    triangles = [
        factory.make("shape_msgs/msg/MeshTriangle", vertex_indices=np.asarray(face, np.uint32)) for face in model.faces
    ]
    vertices = [make_point(factory, vertex) for vertex in model.vertices(model.rest_state()).tolist()]
    return factory.make(MESH, triangles=triangles, vertices=vertices)


def preview_faces(model: StitchedPuppet, triangles: int) -> I64:
    """Return about `triangles` faces (F', 3) over the model's own vertices; all of the model's faces when 0."""
    faces = np.asarray(model.faces, np.int64)
    if not 0 < triangles < len(faces):
        return faces
    return simplify_mesh(model.vertices(model.rest_state()), faces, triangles)
