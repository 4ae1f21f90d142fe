# SPDX-License-Identifier: Apache-2.0
"""What a puppet is: part trees, Gaussian algebra, Deformable Structures (2D, in `ds`) and the Stitched Puppet (3D).

Weights come in; models that sample, pose and score go out. Read `tree` first, then `ds.puppet` or `sp`.
"""
