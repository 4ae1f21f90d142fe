# SPDX-License-Identifier: Apache-2.0
"""Fits of scans against the truth, on synthetic people of whom every vertex is known, and between scans.

Fits and true vertices come in; errors in metres go out. Read `bodies` first, then `synthetic_scans`.
"""
