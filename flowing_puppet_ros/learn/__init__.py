# SPDX-License-Identifier: Apache-2.0
"""Where a puppet comes from: bodies of a 3D model become Deformable Structures and Stitched Puppets."""
