# SPDX-License-Identifier: Apache-2.0
"""Bodies of capsule men, whose surfaces owe nothing to the body model, from depth and joints with noise."""

from dataclasses import replace

import numpy as np
import pytest
from capsule_man import joints_of  # type: ignore[import-not-found]
from watched_people import (  # type: ignore[import-not-found]
    Standing,
    Watched,
    find_puppet,
    make_colour_camera,
    stand_at,
    watch,
)

from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter
from flowing_puppet_ros.body.settings import FitterSettings
from flowing_puppet_ros.fusion.people_fitter import FusionSettings, PeopleFitter
from flowing_puppet_ros.image.person_mask import PersonMask
from flowing_puppet_ros.model.sp import StitchedPuppet

pytestmark = pytest.mark.slow

COMPARED = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")


@pytest.fixture(scope="module")
def people(model: StitchedPuppet) -> PeopleFitter:
    return PeopleFitter(BodyFitter(model, FitterSettings()), FusionSettings())


def errors(model: StitchedPuppet, fit: BodyFit, person: Standing) -> np.ndarray:
    """Return the distances (12,) m of the limbs' joints from the capsule man's."""
    names = [f"{side}_{name}" for side in ("left", "right") for name in COMPARED]
    fitted = fit.joints[[model.joint_names.index(name) for name in names]]
    return np.linalg.norm(fitted - np.array([person.joints[name] for name in names]), axis=1)


@pytest.mark.parametrize("beside", [0.0, 0.06])
def test_two_people_side_by_side_get_their_own_points_and_bodies(
    model: StitchedPuppet, people: PeopleFitter, beside: float
) -> None:
    """One faces the camera, the other one does not; a colour camera of twice the resolution is at or beside it."""
    pair = [stand_at(joints_of(), 2.5, 0.35), stand_at(joints_of(0.2, 0.2, 0.2), 2.4, -0.3, turn=0.0)]
    seen, camera = watch(pair), make_colour_camera(beside)
    puppets = [find_puppet(model, person, camera, f"a{k}", 5.0, k) for k, person in enumerate(pair)]
    cloud = seen.seen_by(camera)
    claims, _ = people.claim(cloud, puppets, people.find_clear(cloud.points)[0])
    for number, claim in enumerate(claims):
        assert (seen.owner[claim.own] == number).mean() > 0.95
        assert claim.own[seen.owner == number].mean() > 0.95
    fits = dict(people.fit_people(cloud, puppets, seen.image))
    assert list(fits) == ["a0", "a1"]
    for number, person in enumerate(pair):
        error = errors(model, fits[f"a{number}"], person)
        assert error.mean() < 0.035
        assert error.max() < 0.09


def test_an_arm_that_points_at_the_camera_is_where_its_depth_is(model: StitchedPuppet, people: PeopleFitter) -> None:
    joints = joints_of()
    joints["right_elbow"] = joints["right_shoulder"] + np.array([0.12, -0.04, -0.24])
    joints["right_wrist"] = joints["right_elbow"] + np.array([0.25, 0.02, 0.04])
    joints["right_hand"] = joints["right_wrist"] + np.array([0.12, 0.01, 0.02])
    person = stand_at(joints, 2.2)
    seen, camera = watch([person]), make_colour_camera()
    ((_, fit),) = people.fit_people(seen.seen_by(camera), [find_puppet(model, person, camera, "a1", 3.0)], seen.image)
    wrist = fit.joints[model.joint_names.index("right_wrist")]
    assert np.linalg.norm(wrist - person.joints["right_wrist"]) < 0.09


@pytest.mark.parametrize("kinds", [("knee", "ankle"), ("elbow", "wrist")])
def test_limbs_that_a_network_takes_for_the_other_sides_are_exchanged(
    model: StitchedPuppet, people: PeopleFitter, kinds: tuple[str, ...]
) -> None:
    person = stand_at(joints_of(0.2, 0.2, 0.2), 2.4)
    seen, camera = watch([person]), make_colour_camera()
    puppet = find_puppet(model, person, camera, "a1", 3.0)
    left, right = ([model.joint_names.index(f"{side}_{kind}") for kind in kinds] for side in ("left", "right"))
    pixels = puppet.pixels.copy()
    pixels[left], pixels[right] = puppet.pixels[right], puppet.pixels[left]
    ((_, fit),) = people.fit_people(seen.seen_by(camera), [replace(puppet, pixels=pixels)], seen.image)
    error = errors(model, fit, person)
    assert error.mean() < 0.035
    assert error.max() < 0.09


@pytest.mark.parametrize(("low", "high"), [(-1.1, 0.0), (-0.05, 0.45)])
def test_trousers_or_a_shirt_without_depth_do_not_bend_the_body(
    model: StitchedPuppet, people: PeopleFitter, low: float, high: float
) -> None:
    """Black cloth gives no depth; the wall around it has some. `low` and `high` m are its ends above the camera."""
    person = stand_at(joints_of(), 2.4)
    seen, camera = watch([person]), make_colour_camera()
    row, column = np.nonzero(np.isfinite(seen.depth))
    black = (seen.owner == 0) & (seen.points[:, 2] > low) & (seen.points[:, 2] < high)
    depth = seen.depth.copy()
    depth[row[black], column[black]] = np.nan
    dark = Watched(depth, seen.people, seen.owner[~black])
    ((_, fit),) = people.fit_people(dark.seen_by(camera), [find_puppet(model, person, camera, "a1", 3.0)], dark.image)
    error = errors(model, fit, person)
    assert error.mean() < 0.07
    assert error.max() < 0.2


def test_the_result_does_not_depend_on_threads_and_nobody_is_where_no_points_are(
    model: StitchedPuppet, people: PeopleFitter
) -> None:
    person = stand_at(joints_of(), 2.4)
    seen, camera = watch([person]), make_colour_camera()
    puppet = find_puppet(model, person, camera, "a1", 5.0)
    nobody = find_puppet(model, stand_at(joints_of(), 2.4, 1.2), camera, "a2")
    cloud, found = seen.seen_by(camera), []
    for threads in (1, 2):
        people.threads = threads
        found.append(people.fit_people(cloud, [puppet, nobody], seen.image))
    assert [name for name, _ in found[0]] == ["a1"]
    assert found[0][0][1].vertices.tobytes() == found[1][0][1].vertices.tobytes()


def test_a_board_that_touches_the_legs_is_not_the_persons_where_a_mask_tells(
    model: StitchedPuppet, people: PeopleFitter
) -> None:
    person = stand_at(joints_of(), 2.4)
    knee = person.joints["left_knee"]
    across, up = np.meshgrid(np.linspace(-0.2, -0.06, 60), np.linspace(-0.5, 0.25, 300))
    board = Standing({}, knee + np.column_stack([np.zeros(across.size), across.ravel(), up.ravel()]))
    seen, camera = watch([person, board]), make_colour_camera()
    puppet = find_puppet(model, person, camera, "a1", 3.0)
    cloud = seen.seen_by(camera)
    shown = np.zeros(seen.depth.shape, dtype=np.uint8)
    shown[np.isfinite(seen.depth)] = np.where(seen.owner == 0, 255, 0)
    clear = people.find_clear(cloud.points)[0]
    taken = {}
    for mask in (None, PersonMask.of_grid(shown, camera.size)):
        ((claim,), _) = people.claim(cloud, [replace(puppet, mask=mask)], clear)
        assert claim.own[seen.owner == 0].mean() > 0.95
        taken[mask is None] = int((claim.own & (seen.owner == 1)).sum())
    assert taken[True] > 100
    assert taken[False] < 0.2 * taken[True]


def test_no_puppets_and_no_planes_are_no_error(model: StitchedPuppet, people: PeopleFitter) -> None:
    seen, camera = watch([stand_at(joints_of(), 2.4)]), make_colour_camera()
    assert people.fit_people(seen.seen_by(camera), [], seen.image) == []
