# SPDX-License-Identifier: Apache-2.0
"""Joints that trackers get wrong: exchanged sides, views that contradict one another, limbs behind somebody else."""

import numpy as np
from walkers import NAMES, photograph, ring, walker  # type: ignore[import-not-found]

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.multiview.association.people_tracker import PeopleTracker3D, PersonInSpace
from flowing_puppet_ros.multiview.association.track_3d import find_bones
from flowing_puppet_ros.multiview.association.view import CalibratedView, PersonInView
from flowing_puppet_ros.multiview.association.weights import doubt_hidden_joints

CAMERAS = ring()
STEP_NS = 33_000_000
SIDES = np.array([NAMES.index(n.replace("left", "RIGHT").replace("right", "left").lower()) for n in NAMES])
WRIST, ANKLE = NAMES.index("left_wrist"), NAMES.index("left_ankle")


def truth(k: int) -> F64:
    return walker((0.01 * k, 0.2), 0.4, 0.15 * k)


def follow(spoil: object, sets: int = 30) -> list[tuple[PersonInSpace, F64]]:
    """Return the person of each set and the true joints; `spoil(k, seen)` makes the views worse."""
    assert callable(spoil)
    random, tracker = np.random.default_rng(7), PeopleTracker3D(NAMES)
    results = []
    for k in range(sets):
        seen = photograph(CAMERAS, {"ann": truth(k)}, 1.0, random)
        spoil(k, seen)
        (person,) = tracker.step(k * STEP_NS, CAMERAS, seen)
        results.append((person, truth(k)))
    return results


def test_limbs_that_two_of_four_cameras_exchange_are_put_right() -> None:
    """The votes are even; what decides is where the limbs were before."""

    def exchange(k: int, seen: dict[str, list[PersonInView]]) -> None:
        for name in ("cam1", "cam3") if k >= 12 else ():
            seen[name][0].joints[:] = seen[name][0].joints[SIDES]

    results = follow(exchange)
    errors = np.stack([np.linalg.norm(person.joints - joints, axis=1) for person, joints in results])
    assert np.nanmax(errors[14:]) < 0.04 and np.isfinite(errors[14:]).all()
    last, _ = results[-1]
    straight, _ = CAMERAS["cam1"].project(truth(29))
    assert np.abs(last.seen["cam1"].joints - straight).max() < 5  # exchanged back


def test_two_wrong_views_against_two_right_ones_do_not_move_a_joint() -> None:
    """Two cameras agree on a wrist half a metre away, two on the right one."""

    def mislead(k: int, seen: dict[str, list[PersonInView]]) -> None:
        for name in ("cam2", "cam4") if k >= 12 else ():
            seen[name][0].joints[WRIST] = CAMERAS[name].project(truth(k)[WRIST] + np.array([0.3, 0.3, 0.25]))[0]

    errors = [np.linalg.norm(person.joints[WRIST] - joints[WRIST]) for person, joints in follow(mislead)]
    assert max(errors) < 0.03


def test_a_joint_that_jumps_away_from_its_body_is_not_sure() -> None:
    """All cameras that know it put it 60 cm away, as if the shank had grown: nobody can tell, but it is doubted."""

    def jump(k: int, seen: dict[str, list[PersonInView]]) -> None:
        for name in CAMERAS if k == 20 else ():
            seen[name][0].joints[ANKLE] = CAMERAS[name].project(truth(k)[ANKLE] + np.array([0.4, 0.3, 0.3]))[0]

    results = follow(jump)
    assert results[19][0].confidence[ANKLE] > 0.7
    assert results[20][0].confidence[ANKLE] < 0.2
    # The arms of these stick people are not rigid, and the knee is the ankle's neighbour.
    others = [k for k, name in enumerate(NAMES) if k not in (ANKLE, ANKLE - 2) and name[-5:] not in ("elbow", "wrist")]
    assert np.abs(results[20][0].confidence[others] - results[19][0].confidence[others]).max() < 0.1


def test_joints_behind_somebody_else_count_less() -> None:
    camera = CAMERAS["cam1"]
    away = camera.centre[:2] / np.linalg.norm(camera.centre[:2])
    behind, before = walker((0.0, 0.0), 0.0, 0.0), walker(1.5 * away, 0.0, 0.0)
    view = CalibratedView.of(PersonInView("a1", camera.project(behind)[0], np.full(len(NAMES), 0.8)), camera, 0.1)
    bones = find_bones(NAMES)
    hidden = doubt_hidden_joints(view, behind, [before], bones).weight < 0.8
    # Which they are, from the depth of a thousand points of the other's limbs in this image.
    share = np.linspace(0, 1, 80)[:, None, None]
    first, second = np.array(bones).T
    limbs = (before[first] + share * (before[second] - before[first])).reshape(-1, 3)
    pixels, depth = camera.project(limbs)
    own, own_depth = camera.project(behind)
    reach = 0.12 * camera.focal / depth
    near = (np.linalg.norm(pixels - own[:, None], axis=2) < reach) & (depth < own_depth[:, None])
    assert hidden.sum() >= 2 and np.count_nonzero(hidden != near.any(axis=1)) <= 1
    alone = doubt_hidden_joints(view, before, [behind], bones)
    assert alone is view  # who stands in front is hidden by nobody
