# SPDX-License-Identifier: Apache-2.0
"""Figures of the 3D model and of fits to samples of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from flowing_puppet_ros.body.cloud.correspondence import Cloud, two_way_distance
from flowing_puppet_ros.body.fit.initialisation import flip_heading, sample_bodies
from flowing_puppet_ros.body.refine.gauss_newton import GaussNewton, RefineWeights
from flowing_puppet_ros.body.search.dpmp import BodyParticleSearch, SearchWeights
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.body.search.part_points import build_part_points
from flowing_puppet_ros.body.search.particles import particles_to_state, states_to_particles
from flowing_puppet_ros.body.search.proposals import Proposer
from flowing_puppet_ros.body.search.schedule import WIDE, four_stages
from flowing_puppet_ros.draw.mesh_render import Canvas, OrthographicCamera, fit_orthographic_camera, render
from flowing_puppet_ros.draw.palette import part_colours
from flowing_puppet_ros.draw.pictures import add_caption, make_contact_sheet
from flowing_puppet_ros.evaluate.body.synthetic_scans import sample_surface
from flowing_puppet_ros.evidence.cloud.data_term import CloudGrid
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.visual_hull import HullSettings, bounds_of_joints, visual_hull

FRONT, ASIDE = (-1.0, -0.35, -0.12), (-1.0, 0.9, -0.2)
NOISE, POINTS = 0.003, 4000
GREY = (150, 150, 155)
Picture = np.ndarray[Any, Any]


class Bodies:
    """The model, a body drawn from it, and a cloud on that body."""

    def __init__(self) -> None:
        """Draw the body and its cloud."""
        self.model = StitchedPuppet.load()
        self.colours = part_colours(self.model.tree.names)
        self.body = self.model.sample(np.random.default_rng(12), pose_scale=0.9)
        self.truth = self.model.vertices(self.body)
        rng = np.random.default_rng(5)
        points, self.normals = sample_surface(self.truth, self.model.faces, rng, POINTS)
        self.points = points + NOISE * rng.standard_normal(points.shape)
        self.recorded = Recorded(self.model, build_part_points(self.model), SearchWeights())

    def searched(self) -> BodyState:
        """Search for the body in the cloud, recording the particles."""
        if not self.recorded.bodies:
            rng = np.random.default_rng(1)
            grid = CloudGrid.build(self.points, self.normals)
            bodies = sample_bodies(self.model, self.points.mean(axis=0), 30, rng)
            start, stages = states_to_particles(self.model, bodies), four_stages(self.model.tree)
            self.recorded.optimise(start, grid, JointTargets.none(self.model), stages, 40, rng)
        return self.recorded.bodies[-1]

    def picture(self, vertices: np.ndarray, camera: OrthographicCamera, size: tuple[int, int]) -> Picture:
        """Render a body in the colours of its parts."""
        colours = self.colours[self.model.part_of_vertex].astype(float)
        return render(vertices, self.model.faces, camera, size, colours).rgb

    def parts_picture(self, states: Sequence[BodyState], camera: OrthographicCamera, size: tuple[int, int]) -> Picture:
        """Return the mean of pictures of bodies, whose parts are drawn one by one with the gaps between them."""
        total = np.zeros((size[1], size[0], 3))
        for state in states:
            canvas = Canvas(camera, size)
            for part, mesh in enumerate(self.model.parts(state)):
                canvas.draw_mesh(mesh, self.model.part_faces[part], self.colours[part])
            total += canvas.compose().rgb
        return np.asarray(total / len(states)).astype(np.uint8)


class Recorded(BodyParticleSearch):
    """A search that keeps the best body and some particles of every round."""

    def __init__(self, *given: Any) -> None:
        """Start with nothing recorded."""
        super().__init__(*given)
        self.bodies: list[BodyState] = []
        self.particles: list[list[BodyState]] = []

    def _improve_and_select(self, *given: Any) -> Any:
        scored = super()._improve_and_select(*given)
        first = np.zeros(len(scored), dtype=np.int64)
        groups = [group.particles for group in scored]
        self.bodies.append(self._state(groups, first))
        self.particles.append([self._state(groups, first + k) for k in range(min(map(len, groups)))])
        return scored

    def _state(self, groups: Any, chosen: np.ndarray) -> BodyState:
        return particles_to_state(self._model, groups, chosen)


def sp_samples(made: Bodies) -> Picture:
    """Draw eight random bodies."""
    size, pictures = (200, 330), []
    for seed in (0, 1, 2, 3, 4, 5, 7, 9):
        vertices = made.model.vertices(made.model.sample(np.random.default_rng(seed)))
        pictures.append(made.picture(vertices, fit_orthographic_camera(vertices, FRONT, size, scale=150.0), size))
    return make_contact_sheet(pictures, 8)


def sp_modes(made: Bodies) -> Picture:
    """Draw shape components of the body, and pose components of the torso, from -2 to +2."""
    size, steps, pictures = (150, 250), (-2.0, 0.0, 2.0), []
    rest = made.model.rest_state()
    for component in range(3):
        for step in steps:
            shape = rest.shape.copy()
            shape[:, component] = step
            vertices = made.model.vertices(restitched(made.model, replace(rest, shape=shape)))
            pictures.append(made.picture(vertices, fit_orthographic_camera(vertices, FRONT, size, scale=115.0), size))
    for component in range(3):
        for step in steps:
            pose = np.zeros(made.model.pose_count(0))
            pose[component] = step
            mesh = made.model.part_mesh(0, np.zeros(3), np.eye(3), pose, np.zeros(made.model.shape_count))
            camera = fit_orthographic_camera(mesh, ASIDE, size, scale=210.0)
            pictures.append(render(mesh, made.model.part_faces[0], camera, size, made.colours[0]).rgb)
    return make_contact_sheet(pictures, 9)


def restitched(model: StitchedPuppet, state: BodyState) -> BodyState:
    """Return the same shapes and rotations with the centres that close the interfaces."""
    center = state.center.copy()
    for parent, child in model.tree.edges:
        interface = model.interfaces[child - 1]
        mesh = model.part_mesh(parent, center[parent], state.rotation[parent], state.pose[parent], state.shape[parent])
        own = model.local_vertices(child, state.pose[child], state.shape[child])[interface.child_index]
        offsets = mesh[interface.parent_index] - own @ state.rotation[child].T
        center[child] = np.average(offsets, axis=0, weights=interface.weight)
    return replace(state, center=center)


def stitching(made: Bodies) -> Picture:
    """Draw separated parts with the gaps between their interface points, and the stitched body."""
    size, rng = (330, 430), np.random.default_rng(3)
    proposer = Proposer(made.model, build_part_points(made.model))
    walked = [proposer.random_walk(group, WIDE, rng) for group in states_to_particles(made.model, [made.body])]
    apart = particles_to_state(made.model, walked, np.zeros(len(walked), dtype=np.int64))
    camera = fit_orthographic_camera(made.truth, FRONT, size, margin=0.12)
    canvas = Canvas(camera, size)
    meshes = made.model.parts(apart)
    for part, mesh in enumerate(meshes):
        canvas.draw_mesh(mesh, made.model.part_faces[part], 0.45 * made.colours[part] + 140)
    for (parent, child), interface in zip(made.model.tree.edges, made.model.interfaces, strict=True):
        ends = meshes[parent][interface.parent_index], meshes[child][interface.child_index]
        steps = np.linspace(0, 1, 30)[:, None, None]
        springs = ((1 - steps) * ends[0][::4] + steps * ends[1][::4]).reshape(-1, 3)
        towards = -0.25 * camera.axes[2]
        canvas.draw_points(springs + towards, (190, 30, 40), 0.5)
        canvas.draw_points(np.concatenate(ends) + towards, (20, 20, 20), 1.0)
    stitched = made.parts_picture([made.body], camera, size)
    return make_contact_sheet([canvas.compose().rgb, stitched], 2)


def dpmp(made: Bodies) -> Picture:
    """Draw the particles and the best bodies of a search."""
    made.searched()
    size = (230, 300)
    camera = fit_orthographic_camera(made.truth, FRONT, size, margin=0.14)
    rounds = (0, 4, 12, 24, 39)
    above, below = [], []
    for number in rounds:
        above.append(
            add_caption(made.parts_picture(made.recorded.particles[number], camera, size), f"round {number + 1}")
        )
        canvas = Canvas(camera, size)
        canvas.draw_points(made.points, GREY, 0.8)
        state = made.recorded.bodies[number]
        for part, mesh in enumerate(made.model.parts(state)):
            canvas.draw_mesh(mesh, made.model.part_faces[part], made.colours[part])
        below.append(canvas.compose().rgb)
    return make_contact_sheet([*above, *below], len(rounds))


def fit_stages(made: Bodies) -> Picture:
    """Draw a cloud, the body found by the search, and the refined body."""
    size = (270, 380)
    camera = fit_orthographic_camera(made.truth, FRONT, size, margin=0.1)
    canvas = Canvas(camera, size)
    canvas.draw_points(made.points, GREY, 1.0)
    searched = made.searched()
    cloud = Cloud.of(made.points, made.normals)
    done = GaussNewton(made.model).run(searched, cloud, JointTargets.none(made.model), RefineWeights())
    pictures = [add_caption(canvas.compose().rgb, "cloud")]
    for name, state in (("search", searched), ("finish", done)):
        vertices = made.model.vertices(state)
        error = 1000 * np.linalg.norm(vertices - made.truth, axis=1).mean()
        pictures.append(add_caption(made.picture(vertices, camera, size), f"{name}: {error:.0f} mm"))
    return make_contact_sheet(pictures, 3)


def hypotheses(made: Bodies) -> Picture:
    """Draw a refined body, and the refinement of the same body facing backwards."""
    size = (270, 380)
    camera = fit_orthographic_camera(made.truth, FRONT, size, margin=0.1)
    cloud = Cloud.of(made.points, made.normals)
    pictures = []
    for name, state in (("as found", made.searched()), ("turned around", flip_heading(made.model, made.searched()))):
        done = GaussNewton(made.model).run(state, cloud, JointTargets.none(made.model), RefineWeights())
        vertices = made.model.vertices(done)
        distance = 1000 * two_way_distance(vertices, made.model.faces, cloud)
        canvas = Canvas(camera, size)
        canvas.draw_mesh(vertices, made.model.faces, made.colours[made.model.part_of_vertex].astype(float))
        canvas.draw_points(made.points - 0.02 * camera.axes[2], (60, 60, 60), 0.6)
        pictures.append(add_caption(canvas.compose().rgb, f"{name}: {distance:.1f} mm"))
    return make_contact_sheet(pictures, 2)


def hull(made: Bodies) -> Picture:
    """Draw four silhouettes, their visual hull, and the body."""
    cameras = [camera_around(angle) for angle in (20.0, 110.0, 200.0, 290.0)]
    masks = []
    for camera in cameras:
        seen = Canvas(PinholeView(camera), camera.size)
        seen.draw_mesh(made.truth, made.model.faces)
        masks.append(np.where(seen.compose().coverage > 0.5, 255, 0).astype(np.uint8))
    bounds = bounds_of_joints(made.model.joints(made.truth), 0.3)
    assert bounds is not None
    points, normals = visual_hull(cameras, masks, bounds, HullSettings(voxel=0.01))
    size = (240, 320)
    view = fit_orthographic_camera(made.truth, FRONT, size, margin=0.1)
    carved = Canvas(view, size)
    carved.draw_points(points, (170, 180, 205), 2.2, normals)
    shown = [np.repeat(255 - mask[..., None], 3, axis=2) for mask in masks]
    return make_contact_sheet([*shown, carved.compose().rgb, made.picture(made.truth, view, size)], 6)


class PinholeView:
    """A calibrated camera with the interface of the renderer."""

    def __init__(self, camera: Camera) -> None:
        """Wrap a camera."""
        self._camera = camera

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Map (N,3) points to pixels (N,2) and depths (N,)."""
        seen = points @ self._camera.rotation.T + self._camera.translation
        homogeneous = seen @ self._camera.matrix.T
        return homogeneous[:, :2] / homogeneous[:, 2:], seen[:, 2]


def camera_around(degrees: float, distance: float = 3.2, size: tuple[int, int] = (240, 320)) -> Camera:
    """Return a camera at hip height that looks at the origin."""
    angle = np.radians(degrees)
    eye = distance * np.array([np.cos(angle), np.sin(angle), 0.1])
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    k = [430.0, 0.0, size[0] / 2, 0.0, 430.0, size[1] / 2, 0.0, 0.0, 1.0]
    return Camera.from_info(k, np.zeros(5), *size, rotation, -rotation @ eye)


FIGURES = {
    function.__name__: function for function in (sp_samples, sp_modes, stitching, dpmp, fit_stages, hypotheses, hull)
}
