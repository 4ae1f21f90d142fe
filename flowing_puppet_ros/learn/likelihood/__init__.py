# SPDX-License-Identifier: Apache-2.0
"""The image likelihood of a puppet's parts learned from annotated images (Eqs. 20-22).

Annotated images come in; the weights of `evidence.image.likelihood` go out. Read `training` first; `command` is the
verb.
"""
