# SPDX-License-Identifier: Apache-2.0
"""A software renderer for meshes and points: z-buffer, Gouraud shading, no graphics card and no display.

    camera = fit_orthographic_camera(vertices, direction=(-1, 0, 0), size=(300, 480))  # front of a body facing +x
    picture = render(vertices, faces, camera, (300, 480), colours=face_colours)
    Image.fromarray(picture.rgb)

Anything with `project(points (N, 3)) -> (pixels (N, 2), depth (N,))` is a camera, if depth is linear in the points
(pinhole and orthographic cameras are). World axes as in REP-103: z is up. The result depends only on the input.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import product
from typing import Protocol

import cv2
import numpy as np
from numba import njit

MIN_DEPTH_M = 1e-3  # nearer faces and points are not drawn
MAX_COORDINATE_PX = 1e6  # points further outside of the image are not drawn
AMBIENT, HEADLIGHT, SKYLIGHT = 0.30, 0.58, 0.14  # shares of the light


class Projector(Protocol):
    """A camera, as far as the renderer needs it."""

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Map `points` (N, 3) to pixels (N, 2) and depths (N,), larger is farther."""


@dataclass(frozen=True, slots=True, eq=False)
class OrthographicCamera:
    """A camera infinitely far away: pixels = scale * (right, down) + offset; positive depth along the third axis."""

    axes: np.ndarray  # (3, 3), rows are right, down and forward in the world
    centre: np.ndarray  # (3,) world point that is shown at `offset`
    scale: float  # pixels per metre
    offset: np.ndarray  # (2,) pixels
    distance: float  # depth of the centre, metres

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Map `points` (N, 3) in metres to pixels (N, 2) and depths (N,) in metres."""
        local = (np.asarray(points, float) - self.centre) @ self.axes.T
        return local[:, :2] * self.scale + self.offset, local[:, 2] + self.distance


def fit_orthographic_camera(
    points: np.ndarray,
    direction: Sequence[float] | np.ndarray,
    size: tuple[int, int],
    up: Sequence[float] | np.ndarray = (0.0, 0.0, 1.0),
    margin: float = 0.05,
    scale: float | None = None,
) -> OrthographicCamera:
    """Make a camera that looks along `direction` (world) and shows all `points` (N, 3) in an image of (width, height).

    `margin` is the free part of the image on each side. `scale` in pixels per metre replaces the fitted one, so that
    several pictures can share it. `direction` must not be parallel to `up`.
    """
    forward = np.asarray(direction, float) / np.linalg.norm(direction)
    right = np.cross(forward, np.asarray(up, float))
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(forward, right), forward])
    local = np.asarray(points, float) @ axes.T
    low, high = local.min(axis=0), local.max(axis=0)
    extent = np.maximum((high - low)[:2], 1e-6)
    if scale is None:
        scale = float(np.min((1 - 2 * margin) * np.array(size) / extent))
    offset = (np.array(size, float) - 1) / 2
    return OrthographicCamera(axes, (low + high) / 2 @ axes, scale, offset, float(high[2] - low[2]) / 2 + 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class Rendering:
    """A picture: `rgb` (H, W, 3) uint8, `depth` (H, W) float32 (inf where empty), `coverage` (H, W) in [0, 1]."""

    rgb: np.ndarray
    depth: np.ndarray
    coverage: np.ndarray

    @property
    def mask(self) -> np.ndarray:
        """(H, W) bool, True where anything was drawn."""
        return self.coverage > 0


class Canvas:
    """A picture into which meshes and points are drawn, in any order: the nearest surface stays."""

    def __init__(self, camera: Projector, size: tuple[int, int], samples: int = 2) -> None:
        """Start an empty picture of (width, height) pixels with `samples` x `samples` sub-pixels each."""
        self.camera, self.size, self.samples = camera, size, samples
        self._depth = np.full((size[1] * samples, size[0] * samples), np.inf, np.float32)
        self._colour = np.zeros((*self._depth.shape, 3), np.float32)
        frame = np.vstack([np.zeros(3), np.eye(3)])
        depth = camera.project(frame)[1]
        self._forward = (depth[1:] - depth[0]) / np.linalg.norm(depth[1:] - depth[0])

    def draw_mesh(
        self,
        vertices: np.ndarray,
        faces: np.ndarray,
        colours: np.ndarray | Sequence[int] = (205, 205, 210),
        smooth: bool = True,
    ) -> None:
        """Draw `vertices` (V, 3) and `faces` (F, 3), counter-clockwise; `colours` (3,), (V, 3) or (F, 3), 0 to 255.

        Faces seen from inside are dark; faces that reach behind the camera or have NaN are left out.
        """
        vertices, faces = np.asarray(vertices, float), np.asarray(faces, np.int64)
        paint = np.asarray(colours, np.float32)
        if paint.ndim == 1:
            corners = np.broadcast_to(paint, (*faces.shape, 3))
        elif len(paint) == len(vertices):
            corners = paint[faces]
        else:
            corners = np.broadcast_to(paint[:, None], (*faces.shape, 3))
        normals = _vertex_normals(vertices, faces)[faces] if smooth else _face_normals(vertices, faces)[:, None]
        lit = np.ascontiguousarray(corners * self._shade(normals)[..., None], np.float32)
        pixels, depth = self._project(vertices)
        _fill_triangles(pixels, depth, faces, lit, self._depth, self._colour)

    def draw_points(
        self,
        points: np.ndarray,
        colours: np.ndarray | Sequence[int] = (40, 90, 160),
        radius: float = 1.5,
        normals: np.ndarray | None = None,
    ) -> None:
        """Draw `points` (N, 3) as discs of `radius` pixels, shaded by `normals`; `colours` (3,) or (N, 3), 0 to 255."""
        pixels, depth = self._project(np.asarray(points, float))
        light = np.ones(len(pixels)) if normals is None else self._shade(np.asarray(normals, float))
        lit = np.ascontiguousarray(np.asarray(colours, np.float32) * light[:, None], np.float32)
        _fill_discs(pixels, depth, lit, radius * self.samples, self._depth, self._colour)

    def compose(self, background: Sequence[int] | np.ndarray = (255, 255, 255), opacity: float = 1.0) -> Rendering:
        """Return the drawing with `opacity` over a colour (3,) or an image (H, W, 3); sub-pixels are averaged."""
        drawn = np.isfinite(self._depth).astype(np.float32)
        covered, total = (
            np.asarray(cv2.resize(values, self.size, interpolation=cv2.INTER_AREA)) for values in (drawn, self._colour)
        )
        rgb = opacity * total + (1 - opacity * covered[..., None]) * np.asarray(background, np.float32)
        shifts = product(range(self.samples), repeat=2)
        depth = reduce(np.minimum, [self._depth[row :: self.samples, column :: self.samples] for row, column in shifts])
        return Rendering(np.clip(np.rint(rgb), 0, 255).astype(np.uint8), depth, covered)

    def _project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pixels, depth = self.camera.project(points)
        pixels = (np.asarray(pixels, float) + 0.5) * self.samples - 0.5
        return np.ascontiguousarray(pixels), np.ascontiguousarray(depth, float)

    def _shade(self, normals: np.ndarray) -> np.ndarray:
        head = np.maximum(normals @ -self._forward, 0)
        sky = np.maximum(normals[..., 2], 0)
        return AMBIENT + HEADLIGHT * head + SKYLIGHT * sky


def render(
    vertices: np.ndarray,
    faces: np.ndarray,
    camera: Projector,
    size: tuple[int, int],
    colours: np.ndarray | Sequence[int] = (205, 205, 210),
    smooth: bool = True,
    background: Sequence[int] | np.ndarray = (255, 255, 255),
) -> Rendering:
    """Draw one mesh and return the picture; arguments as `Canvas.mesh` and `Canvas.picture` take them."""
    canvas = Canvas(camera, size)
    canvas.draw_mesh(vertices, faces, colours, smooth)
    return canvas.compose(background)


def _face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return _unit(np.cross(b - a, c - a))


def _vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    weighted = np.cross(b - a, c - a)  # length is twice the area, so that large faces weigh more
    normals = np.zeros_like(vertices)
    for k in range(3):
        for axis in range(3):
            normals[:, axis] += np.bincount(faces[:, k], weighted[:, axis], len(vertices))
    return _unit(normals)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


@njit(cache=True, nogil=True)
def _fill_triangles(pixels, depth, faces, corners, buffer, colour):  # type: ignore[no-untyped-def]
    height, width = buffer.shape
    for face in range(len(faces)):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        # Written so that NaN fails it too.
        if not (depth[a] > MIN_DEPTH_M and depth[b] > MIN_DEPTH_M and depth[c] > MIN_DEPTH_M):
            continue
        ax, ay, bx, by, cx, cy = pixels[a, 0], pixels[a, 1], pixels[b, 0], pixels[b, 1], pixels[c, 0], pixels[c, 1]
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if not (abs(area) > 1e-12 and abs(area) < 1e12):
            continue
        left, right = max(0, int(np.ceil(min(ax, bx, cx)))), min(width - 1, int(np.floor(max(ax, bx, cx))))
        top, bottom = max(0, int(np.ceil(min(ay, by, cy)))), min(height - 1, int(np.floor(max(ay, by, cy))))
        for y in range(top, bottom + 1):
            for x in range(left, right + 1):
                v = ((x - ax) * (cy - ay) - (cx - ax) * (y - ay)) / area
                w = ((bx - ax) * (y - ay) - (x - ax) * (by - ay)) / area
                u = 1.0 - v - w
                if u < 0 or v < 0 or w < 0:
                    continue
                # Linear in the image: the error against 1/z is far below the size of a body's faces.
                z = u * depth[a] + v * depth[b] + w * depth[c]
                if z < buffer[y, x]:
                    buffer[y, x] = z
                    for k in range(3):
                        colour[y, x, k] = u * corners[face, 0, k] + v * corners[face, 1, k] + w * corners[face, 2, k]


@njit(cache=True, nogil=True)
def _fill_discs(pixels, depth, colours, radius, buffer, colour):  # type: ignore[no-untyped-def]
    height, width = buffer.shape
    for point in range(len(pixels)):
        px, py, z = pixels[point, 0], pixels[point, 1], depth[point]
        if not (z > MIN_DEPTH_M and abs(px) < MAX_COORDINATE_PX and abs(py) < MAX_COORDINATE_PX):
            continue
        for y in range(max(0, int(np.ceil(py - radius))), min(height - 1, int(np.floor(py + radius))) + 1):
            for x in range(max(0, int(np.ceil(px - radius))), min(width - 1, int(np.floor(px + radius))) + 1):
                if (x - px) ** 2 + (y - py) ** 2 <= radius * radius and z < buffer[y, x]:
                    buffer[y, x] = z
                    for k in range(3):
                        colour[y, x, k] = colours[point, k]
