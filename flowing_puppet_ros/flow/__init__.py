# SPDX-License-Identifier: Apache-2.0
"""Dense optical flow, robust affine motion per part, and the puppet flow.

Images (H, W, 3) in order come in; flow (H, W, 2) in pixels and the motion of a puppet's parts go out. Read
`puppet_flow` first.
"""
