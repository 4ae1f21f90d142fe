# SPDX-License-Identifier: Apache-2.0
"""Errors of bodies fitted to colour and depth of people whose every vertex is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.body.fit.fitter import BodyFit
from flowing_puppet_ros.body.fit.visibility import Visibility, rate_joints
from flowing_puppet_ros.evaluate.body.bodies import is_flipped
from flowing_puppet_ros.evaluate.rgbd.keypoints import LIMB_JOINTS
from flowing_puppet_ros.evaluate.rgbd.views import RgbdFrame
from flowing_puppet_ros.evaluate.scene.reliability import BIN_EDGES, CLOSE_M
from flowing_puppet_ros.model.sp import StitchedPuppet

MIN_WRONG_M = 0.06  # mean error of the vertices, or of the seen joints of people who are cut off, of a wrong body
MIN_LOST_M = 0.15  # error of a seen elbow or wrist that is lost
MAX_HIT_M = 0.10  # error of a joint that is where it is said to be; a joint's confidence is the probability of it
MAX_SURFACE_GAP_M = 0.02  # from the true surface at its pixel to a vertex that is seen

type CalibrationRow = dict[str, float | str]


@dataclass(frozen=True, slots=True)
class RgbdScore:
    """One fit against the truth; distances are means in metres, NaN where there is nothing to compare.

    Attributes:
        cut: one of CUTS, or of LOSSES of whole people.
        found: whether there is a body.
        vertex_error: over all vertices of the template.
        seen_vertex_error, hidden_vertex_error: over those that the depth camera sees, and over the others.
        seen_error, unseen_error: over the limbs' joints that are in view, and over the others, see `SeenKeypoints`.
        visible_error: over the joints that nothing hides, not even the person's own body.
        stature_error: fitted minus true.
        flipped: whether the body is nearer to the truth with left and right swapped.
        wrong: whether the vertices of a whole person, or the seen joints of others, are off by more than 6 cm.
        lost_arms, seen_arms: elbows and wrists in view that are off by more than 15 cm, and all in view.
        reliable, confidence: as reported by the fit.
        seconds: processor time of the fit.
        joints, hits: limbs' joints by `Visibility` (inferred, near, seen), and those of them that are off by less than
            10 cm.
    """

    cut: str
    found: bool
    vertex_error: float
    seen_vertex_error: float
    hidden_vertex_error: float
    seen_error: float
    unseen_error: float
    visible_error: float
    stature_error: float
    flipped: bool
    wrong: bool
    lost_arms: int
    seen_arms: int
    reliable: bool
    confidence: float
    seconds: float
    joints: tuple[int, int, int] = (0, 0, 0)
    hits: tuple[int, int, int] = (0, 0, 0)


def score_body(
    model: StitchedPuppet, fit: BodyFit | None, to_world: F64, frame: RgbdFrame, person: int, cut: str, seconds: float
) -> RgbdScore:
    """Compare a fit, or that there is none, with the `person`-th body of a frame.

    `to_world` (4, 4) takes the fit's frame into the frame's world.
    """
    truth, seen = frame.bodies[person], frame.seen[person]
    arms = np.array([name.endswith(("elbow", "wrist")) for name in LIMB_JOINTS]) & seen.in_view
    nan = float("nan")
    if fit is None:
        number = int(arms.sum())
        return RgbdScore(
            cut, False, nan, nan, nan, nan, nan, nan, nan, False, True, number, number, False, 0.0, seconds
        )  # fmt: skip
    vertices = fit.vertices @ to_world[:3, :3].T + to_world[:3, 3]
    rows = [model.joint_names.index(name) for name in LIMB_JOINTS]
    joints = (fit.joints @ to_world[:3, :3].T + to_world[:3, 3])[rows]
    template = truth.template_vertices(model.name)
    vertex_errors = np.linalg.norm(vertices - template, axis=1)
    vertex_error, shown = float(vertex_errors.mean()), _find_shown(frame, person, template)
    visibility = fit.visibility.joints[rows]
    error = np.linalg.norm(joints - frame.joints[person], axis=1)
    seen_error = _mean(error[seen.in_view])
    return RgbdScore(
        cut=cut,
        found=True,
        vertex_error=vertex_error,
        seen_vertex_error=_mean(vertex_errors[shown]),
        hidden_vertex_error=_mean(vertex_errors[~shown]),
        seen_error=seen_error,
        unseen_error=_mean(error[~seen.in_view]),
        visible_error=_mean(error[seen.visible]),
        stature_error=model.measure_height(fit.state.shape) - truth.stature,
        flipped=is_flipped(vertices, template, model),
        wrong=(vertex_error if cut == "whole" else seen_error) > MIN_WRONG_M,
        lost_arms=int((error[arms] > MIN_LOST_M).sum()),
        seen_arms=int(arms.sum()),
        reliable=fit.reliable,
        confidence=fit.confidence,
        seconds=seconds,
        joints=_count_levels(visibility),
        hits=_count_levels(visibility[error < MAX_HIT_M]),
    )


def summarise_rgbd(scores: Sequence[RgbdScore]) -> dict[str, float | str]:
    """Summarise the fits of one kind; distances in centimetres, over the bodies that were found."""

    def mean(name: str) -> float:
        return 100 * _mean(np.array([getattr(score, name) for score in scores]))

    joints, hits = (np.array([getattr(score, name) for score in scores]).sum(axis=0) for name in ("joints", "hits"))
    share = hits / np.maximum(joints, 1)
    stature = 100 * np.array([score.stature_error for score in scores])
    return {
        "cut": scores[0].cut,
        "bodies": len(scores),
        "missed": sum(not score.found for score in scores),
        "vertices_cm": mean("vertex_error"),
        "seen_vertices_cm": mean("seen_vertex_error"),
        "hidden_vertices_cm": mean("hidden_vertex_error"),
        "seen_cm": mean("seen_error"),
        "visible_cm": mean("visible_error"),
        "unseen_cm": mean("unseen_error"),
        "stature_cm": _mean(stature),
        "stature_off_cm": _mean(np.abs(stature)),
        "flipped": sum(score.flipped for score in scores),
        "over_6_cm": sum(score.wrong for score in scores),
        "unreliable": sum(not score.reliable for score in scores),
        "wrong_reliable": sum(score.wrong and score.reliable for score in scores),
        "seconds": float(np.mean([score.seconds for score in scores])),
        **{
            f"{level.name.lower()}_hits": float(share[level]) if joints[level] else float("nan") for level in Visibility
        },
    }


def tabulate_calibration(scores: Sequence[RgbdScore]) -> list[CalibrationRow]:
    """Tabulate what confidence is said of joints and bodies, and the share of them that is right.

    A joint is right within 10 cm, a body if its joints in view are in the mean. Joints are told apart by their
    visibility, and by whether their body is reliable; bodies by their confidence, and by whether they are reliable.
    """
    found = [score for score in scores if score.found]
    rows = [
        row
        for level in reversed(Visibility)
        for reliable in (True, False)
        if (row := _count_joints([score for score in found if score.reliable is reliable], level, reliable))
    ]
    known = [score for score in found if np.isfinite(score.seen_error)]
    place = np.digitize([score.confidence for score in known], BIN_EDGES[1:-1])
    for k in reversed(range(len(BIN_EDGES) - 1)):
        for reliable in (True, False):
            own = [score for score, bin_ in zip(known, place, strict=True) if bin_ == k and score.reliable is reliable]
            if own:
                right = float(np.mean([score.seen_error < CLOSE_M for score in own]))
                said = float(np.mean([score.confidence for score in own]))
                rows.append(_make_row(f"bodies from {BIN_EDGES[k]}", reliable, len(own), said, right))
    return rows


def _count_joints(scores: Sequence[RgbdScore], level: Visibility, reliable: bool) -> CalibrationRow | None:
    """Return the row of the joints of one visibility; None without any."""
    count = np.array([score.joints[level] for score in scores], dtype=float)
    if not count.sum():
        return None
    hits = sum(score.hits[level] for score in scores)
    said = [float(rate_joints(np.array([level]), score.reliable, score.confidence)[0]) for score in scores]
    kind = f"{level.name.lower()} joints"
    return _make_row(kind, reliable, int(count.sum()), float(count @ said / count.sum()), hits / float(count.sum()))


def _make_row(kind: str, reliable: bool, count: int, said: float, right: float) -> CalibrationRow:
    return {"kind": kind, "reliable": "yes" if reliable else "no", "count": count, "said": said, "within_10_cm": right}


def _find_shown(frame: RgbdFrame, person: int, vertices: F64) -> np.ndarray:
    """Return which vertices (V, 3) m of a true body, in the world, the depth camera sees, (V,) bool."""
    pixels, depth = frame.cameras.depth.project(vertices)
    height, width = frame.true_depth.shape
    column, row = np.rint(np.nan_to_num(pixels, nan=-1.0)).astype(np.int64).T
    inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    column, row = np.where(inside, column, 0), np.where(inside, row, 0)
    on_surface = np.abs(frame.true_depth[row, column] - depth) < MAX_SURFACE_GAP_M
    return np.asarray(inside & on_surface & (frame.person[row, column] == person))


def _count_levels(visibility: np.ndarray) -> tuple[int, int, int]:
    inferred, near, seen = (int(np.count_nonzero(visibility == level)) for level in Visibility)
    return inferred, near, seen


def _mean(values: F64) -> float:
    """Return the mean of the values that are known, NaN without any."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else float("nan")
