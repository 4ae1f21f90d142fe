# SPDX-License-Identifier: Apache-2.0
"""People in calibrated cameras, the third data path: silhouettes, visual hull, joints, the same fit.

Images, part labels and puppets of calibrated cameras come in; silhouettes, a visual hull, triangulated joints and a
body fitted to the silhouettes go out. Read `hull_builder` first, then `silhouette_fit`.
"""
