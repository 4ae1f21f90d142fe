# SPDX-License-Identifier: Apache-2.0
"""Deformable Structures, the 2D puppet, seen from the front or in nine views (Eqs. 1-14, 23-30, 38-43).

Joints or part parameters come in; part contours, energies and label images go out. Read `puppet` first.
"""
