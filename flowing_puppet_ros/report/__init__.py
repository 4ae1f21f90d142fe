# SPDX-License-Identifier: Apache-2.0
"""Reports of a replayed bag: one HTML file, or a Rerun recording.

The input and the output bag of a replay come in; a file goes out. Read `report` first, then `data`.
"""
