# SPDX-License-Identifier: Apache-2.0
"""Flowing-puppet tracker: people as 2D puppets, propagated by optical flow and corrected by detections.

Causal: each image is used once, with the flow from the one before it (thesis, flowing puppets, sections 1 and 2). The
state of a person is the joints, a scale and a view; the puppet follows from them (section 4).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from flowing_puppet_ros.arrays import F64, U8, Bools, Flow
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.flow.estimate import MIN_SIDE_PX, FlowPair, OpticalFlow, resize_flow, working_size
from flowing_puppet_ros.flow.puppet_flow import PuppetFlow
from flowing_puppet_ros.flow.settings import FlowSettings
from flowing_puppet_ros.ids import letters_of_seed
from flowing_puppet_ros.image.formats.keypoints import Keypoints, joints_from_keypoints
from flowing_puppet_ros.image.person_mask import PersonMask, label_people
from flowing_puppet_ros.image.tracking.appearance import TorsoAppearance, find_overlapping, torso_appearances
from flowing_puppet_ros.image.tracking.association import Detection, associate, joint_distance
from flowing_puppet_ros.image.tracking.heading import HeadingFilter
from flowing_puppet_ros.image.tracking.propagation import (
    ImageScale,
    Propagation,
    propagate_tracks,
    render_part_map,
    render_tracks,
)
from flowing_puppet_ros.image.tracking.settings import TrackerSettings
from flowing_puppet_ros.image.tracking.shot_boundary import colour_histogram, is_cut
from flowing_puppet_ros.image.tracking.track import Track
from flowing_puppet_ros.images import as_image
from flowing_puppet_ros.model.ds.multiview import MultiViewStructures
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.render import depth_order
from flowing_puppet_ros.model.ds.shape import PuppetShape, View

MIN_KNOWN_JOINTS = 3  # of a live track
HIDDEN_CONFIDENCE = 0.3  # share of the confidence that a joint behind a nearer person keeps ...
OUTSIDE_CONFIDENCE = 0.1  # ... and one outside of the image


type DetectedInTracks = tuple[Sequence[Keypoints] | None, Collection[str] | None]
"""The people detected in an image, None where no detector ran, and the ids that were searched."""
type DetectInTracks = Callable[[Sequence[Track], FlowPair | None], DetectedInTracks]
"""From the tracks in an image, and the flow at working scale from the image before, to who is detected there. None for
the flow: there is no image before, or nobody was tracked in it."""


@dataclass(frozen=True, slots=True, eq=False)
class TrackedPuppet:
    """One person in one image, in pixels of the image.

    `joints` (J, 2) are in the order of the model's joint_names. `confidence` (J,) in [0, 1] is already multiplied by
    `visible` (J,), which is below 1 for joints that are occluded or outside the image. `scale` is in px/m, `view` front
    or back, `heading` where the torso faces (rad, 0 to the camera, pi/2 to the right of the image; NaN unknown).
    `drawing` is the model of the side, turned by `side_heading`, whose puppet is drawn; `contours` (K_i, 2) per part,
    `depth` (P,) the drawing order of each part, 0 farthest. `energy` is the negative log of the body prior plus the
    flow's misfit and the distance of the detection, up to a constant; lower is better. `detected` (J, 3) is this
    image's detection as x, y and confidence, and `detection` its index, or None. `mask` is where a network has said
    that the person is, carried along the flow; None without one.
    """

    id: str
    model: str
    joints: F64
    confidence: F64
    visible: F64
    scale: float
    view: View
    heading: float
    side_heading: float
    drawing: DeformableStructures
    energy: float
    contours: tuple[F64, ...]
    depth: tuple[int, ...]
    shape: PuppetShape
    detected: F64 | None
    detection: int | None
    mask: PersonMask | None


@dataclass(frozen=True, slots=True, eq=False)
class TrackResult:
    """Result of one step: `puppets` in the order of their ids, and `flow` (forward, backward) at working scale.

    `flow` leads from the previous image to this one; it is None for the first image and if nobody was tracked.
    `restarted` is set if all earlier tracks were dropped: at a cut, a stamp that went back or a new image size.
    """

    puppets: list[TrackedPuppet]
    flow: FlowPair | None
    warnings: list[str]
    _model: DeformableStructures
    grid: ImageScale
    _propagation: Propagation | None
    restarted: bool = False

    def render_part_labels(self, shape: tuple[int, int] | None = None) -> U8:
        """Draw the part labels (H, W) of all people: part index + 1, 0 background; `shape` as the image by default."""
        height, width = shape or (self.grid.image[1], self.grid.image[0])
        grid = ImageScale(self.grid.image, (width, height))
        shapes, headings = ([getattr(each, name) for each in self.puppets] for name in ("shape", "side_heading"))
        return render_part_map(self._model, shapes, headings, grid)

    def render_person_masks(self) -> U8:
        """Draw on the working grid (h, w) who is where: the place in `puppets` + 1; 0 where nobody is known to be."""
        return label_people([puppet.mask for puppet in self.puppets], self.grid.work, self.grid.image)

    def puppet_flow(self) -> PuppetFlow | None:
        """Return the puppet flow from the previous image, on the grid of `flow`; None if that is None."""
        return self._propagation.puppet_flow() if self._propagation else None


@dataclass(slots=True, eq=False)
class _Frame:
    """Data of an image that the next step needs: its stamp, the grid, the small grey image and its colours."""

    stamp_ns: int
    grid: ImageScale
    grey: U8
    colours: F64


class FlowingPuppetTracker:
    """Tracker of people through the images of one camera.

    Every step takes the next image: propagate the tracks by the flow, unless there is a cut; associate the detections;
    fuse the matched ones; start tracks at the others; drop lost tracks.
    """

    def __init__(
        self,
        model: DeformableStructures,
        settings: TrackerSettings | None = None,
        flow_settings: FlowSettings | None = None,
        views: MultiViewStructures | None = None,
    ) -> None:
        """Track with puppets of `model`, from the side with those of `views`, if they are given."""
        self.model = model
        self._views = views
        self.settings = settings or TrackerSettings()
        self.optical_flow = OpticalFlow(flow_settings)
        self.tracks: list[Track] = []
        self._previous: _Frame | None = None
        self._started = 0

    def reset(self) -> None:
        """Drop all tracks and the previous image; ids continue, so that none is used twice in a run."""
        self.tracks = []
        self._previous = None

    def step(
        self,
        image: U8,
        stamp_ns: int,
        detections: Sequence[Keypoints] | None = None,
        flow: FlowPair | None = None,
        searched_ids: Collection[str] | None = None,
        detect: DetectInTracks | None = None,
    ) -> TrackResult:
        """Track the people into the next `image` (H, W, 3) RGB or (H, W) grey, uint8.

        `detections` are the people a detector found in this image; None if none ran, empty if it found nobody. Tracks
        without a detection count as missed; if the detector searched for some people only, give their `searched_ids`.
        `detect` runs a detector on this image once the tracks are propagated into it.
        `flow` is (forward from the previous image, backward to it), each (h, w, 2) in pixels of its own grid of any
        resolution, NaN unknown; computed here if not given. A stamp before the previous one, an image of another size
        or a cut between shots restarts the tracker with a warning. InputError if `image` is not an image.
        """
        image = as_image(image, MIN_SIDE_PX)
        frame = self._prepare(image, stamp_ns)
        warnings: list[str] = []
        restarted = self._restart_if_broken(frame, warnings)
        previous, self._previous = self._previous, frame
        pair, propagation = None, None
        if previous is not None and self.tracks:
            pair = self._choose_flow(previous, frame, flow, warnings)
            if is_cut(previous.colours, frame.colours, pair):
                warnings.append("the picture changes as at a cut between shots: tracking restarts")
                self.tracks, pair, restarted = [], None, True
            else:
                propagation = propagate_tracks(self.model, self.tracks, pair, frame.grid, self.settings)
        self._count_image()
        if detect is not None:
            detections, searched_ids = detect(self.tracks, pair)
        if detections is not None:
            found = [joints_from_keypoints(self.model, keypoints) for keypoints in detections]
            appearances = self._measure_appearances(image, found)
            ids = [keypoints.track_id for keypoints in detections]
            matched, unmatched = associate(self.tracks, found, self.settings.match_distance, appearances, ids)
            self._fuse_detections(found, appearances, matched, searched_ids)
            self._start_tracks(found, unmatched, warnings)
            for track in self.tracks:
                if track.detection is not None:
                    track.detector_id = ids[track.detection] or track.detector_id
                    if (mask := detections[track.detection].mask) is not None:
                        track.mask, track.mask_age = mask, 0
        self.tracks = [track for track in self.tracks if self._is_alive(track, frame.grid.image)]
        if pair is not None:
            self._carry_masks(pair[0], frame.grid.image, detections or ())
        for track in self.tracks:
            track.complete_and_redraw(self.model)
        return TrackResult(
            puppets=self._make_puppets(frame.grid),
            flow=pair,
            warnings=warnings,
            grid=frame.grid,
            restarted=restarted,
            _model=self.model,
            _propagation=propagation,
        )

    def override_joints(
        self, result: TrackResult, places: Mapping[str, Mapping[int, tuple[F64, float]]]
    ) -> TrackResult:
        """Return the last result with some joints moved: by id and joint, the position (2,) px and its confidence."""
        for track in self.tracks:
            for joint, (place, confidence) in places.get(track.id, {}).items():
                track.override_joint(joint, place, confidence, self.settings)
            if places.get(track.id):
                track.complete_and_redraw(self.model)
        return replace(result, puppets=self._make_puppets(result.grid))

    def _prepare(self, image: U8, stamp_ns: int) -> _Frame:
        grid = ImageScale(
            (image.shape[1], image.shape[0]), working_size(image.shape, self.optical_flow.settings.max_side)
        )
        return _Frame(stamp_ns, grid, self.optical_flow.prepare(image), colour_histogram(image))

    def _restart_if_broken(self, frame: _Frame, warnings: list[str]) -> bool:
        """Reset, and return True, if `frame` cannot follow the previous one."""
        previous = self._previous
        if previous is None:
            return False
        size, before = frame.grid.image, previous.grid.image
        if frame.stamp_ns < previous.stamp_ns:
            warnings.append(f"the stamp went back from {previous.stamp_ns} to {frame.stamp_ns} ns: tracking restarts")
        elif size != before:
            warnings.append(f"the image size changed from {before} to {size}: tracking restarts")
        else:
            if frame.stamp_ns == previous.stamp_ns:
                warnings.append(f"two images have the stamp {frame.stamp_ns} ns: both are used, in order of arrival")
            return False
        self.reset()
        return True

    def _choose_flow(self, previous: _Frame, frame: _Frame, given: FlowPair | None, warnings: list[str]) -> FlowPair:
        """Return the given flow on the working grid; compute it if there is none or it cannot be used."""
        if given is not None:
            if all(part.ndim == 3 and part.shape[2] == 2 and min(part.shape[:2]) > 1 for part in given):
                work = previous.grid.work
                return resize_flow(given[0], work), resize_flow(given[1], work)
            warnings.append(f"flow of shape {given[0].shape} is not an (h, w, 2) field: it is computed here instead")
        return self.optical_flow.estimate_prepared(previous.grey, frame.grey)

    def _count_image(self) -> None:
        """Start a new image: no track has a detection in it yet, and some may overlap."""
        overlapping = find_overlapping(self.model.joint_names, [track.mean for track in self.tracks])
        for track, overlaps in zip(self.tracks, overlapping, strict=True):
            track.unseen += 1
            track.detection_energy = 0.0
            track.detected = track.detection = None
            track.overlapped |= overlaps

    def _measure_appearances(self, image: U8, found: Sequence[Detection]) -> list[TorsoAppearance | None] | None:
        """Return the appearance of each detection; None if a single person leaves nothing to tell apart."""
        if max(len(self.tracks), len(found)) <= 1:
            return None
        return torso_appearances(self.model.joint_names, image, [joints for joints, _ in found])

    def _fuse_detections(
        self,
        found: Sequence[Detection],
        appearances: Sequence[TorsoAppearance | None] | None,
        matched: Mapping[int, int],
        searched_ids: Collection[str] | None,
    ) -> None:
        """Fuse each matched detection into its track; count a miss for the other tracks that were searched for."""
        for index, track in enumerate(self.tracks):
            track.missed += searched_ids is None or track.id in searched_ids
            if index not in matched:
                continue
            detection = found[matched[index]]
            if joint_distance(track, detection) > self.settings.match_distance:
                track.reset_gate()
            track.fuse(*detection, self.settings)
            track.update_scale_and_view(self.model)
            track.unseen = track.missed = 0
            track.detection, track.overlapped = matched[index], False
            appearance = appearances[matched[index]] if appearances else None
            if appearance is not None and appearance.isolated:
                track.update_appearance(appearance.colours)

    def _start_tracks(self, found: Sequence[Detection], unmatched: Sequence[int], warnings: list[str]) -> None:
        """Start tracks at the unmatched detections, the most certain first: it gets the lower id and the last slot."""
        for index in sorted(unmatched, key=lambda k: -found[k][1].sum()):
            joints, confidence = found[index]
            known = np.count_nonzero(np.isfinite(joints).all(axis=1))
            if known < self.settings.min_joints:
                limit = self.settings.min_joints
                warnings.append(f"a detected person is left out: {known} joints can be used, min_joints is {limit}")
                continue
            if len(self.tracks) >= self.settings.max_people:
                warnings.append(f"more than {self.settings.max_people} people: the others are left out (max_people)")
                continue
            heading = None if self._views is None else HeadingFilter(self._views)
            identity = letters_of_seed(self.settings.seed) + str(self._started + 1)
            try:
                self.tracks.append(Track.start(identity, self.model, joints, confidence, self.settings, heading))
            except InputError as error:
                warnings.append(f"a detected person is left out: {error}")
                continue
            self.tracks[-1].detection = index
            self._started += 1

    def _carry_masks(self, forward: Flow, size: tuple[int, int], detections: Sequence[Keypoints]) -> None:
        """Move the masks of the image before along the flow; those that came with this image's detections are there."""
        for track in self.tracks:
            if track.detection is None or detections[track.detection].mask is None:
                track.carry_mask(forward, size)

    def _is_alive(self, track: Track, size: tuple[int, int]) -> bool:
        """Return whether a track was seen recently enough and is still inside the image (width, height)."""
        if track.unseen > self.settings.max_unmatched_images or track.missed > self.settings.max_missed_detections:
            return False
        known = track.mean[~track.unknown]
        if len(known) < MIN_KNOWN_JOINTS:
            return False
        low, high = known.min(axis=0), known.max(axis=0)
        return not ((high < 0).any() or (low > np.array(size) - 1).any())

    def _make_puppets(self, grid: ImageScale) -> list[TrackedPuppet]:
        hidden = find_hidden_joints(self.model, self.tracks, grid)
        return [self._make_puppet(*pair, grid.image) for pair in zip(self.tracks, hidden, strict=True)]

    def _make_puppet(self, track: Track, hidden: Bools, size: tuple[int, int]) -> TrackedPuppet:
        shape = track.shape
        assert shape is not None
        depth = np.argsort(depth_order(self.model, track.view, track.side_heading))
        drawing = track.choose_model(self.model)
        visible = np.where(hidden, HIDDEN_CONFIDENCE, 1.0) * np.where(track.find_outside(size), OUTSIDE_CONFIDENCE, 1.0)
        return TrackedPuppet(
            id=track.id,
            model=self.model.name,
            joints=track.mean.copy(),
            confidence=track.confidence * visible,
            visible=visible,
            scale=track.scale,
            view=track.view,
            heading=np.nan if track.heading is None else track.heading.heading,
            side_heading=track.side_heading,
            drawing=drawing,
            energy=float(drawing.energy(shape) + track.flow_energy + track.detection_energy),
            contours=shape.contours,
            depth=tuple(int(rank) for rank in depth),
            shape=shape,
            detected=track.detected,
            detection=track.detection,
            mask=track.mask,
        )


def find_hidden_joints(model: DeformableStructures, tracks: Sequence[Track], grid: ImageScale) -> list[Bools]:
    """Return which joints (J,) of each track lie behind the puppet of a nearer person."""
    if len(tracks) < 2:
        return [np.zeros(len(model.joint_names), dtype=bool) for _ in tracks]
    labels = render_tracks(model, tracks, grid)
    height, width = labels.shape
    hidden = []
    for k, track in enumerate(tracks):
        x, y = np.rint(grid.to_work(track.mean)).astype(np.int64).T
        inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
        owner = (labels[np.where(inside, y, 0), np.where(inside, x, 0)].astype(np.int64) - 1) // len(model.tree)
        hidden.append(inside & (owner >= 0) & (owner != k))
    return hidden
