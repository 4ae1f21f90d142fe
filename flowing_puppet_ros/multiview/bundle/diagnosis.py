# SPDX-License-Identifier: Apache-2.0
"""Why cameras do not agree on anybody: the mistakes that calibrations are imported with, tried one by one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.multiview.association.clusters import find_clusters
from flowing_puppet_ros.multiview.association.height import measure_height
from flowing_puppet_ros.multiview.association.settings import AssociationSettings
from flowing_puppet_ros.multiview.association.view import PersonInView, calibrate_views
from flowing_puppet_ros.multiview.bundle.gauge import scale_to
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.triangulation import TriangulationSettings

MIN_AGREEMENT = 0.4
"""Minimum share of the pairs of views that agree, for a calibration to be right."""
MIN_HEIGHT_M, MAX_HEIGHT_M, USUAL_HEIGHT_M = 0.9, 2.4, 1.7
_BASELINES_M = (4.0, 2.0, 8.0, 1.0, 0.5, 16.0)  # tried as the median distance of cameras
_INSTANTS = 3  # at which mistakes are tried
_MIN_GAIN = 0.25  # in that share, for a mistake to be the reason
_ASSOCIATION = AssociationSettings()
_TRIANGULATION = TriangulationSettings()

type People = Mapping[str, Sequence[PersonInView]]
"""Camera -> the people in its image at one instant."""


@dataclass(frozen=True, slots=True, eq=False)
class AgreementOfViews:
    """How many views of people agree.

    Attributes:
        share: of the pairs of views that could show one person, those that do.
        by_camera: share of a camera's views that agree with any other.
        joints: (T, J, 3) m of the people.
    """

    share: float
    by_camera: dict[str, float]
    joints: F64


def measure_agreement_of_views(cameras: Mapping[str, Camera], instants: Sequence[People]) -> AgreementOfViews:
    """Return how many views of people, at several instants, belong to somebody whom several cameras see."""
    agreeing, total = dict.fromkeys(cameras, 0), dict.fromkeys(cameras, 0)
    pairs, possible = 0, 0
    joints = []
    for people in instants:
        views = calibrate_views(cameras, people, _TRIANGULATION.min_confidence)
        free = {(name, k) for name, group in views.items() for k in range(len(group))}
        for name, group in views.items():
            total[name] += len(group)
        possible += sum(min(len(views[one]), len(views[other])) for one, other in combinations(views, 2))
        for cluster in find_clusters(views, free, _ASSOCIATION, _TRIANGULATION):
            joints.append(cluster.joints)
            pairs += len(cluster.views) * (len(cluster.views) - 1) // 2
            for name in cluster.views:
                agreeing[name] += 1
    by_camera = {name: agreeing[name] / total[name] for name in cameras if total[name]}
    return AgreementOfViews(pairs / max(1, possible), by_camera, np.stack(joints) if joints else np.zeros((0, 0, 3)))


def find_size(
    cameras: Mapping[str, Camera], names: Sequence[str], instants: Sequence[People]
) -> tuple[float, AgreementOfViews]:
    """Return the factor at which most views agree on people as tall as people are, and how they agree.

    Distances between rays grow with the unit, and the association knows people in metres only.
    """
    centres = np.array([camera.centre for camera in cameras.values()])
    gaps = np.linalg.norm(centres[:, None] - centres[None], axis=2)[np.triu_indices(len(centres), 1)]
    median = float(np.median(gaps[gaps > 0]))
    best: tuple[bool, float, float, AgreementOfViews] | None = None
    for baseline in _BASELINES_M:
        factor = baseline / median
        seen = measure_agreement_of_views(scale_to(cameras, factor), instants)
        tall = measure_height(names, seen.joints) if len(seen.joints) else np.nan
        candidate = bool(MIN_HEIGHT_M < tall < MAX_HEIGHT_M), seen.share, factor, seen
        if best is None or candidate[:2] > best[:2]:
            best = candidate
        if candidate[0] and seen.share >= MIN_AGREEMENT:
            # Once more at a usual height, where the limits of the association fit.
            exact = factor * USUAL_HEIGHT_M / tall
            again = measure_agreement_of_views(scale_to(cameras, exact), instants)
            return (exact, again) if again.share >= seen.share else (factor, seen)
    assert best is not None
    return best[2], best[3]


def explain_disagreement(
    cameras: Mapping[str, Camera], names: Sequence[str], instants: Sequence[People], share: float
) -> str:
    """Return in one sentence which mistake in the calibration would explain why views do not agree; "" if none does.

    `share` of them agree as it is.
    """
    best, reason = share + _MIN_GAIN, ""
    for sentence, changed, people in _list_mistakes(cameras, instants[:: max(1, len(instants) // _INSTANTS)]):
        found = find_size(changed, names, people)[1].share
        if found > best:
            best, reason = found, sentence
    return reason


def _list_mistakes(
    cameras: Mapping[str, Camera], instants: Sequence[People]
) -> Iterator[tuple[str, dict[str, Camera], Sequence[People]]]:
    """Yield what may be wrong, with the cameras and people as they would be without that."""
    for one, other in combinations(cameras, 2):
        swapped = dict(cameras) | {one: cameras[other], other: cameras[one]}
        yield f"{one} and {other} are swapped: give the videos or the calibration the other's name", swapped, instants
    inverse = {
        name: replace(each, rotation=each.rotation.T, translation=-each.rotation.T @ each.translation)
        for name, each in cameras.items()
    }
    yield (
        "the poses are those of the cameras in the world: the inverse, world to camera, is expected",
        inverse,
        instants,
    )
    flip = np.diag([1.0, -1.0, -1.0])
    backward = {
        name: replace(each, rotation=flip @ each.rotation, translation=flip @ each.translation)
        for name, each in cameras.items()
    }
    yield "the cameras look along -z with y up: z forward and y down are expected", backward, instants
    for axis, label in enumerate("xyz"):
        mirror = np.ones(3)
        mirror[axis] = -1.0
        moved = {name: replace(each, translation=mirror * each.translation) for name, each in cameras.items()}
        yield f"the {label} axis of the translations is mirrored: its sign is wrong", moved, instants
        placed = {
            name: replace(each, translation=-each.rotation @ (mirror * each.centre)) for name, each in cameras.items()
        }
        yield f"the {label} axis of the world is mirrored: its sign is wrong in the cameras' places", placed, instants
    turned = [
        {
            name: [_mirror_image(person, cameras[name]) for person in group if name in cameras]
            for name, group in people.items()
        }
        for people in instants
    ]
    yield (
        "the images are mirrored, or an axis of the world is: turn the videos over or the sign of the axis",
        dict(cameras),
        turned,
    )


def _mirror_image(person: PersonInView, camera: Camera) -> PersonInView:
    joints = person.joints.copy()
    joints[:, 0] = camera.size[0] - 1 - joints[:, 0]
    return replace(person, joints=joints)
