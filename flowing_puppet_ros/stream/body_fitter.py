# SPDX-License-Identifier: Apache-2.0
"""Point clouds, depth images or silhouettes in, fitted bodies out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flowing_puppet_ros.body.fitter import BodyFit, BodyFitter, FitterSettings
from flowing_puppet_ros.body.frames import axis_of, upright
from flowing_puppet_ros.body.people import ExtractionSettings
from flowing_puppet_ros.body.silhouette_fit import SilhouetteFitterSettings
from flowing_puppet_ros.body.tracker import BodyTracker, BodyTrackerSettings
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.settings import setting
from flowing_puppet_ros.stream.clouds import decode_cloud, make_cloud
from flowing_puppet_ros.stream.component import (
    BODIES,
    CAMERA_INFO,
    IMAGE,
    POINT_CLOUD,
    SILHOUETTES,
    TRANSFORMS,
    Component,
    Output,
    Port,
)
from flowing_puppet_ros.stream.depth import DepthPairs, depth_cloud
from flowing_puppet_ros.stream.messages import MessageFactory, make_transform, stamp_ns
from flowing_puppet_ros.stream.people import Joint, joints_of, make_bodies, make_body
from flowing_puppet_ros.stream.scenes import ScenePeople
from flowing_puppet_ros.stream.shapes import make_deletions, make_mesh_marker, make_part_poses, make_topology
from flowing_puppet_ros.stream.silhouettes import SilhouetteBodies
from flowing_puppet_ros.stream.waiting import Line, Shelf

Progress = Callable[[float], None]


@dataclass(frozen=True)
class BodyFitterSettings(FitterSettings, SilhouetteFitterSettings, BodyTrackerSettings, ExtractionSettings):
    """Settings of the fits, and of what the component reads and waits for."""

    model: str = setting("neutral", "body model", choices=("neutral", "female", "male"))
    up: str = setting("z", "axis of the cloud's frame that points up (-y in optical frames)", choices=("z", "y", "-y"))
    view: str = setting("full", "cloud from all sides, or from one sensor at the frame's origin",
                        choices=("full", "single"))  # fmt: skip
    track: bool = setting(False, "follow one person through the clouds that come without initial joints")
    scene: bool = setting(False, "find the people among floor, walls and furniture in clouds that come without initial"
                                 " joints")  # fmt: skip
    wait: int = setting(1, "newer clouds that may come before a cloud goes on without its initial joints",
                        low=0, high=50)  # fmt: skip


class BodyFitterComponent(Component):
    """Fits a body to each cloud; starts from the joints on `initial` when somebody publishes them.

    Each fit to a cloud draws its random numbers from the seed and the cloud's stamp, so it does not depend on which
    clouds came before it or were dropped, unless a person is tracked. What comes on `silhouettes` has its joints with
    it and is fitted at once; nothing in that is random, and the last good body of a person only helps where the joints
    lead astray.
    """

    settings_type = BodyFitterSettings
    inputs = (
        Port("points", POINT_CLOUD, "sensor"),
        Port("depth", IMAGE, "sensor"),
        Port("camera_info", CAMERA_INFO, "sensor"),
        Port("initial", BODIES, optional=True),
        Port("silhouettes", SILHOUETTES),
    )
    outputs = (
        Port("bodies", BODIES),
        Port("body_meshes", "visualization_msgs/msg/MarkerArray", lazy=True),
        Port("part_poses", "geometry_msgs/msg/PoseArray"),
        Port("body_vertices", POINT_CLOUD, lazy=True),
        Port("body_topology", "shape_msgs/msg/Mesh", "latched"),
        Port("/tf", TRANSFORMS),
    )

    def __init__(self, settings: BodyFitterSettings, factory: MessageFactory) -> None:
        """Load the body model."""
        super().__init__(settings, factory)
        self._settings = settings
        self._model = StitchedPuppet.load(settings.model)
        self._fitter = BodyFitter(self._model, settings)
        self._trackers: dict[str, BodyTracker] = {}
        self._people = ScenePeople(settings)
        self._silhouettes = SilhouetteBodies(self._model, settings)
        self._depth = DepthPairs()
        self._line = Line()
        self._initial = Shelf()
        self._shown: dict[str, int] = {}
        self._topology_sent = False

    def reset(self) -> None:
        """Forget what waits, whom the silhouettes showed and who was tracked."""
        self._silhouettes.reset()
        self._trackers.clear()
        self._people.reset()
        self._depth.reset()
        self._line.clear()
        self._initial.clear()

    def flush(self) -> Output:
        """Fit the clouds that still wait."""
        return self._fit_depth(self._depth.flush()) + self._release(final=True)

    def fit(
        self, cloud: Any, initial: Any | None, seed: int, progress: Progress | None = None, track: bool = False
    ) -> tuple[Any, list[tuple[str, BodyFit]]]:
        """Fit the bodies in a PointCloud2 message: those in `initial` (a BodyArray), else those of the scene, else one.

        With `track` the ones without `initial` go on from the last cloud's. Returns the BodyArray message and (id, fit)
        of each of its bodies, in the cloud's frame. InputError in one sentence when the cloud cannot be used.
        """
        turn = upright(axis_of(self._settings.up))
        points, normals = decode_cloud(cloud)
        points, normals = points @ turn.T, None if normals is None else normals @ turn.T
        viewpoint = np.zeros(3) if self._settings.view == "single" else None
        fits: list[tuple[str, BodyFit]] = []
        if initial is not None and initial.bodies:
            for number, body in enumerate(initial.bodies, start=1):
                joints = _turned_joints(joints_of(body), turn)
                fit = self._fitter.fit(
                    points, normals, initial=joints, viewpoint=viewpoint, seed=seed, progress=progress
                )
                fits.append((body.id or f"b{number}", fit))
        else:
            for identity, part, part_normals in self._parts(points, normals, viewpoint):
                if track:
                    tracker = self._trackers.setdefault(identity, BodyTracker(self._fitter, self._settings))
                    fit = tracker.step(part, part_normals, stamp_ns(cloud), viewpoint, seed)
                else:
                    fit = self._fitter.fit(part, part_normals, viewpoint=viewpoint, seed=seed, progress=progress)
                fits.append((identity, fit))
        fits = [(identity, _turned_back(fit, turn)) for identity, fit in fits]
        bodies = [make_body(self.factory, identity, self._model, fit) for identity, fit in fits]
        return make_bodies(self.factory, cloud.header, bodies), fits

    def _parts(
        self, points: NDArray[np.float64], normals: NDArray[np.float64] | None, viewpoint: NDArray[np.float64] | None
    ) -> list[tuple[str, NDArray[np.float64], NDArray[np.float64] | None]]:
        """Return (id, points, normals) of every person in a cloud; people who are not seen any more are not tracked."""
        if not self._settings.scene:
            return [("b1", points, normals)]
        found = self._people.find(points, normals, viewpoint)
        seen = {identity for identity, _ in found}
        self._trackers = {identity: tracker for identity, tracker in self._trackers.items() if identity in seen}
        return [(identity, person.points, person.normals) for identity, person in found]

    def seed_of(self, stamp: int) -> int:
        """Return the seed of the fit to the cloud of a stamp (nanoseconds)."""
        return int(np.random.SeedSequence([self._settings.seed, max(stamp, 0)]).generate_state(1)[0])

    def _process(self, port: str, message: Any) -> Output:
        if port == "silhouettes":
            return self._fit_silhouettes(message)
        if port in ("depth", "camera_info"):
            return self._fit_depth(self._depth.add(port, message))
        stamp = stamp_ns(message)
        if port == "points":
            self._line.waiting.append((stamp, message))
        elif self._line.too_late(stamp):
            self.counters["late initial"] += 1
        else:
            self._initial.put(stamp, message)
        return self._release(final=False)

    def _fit_depth(self, pairs: list[tuple[Any, Any]]) -> Output:
        """Fit the clouds of depth images: seen from one side, in an optical frame, whose y axis points down."""
        outputs: Output = []
        for image, info in pairs:
            self._settings = replace(self._settings, view="single", up="-y")
            try:
                outputs += self._process("points", depth_cloud(self.factory, image, info))
            except InputError as error:
                self._unusable(error)
        return outputs

    def _release(self, final: bool) -> Output:
        outputs: Output = []
        while self._line.waiting:
            stamp, cloud = self._line.waiting[0]
            initial = self._initial.get(stamp)
            crowded = len(self._line.waiting) > self._settings.wait
            if not (final or crowded or initial is not None or "initial" not in self._expected):
                break
            self._line.pop()
            self._initial.forget_until(stamp)
            outputs += self._fit_one(stamp, cloud, initial)
        return outputs

    def _fit_one(self, stamp: int, cloud: Any, initial: Any | None) -> Output:
        self.counters["clouds"] += 1
        try:
            bodies, fits = self.fit(cloud, initial, self.seed_of(stamp), track=self._settings.track)
        except InputError as error:
            self._unusable(error)
            bodies, fits = make_bodies(self.factory, cloud.header, []), []
        self.counters["bodies"] += len(fits)
        return [("bodies", bodies), *self._shapes(cloud.header, fits)]

    def _fit_silhouettes(self, message: Any) -> Output:
        self.counters["silhouettes"] += 1
        fits: list[tuple[str, BodyFit]] = []
        try:
            fits.append(self._silhouettes.fit(message))
        except InputError as error:
            self._unusable(error)
        self.counters["bodies"] += len(fits)
        self.counters["doubtful bodies"] += sum(not fit.reliable for _, fit in fits)
        bodies = [make_body(self.factory, identity, self._model, fit) for identity, fit in fits]
        made = make_bodies(self.factory, message.header, bodies)
        return [("bodies", made), *self._shapes(message.header, fits)]

    def _shapes(self, header: Any, fits: list[tuple[str, BodyFit]]) -> Output:
        outputs: Output = []
        if fits and not self._topology_sent:
            self._topology_sent = True
            outputs.append(("body_topology", make_topology(self.factory, self._model)))
        states = [fit.state for _, fit in fits]
        outputs.append(("part_poses", make_part_poses(self.factory, header, states)))
        if "body_meshes" in self._wanted:
            outputs.append(("body_meshes", self._markers(header, fits)))
        if fits and "body_vertices" in self._wanted:
            vertices = np.vstack([fit.vertices for _, fit in fits])
            outputs.append(("body_vertices", make_cloud(self.factory, header, vertices)))
        if fits:
            pelvis = self._model.joint_names.index("pelvis")
            frames = [
                make_transform(self.factory, header, f"body_{identity}", fit.joints[pelvis], fit.state.rotation[0])
                for identity, fit in fits
            ]
            outputs.append(("/tf", self.factory.make(TRANSFORMS, transforms=frames)))
        return outputs

    def _markers(self, header: Any, fits: list[tuple[str, BodyFit]]) -> Any:
        gone = [number for identity, number in self._shown.items() if identity not in dict(fits)]
        markers = make_deletions(self.factory, header, gone)
        shown: dict[str, int] = {}
        for identity, fit in fits:
            shown[identity] = self._shown.get(identity, max([*self._shown.values(), *shown.values()], default=0) + 1)
            markers.append(make_mesh_marker(self.factory, header, shown[identity], self._model.faces, fit.vertices))
        self._shown = shown
        return self.factory.make("visualization_msgs/msg/MarkerArray", markers=markers)


def _turned_joints(joints: dict[str, Joint], turn: NDArray[np.float64]) -> dict[str, Joint]:
    places = {name: turn @ np.array(joint[:3]) for name, joint in joints.items()}
    return {name: (float(p[0]), float(p[1]), float(p[2]), joints[name][3]) for name, p in places.items()}


def _turned_back(fit: BodyFit, turn: NDArray[np.float64]) -> BodyFit:
    """Return the fit in the cloud's own frame."""
    state = replace(fit.state, center=fit.state.center @ turn, rotation=turn.T @ fit.state.rotation)
    return replace(fit, state=state, vertices=fit.vertices @ turn, joints=fit.joints @ turn)
