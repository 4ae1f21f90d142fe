# SPDX-License-Identifier: Apache-2.0
"""Units that several modules convert between."""

NANOSECONDS = 1_000_000_000
"""Nanoseconds in a second."""
