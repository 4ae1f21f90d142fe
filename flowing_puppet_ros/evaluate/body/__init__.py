# SPDX-License-Identifier: Apache-2.0
"""Fits of scans against the ground truth: synthetic people with known vertices, and correspondence between scans.

Fits and true vertices come in; errors in metres go out. Read `bodies` first, then `synthetic_scans`.
"""
