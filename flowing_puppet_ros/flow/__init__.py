# SPDX-License-Identifier: Apache-2.0
"""Dense optical flow, robust affine motion per part, and the puppet flow."""
