# SPDX-License-Identifier: Apache-2.0
"""What is published of the bodies in one cloud: the bodies, poses, meshes, transforms, and people by REP-155."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import I64
from flowing_puppet_ros.body.fit.fitter import BodyFit
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.settings import setting
from flowing_puppet_ros.stream.component import Output, Port
from flowing_puppet_ros.stream.components.ros4hri import Ros4HriPublisher, Ros4HriSettings, name_component
from flowing_puppet_ros.stream.messages.clouds import make_cloud
from flowing_puppet_ros.stream.messages.geometry import header_ns, make_transform
from flowing_puppet_ros.stream.messages.message_types import BODIES, POINT_CLOUD, TRANSFORMS, MessageFactory
from flowing_puppet_ros.stream.messages.puppets import make_bodies, make_body
from flowing_puppet_ros.stream.messages.ros4hri_skeleton import MOVING, Skeleton, link_frames, urdf
from flowing_puppet_ros.stream.messages.shapes import (
    make_deletions,
    make_mesh_marker,
    make_part_poses,
    make_topology,
    preview_faces,
)

Fits = Sequence[tuple[str, BodyFit]]
"""(id, fit in the cloud's frame) of each body."""

NEW_URDF = 0.02
"""Metres by which a joint must have moved in its link before a person's URDF is published again."""


@dataclass(frozen=True)
class BodyOutputSettings(Ros4HriSettings):
    """What is published of bodies beside the bodies."""

    mesh_rate: float = setting(5.0, "most body_meshes a second, by the stamps of the clouds; 0: every cloud", unit="Hz",
                               low=0.0, high=1000.0)  # fmt: skip
    mesh_triangles: int = setting(2000, "triangles of a body in body_meshes; 0: all of the model", low=0, high=100000)
    part_frames: bool = setting(True, "publish a TF frame <part>_<id> for every part of a body")


class BodyOutputs:
    """Makes the messages of the bodies of one component, and remembers whom it has shown."""

    ports = (
        Port("bodies", BODIES),
        Port("body_meshes", "visualization_msgs/msg/MarkerArray", lazy=True),
        Port("part_poses", "geometry_msgs/msg/PoseArray"),
        Port("body_vertices", POINT_CLOUD, lazy=True),
        Port("body_topology", "shape_msgs/msg/Mesh", "latched"),
        Port("/tf", TRANSFORMS),
    )

    def __init__(self, settings: BodyOutputSettings, factory: MessageFactory, model: StitchedPuppet) -> None:
        """Show the bodies of `model`."""
        self._settings = settings
        self._factory = factory
        self._model = model
        self._skeleton = Skeleton(model)
        self._urdf: dict[str, dict[str, np.ndarray]] = {}
        self.humans = Ros4HriPublisher(settings, factory, "joint_states", "urdf")
        self._markers: dict[str, int] = {}
        self._numbers = 0
        self._shown_at: int | None = None
        self._topology_sent = False

    def make(self, header: Any, fits: Fits, held: Collection[str] = (), wanted: Collection[str] = ()) -> Output:
        """Return all that is published for the cloud of `header`, which gives stamp and frame.

        `held` are the ids of people who are out of sight for now: they have no body in this cloud and are not lost
        yet. `wanted` are the lazy outputs that somebody listens to.
        """
        factory = self._factory
        alive = sorted({identity for identity, _ in fits} | set(held), key=by_id)
        bodies = [make_body(factory, identity, self._model, fit) for identity, fit in fits]
        outputs: Output = [("bodies", make_bodies(factory, header, bodies))]
        if fits and not self._topology_sent:
            self._topology_sent = True
            outputs.append(("body_topology", make_topology(factory, self._model)))
        outputs.append(("part_poses", make_part_poses(factory, header, [fit.state for _, fit in fits])))
        markers = self._mesh_markers(header, fits, alive) if "body_meshes" in wanted else []
        if markers:
            outputs.append(("body_meshes", factory.make("visualization_msgs/msg/MarkerArray", markers=markers)))
        if fits and "body_vertices" in wanted:
            outputs.append(("body_vertices", self._vertices(header, fits)))
        frames = [frame for identity, fit in fits for frame in self._frames(header, identity, fit)]
        if frames:
            outputs.append(("/tf", factory.make(TRANSFORMS, transforms=frames)))
        return outputs + (self._humans(header, fits, alive) if self.humans.on else [])

    def _mesh_markers(self, header: Any, fits: Fits, alive: Collection[str]) -> list[Any]:
        """Deletions of those who are lost at once, meshes of the others not more often than is set."""
        gone = [self._markers.pop(identity) for identity in list(self._markers) if identity not in alive]
        markers = make_deletions(self._factory, header, gone)
        stamp = header_ns(header)
        early = self._shown_at is not None and self._settings.mesh_rate > 0
        # A stamp before the last one is a new recording.
        if early and 0 <= stamp - (self._shown_at or 0) < 1e9 / self._settings.mesh_rate * 0.99:
            return markers
        if fits:
            self._shown_at = stamp
        for identity, fit in fits:
            if identity not in self._markers:
                self._numbers += 1
                self._markers[identity] = self._numbers
            number = self._markers[identity]
            markers.append(make_mesh_marker(self._factory, header, number, self._preview, fit.vertices))
        return markers

    @cached_property
    def _preview(self) -> I64:
        return preview_faces(self._model, self._settings.mesh_triangles)

    def _vertices(self, header: Any, fits: Fits) -> Any:
        """All vertices as an organised cloud: one row a body, in the order of `bodies`."""
        cloud = make_cloud(self._factory, header, np.vstack([fit.vertices for _, fit in fits]))
        cloud.height, cloud.width = len(fits), len(fits[0][1].vertices)
        cloud.row_step = cloud.point_step * cloud.width
        return cloud

    def _frames(self, header: Any, identity: str, fit: BodyFit) -> list[Any]:
        """`body_<id>` in the frame of the cloud; in that the parts, and with REP-155 the links of the URDF."""
        factory = self._factory
        origin, turn = self._skeleton.body_frame(fit.joints, fit.state)
        identity = name_component(identity)
        frames = [make_transform(factory, header, f"body_{identity}", origin, turn)]
        placed = {}
        if self.humans.on:
            angles = self._skeleton.angles(fit.joints, fit.state)
            placed = link_frames(self._skeleton.origins(fit.state.shape), angles)
            del placed["body"]
        if self._settings.part_frames:
            parts = zip(self._model.tree.names, fit.state.center, fit.state.rotation, strict=True)
            placed |= {name: (turn.T @ (center - origin), turn.T @ part) for name, center, part in parts}
        inside = factory.make("std_msgs/msg/Header", stamp=header.stamp, frame_id=f"body_{identity}")
        return frames + [
            make_transform(factory, inside, f"{name}_{identity}", position, own)
            for name, (position, own) in placed.items()
        ]

    def _humans(self, header: Any, fits: Fits, alive: Sequence[str]) -> Output:
        made: dict[str, dict[str, Any]] = {}
        self._urdf = {identity: origins for identity, origins in self._urdf.items() if identity in alive}
        for identity, fit in fits:
            angles = self._skeleton.angles(fit.joints, fit.state)
            made[identity] = {
                "joint_states": self._factory.make(
                    "sensor_msgs/msg/JointState",
                    header=header,
                    name=[f"{name}_{name_component(identity)}" for name in MOVING],
                    position=np.array([angles[name] for name in MOVING]),
                )
            }
            origins, known = self._skeleton.origins(fit.state.shape), self._urdf.get(identity)
            if known is None or max(np.linalg.norm(origins[name] - known[name]) for name in known) > NEW_URDF:
                self._urdf[identity] = origins
                made[identity]["urdf"] = self._factory.make(
                    "std_msgs/msg/String", data=urdf(name_component(identity), origins)
                )
        return self.humans.publish(header, alive, made)


def by_id(identity: str) -> tuple[int, str]:
    """Key that sorts b2 before b10."""
    return len(identity), identity
