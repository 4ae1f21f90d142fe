# SPDX-License-Identifier: Apache-2.0
"""Calibrations of several cameras, from and to the files of other programs.

A file or folder of Pose2Sim, Anipose, Caliscope, EasyMocap, OpenCV, Qualisys, ROS or COLMAP comes in, a `CameraRig` in
metres goes out, and back. Read `rig` first, then `files`, which tells the forms apart.
"""
