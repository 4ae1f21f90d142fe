# SPDX-License-Identifier: Apache-2.0
"""Flowing-puppet tracker: people as 2D puppets, carried by optical flow and re-anchored by detections.

Causal: each image is used once, with the flow from the one before it (thesis, flowing puppets, sections 1 and 2). The
state of a person is the location of the joints, a scale and a view; the puppet follows from them (section 4).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from flowing_puppet_ros.arrays import F64, U8, Bools
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.flow.estimate import (
    FlowPair,
    FlowSettings,
    OpticalFlow,
    as_image,
    resize_flow,
    working_size,
)
from flowing_puppet_ros.flow.puppet_flow import PuppetFlow
from flowing_puppet_ros.ids import letters_of_seed
from flowing_puppet_ros.image.formats.keypoints import Keypoints, joints_from_keypoints
from flowing_puppet_ros.image.tracking.appearance import find_overlapping, torso_appearances
from flowing_puppet_ros.image.tracking.association import Detection, associate, joint_distance
from flowing_puppet_ros.image.tracking.propagation import ImageScale, Propagation, propagate_tracks, render_label_map
from flowing_puppet_ros.image.tracking.shot_boundary import colour_histogram, is_cut
from flowing_puppet_ros.image.tracking.track import Track, TrackerSettings
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.render import depth_order
from flowing_puppet_ros.model.ds.shape import PuppetShape, View

LEAST_KNOWN = 3  # a person of whom fewer joints are known is lost
HIDDEN, OUTSIDE = 0.3, 0.1  # share of the confidence that is left of a joint behind somebody nearer, out of the image


@dataclass(frozen=True, slots=True, eq=False)
class TrackedPuppet:
    """One person in one image, pixels of the image.

    `joints` (J, 2) in the order of the model's joint_names, `confidence` (J,) in [0, 1], in which the share `visible`
    (J,) is contained that joints outside of the image or behind somebody keep, `scale` px/m, `view` front or back,
    `contours` one (K_i, 2) a part, `depth` (P,) paint order of each part, 0 farthest, `energy` the negative log of the
    body prior, the flow's misfit and the distance of the detection (up to a constant; lower is better), `detected`
    (J, 3) what this image's detection says, x, y and confidence, or None, and `detection` its index.
    """

    id: str
    model: str
    joints: F64
    confidence: F64
    visible: F64
    scale: float
    view: View
    energy: float
    contours: tuple[F64, ...]
    depth: tuple[int, ...]
    shape: PuppetShape
    detected: F64 | None
    detection: int | None


@dataclass(frozen=True, slots=True, eq=False)
class TrackResult:
    """What one step found: `puppets` in the order of their ids, `flow` (forward, backward) at working scale, or None.

    `flow` leads from the previous image to this one; it is None for the first image and when nobody was tracked.
    `restarted`: everybody before this image was forgotten, because of a cut, a stamp that went back or another size.
    """

    puppets: list[TrackedPuppet]
    flow: FlowPair | None
    warnings: list[str]
    _model: DeformableStructures
    grid: ImageScale
    _propagation: Propagation | None
    restarted: bool = False

    def labels(self, shape: tuple[int, int] | None = None) -> U8:
        """Part labels (H, W) uint8 of all people, part index + 1, 0 background; `shape` is the image's if not given."""
        height, width = shape or (self.grid.image[1], self.grid.image[0])
        grid = ImageScale(self.grid.image, (width, height))
        labels = render_label_map(self._model, [puppet.shape for puppet in self.puppets], grid)
        parts = len(self._model.tree)
        return np.where(labels > 0, (labels - 1) % parts + 1, 0).astype(np.uint8)

    def puppet_flow(self) -> PuppetFlow | None:
        """The puppet flow from the previous image to this one, on the grid of `flow`; None where that is None."""
        return self._propagation.puppet_flow() if self._propagation else None


@dataclass(slots=True, eq=False)
class _Previous:
    """What the next step needs of an image: its stamp, the grid, the small grey picture and its colours."""

    stamp_ns: int
    grid: ImageScale
    grey: U8
    colours: F64


class FlowingPuppetTracker:
    """Tracks people through the images of one camera; every step takes the next image."""

    def __init__(
        self,
        model: DeformableStructures,
        settings: TrackerSettings | None = None,
        flow_settings: FlowSettings | None = None,
    ) -> None:
        self.model = model
        self.settings = settings or TrackerSettings()
        self.optical_flow = OpticalFlow(flow_settings)
        self.people: list[Track] = []
        self._previous: _Previous | None = None
        self._started = 0

    def reset(self) -> None:
        """Forget everybody and the previous image; ids go on, so that none is used twice in a run."""
        self.people = []
        self._previous = None

    def step(
        self,
        image: U8,
        stamp_ns: int,
        detections: Sequence[Keypoints] | None = None,
        flow: FlowPair | None = None,
        looked_for: Collection[str] | None = None,
    ) -> TrackResult:
        """Take the next `image` (H, W, 3) RGB or (H, W) grey, uint8, and say who is where in it.

        `detections` are the people a detector found in this image; None when none ran, empty when it found nobody. Who
        is not among them is missed, of those with ids in `looked_for` where only some were looked for.
        `flow` is (forward from the previous image, backward to it), each (h, w, 2) in pixels of its own grid of any
        resolution, NaN unknown; computed here when not given. A stamp before the previous one, an image of another size
        and a cut between shots restart the tracker with a warning. InputError for what is no image.
        """
        image = as_image(image)
        size = (image.shape[1], image.shape[0])
        grid = ImageScale(size, working_size(image.shape, self.optical_flow.settings.max_side))
        began = self._previous is not None
        warnings = self._restart_if_broken(stamp_ns, size)
        previous = self._previous
        self._previous = _Previous(stamp_ns, grid, self.optical_flow.prepare(image), colour_histogram(image))
        carriage, pair, restarted = None, None, began and previous is None
        if previous is not None and self.people:
            pair = self._flow(previous, flow, warnings)
            if is_cut(previous.colours, self._previous.colours, pair):
                warnings.append("the picture changes as at a cut between shots: tracking starts anew")
                self.people, pair, restarted = [], None, True
            else:
                carriage = propagate_tracks(self.model, self.people, pair, grid, self.settings)
        self._fuse_detections(image, detections, looked_for, warnings)
        self.people = [person for person in self.people if self._is_alive(person, size)]
        for person in self.people:
            person.complete_and_redraw(self.model)
        return TrackResult(self._puppets(grid), pair, warnings, self.model, grid, carriage, restarted)

    def override_joints(
        self, result: TrackResult, places: Mapping[str, Mapping[int, tuple[F64, float]]]
    ) -> TrackResult:
        """The last result with some joints moved: by id and joint the place (2,) px and how sure it is (0 to 1)."""
        for person in self.people:
            for joint, (place, confidence) in places.get(person.id, {}).items():
                person.override_joint(joint, place, confidence, self.settings)
            if places.get(person.id):
                person.complete_and_redraw(self.model)
        return replace(result, puppets=self._puppets(result.grid))

    def _restart_if_broken(self, stamp_ns: int, size: tuple[int, int]) -> list[str]:
        previous = self._previous
        if previous is None:
            return []
        if stamp_ns < previous.stamp_ns:
            self.reset()
            return [f"the stamp went back from {previous.stamp_ns} to {stamp_ns} ns: tracking starts anew"]
        if size != previous.grid.image:
            self.reset()
            return [f"the image size changed from {previous.grid.image} to {size}: tracking starts anew"]
        if stamp_ns == previous.stamp_ns:
            return [f"two images have the stamp {stamp_ns} ns: both are used, in the order they came"]
        return []

    def _flow(self, previous: _Previous, given: FlowPair | None, warnings: list[str]) -> FlowPair:
        if given is not None:
            if all(part.ndim == 3 and part.shape[2] == 2 and min(part.shape[:2]) > 1 for part in given):
                work = previous.grid.work
                return resize_flow(given[0], work), resize_flow(given[1], work)
            warnings.append(f"flow of shape {given[0].shape} is no (h, w, 2) field: it is computed here instead")
        assert self._previous is not None
        return self.optical_flow.between(previous.grey, self._previous.grey)

    def _fuse_detections(
        self,
        image: U8,
        detections: Sequence[Keypoints] | None,
        looked_for: Collection[str] | None,
        warnings: list[str],
    ) -> None:
        """Fuse the detections into the people they belong to and start new people at the rest."""
        for person in self.people:
            person.unseen += 1
            person.detection_energy = 0.0
            person.detected = person.detection = None
        met = find_overlapping(self.model.joint_names, [person.mean for person in self.people])
        for person, meets in zip(self.people, met, strict=True):
            person.overlapped |= meets
        if detections is None:
            return
        found = [joints_from_keypoints(self.model, keypoints) for keypoints in detections]
        several = max(len(self.people), len(found)) > 1
        worn = torso_appearances(self.model.joint_names, image, [joints for joints, _ in found]) if several else None
        matched, free = associate(self.people, found, self.settings.match_distance, worn)
        for index, person in enumerate(self.people):
            person.missed += looked_for is None or person.id in looked_for
            if index in matched:
                if joint_distance(person, found[matched[index]]) > self.settings.match_distance:
                    person.reset_gate()
                person.fuse(*found[matched[index]], self.settings)
                person.update_scale_and_view(self.model)
                person.unseen = person.missed = 0
                person.detection, person.overlapped = matched[index], False
                if worn and (clothes := worn[matched[index]]) is not None and clothes.alone:
                    person.update_appearance(clothes.colours)
        # The surest new person comes first: it gets the lower id, and a place when there is only one left.
        for index in sorted(free, key=lambda k: -found[k][1].sum()):
            self._start(index, found[index], warnings)

    def _start(self, index: int, detection: Detection, warnings: list[str]) -> None:
        joints, confidence = detection
        known = np.count_nonzero(np.isfinite(joints).all(axis=1))
        if known < self.settings.least_joints:
            least = self.settings.least_joints
            warnings.append(f"a detected person is left out: {known} joints can be used, least_joints is {least}")
            return
        if len(self.people) >= self.settings.most_people:
            warnings.append(f"more than {self.settings.most_people} people: the others are left out")
            return
        identity = letters_of_seed(self.settings.seed) + str(self._started + 1)
        try:
            self.people.append(Track.start(identity, self.model, joints, confidence, self.settings))
        except InputError as error:
            warnings.append(f"a detected person is left out: {error}")
            return
        self.people[-1].detection = index
        self._started += 1

    def _is_alive(self, person: Track, size: tuple[int, int]) -> bool:
        if person.unseen > self.settings.unseen_images or person.missed > self.settings.missed_detections:
            return False
        known = person.mean[~person.unknown]
        if len(known) < LEAST_KNOWN:
            return False
        low, high = known.min(axis=0), known.max(axis=0)
        return not ((high < 0).any() or (low > np.array(size) - 1).any())

    def _puppets(self, grid: ImageScale) -> list[TrackedPuppet]:
        hidden = find_hidden_joints(self.model, self.people, grid)
        return [self._puppet(one, grid.image, covered) for one, covered in zip(self.people, hidden, strict=True)]

    def _puppet(self, person: Track, size: tuple[int, int], hidden: Bools) -> TrackedPuppet:
        shape = person.shape
        assert shape is not None
        order = depth_order(self.model, person.view)
        depth = tuple(int(rank) for rank in np.argsort(order))
        energy = self.model.energy(shape) + person.flow_energy + person.detection_energy
        visible = np.where(hidden, HIDDEN, 1.0) * np.where(person.outside(size), OUTSIDE, 1.0)
        return TrackedPuppet(
            person.id,
            self.model.name,
            person.mean.copy(),
            person.confidence * visible,
            visible,
            person.scale,
            person.view,
            float(energy),
            shape.contours,
            depth,
            shape,
            person.detected,
            person.detection,
        )


def find_hidden_joints(model: DeformableStructures, people: Sequence[Track], grid: ImageScale) -> list[Bools]:
    """Which joints (J,) of each person lie behind the puppet of somebody nearer."""
    if len(people) < 2:
        return [np.zeros(len(model.joint_names), dtype=bool) for _ in people]
    labels = render_label_map(model, [person.shape for person in people if person.shape is not None], grid)
    height, width = labels.shape
    hidden = []
    for k, person in enumerate(people):
        x, y = np.rint(grid.to_work(person.mean)).astype(np.int64).T
        inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
        owner = (labels[np.where(inside, y, 0), np.where(inside, x, 0)].astype(np.int64) - 1) // len(model.tree)
        hidden.append(inside & (owner >= 0) & (owner != k))
    return hidden
