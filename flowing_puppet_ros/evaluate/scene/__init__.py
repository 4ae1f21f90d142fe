# SPDX-License-Identifier: Apache-2.0
"""People found in the clouds of scenes against the ground truth: labelled scans, and synthetic scenes.

Scans, labels and found bodies come in; recall, ghosts and errors go out. Read `scene_score` first, then
`synthetic_scenes`.
"""
