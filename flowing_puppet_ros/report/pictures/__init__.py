# SPDX-License-Identifier: Apache-2.0
"""What a report shows of a recording: images with puppets and bodies drawn over them, and meshes in 3D.

Bags of a replay come in; pictures and meshes, small enough for one page, go out. Read `bag_pictures` first.
"""
