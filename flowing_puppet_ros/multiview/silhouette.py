# SPDX-License-Identifier: Apache-2.0
"""Silhouettes of tracked people: the puppet's labels and a learned background seed a GrabCut of the image.

The puppet says roughly where the body is, the background says which pixels cannot be it; GrabCut (Rother et al. 2004)
settles what lies between by colour. Everything is causal: a frame's mask uses that frame and earlier ones only.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np

from flowing_puppet_ros.arrays import U8, Bools
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.multiview.background import Background, BackgroundSettings
from flowing_puppet_ros.multiview.distance_transform import distance_transform
from flowing_puppet_ros.settings import setting

# Lengths on the body in metres, from a trial on real recordings.
_SURE_CORE = 0.03  # this far inside the puppet is body
_POSSIBLE_FRINGE = 0.07  # this far outside the puppet may be body
_UNKNOWN_FRINGE = 0.035  # the same where the background is not known: there colour alone leaks into what is similar
_BARE_DISTANCE = 0.10  # farther than this outside the puppet is background
_STRAY_REACH = 0.7  # how far a limb may lie from where the puppet has it
_CROP_MARGIN = 0.15  # surroundings that GrabCut learns the colours of the background from
_SPECK = 0.006  # radius of the opening that removes specks and threads

# Background differences: d in grey levels, z in spreads softened by the camera's noise.
_NOISE_LEVELS = 3.0
_SAME = (8.0, 1.5)  # below both: surely background
_OTHER = (40.0, 6.0)  # above both: surely body
_DOUBTFUL = (15.0, 3.0)  # above both: probably body
_AREA_HISTORY = 31
_AREA_MIN_HISTORY = 5


@dataclass(frozen=True)
class SilhouetteSettings(BackgroundSettings):
    """How silhouettes are cut out, and how the background is learned."""

    max_side: int = setting(480, "longest image side that silhouettes are cut at", unit="px", low=64, high=8192)
    cut_rounds: int = setting(1, "GrabCut rounds", low=1, high=10)
    area_change: float = setting(
        0.35,
        "a mask whose area differs from its running median by more than this share is not used",
        low=0.05,
        high=10.0,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """One frame at working scale.

    `image` (h,w,3), `puppet` (h,w) where the person's puppet lies, `others` (h,w) where only other people's do,
    `scale` in working pixels per metre on the body.
    """

    image: U8
    puppet: Bools
    others: Bools
    scale: float


@dataclass(frozen=True, slots=True, eq=False)
class Silhouette:
    """A mask (h,w) uint8, 255 on the body, at working scale; `problem` is a sentence when it should not be used."""

    mask: U8
    problem: str = ""


class SilhouetteEstimator:
    """Silhouettes of the tracked people in one still camera's images.

    `observe` is cheap and wants every frame, for the background; `cut` takes the observations whose mask is wanted.
    """

    def __init__(self, settings: SilhouetteSettings | None = None) -> None:
        """Know no background yet."""
        self.settings = settings or SilhouetteSettings()
        self.background = Background(self.settings)
        self._areas: deque[float] = deque(maxlen=_AREA_HISTORY)

    def reset(self) -> None:
        """Forget the background and the usual area."""
        self.background.reset()
        self._areas.clear()

    def update_background(
        self,
        image: U8,
        labels: U8,
        scale: float,
        person: U8 | None = None,
    ) -> Observation:
        """Shrink `image` (H,W,3) RGB and the part `labels` (H,W), learn the background, return the frame to `cut`.

        `labels` are positive on all puppets; `person` (H,W) is positive on the one to cut out, all of them if not
        given; `scale` is its size in pixels of `image` per metre. Frames without any puppet teach nothing: that nobody
        was tracked is no proof that nobody stands there. Raises InputError for images and labels that do not fit
        together and for a scale that is not positive.
        """
        person = labels if person is None else person
        _check(image, labels, scale)
        _check(image, person, scale)
        height, width = image.shape[:2]
        factor = min(1.0, self.settings.max_side / max(height, width))
        size = (max(1, round(width * factor)), max(1, round(height * factor)))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if factor < 1 else image
        everybody = cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST) > 0
        puppet = cv2.resize(person, size, interpolation=cv2.INTER_NEAREST) > 0
        observation = Observation(small, puppet, everybody & ~puppet, scale * factor)
        if everybody.any():
            self.background.update(small, distance_transform(everybody) > _BARE_DISTANCE * observation.scale)
        return observation

    def segment(self, observation: Observation) -> Silhouette:
        """The silhouette of an observed frame; its `problem` says so when it is empty or much unlike recent ones."""
        if not observation.puppet.any():
            return Silhouette(np.zeros(observation.puppet.shape, np.uint8), "no puppet in the image")
        self.background.resize((observation.puppet.shape[0], observation.puppet.shape[1]))
        seed = self._seed(observation)
        sure = seed == cv2.GC_FGD
        window = _crop(observation.puppet | sure, _CROP_MARGIN * observation.scale)
        body = _grab_cut(np.ascontiguousarray(observation.image[window]), seed[window], self.settings.cut_rounds)
        mask = np.zeros(observation.puppet.shape, np.uint8)
        mask[window] = _cleaned(body, sure[window], _SPECK * observation.scale)
        return Silhouette(mask, self._alarm(mask, observation.scale))

    def _seed(self, observation: Observation) -> U8:
        """GrabCut's seed (h,w): what puppet and background together say of every pixel."""
        puppet, scale = observation.puppet, observation.scale
        known = self.background.known
        levels, spread = self.background.difference(observation.image)
        levels = cv2.blur(levels, (3, 3))
        ratio = levels / (spread + _NOISE_LEVELS)
        same = known & (levels < _SAME[0]) & (ratio < _SAME[1])
        other = known & (levels > _OTHER[0]) & (ratio > _OTHER[1])

        seed = np.where(puppet, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
        seed[known] = cv2.GC_PR_BGD
        seed[known & (levels > _DOUBTFUL[0]) & (ratio > _DOUBTFUL[1])] = cv2.GC_PR_FGD
        seed[other] = cv2.GC_FGD
        seed[same] = cv2.GC_BGD
        distance = distance_transform(puppet)
        seed[distance > np.where(known, _POSSIBLE_FRINGE, _UNKNOWN_FRINGE) * scale] = cv2.GC_BGD
        # A limb that the puppet has elsewhere still hangs on the body and is no shadow.
        stray = other & ~self.background.shadow(observation.image) & (distance <= _STRAY_REACH * scale)
        stray &= distance_transform(observation.others) > _BARE_DISTANCE * scale
        seed[_connected(stray | puppet, puppet) & stray] = cv2.GC_FGD
        # Where a misplaced part of the puppet shows the bare background, colour decides.
        core = _eroded(puppet, _SURE_CORE * scale)
        seed[core] = np.where(same[core], cv2.GC_PR_BGD, cv2.GC_FGD)
        seed[observation.others] = cv2.GC_BGD
        return seed

    def _alarm(self, mask: U8, scale: float) -> str:
        area = np.count_nonzero(mask) / scale**2
        usual = float(np.median(self._areas)) if len(self._areas) >= _AREA_MIN_HISTORY else area
        self._areas.append(area)
        if area == 0:
            return "the silhouette is empty"
        if not 1 / (1 + self.settings.area_change) <= area / usual <= 1 + self.settings.area_change:
            return f"the silhouette's area is {area / usual:.2f} of its running median"
        return ""


def _check(image: U8, labels: U8, scale: float) -> None:
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or image.size == 0:
        raise InputError(f"a silhouette needs an RGB image (H, W, 3) of uint8, got {image.shape} of {image.dtype}")
    if labels.shape != image.shape[:2] or labels.dtype != np.uint8:
        raise InputError(
            f"part labels are {labels.shape} of {labels.dtype}, the image needs {image.shape[:2]} of uint8"
        )
    if not (np.isfinite(scale) and scale > 0):
        raise InputError(f"the puppet's scale is {scale}; it must be a positive number of pixels per metre")


def _disc(radius: float) -> U8:
    reach = max(1, round(radius))
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))


def _eroded(mask: Bools, radius: float) -> Bools:
    return distance_transform(~mask) > radius


def _crop(puppet: Bools, margin: float) -> tuple[slice, slice]:
    """Rows and columns of the puppet's box with a margin, within the image."""
    slices = []
    for axis in (1, 0):
        covered = np.flatnonzero(puppet.any(axis=axis))
        low, high = int(covered[0] - margin), int(np.ceil(covered[-1] + margin)) + 1
        slices.append(slice(max(0, low), min(puppet.shape[1 - axis], high)))
    return slices[0], slices[1]


def _grab_cut(image: U8, seed: U8, rounds: int) -> Bools:
    """GrabCut with fixed randomness; a seed that leaves nothing to decide is the answer itself."""
    body = (seed == cv2.GC_FGD) | (seed == cv2.GC_PR_FGD)
    if body.all() or not body.any():
        return body
    cv2.setNumThreads(1)  # the result depends on the number of threads otherwise
    cv2.setRNGSeed(0)
    labels = seed.copy()
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(image, labels, None, *models, rounds, cv2.GC_INIT_WITH_MASK)
    return (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)


def _connected(mask: Bools, start: Bools) -> Bools:
    """The components (8 neighbours) of `mask` that meet `start`."""
    count, components = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    kept = np.zeros(count, bool)
    kept[components[start]] = True
    kept[0] = False
    return kept[components]


def _cleaned(body: Bools, sure: Bools, speck: float) -> U8:
    """Open away specks and threads, and keep only what meets sure body; 255 on the body."""
    opened = cv2.morphologyEx(body.astype(np.uint8), cv2.MORPH_OPEN, _disc(speck))
    return np.where(_connected(opened > 0, sure), 255, 0).astype(np.uint8)
