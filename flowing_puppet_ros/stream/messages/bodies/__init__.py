# SPDX-License-Identifier: Apache-2.0
"""Bodies as messages: markers and meshes for viewers, silhouettes of the cameras, the skeleton of REP-155.

Fitted bodies, masks and cameras come in and messages or their values go out; nothing here keeps state. Read `shapes`
first.
"""
