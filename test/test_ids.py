# SPDX-License-Identifier: Apache-2.0
"""Ids on topics: five letters, the same in every run, never shared by people of a node, hardly ever between nodes."""

import re

from flowing_puppet_ros.ids import make_public_id

NODES = [f"{space}/{name}" for space in ("", "/cam01", "/cam02") for name in ("puppet_tracker", "body_fitter")]


def test_people_of_a_node_never_share_an_id() -> None:
    ids = [make_public_id("/body_fitter", f"b{number}") for number in range(1, 20_001)]
    assert len(set(ids)) == len(ids)
    assert all(re.fullmatch("[a-z]{5}", identity) for identity in ids)


def test_nodes_and_seeds_have_ids_of_their_own_that_stay() -> None:
    spaces = [(node, letters) for node in NODES for letters in ("a", "b", "bc")]
    ids = {make_public_id(node, f"{letters}{number}") for node, letters in spaces for number in range(1, 51)}
    assert len(ids) == 50 * len(spaces)
    # The same on every machine and in every version, so that recordings and notes keep their meaning.
    assert [make_public_id("/body_fitter", "b1"), make_public_id("/cam01/puppet_tracker", "a12")] == ["ezuxg", "fhlqv"]
