# SPDX-License-Identifier: Apache-2.0
"""The detector of people learned from annotated images: filters, springs, trees, calibration.

Annotated images come in; the weights of `image.detector` go out. Read `training` first; `command` is the verb.
"""
