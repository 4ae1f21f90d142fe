# SPDX-License-Identifier: Apache-2.0
"""The report's section on people in the clouds of one sensor: the scene from above, tracks, and what was no person."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from flowing_puppet_ros.bag.reader import Bag
from flowing_puppet_ros.draw.palette import list_person_colours
from flowing_puppet_ros.draw.plots import ticks
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.bag.recording import Recording, body_joints, sensor_cloud_topics, to_cloud
from flowing_puppet_ros.report.page import paragraph, table
from flowing_puppet_ros.report.pictures.bag_pictures import body_axes, read_messages
from flowing_puppet_ros.stream.messages.clouds import decode_cloud

WIDTH, MAX_HEIGHT = 820, 700  # of the picture, px
LEFT, RIGHT, TOP, BOTTOM = 56, 14, 14, 42  # margins around it, px
MAX_DOTS = 4000
MARGIN_M = 3.0
"""Around what is shown."""
MIN_OVER_FLOOR_M, MAX_OVER_FLOOR_M = 0.25, 2.5
"""Points lower than this over the lowest joint are drawn as the floor, higher ones as the ceiling not at all."""
MAX_GAP = 3.0
"""Times the usual step between clouds, from which on a track is interrupted."""
MIN_SHOWN = 0.1
"""Probability to be a person from which on a rejected candidate is in the picture wherever it is."""
MAX_REASONS = 12
"""Rejected candidates in the table, the likeliest."""
_LAST_CLOUDS = 3  # that are tried, in case the last one is damaged


@dataclass(frozen=True, slots=True, eq=False)
class TrackAbove:
    """Places (T, 2) m, forward and left, of a person's hips at `seconds` (T,) since the start."""

    seconds: np.ndarray
    places: np.ndarray


@dataclass(frozen=True, slots=True)
class RejectedMark:
    """What was no person: its place, m forward and left, the probability to be one, and why."""

    forward: float
    left: float
    probability: float
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class AboveData:
    """The people in the clouds from above: x is forward, y left, z up, in metres; the sensor is at the origin.

    `points` (N, 3) are those of the cloud at `seconds`, with the height over the floor; `frame` is that of the clouds.
    """

    frame: str
    tracks: dict[str, TrackAbove]
    points: np.ndarray
    seconds: float
    rejected: list[RejectedMark]


def gather_above(recording: Recording, given: Bag, summary: Mapping[str, Any]) -> AboveData | None:
    """Gather the people in the clouds or depth images of a sensor; None if there are none, or no such topic."""
    topics = sensor_cloud_topics(recording)
    stamps = sorted(stamp for stamp, bodies in recording.bodies.items() if bodies)
    if not topics or not stamps:
        return None
    joints = {
        stamp: {body.id: found for body in recording.bodies[stamp] if (found := body_joints(body))} for stamp in stamps
    }
    turn = _choose_level_axes([each for people in joints.values() for each in people.values()])
    floor = min(
        (turn[2] @ p for people in joints.values() for each in people.values() for p in each.values()), default=0
    )
    tracks = {
        identity: TrackAbove(
            np.array([(s - recording.start) * 1e-9 for s in stamps if identity in joints[s]]),
            np.array([turn[:2] @ _find_middle(joints[s][identity]) for s in stamps if identity in joints[s]]),
        )
        for identity in dict.fromkeys(identity for stamp in stamps for identity in joints[stamp])
    }
    shown = stamps[-_LAST_CLOUDS:]
    told = {int(each["stamp_ns"]): each["candidates"] for each in summary.get("rejected", {}).values()}
    stamp, points = stamps[-1], np.zeros((0, 3))
    for (_, at), message in read_messages(given, {topics[0]: {*shown, *told}}):
        with suppress(InputError):
            cloud = to_cloud(recording, topics[0], message)
            if cloud.header.frame_id == recording.body_frame:
                stamp, points = at, decode_cloud(cloud)[0] @ turn.T - [0, 0, floor]
    rejected = [_place_rejected(one, turn) for one in told.get(stamp, ())]
    return AboveData(recording.body_frame, tracks, points, (stamp - recording.start) * 1e-9, rejected)


def _place_rejected(one: Mapping[str, Any], turn: np.ndarray) -> RejectedMark:
    """Return the mark of a rejected candidate of the replay's summary."""
    forward, left, _ = turn @ np.array(one["place"], float)
    return RejectedMark(float(forward), float(left), float(one["probability"]), str(one["reason"]))


def _find_middle(joints: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the middle of the hips, or of all joints without hips, (3,)."""
    hips = [joints[name] for name in ("left_hip", "right_hip") if name in joints]
    return np.asarray(np.mean(hips or list(joints.values()), axis=0))


def _choose_level_axes(people: Sequence[Mapping[str, np.ndarray]]) -> np.ndarray:
    """Return forward, left and up (3, 3) in the clouds' frame: x, y, z, or z, -x, -y of an optical frame.

    A camera that looks down is turned level by the people, who stand upright in the mean.
    """
    names = [f"{side}_{joint}" for side in ("left", "right") for joint in ("shoulder", "hip")]
    whole = [each for each in people if set(names) <= set(each)]
    ups = np.array([body_axes(each)[2] for each in whole]).reshape(-1, 3)
    if not len(ups) or ups.mean(axis=0)[2] > 0.5:
        return np.eye(3)
    trunks = [each[names[0]] + each[names[2]] - each[names[1]] - each[names[3]] for each in whole]
    mean = np.mean([trunk / max(float(np.linalg.norm(trunk)), 1e-9) for trunk in trunks], axis=0)
    up = mean / np.linalg.norm(mean)
    ahead = np.array([0.0, 0.0, 1.0]) - up[2] * up
    ahead /= np.linalg.norm(ahead)
    return np.stack([ahead, np.cross(up, ahead), up])


def make_above_section(above: AboveData) -> str:
    """Make the section: the picture, what it shows, and why what was rejected is nobody."""
    html = paragraph(
        f"Seen from above, in the frame {above.frame or 'of the clouds'}: the sensor is the cross at 0, 0, x is "
        f"forward and y left. Grey dots are the cloud at {above.seconds:.2f} s, pale where it is the floor. Each line "
        "is where a person's hips were, in the colour of the id, which stands at its end; a ring is where it begins. "
        "If the sensor moves, so do the tracks of those who stand."
    )
    html += draw_above(above)
    if not above.rejected:
        return html
    likeliest = sorted(above.rejected, key=lambda one: -one.probability)[:MAX_REASONS]
    rows = [
        (str(number), f"{one.forward:.1f}", f"{one.left:.1f}", f"{one.probability:.2f}", one.reason)
        for number, one in enumerate(likeliest, start=1)
    ]
    caption = (
        f"What was looked at in that cloud and is nobody ({len(above.rejected)}, grey crosses; the likeliest are "
        "numbered)."
    )
    return html + table(("number", "forward [m]", "left [m]", "probability", "reason"), rows, (1, 2, 3), caption)


def draw_above(above: AboveData) -> str:
    """Draw the scene from above as an `<svg>`, x to the right and y up, equal in scale."""
    view = _View.around(above)
    body = [view.draw_grid(), view.draw_dots(above.points)]
    likeliest = sorted(above.rejected, key=lambda one: -one.probability)
    body += [
        view.draw_rejected(one, number if number <= MAX_REASONS else None)
        for number, one in enumerate(likeliest, start=1)
    ]
    x, y = view.place(np.zeros((1, 2)))[0]
    body.append(f'<path d="M{x - 7:.1f},{y:.1f}h14M{x:.1f},{y - 7:.1f}v14" stroke="currentColor" stroke-width="2"/>')
    colours = list_person_colours(above.tracks)
    body += [
        view.draw_track(identity, track, "rgb({},{},{})".format(*colours[identity]))
        for identity, track in above.tracks.items()
    ]
    title = f"The scene from above with the tracks of {', '.join(above.tracks)}"
    return (
        f'<svg class="plot above" viewBox="0 0 {WIDTH} {view.height:.0f}" role="img" aria-label="{escape(title)}">'
        f"<title>{escape(title)}</title>{''.join(body)}</svg>"
    )


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """The part that is shown, (2,) m, and pixels a metre."""

    low: np.ndarray
    high: np.ndarray
    scale: float

    @classmethod
    def around(cls, above: AboveData) -> _View:
        """Return the view of all tracks, the sensor, and rejected candidates that were not far from being people."""
        places = [np.zeros((1, 2)), *(track.places for track in above.tracks.values())]
        places += [np.array([[one.forward, one.left]]) for one in above.rejected if one.probability > MIN_SHOWN]
        joined = np.concatenate(places)
        low, high = joined.min(axis=0) - MARGIN_M, joined.max(axis=0) + MARGIN_M
        scale = min((WIDTH - LEFT - RIGHT) / (high - low)[0], (MAX_HEIGHT - TOP - BOTTOM) / (high - low)[1])
        # The width is there anyway.
        spare = (WIDTH - LEFT - RIGHT) / scale - (high - low)[0]
        beside = np.array([spare / 2, 0.0])
        return cls(low - beside, high + beside, scale)

    @property
    def height(self) -> float:
        """Height of the picture, px."""
        return float(TOP + BOTTOM + self.scale * (self.high - self.low)[1])

    def place(self, places: np.ndarray) -> np.ndarray:
        """Return the pixels (N, 2) of places (N, 2) m."""
        return (places - [self.low[0], self.high[1]]) * [self.scale, -self.scale] + [LEFT, TOP]

    def draw_grid(self) -> str:
        bottom = self.height - BOTTOM
        step = ticks(0.0, float((self.high - self.low).max()), 10)[1]
        parts = []
        for k in range(int(np.ceil(self.low[0] / step)), int(self.high[0] // step) + 1):
            x = self.place(np.array([[k * step, 0.0]]))[0, 0]
            parts.append(f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{TOP}" y2="{bottom:.1f}" class="grid"/>')
            parts.append(f'<text x="{x:.1f}" y="{bottom + 16:.1f}" class="tick centre">{k * step:g}</text>')
        for k in range(int(np.ceil(self.low[1] / step)), int(self.high[1] // step) + 1):
            y = self.place(np.array([[0.0, k * step]]))[0, 1]
            parts.append(f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}" class="grid"/>')
            parts.append(f'<text x="{LEFT - 6}" y="{y:.1f}" class="tick end mid">{k * step:g}</text>')
        middle = (TOP + bottom) / 2
        parts.append(
            f'<text x="{(LEFT + WIDTH - RIGHT) / 2}" y="{self.height - 6:.1f}" class="tick centre">x, forward [m]'
            f'</text><text x="14" y="{middle:.1f}" class="tick centre" transform="rotate(-90 14 {middle:.1f})">'
            "y, left [m]</text>"
        )
        return "".join(parts)

    def draw_dots(self, points: np.ndarray) -> str:
        """Draw points (N, 3): what stands over the floor, and the floor paler, one dot a place where there are many."""
        inside = ((points[:, :2] > self.low) & (points[:, :2] < self.high)).all(axis=1)
        points = points[inside & (points[:, 2] < MAX_OVER_FLOOR_M)]
        high = points[:, 2] > MIN_OVER_FLOOR_M
        return "".join(
            f'<path class="{name}" d="{_make_dots(self.place(part[:, :2]))}"/>'
            for name, part in (("floor", points[~high]), ("cloud", points[high]))
            if len(part)
        )

    def draw_rejected(self, one: RejectedMark, number: int | None) -> str:
        place = np.array([one.forward, one.left])
        if (place < self.low).any() or (place > self.high).any():
            return ""
        x, y = self.place(place[None])[0]
        text = "" if number is None else f'<text x="{x + 7:.1f}" y="{y - 5:.1f}">{number}</text>'
        return (
            f'<g class="rejected"><title>{escape(one.reason)}</title>'
            f'<path d="M{x - 4:.1f},{y - 4:.1f}l8,8m0,-8l-8,8"/>{text}</g>'
        )

    def draw_track(self, identity: str, track: TrackAbove, colour: str) -> str:
        pixels = self.place(track.places)
        steps = np.diff(track.seconds)
        usual = np.median(steps) if len(steps) else 0.0
        runs = np.split(pixels, np.flatnonzero(steps > MAX_GAP * usual) + 1)
        d = "".join("M" + "L".join(f"{x:.1f},{y:.1f}" for x, y in run) for run in runs)
        (x0, y0), (x, y) = pixels[0], pixels[-1]
        anchor = ' class="end"' if x > WIDTH - RIGHT - 40 else ""
        return (
            f'<g class="track" style="stroke:{colour}"><path d="{d}" class="line"/>'
            f'<circle cx="{x0:.1f}" cy="{y0:.1f}" r="4" fill="none"/>'
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="5" style="fill:{colour}"/></g>'
            f'<text x="{x + (-9 if anchor else 9):.1f}" y="{y - 8:.1f}"{anchor} style="fill:{colour};font-weight:600;'
            f'font-size:15px">{escape(identity)}</text>'
        )


def _make_dots(pixels: np.ndarray) -> str:
    """Return the path of at most MAX_DOTS of the pixels (N, 2), one for each that has any, thinned at random."""
    cells = np.unique(np.rint(pixels / 2).astype(int) * 2, axis=0)
    if len(cells) > MAX_DOTS:
        cells = np.random.default_rng(0).choice(cells, MAX_DOTS, replace=False)
    return "".join(f"M{x},{y}h0" for x, y in cells.tolist())
