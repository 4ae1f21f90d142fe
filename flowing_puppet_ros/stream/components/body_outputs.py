# SPDX-License-Identifier: Apache-2.0
"""The messages for the bodies in one cloud: bodies, poses, meshes, transforms, and people by REP-155."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import I64
from flowing_puppet_ros.body.fit.fitter import BodyFit
from flowing_puppet_ros.body.fit.visibility import Visibility
from flowing_puppet_ros.body.measurements.measure import measure_fit
from flowing_puppet_ros.body.track.tracked_body import TrackedBody, TrackStatus
from flowing_puppet_ros.fusion.coarse_place import CoarsePerson
from flowing_puppet_ros.ids import id_sort_key
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.settings import Settings, setting
from flowing_puppet_ros.stream.component import Output, Port
from flowing_puppet_ros.stream.components.ros4hri import Ros4HriPublisher, Ros4HriSettings, to_name_component
from flowing_puppet_ros.stream.messages.bodies.human_urdf import make_urdf
from flowing_puppet_ros.stream.messages.bodies.measured_people import make_measurements
from flowing_puppet_ros.stream.messages.bodies.people import (
    PlacedPerson,
    make_people,
    make_person_pose,
    make_place,
)
from flowing_puppet_ros.stream.messages.bodies.ros4hri_skeleton import MOVING_JOINTS, Skeleton, link_frames
from flowing_puppet_ros.stream.messages.bodies.shapes import (
    make_deletions,
    make_mesh_marker,
    make_part_poses,
    make_topology,
    preview_faces,
)
from flowing_puppet_ros.stream.messages.clouds import make_cloud
from flowing_puppet_ros.stream.messages.geometry import header_ns, make_transform
from flowing_puppet_ros.stream.messages.message_types import (
    BODIES,
    MEASUREMENTS,
    MESH,
    PEOPLE,
    PERSON_POSE,
    POINT_CLOUD,
    TRANSFORMS,
    MessageFactory,
)
from flowing_puppet_ros.stream.messages.puppets import make_bodies, make_body, make_coarse_body

URDF_CHANGE_M = 0.02
"""Metres by which a joint must move in its parent link before a person's URDF is published again."""
MEASURING_INTERVAL_NS = 1_000_000_000
"""Between the measurements of one person, by the stamps: sizes change little, and each takes a sixth of a second."""


@dataclass(frozen=True)
class BodyOutputSettings(Settings):
    """What is published beside the bodies themselves."""

    max_mesh_rate: float = setting(
        5.0,
        "maximum rate of body_meshes, by the stamps of the clouds; 0: one for every cloud",
        unit="Hz",
        low=0.0,
        high=1000.0,
    )
    max_mesh_triangles: int = setting(
        2000, "maximum number of triangles of a body in body_meshes; 0: all of the model", low=0, high=100000
    )
    part_frames: bool = setting(True, "publish a TF frame <part>_<id> for every part of a body")
    measure: bool = setting(False, "publish `measurements`, of each person once a second", advanced=True)
    frame_prefix: str = setting("", "in front of the names of TF frames, where robots share a tree", advanced=True)
    person: str = setting(
        "", "id of the person on `person_pose`; empty: the nearest to the frame's origin", advanced=True
    )


class BodyOutputs:
    """Makes the messages for the bodies of one component, and remembers which people it has published."""

    always = (
        Port("bodies", BODIES),
        Port("body_meshes", "visualization_msgs/msg/MarkerArray", lazy=True),
        Port("part_poses", "geometry_msgs/msg/PoseArray", lazy=True),
        Port("body_vertices", POINT_CLOUD, lazy=True),
        Port("body_topology", MESH, "latched"),
        Port("/tf", TRANSFORMS),
        Port("people", PEOPLE, lazy=True, optional=True),
        Port("person_pose", PERSON_POSE, lazy=True),
    )

    def __init__(
        self, settings: BodyOutputSettings, ros4hri: Ros4HriSettings, factory: MessageFactory, model: StitchedPuppet
    ) -> None:
        """Prepare the outputs for bodies of `model`."""
        self._settings = settings
        self._factory = factory
        self._model = model
        self._skeleton = Skeleton(model)
        self._urdf_origins: dict[str, dict[str, np.ndarray]] = {}
        self.ros4hri = Ros4HriPublisher(ros4hri, factory, "joint_states", "urdf", "position", "velocity")
        self._measuring = BodyMeasuring(settings.measure, factory, model)
        self.ports = (*self.always, *self.ros4hri.ports, *self._measuring.ports)
        self._marker_ids: dict[str, int] = {}
        self._marker_count = 0
        self._last_mesh_stamp: int | None = None
        self._topology_sent = False

    def make(
        self,
        header: Any,
        bodies: Sequence[TrackedBody],
        hidden: Collection[str] = (),
        subscribed: Collection[str] = (),
        coarse: Sequence[CoarsePerson] = (),
    ) -> Output:
        """Return everything to publish for the `bodies` in one cloud, whose stamp and frame are those of `header`.

        `hidden` are the ids of people who are occluded: they have no body in this cloud but are not lost yet.
        `subscribed` are the lazy outputs that have subscribers. `coarse` are people of whom only joints are known.
        """
        factory = self._factory
        fits = [(body.id, body.fit) for body in bodies]
        alive = sorted({body.id for body in bodies} | set(hidden), key=id_sort_key)
        messages = {body.id: make_body(factory, self._model, body) for body in bodies}
        for person in coarse:
            messages[person.id] = make_coarse_body(
                factory, self._model.joint_names, person.id, person.joints, person.confidence
            )
        ordered = (
            [messages[identity] for identity in sorted(messages, key=id_sort_key)] if coarse else [*messages.values()]
        )
        outputs: Output = [("bodies", make_bodies(factory, header, ordered))]
        if fits and not self._topology_sent:
            self._topology_sent = True
            outputs.append(("body_topology", self._topology))
        if "part_poses" in subscribed:
            outputs.append(("part_poses", make_part_poses(factory, header, [fit.state for _, fit in fits])))
        markers = self._make_mesh_markers(header, fits, alive) if "body_meshes" in subscribed else []
        if markers:
            outputs.append(("body_meshes", factory.make("visualization_msgs/msg/MarkerArray", markers=markers)))
        if fits and "body_vertices" in subscribed:
            outputs.append(("body_vertices", self._make_vertex_cloud(header, fits)))
        frames = [frame for identity, fit in fits for frame in self._make_transforms(header, identity, fit)]
        if frames:
            outputs.append(("/tf", factory.make(TRANSFORMS, transforms=frames)))
        people = [self._place(body) for body in bodies]
        if "people" in subscribed:
            outputs.append(("people", make_people(factory, header, people)))
        pose = make_person_pose(factory, header, people, self._settings.person) if "person_pose" in subscribed else None
        if pose is not None:
            outputs.append(("person_pose", pose))
        outputs += self._measuring.make(header, bodies, alive)
        return outputs + (self._make_ros4hri(header, fits, people, alive) if self.ros4hri.enabled else [])

    def _place(self, body: TrackedBody) -> PlacedPerson:
        origin, rotation = self._skeleton.body_frame(body.fit.joints, body.fit.state)
        return PlacedPerson(body.id, origin, rotation, body.velocity, body.fit.confidence)

    def _make_mesh_markers(self, header: Any, fits: Sequence[tuple[str, BodyFit]], alive: Collection[str]) -> list[Any]:
        """Return deletions of lost people at once, and meshes of the others no more often than is set."""
        lost = [self._marker_ids.pop(identity) for identity in list(self._marker_ids) if identity not in alive]
        markers = make_deletions(self._factory, header, lost)
        stamp = header_ns(header)
        limited = self._last_mesh_stamp is not None and self._settings.max_mesh_rate > 0
        # A stamp before the last one is a new recording.
        if limited and 0 <= stamp - (self._last_mesh_stamp or 0) < 1e9 / self._settings.max_mesh_rate * 0.99:
            return markers
        if fits:
            self._last_mesh_stamp = stamp
        for identity, fit in fits:
            if identity not in self._marker_ids:
                self._marker_count += 1
                self._marker_ids[identity] = self._marker_count
            number = self._marker_ids[identity]
            inferred = fit.visibility.vertices == Visibility.INFERRED
            markers.append(make_mesh_marker(self._factory, header, number, self._preview_faces, fit.vertices, inferred))
        return markers

    def warm_up(self) -> None:
        """Make beforehand what the first body would wait for."""
        _ = self._topology

    @cached_property
    def _topology(self) -> Any:
        return make_topology(self._factory, self._model)

    @cached_property
    def _preview_faces(self) -> I64:
        return preview_faces(self._model, self._settings.max_mesh_triangles)

    def _make_vertex_cloud(self, header: Any, fits: Sequence[tuple[str, BodyFit]]) -> Any:
        """Return all vertices as an organised cloud: one row per body, in the order of `bodies`."""
        cloud = make_cloud(self._factory, header, np.vstack([fit.vertices for _, fit in fits]))
        cloud.height, cloud.width = len(fits), len(fits[0][1].vertices)
        cloud.row_step = cloud.point_step * cloud.width
        return cloud

    def _make_transforms(self, header: Any, identity: str, fit: BodyFit) -> list[Any]:
        """Return `body_<id>` in the cloud's frame, and in it the parts and, with REP-155, the URDF's links."""
        factory = self._factory
        origin, rotation = self._skeleton.body_frame(fit.joints, fit.state)
        identity = to_name_component(identity)
        body_name = f"{self._settings.frame_prefix}body_{identity}"
        frames = [make_transform(factory, header, body_name, origin, rotation)]
        frames_in_body = {}
        if self.ros4hri.enabled:
            angles = self._skeleton.joint_angles(fit.joints, fit.state)
            frames_in_body = link_frames(self._skeleton.joint_origins(fit.state.shape), angles)
            del frames_in_body["body"]
        if self._settings.part_frames:
            parts = zip(self._model.tree.names, fit.state.center, fit.state.rotation, strict=True)
            frames_in_body |= {
                name: (rotation.T @ (center - origin), rotation.T @ part) for name, center, part in parts
            }
        body_header = factory.make("std_msgs/msg/Header", stamp=header.stamp, frame_id=body_name)
        return frames + [
            make_transform(
                factory, body_header, f"{self._settings.frame_prefix}{name}_{identity}", position, orientation
            )
            for name, (position, orientation) in frames_in_body.items()
        ]

    def _make_ros4hri(
        self,
        header: Any,
        fits: Sequence[tuple[str, BodyFit]],
        people: Sequence[PlacedPerson],
        alive: Sequence[str],
    ) -> Output:
        messages: dict[str, dict[str, Any]] = {}
        self._urdf_origins = {
            identity: origins for identity, origins in self._urdf_origins.items() if identity in alive
        }
        for (identity, fit), person in zip(fits, people, strict=True):
            angles = self._skeleton.joint_angles(fit.joints, fit.state)
            messages[identity] = {
                "joint_states": self._factory.make(
                    "sensor_msgs/msg/JointState",
                    header=header,
                    name=[f"{name}_{to_name_component(identity)}" for name in MOVING_JOINTS],
                    position=np.array([angles[name] for name in MOVING_JOINTS]),
                ),
                **make_place(self._factory, header, person),
            }
            origins, known = self._skeleton.joint_origins(fit.state.shape), self._urdf_origins.get(identity)
            if known is None or max(np.linalg.norm(origins[name] - known[name]) for name in known) > URDF_CHANGE_M:
                self._urdf_origins[identity] = origins
                urdf = make_urdf(to_name_component(identity), origins, self._skeleton.mass(fit.state.shape))
                messages[identity]["urdf"] = self._factory.make("std_msgs/msg/String", data=urdf)
        return self.ros4hri.make(header, alive, messages)


class BodyMeasuring:
    """Makes the messages `measurements`, and remembers when each person was measured."""

    def __init__(self, enabled: bool, factory: MessageFactory, model: StitchedPuppet) -> None:
        """Make the port, or none when nobody asks for measurements."""
        self.ports = (Port("measurements", MEASUREMENTS),) if enabled else ()
        self._factory = factory
        self._model = model
        self._last: dict[str, int] = {}

    def make(self, header: Any, bodies: Sequence[TrackedBody], alive: Collection[str]) -> Output:
        """Return the message for those of the `bodies` in one cloud whose turn it is, nothing when it is nobody's.

        Who is hidden shows nothing new, and waits. Who is not among the ids `alive` is forgotten.
        """
        if not self.ports:
            return []
        stamp = header_ns(header)
        self._last = {identity: last for identity, last in self._last.items() if identity in alive}
        due = [body for body in bodies if body.status != TrackStatus.HIDDEN and self._is_due(body.id, stamp)]
        if not due:
            return []
        self._last |= {body.id: stamp for body in due}
        people = [(body, measure_fit(self._model, body.fit.state, body.fit.vertices)) for body in due]
        return [("measurements", make_measurements(self._factory, header, people))]

    def _is_due(self, identity: str, stamp: int) -> bool:
        """Return whether a person is new, was not measured for a while, or the stamps began anew."""
        last = self._last.get(identity)
        return last is None or not 0 <= stamp - last < MEASURING_INTERVAL_NS
