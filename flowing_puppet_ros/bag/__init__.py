# SPDX-License-Identifier: Apache-2.0
"""MCAP and rosbag2 bags in and out, and the replay of the stream components over them.

A recording comes in; a bag with what the nodes would have published goes out. Read `replay` first, then `graph`, which
finds the components that run on the topics.
"""
