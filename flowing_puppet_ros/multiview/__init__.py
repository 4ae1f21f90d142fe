# SPDX-License-Identifier: Apache-2.0
"""People in calibrated cameras, by the third data path: silhouettes, visual hull, joints, the same fit.

Images, part labels and puppets of calibrated cameras come in; silhouettes, a visual hull, triangulated joints and a
body finished on the silhouettes go out. Read `hull_builder` first, then `silhouette_fit`.
"""
