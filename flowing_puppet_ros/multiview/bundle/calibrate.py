# SPDX-License-Identifier: Apache-2.0
"""A rig refined by the people in its images: cameras, clocks, and how well they agree before and after."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.errors import InputError, PuppetError
from flowing_puppet_ros.multiview.association.height import measure_height
from flowing_puppet_ros.multiview.association.settings import AssociationSettings
from flowing_puppet_ros.multiview.bundle.adjustment import (
    Adjusted,
    Freedom,
    adjust,
    choose_instants,
    measure_residuals,
    triangulate_linear,
    triangulate_median,
)
from flowing_puppet_ros.multiview.bundle.clocks import find_coarse_offsets
from flowing_puppet_ros.multiview.bundle.gauge import match_baselines, place_as_before, scale_to
from flowing_puppet_ros.multiview.bundle.joint_tracks import CameraFrames, PeopleTracks, associate_tracks
from flowing_puppet_ros.multiview.bundle.uncertainty import PoseUncertainty, bound_uncertainty
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.triangulation import TriangulationSettings

# People are associated although cameras are off by some degrees and clocks by some images.
_ASSOCIATION = AssociationSettings(max_epipolar_distance=0.35, max_joint_distance=0.6, max_view_error=0.35)
_TRIANGULATION = TriangulationSettings(max_ray_distance=0.3)
_MIN_OBSERVATIONS = 60  # joints of a camera at all instants
_ROBUST_PX = 3.0  # below which a distance counts squared where joints are placed
AGREE_M = TriangulationSettings().max_ray_distance
"""Distance of a joint from its place in space, at its depth, within which a camera agrees."""
_NEAR_PERIODS = 1.5  # between clocks that lead to the same result
_PASSES = 2  # the second associates people by the cameras of the first


@dataclass(frozen=True, slots=True)
class Scale:
    """What fixes the size: the former baselines, or `distance` m of two `cameras`, or a person's `height` m."""

    cameras: tuple[str, str] | None = None
    distance: float = 0.0
    height: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Agreement:
    """Distances of joints from their projections, px.

    Attributes:
        mean: over all joints of a camera, by camera.
        median: likewise.
        all_mean: over all joints of all cameras.
        all_median: likewise.
        agreeing_mean: over the joints within 6 cm of their place in space, at its depth.
        agreeing_share: of all joints, those.
        agreeing_count: joints in images that agree, each the more the nearer, at all times of the recording: clocks by
            which two cameras show little at the same time have few.
    """

    mean: dict[str, float]
    median: dict[str, float]
    all_mean: float
    all_median: float
    agreeing_mean: float
    agreeing_share: float
    agreeing_count: float


@dataclass(frozen=True, slots=True, eq=False)
class RefinedRig:
    """A refined rig: cameras, seconds to add to each camera's stamps, agreement before and after, heights m.

    `uncertainty` is what the joints cannot tell of each camera.
    """

    cameras: dict[str, Camera]
    offsets: dict[str, float]
    before: Agreement
    after: Agreement
    heights: dict[str, float]
    period: float
    uncertainty: dict[str, PoseUncertainty]


def refine_rig(
    names: Sequence[str],
    cameras: Mapping[str, Camera],
    frames: CameraFrames,
    freedom: Freedom,
    scale: Scale,
    max_offset: float = 1.0,
) -> RefinedRig:
    """Refine approximate `cameras` by the people in their `frames`, whose joints are called `names`.

    PuppetError when no person is seen by two cameras long enough, or a camera sees nobody whom others see.
    """
    zero = dict.fromkeys(cameras, 0.0)
    starts = [zero]
    if freedom.clocks:
        coarse = find_coarse_offsets(names, cameras, frames, max_offset)
        # A turned camera may look as if it were late: both are tried, and where more joints agree is taken.
        starts += [coarse] if any(coarse.values()) else []
    found: list[tuple[float, Adjusted, PeopleTracks]] = []
    reason: PuppetError | None = None
    for start in starts:
        if found and _is_near(start, found[0][1].offsets, found[0][2].period):
            continue
        try:
            found.append(_refine_from(start, names, cameras, frames, freedom))
        except PuppetError as error:
            reason = reason or error
    if not found:
        assert reason is not None
        raise reason
    _, refined, tracks = max(found, key=lambda each: each[0])
    factor, heights = _find_scale(tracks, refined, scale)
    return RefinedRig(
        scale_to(refined.cameras, factor),
        refined.offsets,
        measure_agreement(cameras, zero, tracks),
        measure_agreement(refined.cameras, refined.offsets, tracks),
        {person: height * factor for person, height in heights.items()},
        tracks.period,
        bound_uncertainty(refined.cameras, refined.offsets, tracks),
    )


def _is_near(one: Mapping[str, float], other: Mapping[str, float], period: float) -> bool:
    return all(abs(one[name] - other[name]) <= _NEAR_PERIODS * period for name in one)


def _refine_from(
    offsets: Mapping[str, float],
    names: Sequence[str],
    cameras: Mapping[str, Camera],
    frames: CameraFrames,
    freedom: Freedom,
) -> tuple[float, Adjusted, PeopleTracks]:
    """Refine from the given `offsets`; return how many joints agree, the cameras, and people's tracks."""
    current = Adjusted(dict(cameras), dict(offsets))
    for _ in range(_PASSES):
        tracks = associate_tracks(names, current.cameras, frames, current.offsets, _ASSOCIATION, _TRIANGULATION)
        _check_tracks(tracks, list(cameras))
        current = adjust(current.cameras, current.offsets, cameras, tracks, freedom)
        factor = match_baselines(current.cameras, cameras)
        current = replace(current, cameras=place_as_before(scale_to(current.cameras, factor), cameras))
    return measure_agreement(current.cameras, current.offsets, tracks).agreeing_count, current, tracks


def _check_tracks(tracks: PeopleTracks, names: list[str]) -> None:
    counts = dict.fromkeys(names, 0)
    for person in tracks.tracks.values():
        for name, track in person.items():
            counts[name] += int(np.count_nonzero(track.weight))
    poor = [name for name, count in counts.items() if count < _MIN_OBSERVATIONS]
    if poor:
        raise PuppetError(
            f"{', '.join(poor)} shows nobody whom the other cameras show: check that the calibration belongs to these "
            "videos, that no two cameras are swapped, and that people walk where several cameras see them"
        )


def _find_scale(tracks: PeopleTracks, rig: Adjusted, scale: Scale) -> tuple[float, dict[str, float]]:
    """Return the factor for all lengths and everybody's height before it, m."""
    joints, people = _triangulate_everybody(tracks, rig.cameras, rig.offsets)
    heights = {person: measure_height(tracks.names, each) for person, each in zip(people, joints, strict=True)}
    known = {person: height for person, height in heights.items() if np.isfinite(height)}
    if scale.cameras is not None:
        unknown = [name for name in scale.cameras if name not in rig.cameras]
        if unknown:
            raise InputError(f"there is no camera {unknown[0]!r}; the cameras are {', '.join(rig.cameras)}")
        first, second = (rig.cameras[name].centre for name in scale.cameras)
        return scale.distance / float(np.linalg.norm(first - second)), known
    if scale.height:
        if not known:
            raise InputError("nobody's legs and trunk are seen by two cameras: the height fixes no scale")
        return scale.height / next(iter(known.values())), known
    return 1.0, known


def _triangulate_everybody(
    tracks: PeopleTracks, cameras: Mapping[str, Camera], offsets: Mapping[str, float]
) -> tuple[F64, list[str]]:
    """Return the joints (P, T, J, 3) m of everybody at the chosen instants, and their ids."""
    instants = choose_instants(tracks, list(cameras))
    plane, weight = instants.observe(np.array([offsets.get(name, 0.0) for name in cameras]))
    points = triangulate_linear(*_poses(cameras), plane, weight)
    return points.reshape(len(tracks.tracks), len(instants.times), len(tracks.names), 3), list(tracks.tracks)


def _poses(cameras: Mapping[str, Camera]) -> tuple[F64, F64]:
    return np.stack([c.rotation for c in cameras.values()]), np.stack([c.translation for c in cameras.values()])


def measure_agreement(cameras: Mapping[str, Camera], offsets: Mapping[str, float], tracks: PeopleTracks) -> Agreement:
    """Measure how far joints are from the projections of their robust place in space, px."""
    instants = choose_instants(tracks, list(cameras))
    plane, weight = instants.observe(np.array([offsets.get(name, 0.0) for name in cameras]))
    rotation, translation = _poses(cameras)
    focal = np.array([camera.focal for camera in cameras.values()])
    points = triangulate_median(rotation, translation, plane, weight, _ROBUST_PX / float(focal.mean()))
    distance = np.linalg.norm(measure_residuals(rotation, translation, plane, points), axis=2)
    depth = np.einsum("ck,nk->cn", rotation[:, 2], points) + translation[:, 2, None]
    used = (weight > 0) & np.isfinite(points).all(axis=1)
    error, metres = distance * focal[:, None], np.nan_to_num(distance * depth)
    agrees = used & (metres < AGREE_M)
    by_camera = {name: error[k][used[k]] for k, name in enumerate(cameras) if used[k].any()}
    some = used.any()
    return Agreement(
        {name: float(each.mean()) for name, each in by_camera.items()},
        {name: float(np.median(each)) for name, each in by_camera.items()},
        float(error[used].mean()) if some else float("nan"),
        float(np.median(error[used])) if some else float("nan"),
        float(error[agrees].mean()) if agrees.any() else float("nan"),
        float(agrees.sum() / used.sum()) if some else float("nan"),
        float((1 - (metres[agrees] / AGREE_M) ** 2).sum()),
    )
