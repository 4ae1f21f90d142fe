# SPDX-License-Identifier: Apache-2.0
"""Silhouettes of tracked people: the puppet's labels and a learned background seed a GrabCut of the image.

The puppet gives the rough position of the body, the background rules pixels out; GrabCut (Rother et al. 2004) decides
the rest by colour. Everything is causal: a frame's mask uses that frame and earlier ones only.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from weakref import ref

import cv2
import numpy as np

from flowing_puppet_ros.arrays import F64, U8, Bools
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.images import reduce_image
from flowing_puppet_ros.multiview.background import Background, BackgroundSettings
from flowing_puppet_ros.multiview.distance_transform import distance_transform
from flowing_puppet_ros.process.threads import one_opencv_thread
from flowing_puppet_ros.settings import Settings, nested, setting

# Lengths on the body, tuned on real recordings.
_CORE_DEPTH_M = 0.03  # pixels farther inside the puppet are body
_FRINGE_M = 0.07  # pixels up to this far outside the puppet may be body
_UNKNOWN_FRINGE_M = 0.035  # the same where the background is unknown: there colour alone leaks into what is similar
_BARE_DISTANCE_M = 0.10  # pixels farther outside the puppet are background
_MAX_LIMB_ERROR_M = 0.7  # distance of a limb from where the puppet has it
_CROP_MARGIN_M = 0.15  # surroundings from which GrabCut learns the colours of the background
_OPENING_RADIUS_M = 0.006  # removes specks and threads
_COLOUR_IMAGES = 15  # that start with the colours of the image before

# Differences from the background, in grey levels and in standard deviations with the camera's noise added.
_NOISE_LEVELS = 3.0
_SURE_BACKGROUND = (8.0, 1.5)  # below both: surely background
_SURE_BODY = (40.0, 6.0)  # above both: surely body
_LIKELY_BODY = (15.0, 3.0)  # above both: probably body
# Areas in the running median, and their minimum number.
_AREA_HISTORY = 31
_MIN_AREA_HISTORY = 5


@dataclass(frozen=True)
class SilhouetteSettings(Settings):
    """How silhouettes are cut out, and how the background is learned."""

    background: BackgroundSettings = nested(BackgroundSettings)
    max_side: int = setting(480, "longest image side at which silhouettes are segmented", unit="px", low=64, high=8192)
    grabcut_rounds: int = setting(1, "GrabCut iterations", low=1, high=10, advanced=True)
    max_area_change: float = setting(
        0.35,
        "relative deviation of a mask's area from its running median beyond which the mask is not used",
        low=0.05,
        high=10.0,
        advanced=True,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """One frame at working scale.

    Attributes:
        image: (h, w, 3) uint8 RGB.
        puppet: (h, w) pixels of the person's puppet.
        others: (h, w) pixels of other people's puppets only.
        scale: working pixels per metre on the body.
    """

    image: U8
    puppet: Bools
    others: Bools
    scale: float


@dataclass(frozen=True, slots=True, eq=False)
class Silhouette:
    """A `mask` (h, w) uint8 at working scale, 255 on the body; `problem` says why it should not be used."""

    mask: U8
    problem: str = ""


class SilhouetteEstimator:
    """Silhouettes of the tracked people in one still camera's images.

    `update_background` is cheap and needs every frame, `observe` gives the other people of the same frame; `segment`
    takes the observations whose mask is wanted.
    """

    def __init__(self, settings: SilhouetteSettings | None = None) -> None:
        """Start without a background."""
        self.settings = settings or SilhouetteSettings()
        self.background = Background(self.settings.background)
        self._areas: dict[str, deque[float]] = {}
        self._colours: dict[str, _Colours] = {}
        self._reduced: tuple[ref[U8], U8] | None = None  # the last image, which is observed once for each person in it

    def reset(self) -> None:
        """Forget the background and the areas."""
        self.background.reset()
        self._areas.clear()
        self._colours.clear()

    def update_background(
        self,
        image: U8,
        labels: U8,
        scale: float,
        person: U8 | None = None,
    ) -> Observation:
        """Learn the background from a frame and return the frame at working scale, for `segment`.

        Frames without any puppet are not learned: an untracked person may still be there. Arguments as of `observe`.
        """
        observation = self.observe(image, labels, scale, person)
        everyone = observation.puppet | observation.others
        if everyone.any():
            bare = distance_transform(everyone) > _BARE_DISTANCE_M * observation.scale
            self.background.update(observation.image, bare)
        return observation

    def observe(self, image: U8, labels: U8, scale: float, person: U8 | None = None) -> Observation:
        """Return a frame at working scale, without learning from it.

        Args:
            image: (H, W, 3) uint8 RGB.
            labels: (H, W) uint8 part labels, positive on all puppets.
            scale: pixels of `image` per metre on the person.
            person: (H, W) uint8, positive on the puppet to segment; None for all of them.

        Raises:
            InputError: when image and labels do not fit together, or the scale is not positive.
        """
        person = labels if person is None else person
        _check_inputs(image, labels, scale)
        _check_inputs(image, person, scale)
        height, width = image.shape[:2]
        factor = min(1.0, self.settings.max_side / max(height, width))
        size = (max(1, round(width * factor)), max(1, round(height * factor)))
        if self._reduced is None or self._reduced[0]() is not image:
            self._reduced = ref(image), reduce_image(image, size)
        small = self._reduced[1]
        everyone = cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST) > 0
        puppet = cv2.resize(person, size, interpolation=cv2.INTER_NEAREST) > 0
        return Observation(small, puppet, everyone & ~puppet, scale * factor)

    def segment(self, observation: Observation, identity: str = "") -> Silhouette:
        """Segment an observed frame; the result has a `problem` when it is empty or its area unlike recent ones.

        Areas are those of the person called `identity`.
        """
        if not observation.puppet.any():
            return Silhouette(np.zeros(observation.puppet.shape, np.uint8), "no puppet in the image")
        self.background.resize((observation.puppet.shape[0], observation.puppet.shape[1]))
        seed = self._make_seed(observation)
        sure = seed == cv2.GC_FGD
        window = _crop(observation.puppet | sure, _CROP_MARGIN_M * observation.scale)
        colours = self._colours.setdefault(identity, _Colours())
        body = _grab_cut(
            np.ascontiguousarray(observation.image[window]), seed[window], self.settings.grabcut_rounds, colours
        )
        mask = np.zeros(observation.puppet.shape, np.uint8)
        mask[window] = _clean(body, sure[window], _OPENING_RADIUS_M * observation.scale)
        return Silhouette(mask, self._check_area(mask, observation.scale, identity))

    def _make_seed(self, observation: Observation) -> U8:
        """Return GrabCut's seed (h, w): the evidence of puppet and background for every pixel."""
        puppet, scale = observation.puppet, observation.scale
        known = self.background.known
        levels, deviation = self.background.difference(observation.image)
        levels = cv2.blur(levels, (3, 3))
        ratio = levels / (deviation + _NOISE_LEVELS)
        same = known & (levels < _SURE_BACKGROUND[0]) & (ratio < _SURE_BACKGROUND[1])
        other = known & (levels > _SURE_BODY[0]) & (ratio > _SURE_BODY[1])

        seed = np.where(puppet, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
        seed[known] = cv2.GC_PR_BGD
        seed[known & (levels > _LIKELY_BODY[0]) & (ratio > _LIKELY_BODY[1])] = cv2.GC_PR_FGD
        seed[other] = cv2.GC_FGD
        seed[same] = cv2.GC_BGD
        distance = distance_transform(puppet)
        seed[distance > np.where(known, _FRINGE_M, _UNKNOWN_FRINGE_M) * scale] = cv2.GC_BGD
        # A limb that the puppet has elsewhere is still connected to the body, and is not a shadow.
        stray = other & ~self.background.find_shadows(observation.image) & (distance <= _MAX_LIMB_ERROR_M * scale)
        if observation.others.any():
            stray &= distance_transform(observation.others) > _BARE_DISTANCE_M * scale
        seed[_keep_connected(stray | puppet, puppet) & stray] = cv2.GC_FGD
        # Where a misplaced part of the puppet shows the bare background, colour decides.
        core = _erode(puppet, _CORE_DEPTH_M * scale)
        seed[core] = np.where(same[core], cv2.GC_PR_BGD, cv2.GC_FGD)
        seed[observation.others] = cv2.GC_BGD
        return seed

    def _check_area(self, mask: U8, scale: float, identity: str) -> str:
        area = np.count_nonzero(mask) / scale**2
        areas = self._areas.setdefault(identity, deque(maxlen=_AREA_HISTORY))
        median = float(np.median(areas)) if len(areas) >= _MIN_AREA_HISTORY else area
        areas.append(area)
        if area == 0:
            return "the silhouette is empty"
        if not 1 / (1 + self.settings.max_area_change) <= area / median <= 1 + self.settings.max_area_change:
            return f"the silhouette's area is {area / median:.2f} of its running median"
        return ""


def _check_inputs(image: U8, labels: U8, scale: float) -> None:
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or image.size == 0:
        raise InputError(f"a silhouette needs an RGB image (H, W, 3) of uint8, got {image.shape} of {image.dtype}")
    if labels.shape != image.shape[:2] or labels.dtype != np.uint8:
        raise InputError(
            f"part labels are {labels.shape} of {labels.dtype}, the image needs {image.shape[:2]} of uint8"
        )
    if not (np.isfinite(scale) and scale > 0):
        raise InputError(f"the puppet's scale is {scale}; it must be a positive number of pixels per metre")


def _make_disc(radius: float) -> U8:
    size = 2 * max(1, round(radius)) + 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))


def _erode(mask: Bools, radius: float) -> Bools:
    """Return the pixels of a mask that are farther than `radius` from its outside, which begins beside its box."""
    eroded = np.zeros_like(mask)
    box = _crop(mask, 1)
    eroded[box] = distance_transform(~mask[box]) > radius
    return eroded


def _crop(puppet: Bools, margin: float) -> tuple[slice, slice]:
    """Return the rows and columns of the puppet's box with a margin, within the image."""
    slices = []
    for axis in (1, 0):
        covered = np.flatnonzero(puppet.any(axis=axis))
        low, high = int(covered[0] - margin), int(np.ceil(covered[-1] + margin)) + 1
        slices.append(slice(max(0, low), min(puppet.shape[1 - axis], high)))
    return slices[0], slices[1]


@dataclass(slots=True, eq=False)
class _Colours:
    """GrabCut's mixtures of colours (1, 65) of background and body, and in how many more images others start with them.

    To find mixtures from nothing takes as long as the cut itself. Those of the image before are a better start, but a
    component that has lost all pixels never comes back, so they are found anew from time to time.
    """

    background: F64 = field(default_factory=lambda: np.zeros((1, 65)))
    body: F64 = field(default_factory=lambda: np.zeros((1, 65)))
    images_left: int = 0


def _grab_cut(image: U8, seed: U8, rounds: int, colours: _Colours) -> Bools:
    """Run GrabCut with fixed randomness and change the `colours`; a seed that leaves nothing to decide is returned."""
    body = (seed == cv2.GC_FGD) | (seed == cv2.GC_PR_FGD)
    if body.all() or not body.any():
        return body
    labels = seed.copy()
    mode = cv2.GC_EVAL if colours.images_left > 0 else cv2.GC_INIT_WITH_MASK
    colours.images_left = colours.images_left - 1 if colours.images_left > 0 else _COLOUR_IMAGES
    # The result depends on the number of threads otherwise.
    with one_opencv_thread():
        cv2.setRNGSeed(0)
        cv2.grabCut(image, labels, None, colours.background, colours.body, rounds, mode)
    return (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)


def _keep_connected(mask: Bools, start: Bools) -> Bools:
    """Return the components (8 neighbours) of `mask` (h, w) that touch `start` (h, w)."""
    count, components = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    kept = np.zeros(count, bool)
    kept[components[start]] = True
    kept[0] = False
    return kept[components]


def _clean(body: Bools, sure: Bools, radius: float) -> U8:
    """Remove specks and threads by opening, and keep only what is connected to sure body; 255 on the body."""
    opened = cv2.morphologyEx(body.astype(np.uint8), cv2.MORPH_OPEN, _make_disc(radius))
    return np.where(_keep_connected(opened > 0, sure), 255, 0).astype(np.uint8)
