# SPDX-License-Identifier: Apache-2.0
"""Scan files in and out, their unit and axes, and the map from scan to scan through two fits.

A file comes in; points, faces and normals in metres with z up go out, and the way back into the file's own frame. Read
`scan` first.
"""
