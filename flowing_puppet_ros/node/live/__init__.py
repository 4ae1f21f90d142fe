# SPDX-License-Identifier: Apache-2.0
"""Listening to a running ROS graph without a node of this package.

A time comes in; the topics of the graph and their messages in that time go out, as a recording. Read `listener`.
"""
