# SPDX-License-Identifier: Apache-2.0
"""A stream of clouds to bodies that keep their ids: warm starts, and searches in the background.

Stamped clouds of a person or a scene come in; the bodies of each go out. Read `body_tracker` first (one person), then
`multi_body_tracker` and `scene_tracker`.
"""
