# SPDX-License-Identifier: Apache-2.0
"""Bags of ROS 2 and ROS 1 in, MCAP out.

A recording comes in and its messages go out, or messages come in and a bag goes out. `reader` opens recordings by means
of `storage` (files) and `foreign` (messages); `replay` runs the stream components over one.
"""
