# SPDX-License-Identifier: Apache-2.0
"""Identifiers of people that differ between runs with different seeds."""


def letters_of_seed(seed: int) -> str:
    """Return a seed as letters (0 a, 1 b, ..., 25 z, 26 aa), so that ids of runs with different seeds differ."""
    text = ""
    seed += 1
    while seed > 0:
        seed, digit = divmod(seed - 1, 26)
        text = chr(ord("a") + digit) + text
    return text
