# SPDX-License-Identifier: Apache-2.0
"""The fit of one body to a person's points and silhouettes, and how far it can be trusted.

What is known of a body where depth is missing comes from the silhouettes alone: a pixel without a depth is therefore
unknown to its sensor here, and not free as in a fit to depth alone, where it may be the open air.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flowing_puppet_ros.body.cloud.person_cloud import PersonCloud
from flowing_puppet_ros.body.cloud.single_view import SingleViewCloud
from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter, check_cloud
from flowing_puppet_ros.body.fit.visibility import BodyVisibility
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.fusion.rig.silhouette_person import SilhouettePerson
from flowing_puppet_ros.model.sp import BodyState
from flowing_puppet_ros.multiview.silhouette_fit import SilhouetteFitter, SilhouetteFitterSettings
from flowing_puppet_ros.multiview.visual_hull import MIN_VIEWS

MIN_DEPTH_CONFIDENCE, MIN_OVERLAP = 0.3, 0.7
"""Of a body that is reliable: the confidence that depth gives it, and the overlap with the silhouettes, if the other
one says that it is."""


class JoinedFitter:
    """Fits bodies of one model to depth and silhouettes."""

    def __init__(self, fitter: BodyFitter, settings: SilhouetteFitterSettings) -> None:
        """Fit with the model and the parts of `fitter`."""
        self.fitter = fitter
        self._silhouettes = SilhouetteFitter(fitter.model, settings)

    def fit(self, cloud: PersonCloud | None, person: SilhouettePerson, previous: BodyState | None = None) -> BodyFit:
        """Return the body of a person.

        Args:
            cloud: their own points, with the sensors that saw them; None where there are too few.
            person: their silhouettes and joints; none, one or more silhouettes beside a cloud, else two.
            previous: their body a moment ago, whose shape helps.

        Raises:
            InputError: when joints or silhouettes place no body.
        """
        prepared = None if cloud is None else self._prepare(cloud)
        views = list(person.views.values())
        if prepared is None:
            return self._silhouettes.fit(views, person.joints, previous)
        if not views:
            assert cloud is not None
            return self.fitter.fit(
                cloud.points, initial=person.joints, viewpoint=cloud.viewpoint, field=cloud.field, seed=0
            )
        fit = self._silhouettes.fit(views, person.joints, previous, prepared)
        return self._join(fit, self.fitter.assess(fit.state, prepared))

    def _prepare(self, cloud: PersonCloud) -> SingleViewCloud | None:
        try:
            points, _ = check_cloud(cloud.points, None)
            field = None if cloud.field is None else cloud.field.doubt_blanks(points)
            prepared = self.fitter.prepare_cloud(points, None, cloud.viewpoint, field)
        except InputError:
            return None
        assert isinstance(prepared, SingleViewCloud)
        return prepared

    def _join(self, seen: BodyFit, touched: BodyFit) -> BodyFit:
        """Return one judgement of the same body, from what silhouettes and what depth say."""
        vertices = np.maximum(seen.visibility.vertices, touched.visibility.vertices)
        overlap, depth = seen.confidence, touched.confidence
        reliable = (touched.reliable and overlap >= MIN_OVERLAP) or (seen.reliable and depth >= MIN_DEPTH_CONFIDENCE)
        return replace(
            touched,
            part_confidence=np.maximum(seen.part_confidence, touched.part_confidence),
            confidence=float(np.sqrt(overlap * depth)),
            reliable=bool(reliable),
            visibility=BodyVisibility.of_vertices(self.fitter.model, vertices),
        )


def can_stand_alone(person: SilhouettePerson) -> bool:
    """Return whether a person's silhouettes give a body without depth."""
    return len(person.views) >= MIN_VIEWS
