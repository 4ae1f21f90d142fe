# SPDX-License-Identifier: Apache-2.0
"""Calibration from people: extrinsics, clock offsets and intrinsics from the joints of those who walk about.

Tracks of people in images and an approximate rig come in, a rig that agrees with them goes out. Read `calibrate` first.
"""
