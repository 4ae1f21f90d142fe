# SPDX-License-Identifier: Apache-2.0
"""What is tracked is shown once scans agree that it is a person, and forgotten once they agree that it is none."""

import numpy as np

from flowing_puppet_ros.body.track.person_belief import PersonBelief, measure_wander

TENTH = 100_000_000


def tell(belief: PersonBelief, *probabilities: float, points: int = 60) -> list[bool]:
    """Ask scans 0.1 s apart, and return after each whether it is taken for a person."""
    shown = []
    for probability in probabilities:
        belief.add(probability, 0.5, belief.asked + TENTH, points)
        shown.append(belief.decide())
    return shown


def test_a_sure_scan_is_enough_and_a_doubtful_one_is_not() -> None:
    assert tell(PersonBelief(np.zeros(2)), 0.95) == [True]
    assert tell(PersonBelief(np.zeros(2)), 0.7, 0.7) == [False, True]
    assert not any(tell(PersonBelief(np.zeros(2)), *[0.4] * 10))


def test_many_points_have_to_show_more_unless_they_move() -> None:
    assert tell(PersonBelief(np.zeros(2)), 0.95, points=600) == [True]
    assert not any(tell(PersonBelief(np.zeros(2)), 0.85, 0.7, 0.7, points=600))
    walking = PersonBelief(np.zeros(2))
    walking.visit(np.array([[0.6, 0.0, 1.0]]), 0)
    assert tell(walking, 0.7, 0.7, points=600) == [False, True]


def test_what_moved_needs_less_and_the_noise_of_a_place_is_no_motion() -> None:
    belief = PersonBelief(np.zeros(2))
    belief.visit(np.array([[0.2, -0.2, 1.0]]), 0)
    assert not any(tell(belief, 0.4, 0.4, 0.4))
    belief.visit(np.array([[0.4, 0.4, 1.0]]), 0)
    assert tell(belief, 0.4) == [True]


def test_who_was_shown_stays_through_doubtful_scans_and_not_through_many_bad_ones() -> None:
    belief = PersonBelief(np.zeros(2))
    assert all(tell(belief, 0.95, 0.95, 0.4, 0.4, 0.4))
    assert not belief.is_hopeless
    assert not tell(belief, *[0.03] * 20)[-1]
    assert belief.is_hopeless


def test_later_scans_are_asked_once_a_second() -> None:
    belief = PersonBelief(np.zeros(2))
    tell(belief, *[0.9] * 8)
    assert not belief.is_due(belief.asked + 5 * TENTH)
    assert belief.is_due(belief.asked + 10 * TENTH)


def stand(belief: PersonBelief, sway: float, probability: float, step: int = TENTH) -> list[bool]:
    """Show 40 points with noise of 2 cm in 60 scans, of something that sways in 4 s; ask ten of them."""
    rng, shown = np.random.default_rng(5), []
    for scan in range(60):
        middle = np.array([4.0, 1.0 + sway * np.sin(2 * np.pi * scan / 40), 0.0])
        belief.visit(middle + 0.02 * rng.standard_normal((40, 3)), scan * step)
        if scan % 6 == 0:
            belief.add(probability, 0.5, scan * step, 60)
        shown.append(belief.decide())
    return shown


def test_what_never_sways_has_to_look_more_like_a_person() -> None:
    post, person, sure = (PersonBelief(np.array([4.0, 1.0])) for _ in range(3))
    shown = stand(post, 0.0, 0.85)
    assert all(shown[:29]) and not any(shown[29:]) and not post.is_hopeless
    assert all(stand(person, 0.02, 0.85))
    assert all(stand(sure, 0.0, 0.95))


def test_scans_that_are_far_apart_do_not_show_whether_something_sways() -> None:
    assert all(stand(PersonBelief(np.array([4.0, 1.0])), 0.0, 0.85, step=5 * TENTH))


def test_noise_has_a_ratio_of_one_and_a_slow_motion_a_larger_one() -> None:
    rng = np.random.default_rng(2)
    assert abs(measure_wander(0.01 * rng.standard_normal((4000, 3))) - 1) < 0.05
    # A sine has the variance 1 / 2, and steps of 2 sin(d / 2) cos: half their mean square is sin(d / 2) ** 2.
    phase = 2 * np.pi * np.arange(4000) / 40
    expected = 0.5 / np.sin(np.pi / 40) ** 2
    assert abs(measure_wander(np.column_stack([np.sin(phase)] * 3)) / expected - 1) < 0.01


def test_several_scans_decide_which_way_somebody_faces_and_turn_once() -> None:
    belief = PersonBelief(np.zeros(2))
    turned = []
    for preference in (0.004, -0.001, 0.003, -0.002):
        assert belief.asks_facing(60) and not belief.asks_facing(600)
        belief.add(0.9, 0.5, belief.asked + TENTH, 60)
        turned.append(belief.turns(preference))
    assert turned == [False, False, False, True]
    assert not belief.asks_facing(60)
    walking = PersonBelief(np.zeros(2))
    walking.visit(np.array([[0.6, 0.0, 1.0]]), 0)  # a walk shows it
    assert not walking.asks_facing(60)


def test_nothing_has_moved_against_a_sensor_that_moves() -> None:
    belief, moved = PersonBelief(np.zeros(2)), []
    for step, sensor_moves in enumerate((False, True, False)):
        belief.visit(np.array([[0.6 + 0.3 * step, 0.0, 1.0]]), 100_000_000 * step, sensor_moves)
        moved.append(belief.moved)
    assert moved == [True, False, False]
