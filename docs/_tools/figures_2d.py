# SPDX-License-Identifier: Apache-2.0
"""Figures of the 2D model, of puppet flow and of tracking, on a synthetic person."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np

from flowing_puppet_ros.cli.sample.ds import draw_picture
from flowing_puppet_ros.draw.flow_colour import flow_scale, flow_to_rgb
from flowing_puppet_ros.draw.overlay import DrawnPuppet, draw_puppets
from flowing_puppet_ros.draw.palette import part_colours
from flowing_puppet_ros.draw.pictures import join_row, make_contact_sheet
from flowing_puppet_ros.draw.plots import Series, draw_line_plot
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.tracking.tracker import FlowingPuppetTracker, TrackResult
from flowing_puppet_ros.model.ds.multiview import VIEW_HEADINGS, MultiViewStructures
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.render import depth_order, render_labels
from flowing_puppet_ros.model.ds.shape import PuppetShape

SIZE = (320, 400)
SCALE = 190.0
NECK = np.array([160.0, 130.0])
LEVELS = ((0, 190, 0), (220, 30, 30), (40, 60, 230))  # inside, on, outside
Picture = np.ndarray[Any, Any]


@dataclass(frozen=True)
class DrawnPerson:
    """A synthetic person who walks swinging the left forearm; every part has a texture that moves with it."""

    seed: int = 4

    @cached_property
    def model(self) -> DeformableStructures:
        """The model that draws the person."""
        return DeformableStructures.load()

    @cached_property
    def _textures(self) -> list[Picture]:
        rng = np.random.default_rng(self.seed)
        tones = part_colours(self.model.tree.names).astype(float)
        made = []
        for tone in tones:
            noise = rng.normal(0, 55, (40, 40, 1)) + tone
            small = np.clip(noise, 0, 255).astype(np.uint8)
            made.append(np.asarray(cv2.resize(small, None, fx=6, fy=6, interpolation=cv2.INTER_CUBIC)))
        return made

    @cached_property
    def _ground(self) -> Picture:
        rng = np.random.default_rng(self.seed + 1)
        small = rng.integers(60, 210, (25, 20, 3)).astype(np.uint8)
        return np.asarray(cv2.resize(small, SIZE, interpolation=cv2.INTER_CUBIC))

    def joints(self, time: float) -> np.ndarray:
        """Return the joints (J, 2) px at a time in frames."""
        names = list(self.model.joint_names)
        likely = self.model.likely_puppet().joints
        joints = (likely - likely[names.index("neck")]) * SCALE + NECK + [1.2 * time, 0.0]
        elbow, wrist = names.index("left_elbow"), names.index("left_wrist")
        angle = -0.9 + 0.8 * np.sin(0.16 * time)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        joints[wrist] = joints[elbow] + turn @ (joints[wrist] - joints[elbow])
        return np.asarray(joints)

    def shape(self, time: float) -> PuppetShape:
        """Return the puppet on those joints."""
        return self.model.puppet_from_joints(self.joints(time), SCALE)

    def image(self, time: float) -> Picture:
        """Draw the image (H, W, 3) at a time in frames."""
        image, shape = self._ground.copy(), self.shape(time)
        for part in depth_order(self.model):
            a, b = shape.joints[self.model.bone[part]]
            along = (b - a) / np.linalg.norm(b - a)
            across = np.array([-along[1], along[0]])
            move = np.column_stack([along, across, a - 110 * (along + across)])
            mask = cv2.fillPoly(np.zeros(SIZE[::-1], np.uint8), [np.round(shape.contours[part]).astype(np.int32)], 1)
            cv2.copyTo(cv2.warpAffine(self._textures[part], move, SIZE), mask, image)
        return image

    def drawn(self, time: float) -> DrawnPuppet:
        """Return the puppet as the overlay draws it."""
        shape = self.shape(time)
        certain = np.ones(len(shape.joints))
        names, parts = self.model.joint_names, self.model.tree.names
        return DrawnPuppet("", names, shape.joints, certain, parts, shape.contours, depth_order(self.model))


def ds_samples() -> Picture:
    """Draw eight random puppets."""
    model, rng = DeformableStructures.load(), np.random.default_rng(3)
    return make_contact_sheet([draw_picture(model, model.sample(rng)) for _ in range(8)], 8)


def ds_bend() -> Picture:
    """Draw one arm at five angles of the elbow."""
    person, pictures = DrawnPerson(), []
    names, parts = list(person.model.joint_names), person.model.tree.names
    arm = [parts.index("left_upper_arm"), parts.index("left_lower_arm")]
    elbow, wrist = names.index("left_elbow"), names.index("left_wrist")
    for degrees in (-150, -100, -50, 0, 40):
        joints, angle = person.joints(0.0), np.radians(degrees)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        upper = joints[elbow] - joints[names.index("left_shoulder")]
        length = np.linalg.norm(joints[wrist] - joints[elbow])
        joints[wrist] = joints[elbow] + turn @ upper / np.linalg.norm(upper) * length
        shape = person.model.puppet_from_joints(joints, SCALE)
        middle = joints[elbow] - np.array([70, 70])
        contours = tuple((shape.contours[part] - middle) * 1.5 for part in arm)
        certain = np.ones(3)
        shown = (shape.joints[[names.index("left_shoulder"), elbow, wrist]] - middle) * 1.5
        chosen = ("left_shoulder", "left_elbow", "left_wrist")
        drawn = DrawnPuppet("", chosen, shown, certain, tuple(parts[part] for part in arm), contours, (0, 1))
        pictures.append(draw_puppets(np.full((210, 210, 3), 255, np.uint8), [drawn], opacity=0.8, labels=False))
    return make_contact_sheet(pictures, 5)


def ds_views() -> Picture:
    """Draw the most probable puppet of every view."""
    sides = MultiViewStructures.load()
    pictures = [
        draw_picture(side, side.likely_puppet(), angle) for side, angle in zip(sides.views, VIEW_HEADINGS, strict=True)
    ]
    return make_contact_sheet(pictures, 9)


def labels() -> Picture:
    """Draw a puppet on an image and its label image."""
    person = DrawnPerson()
    image = draw_puppets(person.image(0), [person.drawn(0)], labels=False)
    found = render_labels(person.shape(0).contours, depth_order(person.model), SIZE[::-1])
    colours = np.vstack([[[30, 30, 30]], part_colours(person.model.tree.names)]).astype(np.uint8)
    return join_row([person.image(0), image, colours[found]], SIZE[1])


def contour() -> Picture:
    """Draw the cells of the contour term along one arm."""
    person, factor = DrawnPerson(), 3
    image = np.asarray(cv2.resize(person.image(0), None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC))
    for name in ("left_upper_arm", "left_lower_arm"):
        points = person.shape(0).contours[person.model.tree.names.index(name)]
        chosen = points[np.arange(14) * len(points) // 14]
        following = points[(np.arange(14) * len(points) // 14 + 1) % len(points)]
        along = (following - chosen) / np.linalg.norm(following - chosen, axis=1, keepdims=True)
        inward = np.column_stack([-along[:, 1], along[:, 0]])
        inward *= np.sign(((points.mean(axis=0) - chosen) * inward).sum(axis=1))[:, None]
        cell = 0.03 * SCALE
        for side, colour in zip((1, 0, -1), LEVELS, strict=True):
            for place, turn in zip(chosen + side * cell * inward, along, strict=True):
                corners = cv2.boxPoints(
                    (tuple(factor * place), (factor * cell,) * 2, np.degrees(np.arctan2(*turn[::-1])))
                )
                cv2.polylines(image, [np.round(corners).astype(np.int32)], True, colour, 2, cv2.LINE_AA)
    centre = factor * person.shape(0).joints[person.model.joint_names.index("left_elbow")]
    left, top = np.maximum(np.round(centre - [200, 210]).astype(int), 0)
    return image[top : top + 420, left : left + 400]


def puppet_flow() -> Picture:
    """Draw two frames, the flow between them, and the puppet flow."""
    person = DrawnPerson()
    times = (0.0, 2.0)
    tracker = FlowingPuppetTracker(person.model)
    tracker.step(person.image(times[0]), 0, [detection(person, times[0])])
    result = tracker.step(person.image(times[1]), 1, None)
    moved = result.puppet_flow()
    assert moved is not None and result.flow is not None
    scale = flow_scale(result.flow[0])
    frames = [person.image(times[0]), draw_puppets(person.image(times[1]), [shown(person, result)], labels=False)]
    return join_row([*frames, flow_to_rgb(result.flow[0], scale), flow_to_rgb(moved.field, scale)], 300)


def shown(person: DrawnPerson, result: TrackResult) -> DrawnPuppet:
    """Return a tracked puppet as the overlay draws it."""
    (puppet,) = result.puppets
    template = person.drawn(0)
    return replace(template, joints=puppet.joints, confidence=puppet.confidence, contours=puppet.contours)


def detection(person: DrawnPerson, time: float, shift: np.ndarray | float = 0.0) -> Keypoints:
    """Return the person as a detector reports it."""
    return Keypoints(person.model.joint_names, person.joints(time) + shift, np.full(len(person.joints(0)), 0.9))


def tracking() -> str:
    """Plot the error of the swinging wrist: detections, flow alone, both."""
    person, rng, frames = DrawnPerson(), np.random.default_rng(8), 48
    wrist = person.model.joint_names.index("left_wrist")
    alone, fused = FlowingPuppetTracker(person.model), FlowingPuppetTracker(person.model)
    errors = np.zeros((3, frames))
    for time in range(frames):
        truth, image = person.joints(time), person.image(time)
        noise = rng.normal(0, 4.0, truth.shape)
        if time % 8 == 5:
            noise[wrist] += rng.normal(0, 45.0, 2)
        noisy = detection(person, time, noise)
        flown = alone.step(image, time, [detection(person, 0)] if time == 0 else None)
        both = fused.step(image, time, [noisy])
        for index, joints in enumerate((noisy.xy, flown.puppets[0].joints, both.puppets[0].joints)):
            errors[index, time] = np.linalg.norm(joints[wrist] - truth[wrist])
    names = ("detections", "flow alone", "both")
    x = np.arange(frames, dtype=float)
    lines = [Series(f"{name} ({errors[k].mean():.1f} px)", x, errors[k]) for k, name in enumerate(names)]
    return standalone(
        draw_line_plot(lines, "error of the left wrist", "frame", "error, px"), [line.name for line in lines]
    )


def standalone(plot: str, names: list[str]) -> str:
    """Return a plot of `draw.plots` as an SVG file, with its own colours and legend."""
    svg = plot[: plot.index("</svg>")].replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ', 1)
    colours = ("#b23a48", "#2f6f9f", "#2a9d5c")
    style = "text{font:12px sans-serif;fill:#333}.line{fill:none;stroke-width:1.8}.grid{stroke:#ddd}"
    style += ".centre{text-anchor:middle}.end{text-anchor:end}.mid{dominant-baseline:middle}"
    style += "".join(f".s{k}{{stroke:{colour}}}" for k, colour in enumerate(colours))
    legend = "".join(
        f'<text x="{90 + 190 * k}" y="24" style="fill:{colour};font-weight:bold">{name}</text>'
        for k, (name, colour) in enumerate(zip(names, colours, strict=True))
    )
    return f"{svg}<style>{style}</style>{legend}</svg>"


FIGURES = {
    function.__name__: function for function in (ds_samples, ds_bend, ds_views, labels, contour, puppet_flow, tracking)
}
