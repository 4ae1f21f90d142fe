# SPDX-License-Identifier: Apache-2.0
"""Part trees: order, neighbours and mirroring."""

import pytest

from flowing_puppet_ros.model.tree import DS10_PARENTS, DS14_PARENTS, SP_PARENTS, PartTree, mirrored_name


@pytest.mark.parametrize(("parents", "count"), [(DS10_PARENTS, 10), (DS14_PARENTS, 14), (SP_PARENTS, 16)])
def test_every_body_is_one_tree_whose_mirror_maps_edges_to_edges(parents: dict[str, str | None], count: int) -> None:
    tree = PartTree.from_parents(parents)
    assert len(tree) == count
    assert len(tree.edges) == count - 1
    mirror = tree.mirror
    assert [mirror[mirror[node]] for node in range(count)] == list(range(count))
    assert {(mirror[parent], mirror[child]) for parent, child in tree.edges} == set(tree.edges)


def test_edge_number_is_child_minus_one() -> None:
    tree = PartTree.from_parents(SP_PARENTS)
    assert [child for _, child in tree.edges] == list(range(1, 16))


def test_neighbours_are_mutual() -> None:
    tree = PartTree.from_parents(DS14_PARENTS)
    for node in range(len(tree)):
        assert all(node in tree.neighbours(other) for other in tree.neighbours(node))


@pytest.mark.parametrize("parents", [(0,), (-1, 2, 1), (-1, -1), ()])
def test_a_graph_that_is_not_a_rooted_tree_is_refused(parents: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"part tree|come before"):
        PartTree(tuple("abc"[: len(parents)]), parents)


def test_mirrored_name() -> None:
    assert mirrored_name("left_hand") == "right_hand"
    assert mirrored_name("right_hip") == "left_hip"
    assert mirrored_name("torso") == "torso"
