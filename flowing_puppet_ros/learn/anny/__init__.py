# SPDX-License-Identifier: Apache-2.0
"""The 3D body that puppets are learned from: Anny's shapes in poses of motion capture.

Seeds and motion-capture files come in; posed bodies with the part of every vertex go out. Read `body` first.
"""
