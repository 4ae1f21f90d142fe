# SPDX-License-Identifier: Apache-2.0
"""Colour with depth: a calibrated camera that finds puppets, and a cloud of what it looks at.

In: a cloud of any sensor (points in metres, z up), a camera that projects them, and the puppets in its image. Out: a
body for each puppet, under its id. Start with `people_fitter`.
"""
