# SPDX-License-Identifier: Apache-2.0
"""One cloud to one body: hypotheses, search, refinement, and how far the result can be trusted.

The points (N, 3) of one person in metres, z up, come in; a `BodyFit` with pose, shape, mesh, joints and confidences
goes out. Read `fitter` first, then `hypotheses`.
"""
