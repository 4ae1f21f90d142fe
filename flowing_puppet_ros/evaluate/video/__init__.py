# SPDX-License-Identifier: Apache-2.0
"""Tracks of annotated clips against the ground truth: joints within thresholds, jitter, calibration.

Clips and people come in; errors go out. Read `errors` first, then `methods`.
"""
