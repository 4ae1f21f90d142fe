# SPDX-License-Identifier: Apache-2.0
"""The detector of people that needs no network: HOG filters, a tree of parts, boosted trees.

One image (H,W,3) comes in; the people in it go out, each with candidate places and whole-body pose hypotheses. Read
`part_detector` first.
"""
