# SPDX-License-Identifier: Apache-2.0
"""Pictures of images, puppets, flow and meshes: what nodes, commands and the report show.

Arrays come in; RGB images (H, W, 3), videos and plots go out. Read `overlay` first.
"""
