# SPDX-License-Identifier: Apache-2.0
"""The puppet of nine views: what rotates with the torso, what stays, and how well joints determine the view."""

import numpy as np
import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.model import weights
from flowing_puppet_ros.model.ds.multiview import VIEW_HEADINGS, VIEW_NAMES, MultiViewStructures
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.render import depth_order
from flowing_puppet_ros.model.tree import mirrored_name

MODELS = [(gender, parts) for gender in ("neutral", "female", "male") for parts in (10, 14)]


@pytest.fixture(scope="module", params=MODELS, ids=lambda pair: f"{pair[0]}-{pair[1]}")
def sides(request: pytest.FixtureRequest) -> MultiViewStructures:
    return MultiViewStructures.load(*request.param)


@pytest.fixture(scope="module")
def neutral() -> MultiViewStructures:
    return MultiViewStructures.load()


def shoulder_width(model: DeformableStructures) -> float:
    """Signed: positive when the person's left shoulder is on the right of the image."""
    joints = model.likely_puppet().joints
    return float(
        joints[model.joint_names.index("left_shoulder"), 0] - joints[model.joint_names.index("right_shoulder"), 0]
    )


def test_views_are_named_from_west_to_east(sides: MultiViewStructures) -> None:
    assert len(sides.views) == len(VIEW_NAMES) == len(VIEW_HEADINGS) == 9
    assert sides.at("W") is sides.views[0] and sides.at("S") is sides.views[4]
    assert sides.prior.sum() == pytest.approx(1)
    with pytest.raises(InputError, match="choose one of W, WSW"):
        sides.at("N")


def test_shoulders_are_widest_to_the_camera_and_narrow_to_both_sides(sides: MultiViewStructures) -> None:
    widths = np.array([shoulder_width(view) for view in sides.views])
    assert (np.diff(widths[:5]) > 0).all() and (np.diff(widths[4:]) < 0).all()
    assert widths[4] > 0.25 and np.abs(widths[[0, 8]]).max() < 0.06
    np.testing.assert_allclose(widths, widths[::-1], atol=0.01)


def test_feet_point_where_the_torso_faces(sides: MultiViewStructures) -> None:
    """Only the torso knows the view: upper and lower legs carry it down to the feet."""
    reach = []
    for view in sides.views:
        puppet = view.likely_puppet()
        toes = 0.0
        for side in ("left", "right"):
            ankle = puppet.joints[view.joint_names.index(f"{side}_ankle"), 0]
            part = view.tree.index(f"{side}_foot" if len(view.tree) == 14 else f"{side}_lower_leg")
            x = puppet.contours[part][:, 0] - ankle
            toes += (x.max() + x.min()) / 2
        reach.append(toes)
    assert max(reach[:2]) < -0.05 and min(reach[-2:]) > 0.05
    assert (np.diff(reach) > -0.02).all()


def test_west_is_east_in_the_mirror(neutral: MultiViewStructures) -> None:
    for first, second in zip(neutral.views, neutral.views[::-1], strict=True):
        a, b = first.likely_puppet().joints, second.likely_puppet().joints * [-1, 1]
        order = [first.joint_names.index(mirrored_name(name)) for name in first.joint_names]
        assert np.linalg.norm(a - b[order], axis=1).max() < 0.12


def test_limbs_are_the_same_in_every_view(sides: MultiViewStructures) -> None:
    tree = sides.views[0].tree
    for view in sides.views[1:]:
        for part in range(1, len(tree)):
            assert view.shapes[part] is sides.views[0].shapes[part]
            if tree.parents[part] != 0:
                assert view.pairwise[part - 1] is sides.views[0].pairwise[part - 1]
            else:
                assert not np.array_equal(view.pairwise[part - 1].mean, sides.views[0].pairwise[part - 1].mean)


@pytest.mark.slow
def test_joints_of_another_model_determine_the_view(neutral: MultiViewStructures) -> None:
    """Puppets of the male model, evaluated by the neutral one: the view is right or the next one."""
    other, rng = MultiViewStructures.load("male"), np.random.default_rng(0)
    misses, certain = [], []
    for index, name in enumerate(VIEW_NAMES):
        for _ in range(12):
            joints = other.sample(rng, name).joints * 140 + [200, 80]
            posterior = neutral.posterior(joints, np.ones(len(joints)))
            assert posterior.sum() == pytest.approx(1)
            misses.append(abs(int(posterior.argmax()) - index))
            certain.append(posterior[max(0, index - 1) : index + 2].sum())
    assert np.mean(np.array(misses) <= 1) > 0.9 and np.mean(certain) > 0.8


def test_view_needs_neither_place_nor_all_joints(neutral: MultiViewStructures) -> None:
    joints = neutral.sample(np.random.default_rng(5), "E").joints * 100
    sure = np.ones(len(joints))
    whole = neutral.posterior(joints, sure)
    np.testing.assert_allclose(neutral.posterior(joints + np.array([500, -30]), sure), whole, atol=1e-6)
    seen = sure.copy()
    seen[
        [neutral.views[0].joint_names.index(f"{side}_{j}") for side in ("left", "right") for j in ("knee", "ankle")]
    ] = 0
    hidden = np.where(seen[:, None] > 0, joints, np.nan)
    np.testing.assert_allclose(neutral.posterior(hidden, sure), neutral.posterior(joints, seen), atol=1e-9)
    assert neutral.posterior(joints, seen)[6:].sum() > 0.5
    with pytest.raises(InputError, match="at least two"):
        neutral.posterior(np.full_like(joints, np.nan), sure)


def test_samples_follow_the_mixture(neutral: MultiViewStructures) -> None:
    rng = np.random.default_rng(1)
    widths = np.array([np.ptp(neutral.sample(rng).contours[0][:, 0]) for _ in range(60)])
    assert np.ptp(widths) > 0.1, "torsos of all sides are drawn"


def test_far_limbs_lie_behind_the_torso(neutral: MultiViewStructures) -> None:
    model = neutral.at("E")
    order = [model.tree.names[part] for part in depth_order(model, "front", VIEW_HEADINGS[-1])]
    torso = order.index("torso")
    assert all((order.index(name) < torso) for name in order if name.startswith("left_"))
    assert order.index("right_upper_arm") > torso
    assert depth_order(model, "front", 0.1) == depth_order(model)


def test_files_hold_what_was_learned() -> None:
    arrays = weights.load("ds", "neutral-10-views")
    again = MultiViewStructures.from_arrays("neutral", 10, arrays)
    np.testing.assert_array_equal(again.views[3].mean_joints(), MultiViewStructures.load().views[3].mean_joints())
    assert again.name == "neutral-10-views"
