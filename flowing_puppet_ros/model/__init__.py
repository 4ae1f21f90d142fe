# SPDX-License-Identifier: Apache-2.0
"""What a puppet is: part trees, Gaussian algebra, Deformable Structures (2D) and the Stitched Puppet (3D)."""
