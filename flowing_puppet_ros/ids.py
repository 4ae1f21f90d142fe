# SPDX-License-Identifier: Apache-2.0
"""Identifiers of people: within a run by number, between nodes by letters that follow from the node's name."""

import re
from hashlib import sha256

LETTERS = 5
"""Of the ids of people on topics, as the examples of REP-155 have them."""
_COUNT = 26**LETTERS


def letters_of_seed(seed: int) -> str:
    """Return a seed as letters (0 a, 1 b, ..., 25 z, 26 aa), so that ids of runs with different seeds differ."""
    text = ""
    seed += 1
    while seed > 0:
        seed, digit = divmod(seed - 1, 26)
        text = chr(ord("a") + digit) + text
    return text


def make_public_id(node: str, own: str) -> str:
    """Return the five letters by which a node publishes a person.

    They follow from the node's fully qualified name, so that they are the same in every run and those of two nodes
    differ, and no two people of a node share them: consecutive numbers are spread over all words by a linear
    congruence.

    Args:
        node: fully qualified name of the node.
        own: what the node itself calls the person: letters and a number.
    """
    letters, number = re.fullmatch(r"([a-z]+)([0-9]+)", own).groups()  # type: ignore[union-attr]
    digest = int.from_bytes(sha256(f"{node} {letters}".encode()).digest()[:16])
    # A factor without 2 and 13, which divide the number of words.
    factor = 26 * (digest // _COUNT % (_COUNT // 26)) + 1
    rest = (digest + factor * int(number)) % _COUNT
    text = ""
    for _ in range(LETTERS):
        rest, digit = divmod(rest, 26)
        text += chr(ord("a") + digit)
    return text


def id_sort_key(identity: str) -> tuple[int, str]:
    """Return the key that sorts b2 before b10."""
    return len(identity), identity
