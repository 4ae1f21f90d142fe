# SPDX-License-Identifier: Apache-2.0
"""The annotation tool: people pose puppets on images in the browser (thesis, single images, section 3)."""
