# SPDX-License-Identifier: Apache-2.0
"""Bodies in point clouds, by the second data path: cloud, person clouds, fit or warm-started track, bodies.

Points (N,3) in metres come in; a posed and shaped body with its mesh goes out, for every person. Read `fit.fitter`
first: one cloud to one body; then `track.scene_tracker`: a stream of clouds to bodies with ids.
"""
