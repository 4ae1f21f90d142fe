# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment over joints: cameras and clocks by least squares, the joints themselves eliminated.

For given cameras the best place of each joint follows in closed form from its rays (variable projection), so that only
the cameras are unknown. Weights are those of a robust loss, fixed within a round and found anew after it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.multiview.bundle.joint_tracks import PeopleTracks
from flowing_puppet_ros.multiview.camera import Camera

_MAX_INSTANTS = 60
ROBUST_PX = 5.0  # of the robust loss, at 1000 px focal length
_SCALES_PX = (60.0, 30.0, 20.0, 10.0, 6.0, *[ROBUST_PX] * 8)  # of the robust loss, round by round
_TRIANGULATION_STEPS = 4
_MEDIAN_STEPS = 12
_MIN_DEPTH_M = 0.1  # of a joint in front of a camera
_STEPS = 3  # of Gauss-Newton in a round: new weights help more than many steps
# How far a camera is expected to be from where the former calibration has it: this keeps what the joints leave free,
# and is robust, so that a camera that was pushed is not held back. About its own axis a camera is held hardly at all:
# people on one spot tell that angle five times worse than the others, and a camera that was rolled would stay so.
TURN, ROLL, MOVE_M = np.radians(3.0), np.radians(10.0), 0.02
_CLOCK_PERIODS, _FOCAL, _CENTRE = 100.0, 0.003, 0.003
_PRIOR_JOINTS = 10.0  # joints that weigh as much as the expectation
_TURN_AND_MOVE = slice(0, 6)  # among the unknowns of a camera
_CLOCK_STEP = 0.25  # periods over which the velocity of joints is measured


@dataclass(frozen=True, slots=True)
class Freedom:
    """What is adjusted beside the extrinsics: clocks, and focal length and principal point of each camera."""

    clocks: bool = True
    intrinsics: bool = False

    @property
    def per_camera(self) -> int:
        """Number of unknowns of a camera: turn (3), move (3), clock, focal length, principal point (2)."""
        return 10


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted:
    """Cameras and clocks: `cameras` by name, and `offsets` in seconds to add to each camera's stamps."""

    cameras: dict[str, Camera]
    offsets: dict[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class _Instants:
    """Rays of the joints at chosen instants: times (M,) s, and the tracks of each person."""

    times: F64
    tracks: PeopleTracks
    names: tuple[str, ...]

    def observe(self, offsets: F64) -> tuple[F64, F64]:
        """Return the joints (C, N, 2) on the image planes and weights (C, N), with a camera's `offsets` (C,) s."""
        count = len(self.tracks.names)
        people = list(self.tracks.tracks.values())
        size = len(self.times), count
        plane, weight = [], []
        for name, offset in zip(self.names, offsets, strict=True):
            found = [
                person[name].interpolate(self.times - offset)
                if name in person
                else (np.zeros((*size, 2)), np.zeros(size))
                for person in people
            ]
            plane.append(np.concatenate([each.reshape(-1, 2) for each, _ in found]))
            weight.append(np.concatenate([each.reshape(-1) for _, each in found]))
        return np.stack(plane), np.stack(weight)


def choose_instants(tracks: PeopleTracks, names: Sequence[str]) -> _Instants:
    """Return instants that are spread over the time in which people are seen."""
    first, last = tracks.span
    count = int(min(_MAX_INSTANTS, max(2, round((last - first) / tracks.period))))
    times = np.linspace(first, last, count + 2)[1:-1]
    return _Instants(times, tracks, tuple(names))


def triangulate_linear(rotation: F64, translation: F64, plane: F64, weight: F64) -> F64:
    """Return the points (N, 3) nearest to weighted rays: the minimum of the squared error on the image planes.

    `rotation` (C, 3, 3), `translation` (C, 3), `plane` (C, N, 2), `weight` (C, N); NaN with fewer than two rays. The
    linear solution is refined by dividing by the depths that it finds.
    """
    depth = np.ones(weight.shape)
    enough = (weight > 0).sum(axis=0) >= 2
    root, pixels = np.sqrt(weight), np.swapaxes(plane, 1, 2)
    points = np.zeros((weight.shape[1], 3))
    for _ in range(_TRIANGULATION_STEPS):
        scale = (root / depth)[:, None]
        # (R_xy - plane R_z) X = plane t_z - t_xy, column by column: faster than many small matrices.
        columns = [
            ((rotation[:, :2, k, None] - pixels * rotation[:, 2, k, None, None]) * scale).reshape(-1, len(points))
            for k in range(3)
        ]
        right = ((pixels * translation[:, 2, None, None] - translation[:, :2, None]) * scale).reshape(-1, len(points))
        points = _solve_symmetric(columns, right)
        depth = rotation[:, 2] @ points.T + translation[:, 2, None]
        depth = np.where(depth > _MIN_DEPTH_M, depth, _MIN_DEPTH_M)
    return np.where(enough[:, None], points, np.nan)


def triangulate_median(rotation: F64, translation: F64, plane: F64, weight: F64, width: float) -> F64:
    """Return the points (N, 3) as `triangulate_linear` does, at the minimum of the distances rather than their squares.

    A ray that is far off does not draw the point to itself. `width` is the distance on the image plane at depth 1 below
    which the distance is squared.
    """
    points = triangulate_linear(rotation, translation, plane, weight)
    for _ in range(_MEDIAN_STEPS):
        error = np.linalg.norm(measure_residuals(rotation, translation, plane, points), axis=2)
        points = triangulate_linear(rotation, translation, plane, weight / np.maximum(error, width))
    return points


def _solve_symmetric(columns: Sequence[F64], right: F64) -> F64:
    """Return the least-squares solutions (N, 3) of N systems with `columns` (3 of (M, N)) and `right` (M, N)."""
    x, y, z = columns
    a, d, f = ((each * each).sum(axis=0) + 1e-12 for each in columns)
    b, c, e = (x * y).sum(axis=0), (x * z).sum(axis=0), (y * z).sum(axis=0)
    u, v, w = (x * right).sum(axis=0), (y * right).sum(axis=0), (z * right).sum(axis=0)
    # Cofactors of the symmetric matrix [[a, b, c], [b, d, e], [c, e, f]].
    p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
    s, t, g = a * f - c * c, b * c - a * e, a * d - b * b
    scale = 1 / np.maximum(a * p + b * q + c * r, 1e-300)
    return np.stack([p * u + q * v + r * w, q * u + s * v + t * w, r * u + t * v + g * w], axis=1) * scale[:, None]


def measure_residuals(rotation: F64, translation: F64, plane: F64, points: F64) -> F64:
    """Return projections minus observations (C, N, 2) on the image planes; 0 where `points` (N, 3) are NaN."""
    local = points @ np.swapaxes(rotation, 1, 2) + translation[:, None]
    return np.nan_to_num(local[..., :2] / np.maximum(local[..., 2:], _MIN_DEPTH_M) - plane)


def adjust(
    cameras: Mapping[str, Camera],
    offsets: Mapping[str, float],
    former: Mapping[str, Camera],
    tracks: PeopleTracks,
    freedom: Freedom,
) -> Adjusted:
    """Adjust cameras and clocks to the tracks, starting from `cameras` and expecting them near the `former` ones.

    The first camera's clock is the common one.
    """
    names = list(cameras)
    instants = choose_instants(tracks, names)
    start = np.array([offsets.get(name, 0.0) for name in names])
    state, expected = (
        CameraState.of([cameras[name] for name in names], start),
        CameraState.of([former[name] for name in names], start),
    )
    focal = np.array([cameras[name].focal for name in names])
    for scale in _SCALES_PX:
        state = _adjust_round(state, expected, instants, focal, scale, freedom)
    found = {name: state.apply(index, cameras[name]) for index, name in enumerate(names)}
    return Adjusted(found, {name: float(state.offset[index]) for index, name in enumerate(names)})


@dataclass(frozen=True, slots=True, eq=False)
class CameraState:
    """Cameras as arrays: rotation (C, 3, 3), centre (C, 3), offset (C,) s, lens (C, 3): focal factor, centre."""

    rotation: F64
    centre: F64
    offset: F64
    lens: F64

    @classmethod
    def of(cls, cameras: Sequence[Camera], offset: F64) -> CameraState:
        """Return the state of cameras whose lenses are as they are."""
        rotation, centre = np.stack([c.rotation for c in cameras]), np.stack([c.centre for c in cameras])
        return cls(rotation, centre, offset, np.tile([1.0, 0.0, 0.0], (len(cameras), 1)))

    @property
    def translation(self) -> F64:
        """World to camera (C, 3), m."""
        return -np.einsum("cij,cj->ci", self.rotation, self.centre)

    def move(self, step: F64, period: float) -> CameraState:
        """Return the state after a step (C, 10): turn of the camera, move of its centre, clock, lens."""
        turn = Rotation.from_rotvec(step[:, :3]).as_matrix()
        return CameraState(
            turn @ self.rotation, self.centre + step[:, 3:6], self.offset + step[:, 6] * period, self.lens + step[:, 7:]
        )

    def subtract(self, other: CameraState, period: float) -> F64:
        """Return the step (C, 10) that leads from another state here."""
        turn = Rotation.from_matrix(self.rotation @ np.swapaxes(other.rotation, 1, 2)).as_rotvec()
        clock = (self.offset - other.offset)[:, None] / period
        return np.concatenate([turn, self.centre - other.centre, clock, self.lens - other.lens], axis=1)

    def to_plane(self, plane: F64) -> F64:
        """Return points (C, N, 2) on the image planes of the former lenses on those of these."""
        return (plane - self.lens[:, None, 1:]) / self.lens[:, None, :1]

    def apply(self, index: int, camera: Camera) -> Camera:
        """Return a camera with what was found for it."""
        factor, cx, cy = self.lens[index]
        matrix = camera.matrix.copy()
        matrix[:2, 2] += matrix[:2, :2] @ np.array([cx, cy])
        matrix[:2, :2] *= factor
        return replace(camera, matrix=matrix, rotation=self.rotation[index], translation=self.translation[index])


def _adjust_round(
    state: CameraState, expected: CameraState, instants: _Instants, focal: F64, scale: float, freedom: Freedom
) -> CameraState:
    """Adjust with the weights of the robust loss at the state, of width `scale` px at 1000 px focal length."""
    cameras, period, width = len(focal), instants.tracks.period, scale / 1000.0
    plane, confidence = instants.observe(state.offset)
    weight = reweight(state, state.to_plane(plane), confidence, width)
    used = (weight > 0).sum(axis=0) >= 2
    plane, weight = plane[:, used], weight[:, used]
    # Joints move with their images' velocity while the clock is adjusted; positive offsets show earlier images.
    later, earlier = (instants.observe(state.offset + side * _CLOCK_STEP * period)[0][:, used] for side in (-1, 1))
    velocity = (later - earlier) / (2 * _CLOCK_STEP)
    free = np.zeros((cameras, freedom.per_camera), bool)
    free[:, :6] = True
    free[1:, 6] = freedom.clocks
    free[:, 7:] = freedom.intrinsics
    sigma = np.array([TURN] * 2 + [ROLL] + [MOVE_M] * 3 + [_CLOCK_PERIODS, _FOCAL, _CENTRE, _CENTRE])
    weight = weight * (focal / focal.mean() / width)[:, None] ** 2
    trust = _find_trust(state.subtract(expected, period) / sigma) / sigma
    start, known = state.offset, free.ravel()
    for _ in range(_STEPS):
        seen = state.to_plane(plane - ((state.offset - start) / period)[:, None, None] * velocity)
        normal, gradient = eliminate_joints(state, seen, velocity, weight)
        off = (trust**2 * state.subtract(expected, period)).ravel()
        normal = normal + np.diag((trust**2).ravel())
        step = np.zeros(known.shape)
        step[known] = -np.linalg.solve(normal[np.ix_(known, known)], (gradient + off)[known])
        state = state.move(step.reshape(free.shape), period)
    return state


def eliminate_joints(state: CameraState, seen: F64, velocity: F64, weight: F64) -> tuple[F64, F64]:
    """Return the normal equations (10C, 10C), (10C,) of the cameras, with the joints eliminated (Schur complement).

    `seen` (C, N, 2) are the joints on the image planes, which move by `velocity` (C, N, 2) a period, and `weight`
    (C, N) those of their squared errors.
    """
    points = triangulate_linear(state.rotation, state.translation, seen, weight)
    error = measure_residuals(state.rotation, state.translation, seen, points)
    local = np.einsum("cij,cnj->cni", state.rotation, points[None] - state.centre[:, None])
    x, y, z = np.moveaxis(local, 2, 0)
    depth = np.maximum(z, _MIN_DEPTH_M)
    one, none, u, v = np.ones_like(x), np.zeros_like(x), x / depth, y / depth
    by_turn = np.stack([np.stack([-u * v, 1 + u * u, -v], axis=2), np.stack([-1 - v * v, u * v, u], axis=2)], axis=2)
    image = np.stack([np.stack([one, none, -u], axis=2), np.stack([none, one, -v], axis=2)], axis=2)
    by_point = (image / depth[..., None, None]) @ state.rotation[:, None]
    factor = state.lens[:, 0, None, None]
    by_clock, by_focal = velocity / factor, seen / factor
    by_centre = np.broadcast_to(np.eye(2) / factor[..., None], (*x.shape, 2, 2))
    by_camera = np.concatenate([by_turn, -by_point, by_clock[..., None], by_focal[..., None], by_centre], axis=3)
    cameras, unknowns = len(state.centre), by_camera.shape[3]
    heavy = by_camera * weight[..., None, None]
    own = np.einsum("cnip,cniq->cpq", heavy, by_camera)
    mixed = np.einsum("cnip,cnik->ncpk", heavy, by_point).reshape(len(points), cameras * unknowns, 3)
    of_points = np.einsum("cn,cnik,cnil->nkl", weight, by_point, by_point) + 1e-12 * np.eye(3)
    pull = np.einsum("cn,cnik,cni->nk", weight, by_point, error)
    solved = np.linalg.solve(of_points, np.concatenate([np.swapaxes(mixed, 1, 2), pull[..., None]], axis=2))
    normal = -np.einsum("npk,nkq->pq", mixed, solved[..., :-1])
    for k in range(cameras):
        block = slice(k * unknowns, (k + 1) * unknowns)
        normal[block, block] += own[k]
    gradient = np.einsum("cnip,cni->cp", heavy, error).ravel() - np.einsum("npk,nk->p", mixed, solved[..., -1])
    return normal, gradient


def _find_trust(deviation: F64) -> F64:
    """Return the trust (C, 10) in what is expected of each camera, by its `deviation` (C, 10) from that.

    What is far from expected is free, each axis of turn and move by itself: a camera that was turned to the side still
    stands where it stood and is as level as it was, which a person on one spot hardly tells.
    """
    trust = np.ones_like(deviation)
    trust[:, _TURN_AND_MOVE] = 1 / (1 + deviation[:, _TURN_AND_MOVE] ** 2) ** 2
    return np.sqrt(_PRIOR_JOINTS) * trust


def reweight(state: CameraState, plane: F64, confidence: F64, width: float) -> F64:
    """Return the weights (C, N) of Geman-McClure at the robust places of the joints."""
    weight = confidence
    for _ in range(8):
        points = triangulate_linear(state.rotation, state.translation, plane, weight)
        error = np.linalg.norm(measure_residuals(state.rotation, state.translation, plane, points), axis=2)
        weight = confidence / (1 + (error / width) ** 2) ** 2
    return weight
