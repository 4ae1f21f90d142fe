# SPDX-License-Identifier: Apache-2.0
"""Point clouds, depth images or silhouettes in, fitted bodies out."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter, FitterSettings, Progress
from flowing_puppet_ros.body.scans.scan_frame import axis_of, rotation_to_z_up
from flowing_puppet_ros.body.track.scene_tracker import OrientedCloud, SceneSettings, SceneTracker, crop_to_region
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.multiview.silhouette_fit import SilhouetteFitterSettings
from flowing_puppet_ros.settings import setting
from flowing_puppet_ros.stream.component import COMPRESSED_DEPTH, Component, Output, Port
from flowing_puppet_ros.stream.components.body_outputs import BodyOutputs, BodyOutputSettings, by_id
from flowing_puppet_ros.stream.components.silhouette_bodies import SilhouetteBodies
from flowing_puppet_ros.stream.depth_pairs import DepthPairs
from flowing_puppet_ros.stream.messages.clouds import decode_cloud
from flowing_puppet_ros.stream.messages.depth import depth_cloud
from flowing_puppet_ros.stream.messages.geometry import stamp_ns
from flowing_puppet_ros.stream.messages.message_types import (
    BODIES,
    CAMERA_INFO,
    IMAGE,
    POINT_CLOUD,
    SILHOUETTES,
    MessageFactory,
)
from flowing_puppet_ros.stream.messages.puppets import Joint, joints_of, make_bodies, make_body
from flowing_puppet_ros.stream.stamp_buffer import PendingQueue, StampBuffer

OPTICAL = re.compile(r"optical(_frame)?$")
"""Frames that look along z with y down (REP-103)."""


@dataclass(frozen=True)
class BodyFitterSettings(FitterSettings, SilhouetteFitterSettings, SceneSettings, BodyOutputSettings):
    """Settings of the fits, and of what the component reads, waits for and publishes."""

    model: str = setting("neutral", "body model", choices=("neutral", "female", "male"))
    up: str = setting("auto", "axis of the cloud's frame that points up; auto: -y in frames named *optical or"
                              " *optical_frame, else z", choices=("auto", "z", "y", "-y"))  # fmt: skip
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
        Port("depth", IMAGE, "sensor", transport=COMPRESSED_DEPTH),
        Port("camera_info", CAMERA_INFO, "sensor"),
        Port("initial", BODIES, optional=True),
        Port("silhouettes", SILHOUETTES),
    )
    outputs: tuple[Port, ...] = BodyOutputs.ports

    def __init__(self, settings: BodyFitterSettings, factory: MessageFactory) -> None:
        """Load the body model."""
        super().__init__(settings, factory)
        self._settings = settings
        self._model = StitchedPuppet.load(settings.model)
        self._fitter = BodyFitter(self._model, settings)
        self._people = SceneTracker(self._fitter, settings)
        self._silhouettes = SilhouetteBodies(self._model, settings)
        self._depth = DepthPairs()
        self._line = PendingQueue()
        self._initial = StampBuffer()
        self._outputs = BodyOutputs(settings, factory, self._model)
        self.outputs = (*BodyOutputs.ports, *self._outputs.humans.ports)

    def warm_up(self) -> None:
        """Do beforehand what the first clouds of a live stream would wait for."""
        self._people.warm_up()

    def reset(self) -> None:
        """Forget what waits, whom the silhouettes showed and who was tracked; ids of tracked people go on."""
        self._silhouettes.reset()
        self._people.reset()
        self._depth.reset()
        self._line.clear()
        self._initial.clear()

    def flush(self) -> Output:
        """Fit the clouds that still wait."""
        return self._fit_depth(self._depth.flush()) + self._release(final=True)

    def fit(
        self, cloud: Any, initial: Any | None, seed: int, progress: Progress | None = None
    ) -> tuple[Any, list[tuple[str, BodyFit]]]:
        """Fit the bodies in a PointCloud2 message: those in `initial` (a BodyArray), else those of the scene, else one.

        Nothing of other clouds is used or changed. Returns the BodyArray message and (id, fit) of each of its bodies,
        in the cloud's frame. InputError in one sentence when the cloud cannot be used.
        """
        view = self._view(cloud, of_depth=False)
        if initial is not None and initial.bodies:
            fits = self._from_initial(view, initial, seed, progress)
        else:
            fits = self._people.fit_once(view, seed, progress)
        fits = [(identity, _turned_back(fit, view.turn)) for identity, fit in fits]
        bodies = [make_body(self.factory, identity, self._model, fit) for identity, fit in fits]
        return make_bodies(self.factory, cloud.header, bodies), fits

    def _view(self, cloud: Any, of_depth: bool) -> OrientedCloud:
        """The points of a cloud message in the region of interest, z up.

        That of a depth image is seen from one side, in an optical frame, whatever its name, whose y axis points down.
        """
        up = self._settings.up
        if up == "auto":
            up = "-y" if of_depth or OPTICAL.search(cloud.header.frame_id) else "z"
        turn = rotation_to_z_up(axis_of(up))
        points, normals = decode_cloud(cloud)
        inside = crop_to_region(points, self._settings)
        if not inside.all():
            points, normals = points[inside], None if normals is None else normals[inside]
        return OrientedCloud(
            points @ turn.T, None if normals is None else normals @ turn.T, turn, stamp_ns(cloud), of_depth
        )

    def _from_initial(
        self, view: OrientedCloud, initial: Any, seed: int, progress: Progress | None = None
    ) -> list[tuple[str, BodyFit]]:
        viewpoint = np.zeros(3) if self._settings.view == "single" or view.single else None
        fits = []
        for number, body in enumerate(initial.bodies, start=1):
            joints = _turned_joints(joints_of(body), view.turn)
            fit = self._fitter.fit(
                view.points, view.normals, initial=joints, viewpoint=viewpoint, seed=seed, progress=progress
            )
            fits.append((body.id or f"b{number}", fit))
        return sorted(fits, key=lambda pair: by_id(pair[0]))

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
            self._line.waiting.append((stamp, (message, False)))
        elif self._line.is_late(stamp):
            self.counters["late initial"] += 1
        else:
            self._initial.put(stamp, message)
        return self._release(final=False)

    def _fit_depth(self, pairs: list[tuple[Any, Any]]) -> Output:
        """Fit the clouds of depth images."""
        outputs: Output = []
        for image, info in pairs:
            try:
                cloud = depth_cloud(self.factory, image, info)
            except InputError as error:
                self._unusable(error)
            else:
                self._line.waiting.append((stamp_ns(cloud), (cloud, True)))
                outputs += self._release(final=False)
        return outputs

    def _release(self, final: bool) -> Output:
        outputs: Output = []
        while self._line.waiting:
            stamp, (cloud, of_depth) = self._line.waiting[0]
            initial = self._initial.get(stamp)
            crowded = len(self._line.waiting) > self._settings.wait
            if not (final or crowded or initial is not None or "initial" not in self._expected):
                break
            self._line.pop()
            self._initial.drop_until(stamp)
            outputs += self._fit_one(stamp, cloud, of_depth, initial)
        return outputs

    def _fit_one(self, stamp: int, cloud: Any, of_depth: bool, initial: Any | None) -> Output:
        self.counters["clouds"] += 1
        fits: list[tuple[str, BodyFit]] = []
        held: list[str] = []
        try:
            view = self._view(cloud, of_depth)
            if initial is not None and initial.bodies:
                fits = self._from_initial(view, initial, self.seed_of(stamp))
            else:
                fits, held = self._people.step(view, self.seed_of(stamp), self.background)
            fits = [(identity, _turned_back(fit, view.turn)) for identity, fit in fits]
        except InputError as error:
            self._unusable(error)
        self.counters["bodies"] += len(fits)
        counted, errors = self._people.drain()
        self.counters.update(counted)
        for reason in errors:
            self._unusable(reason)
        return self._outputs.make(cloud.header, fits, held, self._wanted)

    def _fit_silhouettes(self, message: Any) -> Output:
        self.counters["silhouettes"] += 1
        fits: list[tuple[str, BodyFit]] = []
        try:
            fits.append(self._silhouettes.fit(message))
        except InputError as error:
            self._unusable(error)
        self.counters["bodies"] += len(fits)
        self.counters["doubtful bodies"] += sum(not fit.reliable for _, fit in fits)
        return self._outputs.make(message.header, fits, wanted=self._wanted)


def _turned_joints(joints: dict[str, Joint], turn: F64) -> dict[str, Joint]:
    places = {name: turn @ np.array(joint[:3]) for name, joint in joints.items()}
    return {name: (float(p[0]), float(p[1]), float(p[2]), joints[name][3]) for name, p in places.items()}


def _turned_back(fit: BodyFit, turn: F64) -> BodyFit:
    """Return the fit in the cloud's own frame."""
    state = replace(fit.state, center=fit.state.center @ turn, rotation=turn.T @ fit.state.rotation)
    return replace(fit, state=state, vertices=fit.vertices @ turn, joints=fit.joints @ turn)
