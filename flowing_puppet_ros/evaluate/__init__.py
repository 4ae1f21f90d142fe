# SPDX-License-Identifier: Apache-2.0
"""Measures: joint errors, threshold curves, surface distances."""
