# SPDX-License-Identifier: Apache-2.0
"""Definitions of standard messages, as they stand behind those that use them in a file."""

HEADER = """================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
