# SPDX-License-Identifier: Apache-2.0
"""Silhouettes with depth: calibrated cameras that show people's outlines, and depth sensors around the same people.

In: what one or more depth sensors saw at one time, and the masks and triangulated joints of everybody whom two cameras
show. Out: a body for each, fitted to all of them at once, under their ids. Start with `rig_people`.
"""
