# SPDX-License-Identifier: Apache-2.0
"""The components that nodes and replay run: optical flow, puppet tracker, visual hull, body fitter.

Messages come in on named ports and messages to publish go out; the algorithms are elsewhere. Read `optical_flow`
first, the smallest, and `registry` for the list.
"""
