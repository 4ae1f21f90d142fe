# SPDX-License-Identifier: Apache-2.0
"""The person detector that needs no neural network: HOG filters, a tree of parts, boosted trees.

One image (H, W, 3) comes in; the people in it go out, each with joints, alternative poses and the score of any place.
Read `part_detector` first.
"""
