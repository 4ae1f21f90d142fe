# SPDX-License-Identifier: Apache-2.0
"""Deformable Structures learned from projected bodies: contours, shape spaces, pairwise Gaussians.

Bodies of `learn.anny` come in; the weights of a 2D puppet go out. Read `fit` first, then `samples`; `command` is the
verb.
"""
