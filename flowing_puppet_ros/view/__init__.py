# SPDX-License-Identifier: Apache-2.0
"""Pictures: overlays, flow colours, mesh renderings and the HTML report."""
