# SPDX-License-Identifier: Apache-2.0
"""Bags of ROS 2 and ROS 1 in, MCAP out, and the replay of the stream components over them.

A recording comes in; a bag with what the nodes would have published goes out. Read `replay` first, then `graph`, which
finds the components that run on the topics. `reader` opens recordings by means of `storage` (files) and
`foreign` (messages).
"""
