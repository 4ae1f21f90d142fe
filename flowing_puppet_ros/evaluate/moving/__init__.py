# SPDX-License-Identifier: Apache-2.0
"""Bodies from a sensor that drives, turns, nods, hangs upside down, or whose colour and depth do not fit together.

A synthetic room goes in as messages to the body fitter; errors in the world, ids and velocities come out. Read
`robot_view` first, then `fitter_run`.
"""
