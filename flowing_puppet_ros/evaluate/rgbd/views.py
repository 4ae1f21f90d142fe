# SPDX-License-Identifier: Apache-2.0
"""People in a room seen by a colour and a depth camera, whole or cut off, with everything that is true about them.

    source = BodySource(Path("expmap_20hz.npz"))
    studio = RgbdStudio(source)  # one camera for both; RgbdStudio(source, make_pair()) has two
    frame = studio.draw_frame(np.random.default_rng(0), "knees")
    frame.depth, frame.rgb, frame.keypoints[0].pixels, frame.bodies[0].joints

World: metres, z up, floor at 0. `frame.depth_camera.to_camera(points)` takes points into the depth camera's frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from flowing_puppet_ros.arrays import F64, U8
from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource, TrueBody
from flowing_puppet_ros.evaluate.body.synthetic_scans import make_box
from flowing_puppet_ros.evaluate.rgbd.clothing import Wardrobe, paint_surroundings
from flowing_puppet_ros.evaluate.rgbd.depth_sensor import SENSORS, DepthSensor, sense_depth
from flowing_puppet_ros.evaluate.rgbd.keypoints import (
    LIMB_JOINTS,
    SeenKeypoints,
    draw_keypoints,
    find_visible,
    segment_person,
)
from flowing_puppet_ros.evaluate.rgbd.rendering import PaintedMesh, RayCamera, RenderedView
from flowing_puppet_ros.evaluate.scene.synthetic_scenes import draw_upright
from flowing_puppet_ros.image.networks.pose_networks import BlazePose
from flowing_puppet_ros.model import rotation
from flowing_puppet_ros.multiview.camera import Camera

CUTS = ("whole", "knees", "hips", "chest", "table")
"""What is seen of a person: everything, down to a joint at the lower border of the depth, or above a counter."""

DISTANCE_M, EYE_HEIGHT_M = (2.3, 3.5), (0.9, 1.6)  # of the camera
TABLE_DISTANCE_M, TABLE_DEPTH_M, TABLE_WIDTH_M = (0.3, 0.5), 0.6, 2.4  # from the person; of the counter
WALL_DISTANCE_M = (0.5, 2.0)  # behind the person
PEOPLE_GAP_M = (0.55, 0.85)  # between the middles of neighbours
NOISE_FOCAL_PX = 525.0
"""Focal length of the image that keypoints' noise is given for: in others, it is the same angle."""

MAX_CLEAN_ERROR_M = 0.05
IMAGE_GRAIN = 4.0  # standard deviation of the colour image's noise, of 255
MAX_TRUNK_ROLL_RAD = np.radians(3.0)  # of the camera


@dataclass(frozen=True, slots=True, eq=False)
class RgbdPair:
    """A depth camera, and a colour camera that is the same or stands beside it.

    Both have the extrinsics of the rig: the depth camera's frame is the rig's.
    """

    depth: Camera
    colour: Camera

    @property
    def registered(self) -> bool:
        """Whether both are one camera."""
        return self.depth.equals(self.colour)

    def place(self, turn: F64, eye: F64) -> RgbdPair:
        """Return the cameras with the depth camera at `eye` (3,) m, its axes the columns of `turn` (3, 3)."""
        return RgbdPair(self.depth.move(turn, eye), self.colour.move(turn, eye))


def make_camera(size: tuple[int, int] = (640, 480), focal: float = 525.0, lens: Sequence[float] = ()) -> Camera:
    """Return a camera with its principal point in the middle of the image."""
    matrix = [focal, 0, (size[0] - 1) / 2, 0, focal, (size[1] - 1) / 2, 0, 0, 1]
    return Camera.from_info(matrix, lens, *size, np.eye(3), np.zeros(3))


def make_registered() -> RgbdPair:
    """Return one camera of 640x480 pixels, focal length 525 px, for colour and depth: depth registered to colour."""
    return RgbdPair(make_camera(), make_camera())


def make_pair() -> RgbdPair:
    """Return a depth camera and a colour camera 5 cm to its right, turned a little, larger, with another lens."""
    colour = make_camera((1280, 720), 920.0, (0.09, -0.18, 0.001, -0.0008, 0.05))
    turn = rotation.exp(np.array([0.004, -0.012, 0.006]))
    return RgbdPair(make_camera(), replace(colour, rotation=turn, translation=turn @ np.array([-0.05, 0.002, -0.004])))


@dataclass(frozen=True, slots=True, eq=False)
class RgbdFrame:
    """One moment.

    Attributes:
        depth: (H, W) metres along the depth camera's axis, NaN where the sensor has no value.
        rgb: (h, w, 3) drawn image of the colour camera.
        cameras: both, with their places in the world.
        bodies: the people, in the world.
        joints: (P, 12, 3) m in the world, the bodies' LIMB_JOINTS.
        keypoints: per person, in the colour image.
        seen: per person, SeenKeypoints of the depth image without noise: `visible` and `in_view` of the depth camera.
        person: (H, W) index of the person at each pixel of the depth image, -1 for the room.
        true_depth: (H, W) metres without any error, infinite where nothing is.
    """

    depth: F64
    rgb: U8
    cameras: RgbdPair
    bodies: list[TrueBody]
    joints: F64
    keypoints: list[SeenKeypoints]
    seen: list[SeenKeypoints]
    person: np.ndarray
    true_depth: F64

    def clean(self, person: int) -> np.ndarray:
        """Return the pixels (H, W) bool that show a person, the flying ones at the edges left out."""
        with np.errstate(invalid="ignore"):
            return np.asarray((self.person == person) & (np.abs(self.depth - self.true_depth) < MAX_CLEAN_ERROR_M))

    @property
    def points(self) -> F64:
        """The organised cloud (H, W, 3) m in the depth camera's optical frame, NaN where nothing is known."""
        height, width = self.depth.shape
        u, v = np.meshgrid(np.arange(width), np.arange(height))
        plane = self.cameras.depth.undistort(np.stack([u, v], axis=-1))
        return np.asarray(np.concatenate([plane, np.ones((height, width, 1))], axis=-1) * self.depth[..., None])


class RgbdStudio:
    """Draws frames of people; the same generator gives the same frame."""

    def __init__(
        self,
        source: BodySource,
        cameras: RgbdPair | None = None,
        sensor: str = "structured",
        segmenter: BlazePose | None = None,
    ) -> None:
        """Take the people's source, the cameras in the rig's frame (registered if None), and a name of SENSORS.

        The `segmenter`, if there is one, makes the masks of the people in the drawn images.
        """
        self._segmenter = segmenter
        self.source, self.cameras = source, make_registered() if cameras is None else cameras
        self.sensor: DepthSensor = SENSORS[sensor]
        self._wardrobe = Wardrobe(source)
        self._limbs = [source.joint_names.index(name) for name in LIMB_JOINTS]
        self._depth_rays = RayCamera(self.cameras.depth)
        self._colour_rays = self._depth_rays if self.cameras.registered else RayCamera(self.cameras.colour)

    def draw_frame(
        self, rng: np.random.Generator, cut: str = "whole", people: int = 1, noise: float = 5.0, any_pose: bool = False
    ) -> RgbdFrame:
        """Draw people in poses of the motion capture, seen as one of CUTS says.

        People stand or walk; with `any_pose` a whole person may also crouch, bend or sit. Keypoints have `noise` px.
        """
        first = (
            self.source.draw_body(rng, hard=False) if any_pose and cut == "whole" else draw_upright(self.source, rng)
        )
        bodies = [first, *(draw_upright(self.source, rng) for _ in range(people - 1))]
        eye_angle = rng.uniform(-np.pi, np.pi)
        side = np.array([-np.sin(eye_angle), np.cos(eye_angle), 0.0])
        offset = np.concatenate([[0.0], np.cumsum(rng.uniform(*PEOPLE_GAP_M, people - 1))])
        offset -= offset.mean()
        ahead = np.array([np.cos(eye_angle), np.sin(eye_angle), 0.0])
        depth = rng.uniform(-0.15, 0.15, people)
        bodies = [body.translate(offset[k] * side + depth[k] * ahead) for k, body in enumerate(bodies)]
        cameras = self.place_cameras(rng, bodies, cut, ahead)
        room = self.furnish(rng, bodies, cameras, cut)
        return self.look(rng, bodies, room, cameras, noise)

    def place_cameras(self, rng: np.random.Generator, bodies: Sequence[TrueBody], cut: str, ahead: F64) -> RgbdPair:
        """Place the cameras in the direction `ahead` (3,) of the people, with the lower border where `cut` says."""
        middle = np.mean([body.vertices.mean(axis=0) for body in bodies], axis=0)
        eye = middle * [1, 1, 0] + rng.uniform(*DISTANCE_M) * ahead + np.array([0, 0, rng.uniform(*EYE_HEIGHT_M)])
        below = self._cut_height(bodies[0], cut)
        away = float(np.linalg.norm((middle - eye)[:2]))
        if below is None:
            low, high = (
                np.min([b.vertices[:, 2].min() for b in bodies]),
                np.max([b.vertices[:, 2].max() for b in bodies]),
            )
            pitch = (np.arctan2(eye[2] - low, away) + np.arctan2(eye[2] - high, away)) / 2
        else:
            height = self.cameras.depth.size[1]
            plane = self.cameras.depth.undistort(
                [self.cameras.depth.matrix[0, 2], height - self.sensor.border[3] - 0.5]
            )
            pitch = np.arctan2(eye[2] - below - rng.uniform(-0.03, 0.03), away) - np.arctan(plane[1])
        return self.cameras.place(look_along(middle - eye, float(pitch), rng.normal(0, MAX_TRUNK_ROLL_RAD / 2)), eye)

    def furnish(
        self, rng: np.random.Generator, bodies: Sequence[TrueBody], cameras: RgbdPair, cut: str = "whole"
    ) -> list[PaintedMesh]:
        """Make a floor, a wall behind the people, two cupboards beside them and, for `table`, a counter before them."""
        middle = np.mean([body.vertices.mean(axis=0) for body in bodies], axis=0) * [1, 1, 0]
        away = (middle - cameras.depth.centre) * [1, 1, 0]
        away /= np.linalg.norm(away)
        side = np.array([-away[1], away[0], 0.0])
        frame = np.stack([away, side, [0.0, 0.0, 1.0]], axis=1)
        everyone = np.concatenate([body.vertices for body in bodies])
        reach = ((everyone - middle) @ away).max(), ((everyone - middle) @ away).min()
        wall = reach[0] + rng.uniform(*WALL_DISTANCE_M)
        boxes = [
            make_box(middle + np.array([0, 0, -0.05]), np.array([9.0, 9.0, 0.1]), frame),
            make_box(middle + (wall + 0.05) * away + np.array([0, 0, 1.8]), np.array([0.1, 9.0, 3.6]), frame),
        ]
        for sign in (-1, 1):
            size = rng.uniform((0.35, 0.4, 0.5), (0.5, 0.9, 1.9))
            beside = sign * rng.uniform(1.5, 2.2) + 0.4 * sign * (len(bodies) - 1)
            place = middle + beside * side + (wall - size[0] / 2) * away + np.array([0, 0, size[2] / 2])
            boxes.append(make_box(place, size, frame))
        if cut == "table":
            top = self._cut_height(bodies[0], "hips") or 0.0
            near = reach[1] - rng.uniform(*TABLE_DISTANCE_M) - TABLE_DEPTH_M / 2
            size = np.array([TABLE_DEPTH_M, TABLE_WIDTH_M, top])
            boxes.append(make_box(middle + near * away + np.array([0, 0, top / 2]), size, frame))
        return paint_surroundings(boxes, rng)

    def look(
        self,
        rng: np.random.Generator,
        bodies: Sequence[TrueBody],
        room: Sequence[PaintedMesh],
        cameras: RgbdPair,
        noise: float = 5.0,
        colour_bodies: Sequence[TrueBody] | None = None,
    ) -> RgbdFrame:
        """Sense `bodies` in a `room` by both cameras; `colour_bodies` are the people at the colour image's time."""
        # The errors of one part do not depend on the size of another's image.
        for_depth, for_image, for_keypoints = rng.spawn(3)
        meshes = [*(self._wardrobe.dress(body, k) for k, body in enumerate(bodies)), *room]
        view = self._render(self._depth_rays, cameras.depth, meshes)
        depth = sense_depth(view.depth, view.cosine, cameras.depth.focal, self.sensor, for_depth)
        later = bodies if colour_bodies is None else colour_bodies
        colour = view
        if not self.cameras.registered or colour_bodies is not None:
            clothed = [*(self._wardrobe.dress(body, k) for k, body in enumerate(later)), *room]
            colour = self._render(self._colour_rays, cameras.colour, clothed)
        grainy = colour.rgb + IMAGE_GRAIN * for_image.standard_normal(colour.rgb.shape)
        rgb = np.clip(np.rint(grainy), 0, 255).astype(np.uint8)
        joints = np.array([body.joints[self._limbs] for body in bodies]).reshape(-1, len(self._limbs), 3)
        scaled = noise * cameras.colour.focal / NOISE_FOCAL_PX
        keypoints, seen = [], []
        for k, body in enumerate(later):
            there = body.joints[self._limbs]
            flags = find_visible(there, cameras.colour, colour, k)
            drawn = draw_keypoints(for_keypoints, there, cameras.colour, *flags, scaled)
            keypoints.append(drawn if self._segmenter is None else segment_person(self._segmenter, rgb, drawn))
            seen.append(self._see_exactly(joints[k], cameras.depth, view, k))
        return RgbdFrame(
            depth, rgb, cameras, list(bodies), joints, keypoints, seen, view.person, view.depth,
        )  # fmt: skip

    @staticmethod
    def _render(rays: RayCamera, camera: Camera, meshes: Sequence[PaintedMesh]) -> RenderedView:
        return rays.place(camera).render(meshes)

    def _see_exactly(self, joints: F64, camera: Camera, view: RenderedView, person: int) -> SeenKeypoints:
        visible, in_view = find_visible(joints, camera, view, person)
        left, top, right, bottom = self.sensor.border
        pixels = camera.project(joints)[0]
        low, high = np.array([left, top]) - 0.5, np.array(camera.size) - (right, bottom) - 0.5
        inside = ((pixels > low) & (pixels < high)).all(axis=1)
        return SeenKeypoints(pixels, inside.astype(float), visible & inside, in_view & inside)

    def _cut_height(self, body: TrueBody, cut: str) -> float | None:
        """Return the height in metres at which a person is cut off; None where nothing is cut."""
        joint = dict(zip(self.source.joint_names, body.joints[:, 2], strict=True))
        knees, hips, shoulders = (
            (joint[f"left_{name}"] + joint[f"right_{name}"]) / 2 for name in ("knee", "hip", "shoulder")
        )
        return {"knees": knees, "hips": hips, "chest": 0.4 * hips + 0.6 * shoulders}.get(cut)


def look_along(direction: F64, pitch: float, roll: float = 0.0) -> F64:
    """Return the axes (3, 3), as columns right, down and forward, of a camera that looks along a horizontal direction.

    `pitch` rad is downwards. `roll` rad is about the optical axis.
    """
    heading = direction * [1.0, 1.0, 0.0]
    heading = heading / np.linalg.norm(heading)
    right = np.array([heading[1], -heading[0], 0.0])
    forward = np.cos(pitch) * heading - np.sin(pitch) * np.array([0.0, 0.0, 1.0])
    axes = np.stack([right, np.cross(forward, right), forward], axis=1)
    return np.asarray(axes @ rotation.exp(np.array([0.0, 0.0, roll])))
