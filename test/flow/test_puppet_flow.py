# SPDX-License-Identifier: Apache-2.0
"""The puppet flow field, how much it explains, and hidden parts."""

import numpy as np

from flowing_puppet_ros.flow.puppet_flow import explained_fraction, fit_part_motions, fit_puppet_flow, motion_field


def layered() -> tuple[np.ndarray, np.ndarray]:
    """Labels of two parts and a flow: the first moves right, the second down, the background up a little."""
    labels = np.zeros((60, 90), np.uint8)
    labels[10:30, 10:40], labels[30:55, 45:80] = 1, 3
    flow = np.zeros((60, 90, 2), np.float32)
    flow[..., 1] = -0.5
    flow[labels == 1], flow[labels == 3] = (4, 0), (0, 7)
    return labels, flow


def test_field_follows_the_layers_and_explains_them() -> None:
    labels, flow = layered()
    result = fit_puppet_flow(labels, flow)
    np.testing.assert_allclose(result.field, flow, atol=0.05)
    np.testing.assert_allclose(result.background, np.array([[1, 0, 0], [0, 1, -0.5]]), atol=1e-3)
    assert result.affine.shape == (3, 2, 3)
    assert result.explained == 1.0


def test_explained_counts_the_pixels_under_parts_alone() -> None:
    labels, flow = layered()
    field = flow.copy()
    field[labels == 0] += 50
    field[10:20, 10:40] += 3  # half of the 600 pixels of part 1, none of the 875 of part 3
    assert explained_fraction(labels, field, flow) == (300 + 875) / (600 + 875)
    flow[labels == 3] = np.nan
    assert explained_fraction(labels, field, flow) == 0.5
    assert explained_fraction(np.zeros_like(labels), field, flow) == 0.0


def test_a_hidden_part_moves_with_its_neighbours_and_a_hidden_person_with_the_background() -> None:
    labels, flow = layered()
    motions, background = fit_part_motions(labels, (-1, 0, 1, -1, 3), flow)
    np.testing.assert_allclose(motions.affine[1], (motions.affine[0] + motions.affine[2]) / 2)
    np.testing.assert_array_equal(motions.affine[3:], [background, background])
    assert motions.known.tolist() == [True, False, True, False, False]


def test_hidden_chain_takes_the_motion_of_the_nearest_visible_part() -> None:
    labels, flow = layered()
    motions, _ = fit_part_motions(np.where(labels == 1, 1, 0).astype(np.uint8), (-1, 0, 1, 2), flow)
    np.testing.assert_array_equal(motions.affine[1:], np.repeat(motions.affine[:1], 3, axis=0))


def test_motion_field_paints_each_label_with_its_motion() -> None:
    labels = np.array([[0, 1], [2, 0]], np.uint8)
    shift = np.array([np.eye(2, 3)] * 2)
    shift[0, :, 2], shift[1, 0, 0] = (3, 4), 2.0
    field = motion_field(labels, shift, np.eye(2, 3))
    np.testing.assert_array_equal(field, [[[0, 0], [3, 4]], [[0, 0], [0, 0]]])
