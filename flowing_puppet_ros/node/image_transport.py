# SPDX-License-Identifier: Apache-2.0
"""Which transport of an image is subscribed to: one at a time, so that nobody encodes images for nothing."""

from __future__ import annotations

AUTO, RAW, COMPRESSED = "auto", "raw", "compressed"
CHECK_INTERVAL_S = 0.25
"""Seconds between two looks at who publishes."""


class TransportChoice:
    """The transport of one image, raw or compressed, by what is published.

    `setting` is AUTO, RAW or COMPRESSED. With AUTO the choice stays while somebody publishes what was chosen. When
    nobody does, raw images come first, then compressed ones. Publishers are discovered one after the other: a change
    needs two updates in a row.
    """

    def __init__(self, setting: str = AUTO) -> None:
        """Start with raw images, unless the setting says otherwise."""
        self.chosen = COMPRESSED if setting == COMPRESSED else RAW
        self.setting = setting
        self._used = False
        self._wanted = self.chosen

    def update(self, raw: int, compressed: int) -> str:
        """Return the transport to subscribe to, given the numbers of `raw` and `compressed` publishers."""
        if self.setting != AUTO:
            self.chosen = self.setting
            return self.chosen
        publishers = {RAW: raw, COMPRESSED: compressed}
        before, self._wanted = self._wanted, self._find_wanted(publishers)
        if before == self._wanted:
            self.chosen = self._wanted
        self._used = self._wanted == self.chosen and publishers[self.chosen] > 0
        return self.chosen

    def _find_wanted(self, publishers: dict[str, int]) -> str:
        if self._used and publishers[self.chosen]:
            return self.chosen
        return next((transport for transport in (RAW, COMPRESSED) if publishers[transport]), self.chosen)
