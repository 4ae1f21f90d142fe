# SPDX-License-Identifier: Apache-2.0
"""The people in the cloud of a scene: floor and walls removed, clusters found and scored.

The points (N, 3) of a scene in metres come in; the clouds of single people go out. Read `people` first.
"""
