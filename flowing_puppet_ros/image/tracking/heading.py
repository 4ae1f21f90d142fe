# SPDX-License-Identifier: Apache-2.0
"""Where a tracked person's torso faces, from the joints of many images: front or back, and one of the nine views.

One image tells the view by little more than the width of shoulders and hips, which detectors get wrong by a few pixels;
people turn slowly. So the probability of each view is carried on from detection to detection (a filter over Eq. 38's
views) and the puppet of a side is drawn only once a side is nearly certain.
"""

from __future__ import annotations

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.model.ds.multiview import VIEW_HEADINGS, MultiViewStructures
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.shape import View

UPDATE_INTERVAL = 4  # detections from one estimate to the next, since one takes a few milliseconds
CONFIDENCE_FACTOR = 0.5  # on the confidence of detected joints: detectors err more than the model
STAY_PROBABILITY = 0.7  # of a view from one estimate to the next; the rest goes to its two neighbours
MAX_SIDE_DOUBT = 0.5  # probability of the frontal views from which on the frontal puppet is drawn again


class HeadingFilter:
    """The probability of each view of one person over the images."""

    def __init__(self, views: MultiViewStructures) -> None:
        """Start without any evidence."""
        self._views = views
        self._probability = views.prior.copy()
        self._view: View | None = None
        self._side: int | None = None
        self._detections = 0

    @property
    def side_model(self) -> DeformableStructures | None:
        """The puppet of the side from which the person is seen, None where the frontal one is right."""
        return None if self._side is None else self._views.views[self._side]

    @property
    def side_heading(self) -> float:
        """Angle in rad by which the side's puppet is turned to the right of its image, 0 for the frontal one."""
        return 0.0 if self._side is None else VIEW_HEADINGS[self._side]

    @property
    def heading(self) -> float:
        """Where the torso faces, rad in (-pi, pi]: 0 to the camera, pi/2 to the right of the image, pi away."""
        turned = float(self._probability @ np.array(VIEW_HEADINGS))
        if self._view != "back":
            return turned
        # Seen from behind, the mirrored joints are those of somebody who faces the camera.
        return turned - np.pi if turned > 0 else turned + np.pi

    def update(self, joints: F64, confidence: F64, view: View) -> None:
        """Take detected `joints` (J, 2) px, NaN unknown, their `confidence` (J,), and whether front or back is seen."""
        if view != self._view:
            self._view, self._probability, self._side = view, self._views.prior.copy(), None
            self._detections = 0
        self._detections += 1
        if self._detections % UPDATE_INTERVAL != 1:
            return
        mirror = np.array([1.0 if view == "front" else -1.0, 1.0])
        try:
            seen = self._views.posterior(joints * mirror, confidence * CONFIDENCE_FACTOR)
        except InputError:
            return  # too few joints to tell
        likelihood = seen / self._views.prior
        beside = np.pad(self._probability, 1, mode="edge")
        carried = STAY_PROBABILITY * self._probability + (1 - STAY_PROBABILITY) / 2 * (beside[:-2] + beside[2:])
        self._probability = carried * likelihood / (carried @ likelihood)
        self._choose_side()

    def _choose_side(self) -> None:
        side = self._views.find_side(self._probability)
        if side is not None or self._views.frontal_probability(self._probability) > MAX_SIDE_DOUBT:
            self._side = side
