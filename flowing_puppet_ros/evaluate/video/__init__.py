# SPDX-License-Identifier: Apache-2.0
"""Tracks of annotated clips against the truth: joints within distances, shake, calibration.

Clips and people come in; errors go out. Read `errors` first, then `methods`.
"""
