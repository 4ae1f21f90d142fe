# SPDX-License-Identifier: Apache-2.0
"""The annotation tool: people pose puppets on images in the browser (thesis, single images, section 3).

A folder of images comes in; an annotations.json of puppets goes out. Read `server` first; `page/` is what the browser
runs.
"""
